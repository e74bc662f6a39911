"""Joins the curves of a drawing into the outline of one tool."""

from dataclasses import dataclass
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
FRAMES = ("page", "tool")
"""The possible meanings of a rectangle around all other curves of a drawing."""

_JOIN_MM = 0.1
"""The largest gap between the ends of two curves that are joined, in mm."""
_POINT_MM = 0.002
"""A curve of at most this size, in mm, counts as a point and is dropped."""
_SAME_MM = 0.05
"""Two curves at most this far apart, in mm, count as one curve that is drawn twice."""
_LEAST_AREA_MM2 = 1.0
_LINE_MM = 1.5
"""Two outlines less than this far apart, in mm, count as the two sides of one thick line."""
_BOX = 0.9
"""A curve counts as a rectangle if it fills at least this share of its bounding box."""
_THE_PAGE = "the page"
_PAGE = 0.85
"""A rectangle counts as the page if each of its sides is `_PAGE` to 1 / `_PAGE` times as long as
the page's side."""
_HOLE, _TOOL = 0.25, 0.4
"""Shares of a rectangle's length. Within the rectangle, a curve shorter than `_HOLE` is a hole, and
a curve longer than `_TOOL` may be a tool."""
_ROUND = 0.02
"""A curve is a circle if its extents and area differ from a circle's by less than this fraction."""

Points = NDArray[np.float64]


class FrameError(UserError):
    """Raised if it is not clear whether a rectangle is a frame or the tool."""


@dataclass(frozen=True)
class _Loop:
    """A closed curve."""

    area: CrossSection
    element: int | None
    """See `Curve.element`."""

    @property
    def size(self) -> Points:
        """The extents (2,) of the curve along x and y, in mm."""
        x_min, y_min, x_max, y_max = self.area.bounds()
        return np.array([x_max - x_min, y_max - y_min])

    @property
    def is_round(self) -> bool:
        """Whether the curve is a circle."""
        across = self.size.mean()
        square = abs(self.size[0] - self.size[1]) < _ROUND * across
        return bool(square and abs(self.area.area() / (np.pi / 4 * across**2) - 1) < _ROUND)

    def holds(self, other: "_Loop") -> bool:
        """Whether another curve lies inside this curve."""
        return bool((other.area - self.area).area() < 0.01 * other.area.area())


def enclosed(
    drawn: DrawnCurves, path: Path, frame: str | None = None
) -> tuple[CrossSection, list[str]]:
    """Returns the outline of a tool, and notes for the user.

    Pages and frames are left out first. The outline is then the region inside the largest closed
    curve and outside the other curves.

    Args:
        drawn: the curves.
        path: the drawing, for messages.
        frame: whether a rectangle around all other curves is the page or the tool, one of `FRAMES`.
            None: it is inferred from the curves.

    Raises:
        FrameError: it cannot be inferred whether the largest curve is a frame.
        UserError: a curve is open, crosses itself, or is not inside the largest curve.
    """
    notes: list[str] = []
    loops = [
        _Loop(CrossSection([points], FillRule.EvenOdd), element)
        for points, element in _joined(drawn, path, notes)
    ]
    loops.sort(key=lambda loop: -loop.area.area())
    while len(loops) > 1 and (left_out := _as_frame(loops, drawn.page_mm, path, frame)):
        notes.append(f"left out {left_out} around it")
        loops.pop(0)
    areas = [loop.area for loop in loops]
    if not areas or areas[0].area() < _LEAST_AREA_MM2:
        raise UserError(
            f"{path} has no closed curve that encloses an area: close the tool's outline"
        )
    outer, *holes = areas
    parts = sorted(outer.decompose(), key=lambda part: -part.area())
    if sum(part.area() for part in parts[1:]) > _LEAST_AREA_MM2:
        raise UserError(f"{path} has an outline that crosses itself: draw it without crossings")
    # Drop the tiny areas that lines enclose where they overshoot a corner.
    outer = parts[0]
    for hole in holes:
        if (hole - outer).area() > 0.01 * hole.area():
            raise UserError(
                f"{path} has a curve outside the largest one: draw the outline of one tool only"
            )
    inner = outer.offset(-_LINE_MM, JoinType.Round)
    for hole in holes:
        # A curve that is drawn twice, as a fill and as a line, is not a hole.
        if hole.area() >= 0.999 * areas[0].area():
            continue
        if (inner - hole).area() < 0.001 * inner.area():
            notes.append("its outline is a thick line; the outer side of the line is used")
            continue
        outer -= hole
    return outer.simplify(FLAT_MM), notes


def _as_frame(
    loops: list[_Loop], page_mm: tuple[float, float] | None, path: Path, frame: str | None
) -> str | None:
    """Describes the largest curve if it is a page or a frame; returns None if it is the tool.

    Args:
        loops: closed curves, the largest first; at least two.
        page_mm: the size of the page, if the drawing has one.
        path: the drawing, for messages.
        frame: as in `enclosed`.

    Raises:
        FrameError: it is not clear whether the largest curve is a frame or the tool.
    """
    box, inside, *others = loops
    sides = box.size
    if (
        frame == "tool"
        or box.area.area() < _BOX * sides.prod()
        # The second curve may be a copy of the rectangle, or the inner side of the rectangle's
        # thick line.
        or box.area.area() < 1.02 * inside.area.area()
        or (box.area.offset(-_LINE_MM, JoinType.Miter) - inside.area).area()
        < 0.001 * box.area.area()
        or not all(box.holds(other) for other in loops[1:])
    ):
        return None
    size = f"a rectangle of {sides[0]:.0f} x {sides[1]:.0f} mm"
    page = _page_of(sides, page_mm)
    if frame == "page":
        return f"{size}, {page or 'a frame'},"
    # The inner curves of a filled element are holes.
    if inside.element is not None and inside.element == box.element:
        return None
    share = float(inside.size.max() / sides.max())
    has_holes = any(
        other.area.area() < 0.98 * inside.area.area() and inside.holds(other) for other in others
    )
    if sides.max() > LONGEST_MM:
        return f"{size}, {page or 'a frame'}," if share >= _TOOL else None
    # A rectangle as large as the page may also be a tool to which the page was fitted.
    is_ground = page is not None and (
        page != _THE_PAGE or None not in (box.element, inside.element)
    )
    if share >= _TOOL and (has_holes or (is_ground and not inside.is_round)):
        return f"{size}, {page or 'a frame'},"
    if share < _HOLE or inside.is_round:
        return None
    inner = f"{inside.size[0]:.0f} x {inside.size[1]:.0f} mm"
    raise FrameError(
        f"{path} has {size} around a curve of {inner}: give --frame page if the inner curve is the "
        "tool, or --frame tool if the rectangle is the tool and the inner curve is a hole"
    )


def _page_of(sides: Points, page_mm: tuple[float, float] | None) -> str | None:
    """Returns the name of the page or sheet of paper with these sides (2,) in mm, or None."""
    share = np.zeros(2) if page_mm is None else sides / page_mm
    if ((share >= _PAGE) & (share <= 1 / _PAGE)).all():
        return _THE_PAGE
    for name, short, long in PAPERS_MM:
        if np.abs(np.sort(sides) - (short, long)).max() < 1.0:
            return f"a sheet of {name}"
    return None


def _joined(drawn: DrawnCurves, path: Path, notes: list[str]) -> list[tuple[Points, int | None]]:
    """Joins curves at their ends, so that they form closed curves.

    Returns:
        The points (n, 2) of each closed curve in mm, and its element (see `Curve`).

    Raises:
        UserError: a curve stays open.
    """
    # Drop the single points that some programs leave behind.
    curves = [curve for curve in drawn.curves if np.ptp(curve.points, axis=0).max() > _POINT_MM]
    drawn_once = _merged_lines(curves)
    drawn_once = [drawn_once[k] for k in _without_doubles([c.points for c in drawn_once])]
    if len(drawn_once) < len(curves):
        notes.append(f"left out {len(curves) - len(drawn_once)} curves that are drawn twice")
    curves = drawn_once
    loops = [(curve.points, curve.element) for curve in curves if _is_closed(curve.points)]
    chains = [curve for curve in curves if not _is_closed(curve.points)]
    ends = np.array([curve.points[[0, -1]] for curve in chains]).reshape(-1, 2, 2)
    waiting = np.ones(len(chains), dtype=bool)
    while waiting.any():
        index = int(np.flatnonzero(waiting)[-1])
        waiting[index] = False
        first = chains[index]
        chain, filled = first.points, first.filled
        parts = [chain]
        while not _is_closed(chain) and waiting.any():
            gaps = np.linalg.norm(ends - parts[-1][-1], axis=2)
            gaps[~waiting] = np.inf
            index, end = (int(k) for k in np.unravel_index(int(np.argmin(gaps)), gaps.shape))
            if gaps[index, end] > _JOIN_MM:
                break
            waiting[index] = False
            filled = filled and chains[index].filled
            parts.append(chains[index].points[:: 1 if end == 0 else -1])
            chain = np.concatenate(parts)
        if not _is_closed(chain):
            if np.ptp(chain, axis=0).max() <= 2 * _JOIN_MM:
                # Ignore a short piece that is left over where other pieces met.
                continue
            area = abs(CrossSection([chain], FillRule.EvenOdd).area())
            if not filled or area < _LEAST_AREA_MM2:
                rest = [chains[k].points for k in np.flatnonzero(waiting)]
                raise _gap_error([chain, *rest], drawn, path)
            gap = float(np.linalg.norm(chain[-1] - chain[0]))
            notes.append(f"closed a filled curve straight over a gap of {gap:.2f} mm")
        loops.append((chain, first.element))
    return loops


def _gap_error(chains: list[Points], drawn: DrawnCurves, path: Path) -> UserError:
    """Returns an error that names the smallest gap between the ends of open curves."""
    ends = np.array([end for chain in chains for end in (chain[0], chain[-1])])
    gaps = np.linalg.norm(ends[:, None] - ends, axis=2)
    gaps[gaps <= _JOIN_MM] = np.inf
    one, other = np.unravel_index(int(np.argmin(gaps)), gaps.shape)
    x, y = (ends[one] + ends[other]) / 2
    # Give y as an SVG does: down from the page's upper edge.
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
            # Use smaller limits for short lines, so that neighbouring pieces of a curve stay apart.
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
    """Returns the indices of the curves to keep, in order.

    A curve that lies on a longer one, or on an earlier one of the same length, is left out.
    """
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
            # The other curve has a point only every `_SAME_MM`, so allow half of that. Allow less
            # for a short piece, because all of it is close to the pieces that it meets.
            near = min(1.2 * _SAME_MM, 0.5 * _SAME_MM + 0.2 * lengths[index])
            if trees[other].query(places)[0].max() <= near:
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
    if len(curve) < 3:
        return False
    gap = float(np.linalg.norm(curve[-1] - curve[0]))
    # Use a smaller limit for a short piece of a curve, whose ends are always close.
    return gap <= min(_JOIN_MM, 0.3 * float(np.ptp(curve, axis=0).max()))
