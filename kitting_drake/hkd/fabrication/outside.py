"""The outside of a printed block: chamfers, and the feet of a Gridfinity base.

Gridfinity is a public standard of bins on a grid of 42 mm. The numbers are those of its published
specification (https://gridfinity.xyz/specification/): a bin is 0.5 mm smaller than its cells, its
corners have a radius of 3.75 mm, and each cell has a foot, 0.8 + 1.8 + 2.15 mm high.
"""

import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from manifold3d import CrossSection, Manifold
from numpy.typing import NDArray

PITCH = 42.0
"""The grid's pitch in mm."""
GAP = 0.5
"""How much smaller a bin is than its cells, in mm."""
FOOT = ((0.0, 35.6, 0.8), (0.8, 37.2, 1.6), (2.6, 37.2, 1.6), (4.75, 41.5, 3.75))
"""The square sections of a foot from the bottom up: height above the bottom, side and corner
radius, in mm."""
FOOT_HEIGHT = FOOT[-1][0]
"""The height of a foot, in mm."""

_SECTION_HEIGHTS = (0.0, 1.7, 3.2, 3.8, 4.4)
"""The heights of the sections that `foot_sections` returns, in mm."""
_ARC_SEGMENTS = 64


@dataclass(frozen=True)
class Outside:
    """The outside of a block."""

    chamfer_mm: float = 0.0
    """The width of the bevel along the block's outer edges; zero for none."""
    gridfinity: bool = False
    """Whether the block has Gridfinity's feet. Its sides must then be on the grid (`grid_side`)."""

    @property
    def raised_mm(self) -> float:
        """The height by which the feet raise the block, in mm."""
        return FOOT_HEIGHT if self.gridfinity else 0.0


def grid_side(side: float) -> float:
    """Returns the side of the smallest Gridfinity bin that is at least `side` wide, in mm."""
    return PITCH * max(1, math.ceil((side + GAP) / PITCH - 1e-9)) - GAP


def shaped(block: Manifold, outside: Outside) -> Manifold:
    """Shapes the outside of a block.

    Args:
        block: the block in mm, with its lower corner at the origin.
        outside: the shape.

    Returns:
        The shaped block. The lower corner of the block, or of the block with its feet, is at the
        origin.
    """
    if not outside.chamfer_mm and not outside.gridfinity:
        return block
    length, width, height = block.bounding_box()[3:]
    radius = FOOT[-1][2] if outside.gridfinity else 0.0
    bevel = outside.chamfer_mm
    # A chamfer above the feet would be an overhang.
    low = 0.0 if outside.gridfinity else bevel
    levels = ((0.0, low), (low, 0.0), (height - bevel, 0.0), (height, bevel))
    rings = [_ring((length, width), radius, inset, z) for z, inset in dict.fromkeys(levels)]
    block ^= Manifold.hull_points(np.concatenate(rings))
    if not outside.gridfinity:
        return block
    block = block.translate((0, 0, FOOT_HEIGHT))
    foot = _foot()
    for column, row in _cells((length, width)):
        block += foot.translate((PITCH * column, PITCH * row, 0))
    return block


def foot_sections(size: tuple[float, float]) -> list[CrossSection]:
    """Returns sections of a block's feet at several heights, the lowest first, in mm.

    Args:
        size: the block's length and width, in mm.
    """
    heights, sides, radii = np.array(FOOT).T
    sections = []
    for z in _SECTION_HEIGHTS:
        side = float(np.interp(z, heights, sides))
        ring = _ring((side, side), float(np.interp(z, heights, radii)), 0.0, 0.0)
        foot = CrossSection.hull_points(ring[:, :2])
        inset = (PITCH - GAP - side) / 2
        section = CrossSection()
        for column, row in _cells(size):
            section += foot.translate((PITCH * column + inset, PITCH * row + inset))
        sections.append(section)
    return sections


def _cells(size: tuple[float, float]) -> Iterator[tuple[int, int]]:
    """Returns the (column, row) of each cell below a block of the given size in mm."""
    columns, rows = (round((side + GAP) / PITCH) for side in size)
    return itertools.product(range(columns), range(rows))


def _foot() -> Manifold:
    """Returns the foot below the cell in column 0 and row 0, in mm."""
    side = PITCH - GAP
    rings = [_ring((side, side), r, (side - s) / 2, z) for z, s, r in FOOT]
    foot = Manifold()
    for lower, upper in itertools.pairwise(rings):
        foot += Manifold.hull_points(np.concatenate([lower, upper]))
    return foot


def _ring(size: tuple[float, float], radius: float, inset: float, z: float) -> NDArray[np.float64]:
    """Returns the vertices (n, 3) of a rounded rectangle inside a given one, in mm.

    Args:
        size: the sides of the given rectangle, in mm; its lower left corner is at the origin.
        radius: the radius of the returned rectangle's corners, in mm.
        inset: the distance between the sides of the two rectangles, in mm.
        z: the height of the vertices, in mm.
    """
    sides = np.array(size) - 2 * inset
    if radius:
        inner = CrossSection.square(tuple(sides - 2 * radius)).to_polygons()[0] + radius
        circle = CrossSection.circle(radius, _ARC_SEGMENTS).to_polygons()[0]
        flat = np.concatenate([circle + corner for corner in inner])
    else:
        flat = CrossSection.square(tuple(sides)).to_polygons()[0]
    return np.column_stack([flat + inset, np.full(len(flat), z)])
