"""Traces the outlines of tools in a photo, as drawings in mm and as tools (`hkd trace`).

1. An object of known size gives the plane that the tools lie on (`sheet_plane`, `scales`).
2. The photo is rectified (`plane_view`).
3. Tools are separated from the ground and from shadows (`tool_mask`).
4. Their border is found to a fraction of a pixel (`silhouettes`).
5. The silhouette is corrected for the tool's height (`tool_height`).
"""

import math
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from manifold3d import CrossSection, JoinType

from kitting_drake.common.errors import UserError
from kitting_drake.common.extras import import_extra
from kitting_drake.common.files import require_folder, write_atomically, write_json
from kitting_drake.hkd.tracing.corrections import Corrections, read_corrections
from kitting_drake.hkd.tracing.photo_file import Photo, read_photo
from kitting_drake.hkd.tracing.plane_view import RectifiedPhoto, rectify
from kitting_drake.hkd.tracing.scales import Scale, plane_of_scale
from kitting_drake.hkd.tracing.sheet_plane import GroundPlane, plane_of_sheet
from kitting_drake.hkd.tracing.silhouettes import Unclear, find_silhouettes
from kitting_drake.hkd.tracing.tool_height import outline_of_silhouette
from kitting_drake.hkd.tracing.trace_files import outlines_dxf, outlines_svg, trace_png

_STEEPEST = math.radians(30)
"""The largest accepted angle between the camera's optical axis and the vertical, in radians."""
_MOST_PX_PER_MM = 5.0
_MOST_PIXELS = 4e6
_BLURRED_MM = 1.6
"""The width of the edges' blur, in mm, above which a photo counts as blurred."""
_HEIGHTS_MM = (0.5, 100.0)
_CAMERAS_MM = (100.0, 3000.0)
_SHARE_OF_HEIGHT = 0.5
"""A tool may be at most this high, as a share of the camera's height."""
_DOUBTED_MM = 0.12
"""An outline is in doubt if the area of its unclear regions, divided by its perimeter, exceeds
this, in mm."""
_MOST_DOUBTS = 4
_APART_MM = 15.0
"""Silhouettes closer than this, in mm, may belong to one tool."""


@dataclass(frozen=True)
class TraceRequest:
    """A photo to trace, and how to read it."""

    photo: Path
    output: Path
    sheet_mm: tuple[float, float] | None = None
    """The sheet's sides. None: A4 or Letter, whichever the sheet looks like."""
    scale: Scale | None = None
    """An object of known size that is used instead of a sheet."""
    heights_mm: tuple[float, ...] = ()
    """The tools' heights, from left to right, or one height for all tools. Empty: no correction."""
    edges: str = "upright"
    """One of `tool_height.EDGES`."""
    camera_mm: float | None = None
    """The camera's height above the plane. None: computed from the focal length."""
    points: Path | None = None
    """A file of corrections; see `corrections`."""
    name: str | None = None
    """The name of the outlines. None: the photo's name."""


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
    """The outlines traced in a photo, and notes for the user."""

    tools: list[TracedTool]
    notes: list[str]


def trace(request: TraceRequest) -> TraceReport:
    """Traces the tools of a photo and writes their outlines and a picture.

    Raises:
        UserError: the request is not valid, or the photo cannot be traced reliably. Nothing is
            written then.
        MachineError: OpenCV or ezdxf is missing.
    """
    cv2 = import_extra("cv2", purpose="hkd trace", extra="camera")
    name = _checked(request)
    corrections = read_corrections(request.points) if request.points else Corrections()
    photo = read_photo(request.photo)
    plane = (
        plane_of_scale(cv2, photo, request.scale, request.camera_mm)
        if request.scale
        else plane_of_sheet(cv2, photo, request.sheet_mm, corrections.corners, request.camera_mm)
    )
    _check_view(photo, plane)
    seen, silhouette, blur, unclear = _look(cv2, photo, plane, request.heights_mm)
    silhouette = corrections.applied(silhouette)
    parts = [part for part in silhouette.decompose() if part.area() > 0]
    parts.sort(key=lambda part: part.bounds()[0])
    _check_parts(photo, parts, seen, max(blur, plane.blur_mm))
    heights = _heights(request, len(parts))
    names = [name] if len(parts) == 1 else [f"{name}_{i + 1}" for i in range(len(parts))]
    tools = []
    doubts = _doubts(parts, unclear, corrections)
    for part, height, own, doubtful in zip(parts, heights, names, doubts, strict=True):
        outline = part
        if height is not None:
            outline = _corrected(photo, part, plane, height, request.edges)
        svg = request.output / f"{own}.svg"
        tools.append(TracedTool(own, outline, height, svg, doubtful))
    notes = [*plane.notes, *_view_notes(plane, request, len(parts))]
    _write(cv2, request, tools, notes, seen, silhouette, plane)
    return TraceReport(tools, notes)


def _checked(request: TraceRequest) -> str:
    name = request.name or re.sub(r"[^a-z0-9]+", "_", request.photo.stem.lower()).strip("_")[:50]
    if not re.fullmatch(r"[a-z0-9][a-z0-9_]{0,60}", name):
        raise UserError(
            f"the name '{name}' is not valid: give a --name of at most 61 lower-case letters, "
            "digits and underscores, beginning with a letter or digit"
        )
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
    cv2: Any, photo: Photo, plane: GroundPlane, heights: tuple[float, ...]
) -> tuple[RectifiedPhoto, CrossSection, float, list[Unclear]]:
    """Returns the photo as seen from above, and the results of `find_silhouettes`."""
    seen = _rectified(cv2, plane)
    try:
        return (
            seen,
            *find_silhouettes(cv2, seen, plane.sheet, plane.hidden, min(heights, default=None)),
        )
    except UserError as error:
        raise UserError(f"{photo.path}: {error}") from error


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


def _check_parts(
    photo: Photo, parts: list[CrossSection], seen: RectifiedPhoto, blur: float
) -> None:
    if not parts:
        raise UserError(
            f"{photo.path}: no tool is seen: use a ground of another colour, or add the tool "
            "with --points"
        )
    if blur > _BLURRED_MM:
        raise UserError(
            f"{photo.path} is blurred: edges are {blur:.1f} mm wide; take it again, with more "
            "light or a steadier hand"
        )
    for part in parts:
        for loop in part.to_polygons():
            u, v = np.round(seen.to_px(np.asarray(loop))).astype(int).T
            rows, columns = seen.shape
            u, v = np.clip(u, 2, columns - 3), np.clip(v, 2, rows - 3)
            if not all(seen.seen[v + dv, u + du].all() for du in (-2, 2) for dv in (-2, 2)):
                raise UserError(
                    f"{photo.path}: a tool touches the photo's edge: show the whole tool, and "
                    "some ground around it"
                )


def _doubts(
    parts: list[CrossSection], unclear: list[Unclear], corrections: Corrections
) -> list[tuple[Unclear, ...]]:
    """Returns, for each silhouette, the places where it may be wrong.

    First come narrow gaps to other silhouettes, then unclear regions, the largest first. Places
    that the user has corrected are left out.
    """
    near: list[list[Unclear]] = [[] for _ in parts]
    for item in unclear:
        if corrections.settles(item.place):
            continue
        square = CrossSection.square((1.0, 1.0), True).translate(item.place)
        away = [
            CrossSection.batch_hull([part.hull(), square]).area() - part.hull().area()
            for part in parts
        ]
        near[int(np.argmin(away))].append(item)
    result = []
    for i, (part, items) in enumerate(zip(parts, near, strict=True)):
        matters = sum(item.area for item in items) > _DOUBTED_MM * _perimeter(part)
        gaps = [_gap_between(part, other) for j, other in enumerate(parts) if j != i]
        split = [gap for gap in gaps if gap is not None and not corrections.settles(gap.place)]
        result.append(tuple([*split, *(items if matters else [])][:_MOST_DOUBTS]))
    return result


def _gap_between(part: CrossSection, other: CrossSection) -> Unclear | None:
    """Returns the gap between two close silhouettes; a reflection may have split one tool into two.

    Returns None if they are more than `_APART_MM` apart.
    """
    grown = _APART_MM / 2
    bridge = part.offset(grown, JoinType.Round) ^ other.offset(grown, JoinType.Round)
    if bridge.is_empty():
        return None
    x_low, y_low, x_high, y_high = bridge.bounds()
    return Unclear(((x_low + x_high) / 2, (y_low + y_high) / 2), bridge.area())


def _perimeter(area: CrossSection) -> float:
    loops = [np.asarray(loop) for loop in area.to_polygons()]
    return sum(
        float(np.linalg.norm(loop - np.roll(loop, 1, axis=0), axis=1).sum()) for loop in loops
    )


def _heights(request: TraceRequest, count: int) -> list[float | None]:
    given = request.heights_mm
    if not given:
        return [None] * count
    if len(given) == 1:
        return [given[0]] * count
    if len(given) != count:
        raise UserError(
            f"--height_mm has {len(given)} heights, and {request.photo} shows {count} tools: give "
            "one height for each tool, from left to right, or one for all"
        )
    return [*given]


def _corrected(
    photo: Photo, part: CrossSection, plane: GroundPlane, height: float, edges: str
) -> CrossSection:
    camera = plane.view.camera
    if height > _SHARE_OF_HEIGHT * camera[2]:
        raise UserError(
            f"{photo.path}: the camera is only {camera[2]:.0f} mm above the ground, which is too "
            f"close for a tool {height:g} mm high: take the photo from farther away"
        )
    outline = outline_of_silhouette(part, camera, height, edges)
    parts = sorted(outline.decompose(), key=lambda piece: -piece.area())
    if not parts or parts[0].area() < 0.5 * part.area():
        raise UserError(
            f"{photo.path}: the correction for a tool {height:g} mm high leaves less than half of "
            "its silhouette: give its true height, or take the photo from straight above"
        )
    return parts[0]


def _view_notes(plane: GroundPlane, request: TraceRequest, count: int) -> list[str]:
    view = plane.view
    where = (
        f"the camera is {view.camera[2]:.0f} mm above the ground, tilted by "
        f"{math.degrees(view.tilt):.0f} degrees"
    )
    if not request.heights_mm:
        return [where, "not corrected for the tools' height: give --height_mm"]
    if count > 1:
        where += f"; {count} tools (a reflection across a tool may have split it)"
    return [where, f"corrected for the height of the tools, whose sides are {request.edges}"]


def _write(
    cv2: Any,
    request: TraceRequest,
    tools: list[TracedTool],
    notes: list[str],
    seen: RectifiedPhoto,
    silhouette: CrossSection,
    plane: GroundPlane,
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
        seen,
        silhouette,
        outlines,
        [item.place for tool in tools for item in tool.doubts],
        request.photo.name,
    )
    folder = require_folder(request.output)
    for file, content in files.items():
        write_atomically(folder / file, content)
    view = plane.view
    write_json(
        folder / "trace.json",
        {
            "photo": str(request.photo),
            "notes": notes,
            "camera_mm": np.round(view.camera, 2).tolist(),
            "tilt_deg": round(math.degrees(view.tilt), 2),
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
