"""Traces the outlines of tools in photos, as drawings in mm and as tools (`hkd trace`).

1. An object of known size gives the plane that the tools lie on (`sheet_plane`, `scales`).
2. The photo is rectified (`plane_view`).
3. Tools are separated from the ground and from shadows (`tool_mask`).
4. Their border is found to a fraction of a pixel (`silhouettes`).
5. The silhouettes of one or several photos are corrected for the tool's height (`photo_views`).
"""

import math
import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from manifold3d import CrossSection
from numpy.typing import NDArray

from kitting_drake.common.errors import UserError
from kitting_drake.common.extras import import_extra
from kitting_drake.common.files import require_folder, write_atomically, write_json
from kitting_drake.hkd.tracing.doubts import Corrections, doubts_of, read_corrections
from kitting_drake.hkd.tracing.photo_file import Photo, read_photo
from kitting_drake.hkd.tracing.photo_views import (
    PhotoView,
    aligned,
    height_in_views,
    outlines_in_views,
)
from kitting_drake.hkd.tracing.plane_view import RectifiedPhoto, rectify
from kitting_drake.hkd.tracing.scales import Scale, plane_of_scale
from kitting_drake.hkd.tracing.sheet_plane import GroundPlane, plane_of_sheet
from kitting_drake.hkd.tracing.silhouettes import Unclear, find_silhouettes
from kitting_drake.hkd.tracing.trace_files import outlines_dxf, outlines_svg, trace_png

_STEEPEST = math.radians(30)
"""The largest accepted angle between the camera's optical axis and the vertical, in radians."""
_MOST_PX_PER_MM = 5.0
_MOST_PIXELS = 4e6
_BLURRED_MM = 1.6
"""The width of the edges' blur, in mm, above which a photo counts as blurred."""
_HEIGHTS_MM = (0.5, 100.0)
_CAMERAS_MM = (100.0, 3000.0)
_MOST_PHOTOS = 6


@dataclass(frozen=True)
class TraceRequest:
    """Photos to trace, and how to read them."""

    photos: tuple[Path, ...]
    """Photos of the same tools on the same sheet, from different sides. The first one defines the
    frame of all outlines."""
    output: Path
    sheet_mm: tuple[float, float] | None = None
    """The sheet's sides. None: A4 or Letter, whichever the sheet looks like."""
    scale: Scale | None = None
    """An object of known size that is used instead of a sheet."""
    heights_mm: tuple[float, ...] = ()
    """The tools' heights, from left to right, or one height for all tools. Empty: no correction if
    there is one photo; else the heights are found from the photos."""
    edges: str = "upright"
    """One of `photo_views.EDGES`."""
    camera_mm: float | None = None
    """The camera's height above the plane. None: computed from the focal length."""
    points: Path | None = None
    """A file of corrections; see `doubts`."""
    name: str | None = None
    """The name of the outlines. None: the first photo's name."""


@dataclass(frozen=True)
class TracedTool:
    """One traced outline."""

    name: str
    outline: CrossSection
    """The outline in mm, in the frame of the plane that the tools lie on."""
    height_mm: float | None
    """The tool's height, for which the outline is corrected. None: it is not corrected."""
    svg: Path
    doubts: tuple[Unclear, ...] = ()
    """The regions where the outline may be wrong; empty if the photo shows it clearly."""

    @property
    def holes(self) -> int:
        """The number of the outline's holes."""
        return self.outline.num_contour() - 1

    @property
    def size_mm(self) -> tuple[float, float]:
        """The length and width of the smallest rectangle around the outline. Rotations in steps of
        1 degree are compared."""
        sizes = []
        for angle in range(180):
            x_low, y_low, x_high, y_high = self.outline.rotate(angle).bounds()
            sizes.append((x_high - x_low, y_high - y_low))
        length, width = min(sizes, key=lambda size: size[0] * size[1])
        return max(length, width), min(length, width)


@dataclass(frozen=True)
class TraceReport:
    """The outlines traced in photos, and notes for the user."""

    tools: list[TracedTool]
    notes: list[str]


def trace(request: TraceRequest) -> TraceReport:
    """Traces the tools of photos and writes their outlines and a picture.

    Raises:
        UserError: the request is not valid, or the photos cannot be traced reliably. Nothing is
            written then.
        MachineError: OpenCV or ezdxf is missing.
    """
    cv2 = import_extra("cv2", purpose="hkd trace", extra="camera")
    name = _checked(request)
    corrections = read_corrections(request.points) if request.points else Corrections()
    first = _look(cv2, request, request.photos[0], corrections.corners)
    others = [_look(cv2, request, path) for path in request.photos[1:]]
    if not others:
        first = replace(first, silhouette=corrections.applied(first.silhouette))
    parts = [part for part in first.silhouette.decompose() if part.area() > 0]
    if not parts:
        raise UserError(
            f"{request.photos[0]}: no tool is seen: use a ground of another colour, or add the "
            "tool with --points and one photo"
        )
    for view in (first, *others):
        _check_edges(view)
    views = [first, *(aligned(view, first) for view in others)]
    parts.sort(key=lambda part: part.bounds()[0])
    heights = _heights(request, parts, views)
    outlines = outlines_in_views(parts, views, heights, request.edges)
    if others:
        outlines = [corrections.near(outline).applied(outline) for outline in outlines]
    names = [name] if len(parts) == 1 else [f"{name}_{i + 1}" for i in range(len(parts))]
    doubts = doubts_of(parts, outlines, heights, views, request.edges, corrections)
    tools = [
        TracedTool(own, outline, height, request.output / f"{own}.svg", doubtful)
        for own, outline, height, doubtful in zip(names, outlines, heights, doubts, strict=True)
    ]
    notes = [
        note if view is first else f"{view.photo.path.name}: {note}"
        for view in views
        for note in view.plane.notes
    ]
    notes += _view_notes(views, request, tools)
    _write(cv2, request, tools, notes, views)
    return TraceReport(tools, notes)


def _checked(request: TraceRequest) -> str:
    stem = request.photos[0].stem.lower()
    name = request.name or re.sub(r"[^a-z0-9]+", "_", stem).strip("_")[:50]
    if not re.fullmatch(r"[a-z0-9][a-z0-9_]{0,60}", name):
        raise UserError(
            f"the name '{name}' is not valid: give a --name of at most 61 lower-case letters, "
            "digits and underscores, beginning with a letter or digit"
        )
    if len(request.photos) > 1 and request.scale is not None:
        raise UserError("several photos need a sheet of paper below the tools, not another scale")
    if len(request.photos) > 1 and request.camera_mm is not None:
        raise UserError("--camera_mm is for one photo: leave it out, or trace one photo")
    if len(request.photos) > _MOST_PHOTOS:
        raise UserError(f"{len(request.photos)} photos are too many: give up to {_MOST_PHOTOS}")
    for flag, values, (low, high) in (
        ("--height_mm", request.heights_mm, _HEIGHTS_MM),
        ("--camera_mm", (request.camera_mm,) if request.camera_mm else (), _CAMERAS_MM),
        ("--sheet", request.sheet_mm or (), (50.0, 2000.0)),
    ):
        for value in values:
            if not low <= value <= high:
                raise UserError(f"{flag} {value:g} is out of range: give {low:g} to {high:g}")
    return name


def _check_view(photo: Photo, plane: GroundPlane) -> None:
    view = plane.view
    if view.tilt > _STEEPEST:
        raise UserError(
            f"{photo.path}: the camera looks {math.degrees(view.tilt):.0f} degrees from the "
            f"vertical, more than {math.degrees(_STEEPEST):.0f}: take the photo from above"
        )


def _look(
    cv2: Any, request: TraceRequest, path: Path, corners: NDArray[np.float64] | None = None
) -> PhotoView:
    """Finds the silhouettes of the tools in one photo, in the frame of its own plane.

    Raises:
        UserError: the photo cannot be traced reliably.
    """
    photo = read_photo(path)
    plane = (
        plane_of_scale(cv2, photo, request.scale, request.camera_mm)
        if request.scale
        else plane_of_sheet(cv2, photo, request.sheet_mm, corners, request.camera_mm)
    )
    _check_view(photo, plane)
    seen = _rectified(cv2, plane)
    lowest = min(request.heights_mm, default=None)
    try:
        found = find_silhouettes(cv2, seen, plane.sheet, plane.hidden, lowest)
    except UserError as error:
        raise UserError(f"{photo.path}: {error}") from error
    blur = max(found.blur_mm, plane.blur_mm)
    if blur > _BLURRED_MM:
        raise UserError(
            f"{path} is blurred: edges are {blur:.1f} mm wide; take it again, with more light or a "
            "steadier hand"
        )
    return PhotoView(
        photo, plane, seen, found.lightness, found.area, found.unclear, plane.view.camera
    )


def _rectified(cv2: Any, plane: GroundPlane) -> RectifiedPhoto:
    low, high = plane.low, plane.high
    middle = (low + high) / 2
    size = high - low
    px_per_mm = min(
        _MOST_PX_PER_MM,
        plane.view.px_per_mm(middle),
        math.sqrt(_MOST_PIXELS / float(size[0] * size[1])),
    )
    return rectify(cv2, plane.pixels, plane.view, low, high, px_per_mm)


def _check_edges(view: PhotoView) -> None:
    """Raises a UserError if a photo does not show a whole tool."""
    path, seen = view.photo.path, view.seen
    for loop in view.silhouette.to_polygons():
        u, v = np.round(seen.to_px(np.asarray(loop))).astype(int).T
        rows, columns = seen.shape
        u, v = np.clip(u, 2, columns - 3), np.clip(v, 2, rows - 3)
        if not all(seen.seen[v + dv, u + du].all() for du in (-2, 2) for dv in (-2, 2)):
            raise UserError(
                f"{path}: a tool touches the photo's edge: show the whole tool, and some ground "
                "around it"
            )


def _heights(
    request: TraceRequest, parts: list[CrossSection], views: list[PhotoView]
) -> list[float | None]:
    given = request.heights_mm
    if not given:
        if len(views) == 1:
            return [None] * len(parts)
        return [height_in_views(part, views, request.edges) for part in parts]
    if len(given) == 1:
        return [given[0]] * len(parts)
    if len(given) != len(parts):
        raise UserError(
            f"--height_mm has {len(given)} heights, and {request.photos[0]} shows {len(parts)} "
            "tools: give one height for each tool, from left to right, or one for all"
        )
    return [*given]


def _view_notes(
    views: list[PhotoView], request: TraceRequest, tools: list[TracedTool]
) -> list[str]:
    where = "; ".join(
        f"the camera is {view.camera[2]:.0f} mm above the ground, tilted by "
        f"{math.degrees(view.plane.view.tilt):.0f} degrees"
        for view in views
    )
    if len(tools) > 1:
        where += f"; {len(tools)} tools (a reflection across a tool may have split it)"
    if len(views) == 1 and not request.heights_mm:
        return [where, "not corrected for the tools' height: give --height_mm or a second photo"]
    corrected = f"corrected for the height of the tools, whose sides are {request.edges}"
    if not request.heights_mm:
        found = ", ".join(f"{tool.height_mm:g}" for tool in tools)
        corrected += f": {found} mm, as the photos show it"
    return [where, corrected]


def _write(
    cv2: Any,
    request: TraceRequest,
    tools: list[TracedTool],
    notes: list[str],
    views: list[PhotoView],
) -> None:
    outlines = {tool.name: tool.outline for tool in tools}
    files: dict[str, str | bytes] = {}
    for name, outline in outlines.items():
        files[f"{name}.svg"] = outlines_svg({name: outline})
        files[f"{name}.dxf"] = outlines_dxf({name: outline})
    if len(tools) > 1:
        files["all_tools.svg"], files["all_tools.dxf"] = (
            outlines_svg(outlines),
            outlines_dxf(outlines),
        )
    files["trace.png"] = trace_png(
        cv2,
        views[0].seen,
        views[0].silhouette,
        outlines,
        [item.place for tool in tools for item in tool.doubts],
        views[0].photo.path.name,
    )
    folder = require_folder(request.output)
    for file, content in files.items():
        write_atomically(folder / file, content)
    write_json(
        folder / "trace.json",
        {
            "photos": [
                {
                    "file": str(view.photo.path),
                    "camera_mm": np.round(view.camera, 2).tolist(),
                    "tilt_deg": round(math.degrees(view.plane.view.tilt), 2),
                }
                for view in views
            ],
            "notes": notes,
            "edges": request.edges,
            "corrections": str(request.points) if request.points else None,
            "tools": [
                {
                    "name": tool.name,
                    "size_mm": np.round(tool.size_mm, 2).tolist(),
                    "holes": tool.holes,
                    "height_mm": tool.height_mm,
                    "doubts": [
                        {"place_mm": np.round(item.place, 1).tolist(), "area_mm2": round(item.area)}
                        for item in tool.doubts
                    ],
                }
                for tool in tools
            ],
        },
    )
