"""Joins the curves of a drawing into the outline of one tool."""

from pathlib import Path

import numpy as np
from manifold3d import CrossSection, FillRule, JoinType
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from kitting_drake.common.errors import UserError
from kitting_drake.hkd.importing.reading.drawn_curves import FLAT_MM, Curve, DrawnCurves
from kitting_drake.hkd.tools.tool import LONGEST_MM

PAPERS_MM = (
    ("A5", 148.0, 210.0),
    ("A4", 210.0, 297.0),
    ("A3", 297.0, 420.0),
    ("A2", 420.0, 594.0),
    ("Letter", 215.9, 279.4),
    ("Legal", 215.9, 355.6),
    ("Tabloid", 279.4, 431.8),
)
"""Names of sheets of paper, and their sides in mm."""

_JOIN_MM = 0.1
"""The largest gap between the ends of two curves that are joined, in mm."""
_SAME_MM = 0.05
"""The distance in mm within which a curve counts as a second drawing of another."""
_LEAST_AREA_MM2 = 1.0
_LINE_MM = 1.5
"""The width in mm below which two outlines count as the two sides of one thick line."""
# A rectangle counts as a page or frame if its sides are at least `_PAGE` times the page's, and the
# next largest curve is at least `_SPANS` times as long as the rectangle.
_PAGE, _SPANS = 0.85, 0.4

Points = NDArray[np.float64]


def enclosed(drawn: DrawnCurves, path: Path) -> tuple[CrossSection, list[str]]:
    """Returns the area inside the largest closed curve and outside the others, and notes.

    Raises:
        UserError: a curve is open, crosses itself, or is not inside the largest curve.
    """
    notes: list[str] = []
    areas = [CrossSection([loop], FillRule.EvenOdd) for loop in _joined(drawn, path, notes)]
    areas.sort(key=lambda area: -area.area())
    while len(areas) > 1 and (frame := _as_frame(areas, drawn.page_mm)):
        notes.append(f"left out {frame} around it")
        areas.pop(0)
    if not areas or areas[0].area() < _LEAST_AREA_MM2:
        raise UserError(f"{path} has no closed curve that encloses an area")
    outer, *holes = areas
    if len(outer.decompose()) > 1:
        raise UserError(f"{path}: its outline crosses itself")
    for hole in holes:
        if (hole - outer).area() > 0.01 * hole.area():
            raise UserError(
                f"{path} has a curve outside the largest one: draw the outline of one tool only"
            )
    inner = outer.offset(-_LINE_MM, JoinType.Round)
    for hole in holes:
        # If the same curve is drawn as a fill and as a line, the second is not a hole.
        if hole.area() >= 0.999 * areas[0].area():
            continue
        if (inner - hole).area() < 0.001 * inner.area():
            notes.append("its outline is a thick line; the outer side of the line is used")
            continue
        outer -= hole
    return outer.simplify(FLAT_MM), notes


def _as_frame(areas: list[CrossSection], page_mm: tuple[float, float] | None) -> str | None:
    """Describes the largest area if it is a page or a frame; returns None if it is the tool itself.

    Args:
        areas: the areas inside closed curves, the largest first; at least two.
        page_mm: the size of the page, if the drawing has one.
    """
    area, inside, *others = areas
    x_min, y_min, x_max, y_max = area.bounds()
    sides = np.array([x_max - x_min, y_max - y_min])
    low = inside.bounds()
    spans = max(low[2] - low[0], low[3] - low[1]) >= _SPANS * sides.max()
    if area.area() < 0.999 * sides.prod() or not spans or area.area() < 1.02 * inside.area():
        return None
    size = f"a rectangle of {sides[0]:.0f} x {sides[1]:.0f} mm"
    share = np.array([0.0, 0.0]) if page_mm is None else sides / page_mm
    if ((share >= _PAGE) & (share <= 1 / _PAGE)).all():
        return f"{size}, the page,"
    for name, short, long in PAPERS_MM:
        if np.abs(np.sort(sides) - (short, long)).max() < 1.0:
            return f"{size}, a sheet of {name},"
    # A hole contains no other hole, but the tool in a frame may have one.
    edge = (area.offset(-_LINE_MM, JoinType.Miter) - inside).area() < 0.001 * area.area()
    holed = any(
        other.area() < 0.98 * inside.area() and (other - inside).area() < 0.01 * other.area()
        for other in others
    )
    return f"{size}, a frame," if sides.max() > LONGEST_MM or (holed and not edge) else None


def _joined(drawn: DrawnCurves, path: Path, notes: list[str]) -> list[Points]:
    """Joins curves whose ends meet into closed curves.

    Raises:
        UserError: a curve stays open.
    """
    # Drop the single points that some programs leave behind.
    curves = [curve for curve in drawn.curves if np.ptp(curve.points, axis=0).max() > _JOIN_MM]
    drawn_once = _merged_lines(curves)
    drawn_once = [drawn_once[k] for k in _without_doubles([c.points for c in drawn_once])]
    if len(drawn_once) < len(curves):
        notes.append(f"left out {len(curves) - len(drawn_once)} curves that are drawn twice")
    curves = drawn_once
    loops = [curve.points for curve in curves if _is_closed(curve.points)]
    chains = [(curve.points, curve.filled) for curve in curves if not _is_closed(curve.points)]
    while chains:
        chain, filled = chains.pop()
        while not _is_closed(chain) and chains:
            ends = np.array([(other[0], other[-1]) for other, _ in chains])
            gaps = np.linalg.norm(ends - chain[-1], axis=2)
            index, end = np.unravel_index(int(np.argmin(gaps)), gaps.shape)
            if gaps[index, end] > _JOIN_MM:
                break
            other, other_filled = chains.pop(int(index))
            filled = filled and other_filled
            chain = np.concatenate([chain, other if end == 0 else other[::-1]])
        if not _is_closed(chain):
            area = abs(CrossSection([chain], FillRule.EvenOdd).area())
            if not filled or area < _LEAST_AREA_MM2:
                raise _gap_error([chain, *(other for other, _ in chains)], drawn, path)
            gap = float(np.linalg.norm(chain[-1] - chain[0]))
            notes.append(f"closed a filled curve straight over a gap of {gap:.2f} mm")
        loops.append(chain)
    return loops


def _gap_error(chains: list[Points], drawn: DrawnCurves, path: Path) -> UserError:
    """Returns the error for open curves, with the smallest gap between their ends and its place."""
    ends = np.array([end for chain in chains for end in (chain[0], chain[-1])])
    gaps = np.linalg.norm(ends[:, None] - ends, axis=2)
    gaps[gaps <= _JOIN_MM] = np.inf
    one, other = np.unravel_index(int(np.argmin(gaps)), gaps.shape)
    x, y = (ends[one] + ends[other]) / 2
    # In SVG y points down, from the page's upper edge.
    place = f"x = {x:.1f}, y = {y if drawn.page_mm is None else -y:.1f} mm"
    return UserError(
        f"{path} has an open curve with a gap of {gaps[one, other]:.2f} mm at {place}: close the "
        "curve, or delete it if it does not belong to the outline"
    )


def _merged_lines(curves: list[Curve]) -> list[Curve]:
    """Replaces straight lines that overlap in part by one line."""
    merged = [curve for curve in curves if len(curve.points) != 2]
    lines = [curve for curve in curves if len(curve.points) == 2]
    ends = np.array([line.points for line in lines]).reshape(-1, 2, 2)
    waiting = np.ones(len(lines), dtype=bool)
    for index, line in enumerate(lines):
        if not waiting[index]:
            continue
        waiting[index], points = False, line.points
        while True:
            along = points[1] - points[0]
            length = float(np.linalg.norm(along))
            along = along / length
            offsets = ends - points[0]
            places = np.sort(offsets @ along, axis=1)
            overlap = np.minimum(places[:, 1], length) - np.maximum(places[:, 0], 0.0)
            shorter = np.minimum(places[:, 1] - places[:, 0], length)
            # Do not merge short pieces of a curve, because they are neighbours.
            slack = np.minimum(_SAME_MM, 0.2 * shorter)
            beside = np.abs(offsets @ np.array([-along[1], along[0]])).max(axis=1)
            least = np.minimum(2 * _JOIN_MM, 0.5 * shorter)
            found = np.flatnonzero(waiting & (beside <= slack) & (overlap > least))
            if not len(found):
                break
            first, last = places[found[0]]
            waiting[found[0]] = False
            start, end = min(first, 0.0), max(last, length)
            points = np.array([points[0] + start * along, points[0] + end * along])
        merged.append(Curve(points, line.filled))
    return merged


def _without_doubles(curves: list[Points]) -> list[int]:
    """Returns the indices, in order, of the curves that do not lie on a longer or earlier one."""
    if len(curves) < 2:
        return list(range(len(curves)))
    lengths = np.array([np.linalg.norm(np.diff(c, axis=0), axis=1).sum() for c in curves])
    low = np.array([curve.min(axis=0) for curve in curves])
    high = np.array([curve.max(axis=0) for curve in curves])
    trees: dict[int, cKDTree] = {}
    kept: list[int] = []
    for index in np.argsort(-lengths, kind="stable"):
        around = np.array(kept, dtype=int)
        within = (low[around] <= low[index] + _SAME_MM) & (high[around] >= high[index] - _SAME_MM)
        places = _dense(curves[index], max(_SAME_MM, lengths[index] / 60))
        for other in around[within.all(axis=1)]:
            if other not in trees:
                trees[other] = cKDTree(_dense(curves[other], _SAME_MM))
            # The nearest place may lie between two of the dense points, so allow a little more than
            # `_SAME_MM`.
            if trees[other].query(places)[0].max() <= 1.2 * _SAME_MM:
                break
        else:
            kept.append(int(index))
    return sorted(kept)


def _dense(curve: Points, step: float) -> Points:
    """Returns the corners of a polyline (n, 2) and points between them, at most `step` apart."""
    corners = np.linalg.norm(np.diff(curve, axis=0), axis=1)
    pieces = [
        start + (end - start) * np.linspace(0, 1, int(np.ceil(length / step)) + 1)[:, None]
        for start, end, length in zip(curve[:-1], curve[1:], corners, strict=True)
    ]
    return np.vstack(pieces)


def _is_closed(curve: Points) -> bool:
    return len(curve) > 2 and bool(np.linalg.norm(curve[-1] - curve[0]) <= _JOIN_MM)
