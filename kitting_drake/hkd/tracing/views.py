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
from kitting_drake.hkd.tracing.corrections import Corrections
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
_DOUBTED_MM = 0.12
"""An outline is in doubt if the area of its unclear regions, divided by its perimeter, exceeds
this, in mm."""
_MOST_DOUBTS = 4
_APART_MM = 15.0
"""Silhouettes closer than this, in mm, may belong to one tool."""
_SLACK_MM = 0.4
"""Strips of a silhouette that the outline does not explain are ignored if they are narrower than
twice this, in mm."""
_SETTLED_MM = 3.0
"""An unclear region is settled if another photo has none within this distance, in mm."""
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
class View:
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
    scaled = _at_scales(silhouette, camera, height, edges, toward=-1)
    return CrossSection.batch_boolean(scaled, OpType.Intersect)


def silhouette_of_outline(
    outline: CrossSection, camera: Array, height: float, edges: str
) -> CrossSection:
    """Computes the part of the plane that a tool hides from a camera.

    This is the inverse of `outline_of_silhouette`, and has the same arguments, except for the
    tool's outline.
    """
    return CrossSection.batch_boolean(
        _at_scales(outline, camera, height, edges, toward=1), OpType.Add
    )


def _at_scales(
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


def aligned(view: View, first: View) -> View:
    """Returns a view in the frame of the first view, which has the same sheet.

    The sheets' frames differ by a multiple of a quarter turn about the sheet's middle. It is chosen
    such that the silhouettes overlap most.

    Raises:
        UserError: the two photos do not show the same tools at the same places.
    """
    sheet, other = first.plane.sheet, view.plane.sheet
    assert sheet is not None
    assert other is not None
    quarters = (0, 2) if np.allclose(sheet, other) else (1, 3)
    turns = []
    for angle in (90.0 * quarter for quarter in quarters):
        c, s = math.cos(math.radians(angle)), math.sin(math.radians(angle))
        rotation = np.array([[c, -s], [s, c]])
        turns.append(np.column_stack([rotation, sheet / 2 - rotation @ other / 2]))
    moved = [_moved(view, turn) for turn in turns]
    alike = [
        max(
            _agreement(first.silhouette, first, other.silhouette, other, height)
            for height in _TRIED_MM
        )
        for other in moved
    ]
    best = int(np.argmax(alike))
    if alike[best] < _SAME_PLACE or alike[best] < _CLEARLY * alike[1 - best]:
        raise UserError(
            f"{first.photo.path} and {view.photo.path} do not show the same tools at the same "
            "places on the sheet: leave tools and sheet as they are between the photos"
        )
    return moved[best]


def _moved(view: View, turn: Array) -> View:
    """Returns a view after a rigid motion (2, 3) of its plane's frame."""
    return replace(
        view,
        silhouette=view.silhouette.transform(turn),
        camera=np.array([*(turn @ [*view.camera[:2], 1]), view.camera[2]]),
        unclear=tuple(Unclear(item.region.transform(turn), item.area) for item in view.unclear),
        turn=turn,
    )


def _agreement(
    area: CrossSection,
    view: View,
    other_area: CrossSection,
    other: View,
    height: float,
    edges: str = EDGES[0],
) -> float:
    """The area that is in the outlines from both of two silhouettes, as a share of the area that is
    in at least one of them."""
    mine = outline_of_silhouette(area, view.camera, height, edges)
    theirs = outline_of_silhouette(other_area, other.camera, height, edges)
    whole = (mine + theirs).area()
    return (mine ^ theirs).area() / whole if whole else 0.0


def outline_in_views(
    part: CrossSection, views: Sequence[View], height: float, edges: str
) -> CrossSection:
    """Computes a tool's outline from one or several photos.

    Args:
        part: the tool's silhouette in the first photo.
        views: the photos.
        height: the tool's height in mm.
        edges: one of `EDGES`.

    Raises:
        UserError: the tool is too high for its photos.
    """
    for view in views:
        if height > _SHARE_OF_HEIGHT * view.camera[2]:
            raise UserError(
                f"{view.photo.path}: the camera is only {view.camera[2]:.0f} mm above the ground, "
                f"which is too close for a tool {height:g} mm high: take the photo from farther "
                "away"
            )
    outline = _corrected(part, views, height, edges)
    if len(views) > 1:
        outline = cleaned(outline)
    pieces = sorted(outline.decompose(), key=lambda piece: -piece.area())
    if not pieces or pieces[0].area() < 0.5 * part.area():
        raise UserError(
            f"{views[0].photo.path}: the correction for a tool {height:g} mm high leaves less than "
            "half of its silhouette: give its true height, or take the photo from straight above"
        )
    return pieces[0]


def _corrected(
    part: CrossSection, views: Sequence[View], height: float, edges: str
) -> CrossSection:
    """Computes the outline that agrees best with the photos.

    It lies within the outlines from all photos, except for regions that one photo shows as tool and
    another one as ground. There the brightness decides: the ground and its shadows look alike from
    all sides, and a reflection does not.
    """
    from_views = [outline_of_silhouette(part, views[0].camera, height, edges)]
    seen = [part, *(_near(view, part) for view in views[1:])]
    for view, area in zip(views[1:], seen[1:], strict=True):
        from_views.append(outline_of_silhouette(area, view.camera, height, edges))
    outline = CrossSection.batch_boolean(from_views, OpType.Intersect)
    if len(views) == 1:
        return outline
    added = [outline]
    for view, area, own in zip(views, seen, from_views, strict=True):
        left = _opened(area - silhouette_of_outline(outline, view.camera, height, edges))
        if left.is_empty():
            continue
        for region in _opened(own - outline).decompose():
            needed = silhouette_of_outline(region, view.camera, height, edges) ^ left
            if needed.area() > _NEEDED * region.area() and not _is_ground(region, views):
                added.append(region.offset(_SLACK_MM / 4, JoinType.Round) ^ own)
    return CrossSection.batch_boolean(added, OpType.Add)


def _is_ground(region: CrossSection, views: Sequence[View]) -> bool:
    """Whether a region, in the first photo's frame, is equally bright in all photos, and not
    darker than a shadow."""
    cv2 = import_extra("cv2", purpose="hkd trace", extra="camera")
    light = [
        lightness_in(cv2, view.seen, view.lightness, region.transform(_inverse(view.turn)))
        for view in views
    ]
    return float(np.ptp(light)) < _ALIKE and min(light) > -_NO_SHADOW


def _inverse(turn: Array) -> Array:
    back = turn[:, :2].T
    return np.column_stack([back, -back @ turn[:, 2]])


def _opened(area: CrossSection) -> CrossSection:
    """The parts of an area that are wider than twice `_SLACK_MM`."""
    return area.offset(-_SLACK_MM, JoinType.Round).offset(_SLACK_MM, JoinType.Round)


def _near(view: View, part: CrossSection) -> CrossSection:
    """The silhouettes in another photo that overlap a tool's silhouette in the first photo."""
    pieces = [piece for piece in view.silhouette.decompose() if not (piece ^ part).is_empty()]
    return CrossSection.batch_boolean(pieces, OpType.Add) if pieces else CrossSection()


def height_in_views(part: CrossSection, views: Sequence[View], edges: str) -> float:
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
        raise UserError(
            f"{first.photo.path} and {views[1].photo.path} are taken from nearly the same place, "
            "so they do not show the tools' height: give --height_mm, or take the photos from "
            "opposite sides of the sheet"
        )
    near = [_near(view, part) for view in views[1:]]

    def misfit(height: float) -> float:
        return -sum(
            _agreement(part, first, area, view, height, edges)
            for view, area in zip(views[1:], near, strict=True)
        )

    highest = min(_HEIGHTS_MM[1], _SHARE_OF_HEIGHT * min(float(v.camera[2]) for v in views))
    tried = np.geomspace(_HEIGHTS_MM[0], highest, 14)
    best = int(np.argmin([misfit(float(height)) for height in tried]))
    bounds = tried[max(best - 1, 0)], tried[min(best + 1, len(tried) - 1)]
    found = optimize.minimize_scalar(
        misfit, bounds=bounds, method="bounded", options={"xatol": 0.1}
    )
    return round(float(found.x), 1)


def doubts_of(
    parts: Sequence[CrossSection],
    outlines: Sequence[CrossSection],
    heights: Sequence[float | None],
    views: Sequence[View],
    edges: str,
    corrections: Corrections,
) -> list[tuple[Unclear, ...]]:
    """Returns, for each tool, the places where its outline may be wrong.

    First come narrow gaps to other silhouettes, then unclear regions, the largest first. Places
    that the user has corrected are left out. With several photos, so are places that another photo
    shows clearly; added are the parts of silhouettes that the outlines do not explain.

    Args:
        parts: the tools' silhouettes in the first photo.
        outlines: the tools' outlines.
        heights: the tools' heights in mm; None where the outline is not corrected.
        views: the photos.
        edges: one of `EDGES`.
        corrections: the user's corrections.
    """
    unclear = [item for view in views for item in view.unclear if not _is_settled(item, views)]
    if len(views) > 1:
        unclear += _unexplained(outlines, heights, views, edges)
    near: list[list[Unclear]] = [[] for _ in parts]
    for item in sorted(unclear, key=lambda item: -item.area):
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


def _is_settled(item: Unclear, views: Sequence[View]) -> bool:
    """Whether a photo shows clearly what another one does not."""
    around = item.region.offset(_SETTLED_MM, JoinType.Round)
    return any(all((around ^ other.region).is_empty() for other in view.unclear) for view in views)


def _unexplained(
    outlines: Sequence[CrossSection],
    heights: Sequence[float | None],
    views: Sequence[View],
    edges: str,
) -> list[Unclear]:
    """Returns the regions of the photos' silhouettes that tools with these outlines and heights
    would not hide."""
    found = []
    for view in views:
        hidden = CrossSection.batch_boolean(
            [
                silhouette_of_outline(outline, view.camera, height or 0.0, edges)
                for outline, height in zip(outlines, heights, strict=True)
            ],
            OpType.Add,
        )
        left = _opened(view.silhouette - hidden)
        found += [Unclear(region, region.area()) for region in left.decompose()]
    return found


def _gap_between(part: CrossSection, other: CrossSection) -> Unclear | None:
    """Returns the gap between two close silhouettes; a reflection may have split one tool into two.

    Returns None if they are more than `_APART_MM` apart.
    """
    grown = _APART_MM / 2
    bridge = part.offset(grown, JoinType.Round) ^ other.offset(grown, JoinType.Round)
    if bridge.is_empty():
        return None
    return Unclear(bridge, bridge.area())


def _perimeter(area: CrossSection) -> float:
    loops = [np.asarray(loop) for loop in area.to_polygons()]
    return sum(
        float(np.linalg.norm(loop - np.roll(loop, 1, axis=0), axis=1).sum()) for loop in loops
    )
