"""Nesting: packs shapes of any outline on a rectangle as small as possible.

Shapes are placed one by one, largest first, in strips of several widths. Each shape goes where it
raises the strip's used height least, and the best strip is kept.

All translations of a shape are tested at once on a raster. A translation is possible where the
cross-correlation of the shape's mask with the mask of the placed shapes is zero; a fast Fourier
transform computes it for the whole strip. A mask covers every cell that its shape touches, so the
exact outlines keep their distances.
"""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from manifold3d import CrossSection, JoinType
from numpy.typing import NDArray

CELL = 0.0015
"""The side of a raster cell, in metres."""

PREFERRED_SIDE = 0.42
"""The rectangle's sides are at most this long, in metres, unless the shapes need more."""

USUAL_SIDES = (0.48, 0.95)
"""The largest sides, in metres, for shapes that need more than `PREFERRED_SIDE`. Such a rectangle
fits into the usual workspace of 0.5 by 1 m with a margin."""

LONGEST_SIDES = (0.90, 1.20)
"""The sides of the largest rectangle, in metres. It covers most of the table of 1.0 by 1.5 m."""

_YAWS_DEG = (0, 90, 180, 270)
_WIDTHS = (1.0, 0.9, 1.1, 0.8, 1.25, 1.45)
"""Strip widths to try, as multiples of the side of a square of the expected area."""
_EXPECTED_USE = 0.60
"""The expected ratio of the area of the outlines with their walls to the rectangle's area."""
_ELONGATION_COST = 0.10
"""The fraction by which a rectangle with sides of 2 to 1 costs more than a square of equal area."""
_ARC_SEGMENTS = 64
_REACH = 1.02 * CELL / math.sqrt(2)
"""The largest distance of a point from the centre of its cell, with a margin for rounding."""

Mask = NDArray[np.bool_]
Spectrum = NDArray[np.complexfloating]


@dataclass(frozen=True)
class NestedShape:
    """A shape to place; lengths in metres."""

    outline: CrossSection
    """The shape's outline. `nest` leaves a wall between any two outlines."""
    keep_out: CrossSection
    """A region that no other shape's outline may overlap. Such regions may overlap each other."""


@dataclass(frozen=True)
class NestedPose:
    """The pose of a shape on a rectangle.

    (x, y) is the origin of the shape's frame relative to the rectangle's centre, in metres.
    """

    x: float
    y: float
    yaw_deg: int
    """The rotation about z in degrees, a multiple of 90."""


@dataclass(frozen=True)
class Nesting:
    """A rectangle and the poses of the shapes on it."""

    length: float
    """The extent along x, in metres."""
    width: float
    """The extent along y, in metres."""
    poses: tuple[NestedPose, ...]
    """The poses, in the shapes' order."""


def nest(shapes: Sequence[NestedShape], wall: float) -> Nesting | None:
    """Places shapes on the best rectangle found, or returns None if none is large enough.

    The best rectangle is small and nearly square. It exceeds `PREFERRED_SIDE` and `USUAL_SIDES`
    only if no smaller one is found. The result is deterministic.

    Args:
        shapes: the shapes, at least one.
        wall: the least distance between two outlines, and of an outline from the rectangle's edge,
            in metres.
    """
    parts = [[_Part(shape, yaw, wall) for yaw in _YAWS_DEG] for shape in shapes]
    sizes = [int(rotated[0].walled.sum()) for rotated in parts]
    order = sorted(range(len(shapes)), key=lambda i: -sizes[i])
    side = math.sqrt(sum(sizes) / _EXPECTED_USE)
    narrowest = max(min(part.size[1] for part in rotated) for rotated in parts)
    for longest in ((PREFERRED_SIDE, PREFERRED_SIDE), USUAL_SIDES, LONGEST_SIDES):
        columns, rows = (int(length / CELL) for length in longest)
        widths = [min(columns, max(narrowest, round(share * side))) for share in _WIDTHS]
        best, lowest_cost = None, math.inf
        for width in dict.fromkeys([*widths, columns]):
            placements = _fill_strip(parts, order, (rows, width), lowest_cost)
            if placements is None:
                continue
            nesting = _tightened(shapes, placements, wall)
            cost = _cost(nesting.length, nesting.width)
            if cost < lowest_cost:
                best, lowest_cost = nesting, cost
        if best is not None:
            return best
    return None


def nest_on(
    shapes: Sequence[NestedShape], wall: float, room: tuple[float, float]
) -> Nesting | None:
    """Places shapes on a rectangle of a given size, or returns None if no placement is found.

    Args:
        shapes: the shapes, at least one.
        wall: the least distance between two outlines, and of an outline from the rectangle's edge,
            in metres.
        room: the rectangle's length along x and width along y, in metres.

    Returns:
        The nesting; its shapes are centred on the given rectangle.
    """
    parts = [[_Part(shape, yaw, wall) for yaw in _YAWS_DEG] for shape in shapes]
    sizes = [int(rotated[0].walled.sum()) for rotated in parts]
    extents = [max(rotated[0].size) for rotated in parts]
    largest_first = sorted(range(len(shapes)), key=lambda i: -sizes[i])
    longest_first = sorted(range(len(shapes)), key=lambda i: -extents[i])
    # Also try strips that are one or two cells too large. Masks are larger than their shapes, so
    # the shapes may still fit.
    for order, lengthwise, excess in itertools.product(
        (largest_first, longest_first), (True, False), (0, 1, 2)
    ):
        length, width = room if lengthwise else room[::-1]
        strip = (int(width / CELL) + excess, int(length / CELL) + excess)
        placements = _fill_strip(parts, order, strip, math.inf)
        if placements is None:
            continue
        fitted = _centred_on(_tightened(shapes, placements, wall), room, lengthwise)
        if fitted is not None:
            return fitted
    least = nest(shapes, wall)
    return least and (_centred_on(least, room, True) or _centred_on(least, room, False))


def _centred_on(nesting: Nesting, room: tuple[float, float], lengthwise: bool) -> Nesting | None:
    """Centres a nesting on a larger rectangle; turns it by 90 degrees unless `lengthwise`.

    Returns None if the nesting is too large.
    """
    length, width = room if lengthwise else room[::-1]
    if nesting.length > length + 1e-9 or nesting.width > width + 1e-9:
        return None
    return Nesting(
        *room, nesting.poses if lengthwise else tuple(map(_quarter_turned, nesting.poses))
    )


def _quarter_turned(pose: NestedPose) -> NestedPose:
    return NestedPose(-pose.y, pose.x, (pose.yaw_deg + 90) % 360)


def _cost(length: float, width: float) -> float:
    ratio = max(length, width) / min(length, width)
    return length * width * (1.0 + _ELONGATION_COST * (ratio - 1.0))


class _Part:
    """Masks of a rotated shape, all of one size: rows along y, columns along x.

    Cell `inset` (row, column) is the lower left corner of the outline and the wall around it.
    """

    def __init__(self, shape: NestedShape, yaw_deg: int, wall: float) -> None:
        self.yaw_deg = yaw_deg
        # `solid` has every cell that the outline touches. It must not overlap another shape's
        # `walled`, which keeps the wall between the two, nor another shape's `keep_out`.
        solid = _grown(shape.outline.rotate(yaw_deg), _REACH)
        walled = _grown(shape.outline.rotate(yaw_deg), wall + _REACH)
        keep_out = _grown(shape.keep_out.rotate(yaw_deg), _REACH)
        x_low, y_low, x_high, y_high = walled.bounds()
        self.size = (_cells(y_high - y_low), _cells(x_high - x_low))
        x_min, y_min, x_max, y_max = (walled + keep_out).bounds()
        self.inset = (_cells(y_low - y_min), _cells(x_low - x_min))
        self.corner = np.array([x_low, y_low])
        """The lower left corner (x, y) of the outline and its wall, in the rotated frame."""
        start = self.corner - CELL * np.array(self.inset[::-1])
        counts = (_cells(y_max - start[1]), _cells(x_max - start[0]))
        self.solid = rasterized(solid, start, counts)
        self.walled = rasterized(walled, start, counts)
        self.keep_out = rasterized(keep_out, start, counts)
        self._spectra: dict[tuple[int, int], tuple[Spectrum, Spectrum]] = {}

    def spectra(self, canvas: tuple[int, int]) -> tuple[Spectrum, Spectrum]:
        """Returns the complex conjugate spectra of two masks on a canvas of (rows, columns).

        The first mask has the cells that another shape's `solid` may not occupy. The second mask
        has the cells that another shape's `keep_out` may not occupy.
        """
        if canvas not in self._spectra:
            self._spectra[canvas] = (
                np.conj(_transform(self.on_canvas(self.walled | self.keep_out, canvas, (0, 0)))),
                np.conj(_transform(self.on_canvas(self.solid, canvas, (0, 0)))),
            )
        return self._spectra[canvas]

    def on_canvas(self, mask: Mask, canvas: tuple[int, int], place: tuple[int, int]) -> Mask:
        """Puts a mask on a cyclic canvas. The mask's cell `inset` is at `place` (row, column)."""
        result = np.zeros(canvas, dtype=bool)
        result[: mask.shape[0], : mask.shape[1]] = mask
        return np.roll(result, (place[0] - self.inset[0], place[1] - self.inset[1]), axis=(0, 1))


def _transform(mask: Mask) -> Spectrum:
    from scipy import fft

    return fft.rfft2(mask.astype(np.float32))


def _cells(length: float) -> int:
    return math.ceil(length / CELL - 1e-9)


def _grown(outline: CrossSection, distance: float) -> CrossSection:
    return outline.offset(distance, JoinType.Round, circular_segments=_ARC_SEGMENTS)


def rasterized(
    outline: CrossSection,
    start: NDArray[np.float64],
    counts: tuple[int, int],
    cell: float = CELL,
) -> Mask:
    """Returns the mask of the cells whose centres are inside an outline.

    Args:
        outline: the outline in metres; not empty.
        start: (x, y) of the raster's lower left corner, in metres.
        counts: the numbers of cells along y and x.
        cell: the side of a cell, in metres.
    """
    loops = outline.to_polygons()
    a = (np.concatenate(loops) - start) / cell - 0.5
    b = (np.concatenate([np.roll(loop, -1, axis=0) for loop in loops]) - start) / cell - 0.5
    rows = np.arange(counts[0])[:, None]
    row, edge = np.nonzero((a[:, 1] <= rows) != (b[:, 1] <= rows))
    (a_x, a_y), (b_x, b_y) = a[edge].T, b[edge].T
    crossing = a_x + (row - a_y) / (b_y - a_y) * (b_x - a_x)
    # A cell is inside if the number of crossings to its left is odd.
    flips = np.zeros((counts[0], counts[1] + 1), dtype=np.int64)
    np.add.at(flips, (row, np.clip(np.ceil(crossing), 0, counts[1]).astype(int)), 1)
    return np.cumsum(flips, axis=1)[:, :-1] % 2 == 1


_Placement = tuple[_Part, tuple[int, int]]


def _fill_strip(
    parts: Sequence[Sequence[_Part]], order: Sequence[int], strip: tuple[int, int], limit: float
) -> list[_Placement] | None:
    """Places one part of each list in a strip of (rows, columns), each as low as possible.

    Args:
        parts: for each shape, its masks at the angles to try.
        order: the order in which the shapes are placed.
        strip: the rows and columns of the strip.
        limit: the cost above which the strip is abandoned.

    Returns:
        For each shape, the chosen part and the (row, column) of its corner. None if the shapes do
        not fit or cost more than the limit.
    """
    from scipy import fft

    # The Fourier transform is cyclic, so keep-out regions that reach beyond the canvas would wrap
    # around. Make the canvas larger than the strip, by the largest overhang of such a region.
    overhang = max(
        max(part.solid.shape[axis] - part.size[axis] for axis in (0, 1))
        for rotated in parts
        for part in rotated
    )
    canvas = tuple(fft.next_fast_len(extent + overhang, real=True) for extent in strip)
    solid, keep_out = np.zeros(canvas, dtype=bool), np.zeros(canvas, dtype=bool)
    placements: dict[int, _Placement] = {}
    height = 0
    for index in order:
        taken = (_transform(solid), _transform(keep_out))
        options = []
        for rank, part in enumerate(parts[index]):
            place = _lowest_place(part, taken, strip, canvas)
            if place is not None:
                top = place[0] + part.size[0]
                options.append((max(height, top), top, place[1], rank, place))
        if not options:
            return None
        height, _, _, rank, place = min(options)
        if _cost(strip[1] * CELL, max(1, height) * CELL) > limit and height >= strip[1]:
            return None
        part = parts[index][rank]
        solid |= part.on_canvas(part.solid, canvas, place)
        keep_out |= part.on_canvas(part.keep_out, canvas, place)
        placements[index] = (part, place)
    return [placements[index] for index in range(len(parts))]


def _lowest_place(
    part: _Part,
    taken: tuple[Spectrum, Spectrum],
    strip: tuple[int, int],
    canvas: tuple[int, int],
) -> tuple[int, int] | None:
    """Returns the lowest possible place (row, column) of a part's corner, or None if none is free.

    Of equally low places, the leftmost is returned.
    """
    rows, columns = strip[0] - part.size[0] + 1, strip[1] - part.size[1] + 1
    if rows <= 0 or columns <= 0:
        return None
    from scipy import fft

    against_solid, against_keep_out = part.spectra(canvas)
    overlap = fft.irfft2(taken[0] * against_solid + taken[1] * against_keep_out, s=canvas)
    # The correlation is the number of overlapping cells; a value below 0.5 is a zero with a
    # rounding error.
    free = overlap[:rows, :columns] < 0.5
    first = int(np.argmax(free))
    row, column = divmod(first, columns)
    return (row, column) if free[row, column] else None


def _tightened(
    shapes: Sequence[NestedShape], placements: Sequence[_Placement], wall: float
) -> Nesting:
    """Returns the placed shapes on the smallest rectangle that holds them with their walls."""
    origins = [CELL * np.array([column, row]) - part.corner for part, (row, column) in placements]
    bounds = np.array(
        [
            np.array(shape.outline.rotate(part.yaw_deg).bounds()) + np.tile(origin, 2)
            for shape, (part, _), origin in zip(shapes, placements, origins, strict=True)
        ]
    )
    low, high = bounds[:, :2].min(axis=0) - wall, bounds[:, 2:].max(axis=0) + wall
    centred = np.array(origins) - (low + high) / 2
    poses = [
        NestedPose(float(x), float(y), part.yaw_deg)
        for (x, y), (part, _) in zip(centred, placements, strict=True)
    ]
    return Nesting(float(high[0] - low[0]), float(high[1] - low[1]), tuple(poses))
