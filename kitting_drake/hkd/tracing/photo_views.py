"""Combines the silhouettes of a tool, as seen in one or several photos, into its outline.

A silhouette is the part of the plane that the tool hides from a camera. In a photo the sides of a
tool may hide a gap, and a shadow may look like tool. The outline lies within the silhouettes of all
photos, so a photo from another side corrects such errors, and also shows the tool's height.
Outlines are polygons in mm in the frame of the first photo's plane.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from manifold3d import CrossSection, JoinType, OpType
from numpy.typing import NDArray
from scipy import optimize

from kitting_drake.common.errors import UserError
from kitting_drake.common.extras import import_extra
from kitting_drake.hkd.tracing.photo_file import Photo
from kitting_drake.hkd.tracing.plane_view import RectifiedPhoto
from kitting_drake.hkd.tracing.sheet_plane import GroundPlane
from kitting_drake.hkd.tracing.silhouettes import Unclear, cleaned, lightness_in

Array = NDArray[np.float64]

EDGES = ("upright", "round")
"""Shapes of a tool's sides: see `outline_of_silhouette`."""

_STEP_MM = 0.4
_SHARE_OF_HEIGHT = 0.5
"""A tool may be at most this high, as a share of the camera's height."""
_SLACK_MM = 0.4
"""Strips of a silhouette that the outline does not explain are ignored if they are narrower than
twice this, in mm."""
_OVERLAP = 0.3
"""Outlines from two photos belong to one tool if they overlap by this share of the smaller one."""
_SAME_TOOL = 0.5
"""The least area that a tool's outlines from two photos share, relative to the smaller one."""
_ALIKE = 0.15
"""The largest difference between the brightness of the ground in two photos, in logarithms of
light."""
_NO_SHADOW = 1.3
"""A region darker than the ground by more than this, in logarithms of light, is not in shadow."""
_NEEDED = 0.5
"""A region is needed to explain a silhouette if at least this share of it would do so."""
_SAME_PLACE = 0.5
"""Two photos must agree on at least this share of the area of the tools, at one of the heights
`_TRIED_MM`."""
_TRIED_MM = (0.5, 6.0, 12.0, 20.0, 30.0)
_LEAST_BASELINE = 0.2
"""Two photos show the height of a tool if the points below their cameras are at least this far
apart, as a share of the cameras' height."""
_HEIGHTS_MM = (0.5, 80.0)
_CLEARLY = 1.15
"""Two photos must agree better than after half a turn of the sheet by at least this factor."""


@dataclass(frozen=True)
class PhotoView:
    """What one photo shows of the tools."""

    photo: Photo
    plane: GroundPlane
    seen: RectifiedPhoto
    """The photo as seen from above, in the frame of its own plane."""
    lightness: Array
    """`Silhouettes.lightness` of `seen`."""
    silhouette: CrossSection
    """The part of the plane that the tools hide."""
    unclear: tuple[Unclear, ...]
    camera: Array
    """The camera's position (3,) in mm."""
    turn: Array = field(default_factory=lambda: np.eye(2, 3))
    """The rigid motion (2, 3) from the frame of its own plane to that of the first photo."""


def outline_of_silhouette(
    silhouette: CrossSection, camera: Array, height: float, edges: str
) -> CrossSection:
    """Computes a tool's outline from its silhouette, both in mm in the plane's frame.

    Let H be the camera's height above the plane, and t the tool's height. In the photo, a point at
    height h is H / (H - h) times too far from the point below the camera. Where an upright side
    faces away from the camera, the silhouette ends at the side's top edge; where it faces the
    camera, at the side's bottom edge. So the outline is the part of the plane that the silhouette
    covers at every scale from 1 to (H - t) / H; the point below the camera stays fixed. The widest
    points of a round tool are at height t / 2 on all sides, so its silhouette is scaled only once.

    Args:
        silhouette: the part of the plane that the tool hides.
        camera: (3,) the camera's position.
        height: the tool's height t in mm, less than H.
        edges: one of `EDGES`.
    """
    scaled = at_scales(silhouette, camera, height, edges, toward=-1)
    return CrossSection.batch_boolean(scaled, OpType.Intersect)


def silhouette_of_outline(
    outline: CrossSection, camera: Array, height: float, edges: str
) -> CrossSection:
    """Computes the part of the plane that a tool hides from a camera.

    This is the inverse of `outline_of_silhouette`, and has the same arguments, except for the
    tool's outline.
    """
    return CrossSection.batch_boolean(
        at_scales(outline, camera, height, edges, toward=1), OpType.Add
    )


def at_scales(
    area: CrossSection, camera: Array, height: float, edges: str, toward: int
) -> list[CrossSection]:
    """Returns copies of an area, scaled about the point below the camera; see
    `outline_of_silhouette`. With `toward` 1 they grow, with -1 they shrink."""
    below = (float(camera[0]), float(camera[1]))
    factor = camera[2] / (camera[2] - height / (2 if edges == "round" else 1))
    centred = area.translate((-below[0], -below[1]))
    if area.is_empty():
        return [area]
    if edges == "round":
        scales = [factor**toward]
    else:
        low_x, low_y, high_x, high_y = centred.bounds()
        reach = math.hypot(max(abs(low_x), abs(high_x)), max(abs(low_y), abs(high_y)))
        steps = max(1, math.ceil(reach * (1 - 1 / factor) / _STEP_MM))
        scales = [(1 + share * (factor - 1)) ** toward for share in np.arange(steps + 1) / steps]
    return [centred.scale((scale, scale)).translate(below) for scale in scales]


def aligned(view: PhotoView, first: PhotoView) -> PhotoView:
    """Returns a view in the frame of the first view, which has the same sheet.

    The sheets' frames differ by a multiple of a quarter turn about the sheet's middle. It is chosen
    such that the outlines agree best.

    Raises:
        UserError: the two photos do not show the same sheet, or the same tools at the same places.
    """
    sheet, other = first.plane.sheet, view.plane.sheet
    assert sheet is not None
    assert other is not None
    if not np.allclose(sorted(sheet), sorted(other)):
        raise UserError(
            f"{first.photo.path} shows a sheet of {sheet[0]:g} x {sheet[1]:g} mm, and "
            f"{view.photo.path} one of {other[0]:g} x {other[1]:g} mm: say which it is with --sheet"
        )
    quarters = [q for q in range(4) if np.allclose(sheet, other if q % 2 == 0 else other[::-1])]
    moved = []
    for angle in (math.pi / 2 * quarter for quarter in quarters):
        rotation = np.array(
            [[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]]
        )
        turn = np.column_stack([rotation, sheet / 2 - rotation @ other / 2])
        moved.append(_moved(view, turn))
    alike = [
        max(
            _agreement(
                outline_of_silhouette(first.silhouette, first.camera, height, EDGES[0]),
                outline_of_silhouette(turned.silhouette, turned.camera, height, EDGES[0]),
            )
            for height in _TRIED_MM
        )
        for turned in moved
    ]
    second, best = sorted(alike)[-2:]
    if best < _SAME_PLACE:
        raise UserError(
            f"{first.photo.path} and {view.photo.path} do not show the same tools at the same "
            "places on the sheet: leave tools and sheet as they are between the photos"
        )
    if best < _CLEARLY * second:
        raise UserError(
            f"{first.photo.path} and {view.photo.path}: the tools look the same if the sheet is "
            "turned, so it is not clear from which side the photos were taken: lay the tools "
            "away from the middle of the sheet"
        )
    return moved[int(np.argmax(alike))]


def _moved(view: PhotoView, turn: Array) -> PhotoView:
    """Returns a view after a rigid motion (2, 3) of its plane's frame."""
    return replace(
        view,
        silhouette=view.silhouette.transform(turn),
        camera=np.array([*(turn @ [*view.camera[:2], 1]), view.camera[2]]),
        unclear=tuple(Unclear(item.region.transform(turn), item.area) for item in view.unclear),
        turn=turn,
    )


def _agreement(outline: CrossSection, other: CrossSection) -> float:
    """The area that is in both of two outlines, as a share of the area that is in one of them."""
    whole = (outline + other).area()
    return (outline ^ other).area() / whole if whole else 0.0


def _same_tool(outline: CrossSection, view: PhotoView, height: float, edges: str) -> CrossSection:
    """The outline of a tool from another photo: of the silhouettes there that, at a height, overlap
    the tool's outline from the first photo."""
    found = [CrossSection()]
    for piece in view.silhouette.decompose():
        other = outline_of_silhouette(piece, view.camera, height, edges)
        if (outline ^ other).area() > _OVERLAP * min(outline.area(), other.area()):
            found.append(other)
    return CrossSection.batch_boolean(found, OpType.Add)


def height_in_views(part: CrossSection, views: Sequence[PhotoView], edges: str) -> float:
    """Finds a tool's height, in mm, at which the outlines from all photos agree best.

    Args:
        part: the tool's silhouette in the first photo.
        views: at least two photos.
        edges: one of `EDGES`.

    Raises:
        UserError: the photos were taken from nearly the same place.
    """
    first = views[0]
    apart = max(
        float(np.linalg.norm((view.camera - first.camera)[:2])) / float(view.camera[2])
        for view in views[1:]
    )
    if apart < _LEAST_BASELINE:
        names = ", ".join(str(view.photo.path) for view in views)
        raise UserError(
            f"{names} are taken from nearly the same place, so they do not show the tools' "
            "height: give --height_mm, or take the photos from opposite sides of the sheet"
        )

    def misfit(height: float) -> float:
        mine = outline_of_silhouette(part, first.camera, height, edges)
        return -sum(_agreement(mine, _same_tool(mine, view, height, edges)) for view in views[1:])

    highest = min(_HEIGHTS_MM[1], _SHARE_OF_HEIGHT * min(float(v.camera[2]) for v in views))
    tried = np.geomspace(_HEIGHTS_MM[0], highest, 14)
    best = int(np.argmin([misfit(float(height)) for height in tried]))
    bounds = tried[max(best - 1, 0)], tried[min(best + 1, len(tried) - 1)]
    found = optimize.minimize_scalar(
        misfit, bounds=bounds, method="bounded", options={"xatol": 0.1}
    )
    return round(float(found.x), 1)


def outlines_in_views(
    parts: Sequence[CrossSection],
    views: Sequence[PhotoView],
    heights: Sequence[float | None],
    edges: str,
) -> list[CrossSection]:
    """Computes the tools' outlines from one or several photos.

    An outline lies within the outlines from all photos, except for regions that one photo shows as
    tool and another one as ground. There the brightness decides: the ground and its shadows look
    alike from all sides, and a reflection does not.

    Args:
        parts: the tools' silhouettes in the first photo.
        views: the photos.
        heights: the tools' heights in mm; None: the silhouette is not corrected.
        edges: one of `EDGES`.

    Raises:
        UserError: a tool is too high for its photos, or a photo does not show it.
    """
    from_views = [
        [part] if height is None else _outlines(part, views, height, edges)
        for part, height in zip(parts, heights, strict=True)
    ]
    outlines = [CrossSection.batch_boolean(items, OpType.Intersect) for items in from_views]
    if len(views) > 1:
        outlines = _with_needed(outlines, from_views, views, heights, edges)
    return [
        _one_piece(outline, items[0], part, views[0], height)
        for outline, items, part, height in zip(outlines, from_views, parts, heights, strict=True)
    ]


def _outlines(
    part: CrossSection, views: Sequence[PhotoView], height: float, edges: str
) -> list[CrossSection]:
    """Returns a tool's outline from each photo."""
    for view in views:
        if height > _SHARE_OF_HEIGHT * view.camera[2]:
            raise UserError(
                f"{view.photo.path}: the camera is only {view.camera[2]:.0f} mm above the ground, "
                f"which is too close for a tool {height:g} mm high: take the photo from farther "
                "away"
            )
    found = [outline_of_silhouette(part, views[0].camera, height, edges)]
    for view in views[1:]:
        found.append(_same_tool(found[0], view, height, edges))
        common = (found[0] ^ found[-1]).area()
        if common < _SAME_TOOL * min(found[0].area(), found[-1].area()) or not common:
            x_low, y_low, x_high, y_high = part.bounds()
            raise UserError(
                f"{view.photo.path} does not show the tool that {views[0].photo.path} shows at "
                f"({(x_low + x_high) / 2:.0f}, {(y_low + y_high) / 2:.0f}) mm, if it is "
                f"{height:g} mm high: leave tools and sheet as they are between the photos, and "
                "check --height_mm"
            )
    return found


def _with_needed(
    outlines: Sequence[CrossSection],
    from_views: Sequence[Sequence[CrossSection]],
    views: Sequence[PhotoView],
    heights: Sequence[float | None],
    edges: str,
) -> list[CrossSection]:
    """Adds to outlines the regions without which a photo's silhouette cannot be explained, unless
    they are ground."""
    added = list(outlines)
    for number, view in enumerate(views):
        left = unexplained(outlines, heights, view, edges)
        if left.is_empty():
            continue
        for index, (items, height) in enumerate(zip(from_views, heights, strict=True)):
            others = CrossSection.batch_boolean(added, OpType.Add)
            for region in _opened(items[number] - others).decompose():
                needed = silhouette_of_outline(region, view.camera, height or 0.0, edges) ^ left
                if needed.area() > _NEEDED * region.area() and not _is_ground(region, views):
                    added[index] += region.offset(_SLACK_MM / 4, JoinType.Round) ^ items[number]
    return [cleaned(outline) for outline in added]


def _one_piece(
    outline: CrossSection,
    first: CrossSection,
    part: CrossSection,
    view: PhotoView,
    height: float | None,
) -> CrossSection:
    """Returns the piece of an outline that overlaps the outline from the first photo most."""
    pieces = sorted(outline.decompose(), key=lambda piece: -(piece ^ first).area())
    if not pieces or pieces[0].area() < 0.5 * part.area():
        raise UserError(
            f"{view.photo.path}: the correction for a tool {height or 0:g} mm high leaves less "
            "than half of its silhouette: give its true height with --height_mm, or take the "
            "photo from straight above"
        )
    return pieces[0]


def _is_ground(region: CrossSection, views: Sequence[PhotoView]) -> bool:
    """Whether a region, in the first photo's frame, is equally bright in all photos, and not
    darker than a shadow. Photos that do not show it do not count."""
    cv2 = import_extra("cv2", purpose="hkd trace", extra="camera")
    light = np.array(
        [
            lightness_in(cv2, view.seen, view.lightness, region.transform(_inverse(view.turn)))
            for view in views
        ]
    )
    light = light[np.isfinite(light)]
    return len(light) > 1 and float(np.ptp(light)) < _ALIKE and float(light.min()) > -_NO_SHADOW


def _inverse(turn: Array) -> Array:
    back = turn[:, :2].T
    return np.column_stack([back, -back @ turn[:, 2]])


def _opened(area: CrossSection) -> CrossSection:
    """The parts of an area that are wider than twice `_SLACK_MM`."""
    return area.offset(-_SLACK_MM, JoinType.Round).offset(_SLACK_MM, JoinType.Round)


def unexplained(
    outlines: Sequence[CrossSection],
    heights: Sequence[float | None],
    view: PhotoView,
    edges: str,
) -> CrossSection:
    """The part of a photo's silhouettes that tools with these outlines and heights would not
    hide."""
    hidden = [
        silhouette_of_outline(outline, view.camera, height or 0.0, edges)
        for outline, height in zip(outlines, heights, strict=True)
    ]
    return _opened(view.silhouette - CrossSection.batch_boolean(hidden, OpType.Add))
