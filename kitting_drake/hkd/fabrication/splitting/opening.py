"""The recesses of a block that is split, and helpers that find thin walls."""

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from manifold3d import CrossSection, JoinType
from numpy.typing import NDArray

LEAST_WALL = 1.2
"""The least thickness of a wall, in mm: three lines printed with a nozzle of 0.4 mm."""

_SLIVER = 1e-3
"""Parts thinner than twice this share of the least thickness are errors of rounding."""
_SHARPEST = math.radians(42)
"""The angle in radians below which a corner counts as a thin wall."""


@dataclass(frozen=True)
class Opening:
    """A recess in a block, in mm. The origin is the lower left corner of the block's bottom."""

    outline: CrossSection
    """The outline of the recess at the block's top, including the bevel."""
    floor: float
    """The height of the recess's floor."""
    is_label: bool = False
    below_bevel: CrossSection | None = None
    """The outline of the recess below the bevel. None: the recess has no bevel."""

    @property
    def walls(self) -> CrossSection:
        """The outline of the recess's upright walls."""
        return self.outline if self.below_bevel is None else self.below_bevel


def united(outlines: Iterable[CrossSection]) -> CrossSection:
    """Returns the union of outlines."""
    union = CrossSection()
    for outline in outlines:
        union += outline
    return union


def corner_area(least: float) -> float:
    """Returns the area that `thin_parts` finds at the tip of a corner with the angle `_SHARPEST`.

    A part with at most this area counts as the tip of a corner, not as a thin wall.
    """
    return (least / 2) ** 2 * (1 / math.tan(_SHARPEST / 2) - (math.pi - _SHARPEST) / 2)


def thin_parts(shape: CrossSection, least: float) -> CrossSection:
    """Returns the parts of a shape that are thinner than `least`, and the tips of its corners."""
    inner = shape.offset(-least / 2, JoinType.Round, circular_segments=64)
    thin = shape - inner.offset(least / 2, JoinType.Round, circular_segments=64)
    # The arcs are polygons, so slivers along the edges may join one corner's tip to the next.
    sliver = _SLIVER * least
    return thin.offset(-sliver, JoinType.Miter).offset(sliver, JoinType.Miter)


def roomiest_point(outline: CrossSection, farthest: float) -> NDArray[np.float64]:
    """Returns approximately the point (2) inside an outline that is farthest from its boundary.

    Args:
        outline: the outline.
        farthest: the largest distance from the boundary that is tried.
    """
    distance = farthest
    while distance > farthest / 320:
        inner = outline.offset(-distance, JoinType.Round)
        if not inner.is_empty():
            return _middle(inner.decompose()[0])
        distance *= 0.85
    return _middle(outline)


def _middle(outline: CrossSection) -> NDArray[np.float64]:
    x_min, y_min, x_max, y_max = outline.bounds()
    return np.array([(x_min + x_max) / 2, (y_min + y_max) / 2])
