"""The places where a traced outline may be wrong, and a user's corrections (`--points`)."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import yaml
from manifold3d import CrossSection, FillRule, JoinType, OpType
from numpy.typing import NDArray

from kitting_drake.common.errors import UserError
from kitting_drake.hkd.tracing.photo_views import EDGES, PhotoView, at_scales, unexplained
from kitting_drake.hkd.tracing.silhouettes import Unclear

_KINDS = ("add", "remove", "sheet")
_DOUBTED_MM = 0.12
"""An outline is in doubt if the area of its unclear regions, divided by its perimeter, exceeds
this, in mm."""
_MOST_DOUBTS = 4
_APART_MM = 15.0
"""Silhouettes closer than this, in mm, may belong to one tool."""
_SETTLED_MM = 1.5
"""An unclear region is settled if another photo has none within twice this distance, in mm."""


@dataclass(frozen=True)
class Corrections:
    """The sheet's corners, and polygons to add to the traced region or to remove from it."""

    steps: tuple[tuple[str, NDArray[np.float64]], ...] = ()
    """The polygons, in the order in which they are applied. Each has a kind, `add` or `remove`, and
    points (n, 2) in mm, as on the rulers of `trace.png`."""
    corners: NDArray[np.float64] | None = None
    """The sheet's corners (4, 2) in pixels of the first photo, counter-clockwise in the picture.
    None: the corners are found automatically."""

    def settles(self, place: tuple[float, float]) -> bool:
        """Whether the user has checked a place (x, y), in mm: whether a polygon covers it."""
        spot = CrossSection.square((0.1, 0.1), True).translate(place)
        return any(
            not (CrossSection([points], FillRule.EvenOdd) ^ spot).is_empty()
            for _, points in self.steps
        )

    def near(self, area: CrossSection) -> "Corrections":
        """The corrections whose polygons overlap an area in mm."""
        steps = tuple(
            (kind, points)
            for kind, points in self.steps
            if not (CrossSection([points], FillRule.EvenOdd) ^ area).is_empty()
        )
        return Corrections(steps, self.corners)

    def applied(self, area: CrossSection) -> CrossSection:
        """Returns a region with the polygons added and removed."""
        for kind, points in self.steps:
            polygon = CrossSection([points], FillRule.EvenOdd)
            area = area + polygon if kind == "add" else area - polygon
        return area


def read_corrections(path: Path) -> Corrections:
    """Reads a YAML list of items `add: [[x, y], ...]`, `remove: [[x, y], ...]` and `sheet: [[u, v],
    ...]`.

    Raises:
        UserError: the file is missing, or is not such a list. The message names the item.
    """
    try:
        items = yaml.safe_load(path.read_text())
    except OSError as error:
        raise UserError(f"--points: there is no file {path}") from error
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise UserError(f"{path} is not YAML") from error
    if not isinstance(items, list):
        raise UserError(f"{path} must be a list of items such as 'add: [[10, 20], [30, 20], ...]'")
    steps, corners = [], None
    for number, item in enumerate(items, start=1):
        if not isinstance(item, dict) or len(item) != 1 or next(iter(item)) not in _KINDS:
            raise UserError(f"{path}: item {number} must have one of the keys {', '.join(_KINDS)}")
        ((kind, value),) = item.items()
        points = _points(value, f"{path}: item {number}")
        if kind != "sheet":
            steps.append((kind, points))
        elif len(points) == 4:
            corners = _ordered(points)
        else:
            raise UserError(f"{path}: item {number}: a sheet has 4 corners, not {len(points)}")
    return Corrections(tuple(steps), corners)


def _points(value: object, where: str) -> NDArray[np.float64]:
    try:
        points = np.array(value, float)
    except (TypeError, ValueError):
        points = np.empty(0)
    if points.ndim != 2 or points.shape[1] != 2 or len(points) < 3 or not np.isfinite(points).all():
        raise UserError(f"{where} must be a list of at least 3 points [x, y]")
    return points


def _ordered(corners: NDArray[np.float64]) -> NDArray[np.float64]:
    """Orders corners (4, 2) in pixels so that they run counter-clockwise in the picture."""
    away = corners - corners.mean(axis=0)
    return corners[np.argsort(-np.arctan2(away[:, 1], away[:, 0]))]


def doubts_of(
    parts: Sequence[CrossSection],
    outlines: Sequence[CrossSection],
    heights: Sequence[float | None],
    views: Sequence[PhotoView],
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
    highest = max((height or 0.0 for height in heights), default=0.0)
    unclear = _unsettled(views, highest)
    if len(views) > 1:
        regions = [
            region
            for view in views
            for region in unexplained(outlines, heights, view, edges).decompose()
        ]
        unclear += [Unclear(item, item.area()) for item in regions if not item.is_empty()]
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


def _unsettled(views: Sequence[PhotoView], height: float) -> list[Unclear]:
    """Returns the unclear regions of all photos, without those near which some photo has none.

    A region at an unknown height, up to `height` in mm, may be anywhere on a strip of the plane.
    """
    strips = [
        [
            CrossSection.batch_boolean(
                at_scales(item.region, view.camera, height, EDGES[0], toward=-1), OpType.Add
            ).offset(_SETTLED_MM, JoinType.Round)
            for item in view.unclear
        ]
        for view in views
    ]
    return [
        item
        for number, view in enumerate(views)
        for item, strip in zip(view.unclear, strips[number], strict=True)
        if all(
            other == number or any(not (strip ^ near).is_empty() for near in strips[other])
            for other in range(len(views))
        )
    ]


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
