"""Chooses the cuts that divide a block. They pass between the cavities where possible.

A cut is a polyline from one side of the block to the opposite side, and never turns back. So
dynamic programming over a raster of costs finds the cheapest cut. The cost is low in solid
material, and higher across a cavity. It is highest along a cavity's wall, where a cut would leave a
thin wall. Cuts along y divide the block into strips. Cuts along x then divide each strip
separately.
"""

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from manifold3d import CrossSection, FillRule, JoinType
from numpy.typing import NDArray
from scipy import ndimage

from kitting_drake.hkd.fabrication.splitting.opening import (
    LEAST_WALL,
    Opening,
    corner_area,
    thin_parts,
    united,
)
from kitting_drake.hkd.kits.nesting import rasterized

TAB_REACH = 8.0
"""The largest length by which a dovetail sticks out of its piece, in mm."""

_CELL = 0.5
"""The side of a raster cell, in mm."""
# Costs per mm of a cut through solid material, along a wall, across a cavity, and through a label.
_SOLID, _WALL, _CAVITY, _LABEL = 1.0, 30.0, 12.0, 8.0
_FOOT, _FOOT_SIDE, _OFF_THE_MIDDLE = 3.0, 8.0, 2.0
"""Additional costs per mm of a cut through a foot, and of a cut along a foot's side. Between two
feet, `_OFF_THE_MIDDLE` is added for each mm of the cut's distance from the middle."""
_ROOMY = 4.0
"""Where possible, cuts stay at least this far from cavities, in mm."""
_STEEPEST = 4
"""The largest sideways step of a cut for each step forward, in cells."""
_UPRIGHT_ENDS = 6.0
"""The length at each end of a cut, in mm, that is perpendicular to the block's side."""
_REPAIRS = 8
"""The largest number of attempts to find cuts that leave no thin wall."""
_BARRED = 400.0
"""The additional cost per mm at a place where a cut left a thin wall."""

Line = NDArray[np.float64]
"""A polyline (n, 2) in mm."""


@dataclass(frozen=True)
class Cuts:
    """The cuts that divide a block, and the pieces."""

    lines: tuple[Line, ...]
    """All cuts. Each cut along x is as long as the block, although it divides only one strip."""
    regions: tuple[CrossSection, ...]
    """The outlines of the pieces from above, strip by strip."""
    cost: float
    """The sum of the costs of the cuts."""


def choose_cuts(
    size: tuple[float, float],
    openings: Sequence[Opening],
    bed: tuple[float, float],
    feet: Sequence[CrossSection] = (),
) -> Cuts | None:
    """Divides a block into as few pieces as possible, each of which fits the bed.

    Args:
        size: the block's length and width, in mm.
        openings: the block's recesses.
        bed: the sides of the bed, in mm; pieces may be turned by 90 degrees.
        feet: sections of the feet below the block, the lowest first. Cuts go between the feet
            where possible.

    Returns:
        The cuts, or None if all cuts that were tried leave a wall thinner than `LEAST_WALL`.
    """
    for extra in (0, 1, 2):
        found = [
            cuts
            for counts, turned in _counts(size, bed, extra)
            if (cuts := _Cutter(size, openings, turned, feet).cuts(counts)) is not None
        ]
        if found:
            return min(found, key=lambda cuts: (len(cuts.regions), cuts.cost))
    return None


def _counts(
    size: tuple[float, float], bed: tuple[float, float], extra: int
) -> Iterator[tuple[tuple[int, int], tuple[float, float]]]:
    """Yields the numbers of pieces along x and y to try, and the bed's sides along x and y.

    Args:
        size: the block's length and width, in mm.
        bed: the sides of the bed, in mm.
        extra: how many columns and rows of pieces to try in addition to the least possible number.
    """
    options = []
    for turned in dict.fromkeys((bed, bed[::-1])):
        least = [
            1 if side <= room else math.ceil((side - TAB_REACH) / (room - TAB_REACH))
            for side, room in zip(size, turned, strict=True)
        ]
        for more in itertools.product(range(extra + 1), repeat=2):
            # A side that fits the bed stays whole.
            if sum(more) == extra and not any(
                m and n == 1 for m, n in zip(more, least, strict=True)
            ):
                counts = (least[0] + more[0], least[1] + more[1])
                options.append((counts, turned))
    fewest = min((a * b for (a, b), _ in options), default=0)
    yield from (option for option in options if option[0][0] * option[0][1] == fewest)


def _windows(side: float, room: float, count: int) -> list[tuple[float, float]]:
    """Returns, for each cut, the range of positions at which all pieces fit the bed, in mm.

    The pieces' dovetails must fit the bed, too.

    Args:
        side: the side of the block to divide, in mm.
        room: the bed's side, in mm.
        count: the number of pieces.
    """
    reach = room - TAB_REACH
    if count == 2:
        return [(max(side - room, 0.2 * side), min(reach, 0.8 * side))]
    half = (reach - side / count) / 2
    return [(side * i / count - half, side * i / count + half) for i in range(1, count)]


class _Cutter:
    """Finds the cuts of a block for one orientation of the bed."""

    def __init__(
        self,
        size: tuple[float, float],
        openings: Sequence[Opening],
        bed: tuple[float, float],
        feet: Sequence[CrossSection],
    ) -> None:
        self._size, self._bed = size, bed
        self._open = united(o.outline for o in openings if not o.is_label)
        self._levels = list(_levels(size, openings, feet))
        self._counts = (int(size[1] / _CELL), int(size[0] / _CELL))
        labels = united(o.outline for o in openings if o.is_label)
        self._price = self._prices(labels) + self._foot_prices(feet)

    def _mask(self, outline: CrossSection) -> NDArray[np.bool_]:
        if outline.is_empty():
            return np.zeros(self._counts, dtype=bool)
        return rasterized(outline, np.zeros(2), self._counts, _CELL)

    def _prices(self, labels: CrossSection) -> NDArray[np.float64]:
        """Returns the cost per mm of a cut through each cell (rows along y, columns along x)."""
        inside = self._mask(self._open)
        outside = ndimage.distance_transform_edt(~inside) * _CELL if inside.any() else None
        if outside is None:
            return np.full(self._counts, _SOLID)
        within = ndimage.distance_transform_edt(inside) * _CELL
        price = np.where(inside, _CAVITY, _SOLID + np.clip(_ROOMY - outside, 0, None) / 2)
        near = LEAST_WALL + _CELL
        price = np.where((outside < near) & (within < near), _WALL, price)
        return price + _LABEL * self._mask(labels.offset(0.8, JoinType.Round))

    def _foot_prices(self, feet: Sequence[CrossSection]) -> NDArray[np.float64]:
        """Returns the cost per mm (rows, columns) that the feet add to a cut through each cell."""
        price = np.zeros(self._counts)
        if feet:
            inside = self._mask(feet[0])
            from_foot = ndimage.distance_transform_edt(~inside) * _CELL
            within = ndimage.distance_transform_edt(inside) * _CELL
            near = LEAST_WALL + _CELL
            price += _FOOT * inside + _FOOT_SIDE * ((from_foot < near) & (within < near))
            # Prefer the middle between two feet: higher up, the gap between them is narrower.
            price += _OFF_THE_MIDDLE * (from_foot.max() - from_foot) * ~inside
        return price

    def cuts(self, counts: tuple[int, int]) -> Cuts | None:
        """Divides the block into the given numbers of pieces along x and y.

        Returns:
            The cuts, or None if all cuts that were tried leave a thin wall or a piece in two parts.
        """
        price = self._price.copy()
        for _ in range(_REPAIRS):
            lines, regions, cost = self._divide(counts, price)
            thin = self._thin(regions)
            if not thin and all(len(region.decompose()) == 1 for region in regions):
                return Cuts(tuple(lines), tuple(regions), cost)
            for part in thin:
                price += _BARRED * self._mask(part.offset(1.5, JoinType.Round))
        return None

    def _divide(
        self, counts: tuple[int, int], price: NDArray[np.float64]
    ) -> tuple[list[Line], list[CrossSection], float]:
        length, width = self._size
        down = [self._line(price, w, 0) for w in _windows(length, self._bed[0], counts[0])]
        edges = [np.array([(-9.0, 0.0), (-9.0, width)]), *(line for line, _ in down)]
        edges.append(np.array([(length + 9.0, 0.0), (length + 9.0, width)]))
        block = CrossSection.square(self._size)
        lines = [line for line, _ in down]
        cost = sum(value for _, value in down)
        regions = []
        for left, right in itertools.pairwise(edges):
            strip = block ^ _between(_extended(left, 0), _extended(right, 0))
            mask = self._mask(strip)
            across = [
                self._line(np.where(mask, price, 0.01), w, 1)
                for w in _windows(width, self._bed[1], counts[1])
            ]
            cost += sum(value for _, value in across)
            sides = [np.array([(0.0, -9.0), (length, -9.0)]), *(line for line, _ in across)]
            sides.append(np.array([(0.0, width + 9.0), (length, width + 9.0)]))
            for low, high in itertools.pairwise(sides):
                regions.append(strip ^ _between(_extended(low, 1), _extended(high, 1)))
            lines += [line for line, _ in across]
        return lines, regions, cost

    def _line(
        self, price: NDArray[np.float64], window: tuple[float, float], axis: int
    ) -> tuple[Line, float]:
        """Returns the cheapest cut, and its cost.

        Args:
            price: the cost per mm of a cut through each cell (rows, columns).
            window: the range of the cut's coordinate along `axis`, in mm.
            axis: 0 for a cut along y, 1 for a cut along x.
        """
        field = price if axis == 0 else price.T
        end = self._size[1 - axis]
        low, high = math.ceil(window[0] / _CELL), math.floor(window[1] / _CELL)
        path, cost = _cheapest_path(field[:, low : max(high, low + 1)])
        points = np.column_stack([path + low + 0.5, np.arange(len(path)) + 0.5]) * _CELL
        points[0, 1], points[-1, 1] = 0.0, end
        line = _straightened(points, field)
        return (line if axis == 0 else line[:, ::-1]), cost

    def _thin(self, regions: Sequence[CrossSection]) -> list[CrossSection]:
        """Returns thin walls and sharp tips of the pieces, except those of the uncut block."""
        for solid, known in self._levels:
            found = []
            for region in regions:
                thin = thin_parts(region ^ solid, LEAST_WALL) - known
                found += [
                    part for part in thin.decompose() if part.area() > corner_area(LEAST_WALL)
                ]
            if found:
                return found
        return []


def _levels(
    size: tuple[float, float], openings: Sequence[Opening], feet: Sequence[CrossSection]
) -> Iterator[tuple[CrossSection, CrossSection]]:
    """Yields horizontal sections of the uncut block, with the thin parts of each section.

    The sections are at the block's top, at its bottom, above each floor and through its feet.
    """
    room = CrossSection.square(size)
    deep = [opening for opening in openings if not opening.is_label]
    floors = sorted({round(opening.floor, 2) for opening in deep})
    sections = [[opening.outline for opening in deep], []]
    sections += [[o.walls for o in deep if o.floor < floor + 0.01] for floor in floors]
    for solid in (*(room - united(outlines) for outlines in sections), *feet):
        yield solid, thin_parts(solid, LEAST_WALL).offset(0.02, JoinType.Round)


def _cheapest_path(price: NDArray[np.float64]) -> tuple[NDArray[np.int64], float]:
    """Finds the cheapest path through a raster (rows, columns) of costs per mm, row by row.

    Returns:
        The path's column in each row, and the path's cost.
    """
    rows, columns = price.shape
    shifts = np.arange(-_STEEPEST, _STEEPEST + 1)
    lengths = np.hypot(1.0, shifts) * _CELL
    upright = int(_UPRIGHT_ENDS / _CELL)
    best = price[0] * _CELL
    came = np.zeros((rows, columns), dtype=np.int64)
    for row in range(1, rows):
        ends = row <= upright or row >= rows - upright
        options = np.full((len(shifts), columns), np.inf)
        for number, shift in enumerate(shifts):
            if ends and shift:
                continue
            target = slice(max(0, shift), columns + min(0, shift))
            source = slice(max(0, -shift), columns + min(0, -shift))
            if target.start >= columns or source.start >= columns or columns <= abs(shift):
                continue
            mean = (price[row, target] + price[row - 1, source]) / 2
            options[number, target] = best[source] + lengths[number] * mean
        came[row] = np.argmin(options, axis=0)
        best = options[came[row], np.arange(columns)]
    column = int(np.argmin(best))
    cost = float(best[column])
    path = np.empty(rows, dtype=np.int64)
    for row in range(rows - 1, -1, -1):
        path[row] = column
        if row:
            column -= int(shifts[came[row, column]])
    return path, cost


def _straightened(points: Line, price: NDArray[np.float64]) -> Line:
    """Replaces parts of a path by straight lines that cost hardly more.

    Args:
        points: the path (n, 2) in mm, along which the second coordinate increases.
        price: the costs per mm; the rows are along the second coordinate.
    """

    def cost(a: Line, b: Line) -> float:
        length = float(np.linalg.norm(b - a))
        count = max(2, int(2 * length / _CELL))
        at = a + (np.arange(count) + 0.5)[:, None] / count * (b - a)
        cells = np.clip((at / _CELL).astype(int), 0, np.array(price.shape[::-1]) - 1)
        return length * float(price[cells[:, 1], cells[:, 0]].mean())

    steps = np.array([cost(a, b) for a, b in itertools.pairwise(points)])
    along = np.concatenate([[0.0], np.cumsum(steps)])
    kept, last, margin = [0], len(points) - 1, int(_UPRIGHT_ENDS / _CELL)
    first_free, last_free = min(margin, last), max(last - margin, 0)
    while kept[-1] < last:
        start = kept[-1]
        # Near its two ends, the cut must stay perpendicular to the block's sides.
        limit = first_free if start < first_free else last_free if start < last_free else last
        end = limit
        while end > start + 1:
            if cost(points[start], points[end]) <= 1.01 * (along[end] - along[start]) + 0.3:
                break
            end -= max(1, (end - start) // 16)
        kept.append(end)
    return points[kept]


def _extended(line: Line, axis: int) -> Line:
    """Returns a cut with both ends extended beyond the block."""
    along = 1 - axis
    low, high = line[0].copy(), line[-1].copy()
    low[along] -= 9.0
    high[along] += 9.0
    return np.vstack([low, line, high])


def _between(one: Line, other: Line) -> CrossSection:
    return CrossSection([np.vstack([one, other[::-1]])], FillRule.NonZero)
