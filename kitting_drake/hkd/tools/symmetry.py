"""Rotational symmetry of tools about z.

A tool is symmetric if its rotated copy has nearly the same surface and nearly the same outline. The
rotated tool then fits the same cavity, and its pose there counts as correct, too.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import trimesh
from manifold3d import CrossSection
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.spatial import cKDTree

from kitting_drake.hkd.tools.collision import furthest
from kitting_drake.hkd.tools.tool import footprint

MOST_SURFACE_DISTANCE_MM = 0.5
"""A tool counts as symmetric only if its mean distance from its rotated copy is less than this, in
mm."""

MOST_OUTLINE_DEVIATION_MM = 2.0
"""A tool counts as symmetric only if the largest distance between its outline and that of its
rotated copy is less than this, in mm. The limit equals the default clearance of a cavity."""

ORDERS = (24, 12, 10, 9, 8, 7, 6, 5, 4, 3, 2)
"""The orders to try, largest first. The largest stands for round tools."""

_SAMPLES, _DENSE_SAMPLES = 4000, 400_000

_FAR_MM, _COARSER = 2.0, 20
"""A distance above `_FAR_MM` is measured only to every `_COARSER`th sample, and so is less exact.

This saves time, because the search for the nearest neighbour is slow for a point on the axis of a
hollow part: it is equally far from the whole wall.
"""

_REACH_MM = 0.75
"""Two shifts of the copy are assumed to differ by at most this, in mm: the one that best fits the
surfaces, and the one that best fits the outlines."""

Shift = NDArray[np.float64]


@dataclass(frozen=True)
class Difference:
    """The difference between a tool and its rotated copy.

    For each measure, the copy is translated to make that measure as small as possible.
    """

    outline_deviation_mm: float
    """The largest distance of a point of one outline from the other, in mm, but at most 5."""
    surface_distance_mm: float
    """The symmetric mean distance of the surfaces in mm; infinity if the outlines differ too much.

    Unless the comparison is complete, a value above `MOST_SURFACE_DISTANCE_MM` is a lower bound.
    """

    @property
    def is_symmetric(self) -> bool:
        """Whether the rotated copy looks like the tool and fits its cavity."""
        return (
            self.outline_deviation_mm < MOST_OUTLINE_DEVIATION_MM
            and self.surface_distance_mm < MOST_SURFACE_DISTANCE_MM
        )


def symmetry_order(triangles: NDArray[np.float64]) -> int:
    """Returns the order of a tool's rotational symmetry about z: the largest of `ORDERS` for which
    it is symmetric, or 1.

    Args:
        triangles: (n, 3, 3) the surface in frame T, in metres.
    """
    outline = footprint(triangles).scale((1e3, 1e3))
    size = _size(outline)
    for order in ORDERS:
        # However the copy is shifted, the outlines deviate by at least half the difference in size.
        differs = np.abs(_size(outline.rotate(360.0 / order)) - size).max()
        alike = differs < 2 * MOST_OUTLINE_DEVIATION_MM
        if alike and measure_rotation(triangles, order).is_symmetric:
            return order
    return 1


def _size(outline: CrossSection) -> NDArray[np.float64]:
    """Returns the extents (2,) of an outline along x and y."""
    bounds = np.array(outline.bounds())
    return bounds[2:] - bounds[:2]


def measure_rotation(
    triangles: NDArray[np.float64], order: int = 2, *, complete: bool = False
) -> Difference:
    """Compares a tool with its copy, rotated about z by 2 pi / order.

    A first search translates the copy to minimize the area that only one outline covers. From
    there, two separate searches minimize the deviation of the outlines and the distance of the
    surfaces.

    Args:
        triangles: (n, 3, 3) the surface in frame T, in metres.
        order: the order of the symmetry; 2 is a half turn.
        complete: whether to compare the surfaces even if the outlines differ too much.
    """
    outline = footprint(triangles).scale((1e3, 1e3))
    copy = outline.rotate(360.0 / order)

    def uncommon_area(shift: Shift) -> float:
        moved = copy.translate(tuple(shift))
        return float((moved - outline).area() + (outline - moved).area())

    def deviation(shift: Shift) -> float:
        moved = copy.translate(tuple(shift))
        return max(furthest(moved, outline), furthest(outline, moved))

    shift, _ = _minimum(uncommon_area, np.zeros(2), 2.0)
    outline_deviation = deviation(shift)
    # If the deviation is at least twice the limit, assume that no translation brings it below the
    # limit.
    if complete or outline_deviation < 2 * MOST_OUTLINE_DEVIATION_MM:
        outline_deviation = _minimum(deviation, shift, 0.5)[1]
    if not complete and outline_deviation >= MOST_OUTLINE_DEVIATION_MM:
        return Difference(outline_deviation, np.inf)
    distance = _surface_distance(1e3 * triangles, order, shift, complete=complete)
    return Difference(outline_deviation, distance)


def _surface_distance(
    triangles: NDArray[np.float64], order: int, start: Shift, *, complete: bool
) -> float:
    """Returns the mean distance in mm between a surface and its rotated and shifted copy.

    The shift is chosen to minimize this distance, by a search from `start`. A result of at least
    `MOST_SURFACE_DISTANCE_MM` may be only a lower bound of the minimum, unless `complete` is set.
    """
    faces = np.arange(3 * len(triangles)).reshape(-1, 3)
    mesh = trimesh.Trimesh(triangles.reshape(-1, 3), faces, process=False)
    points, _ = trimesh.sample.sample_surface(mesh, _SAMPLES, seed=0)
    dense, _ = trimesh.sample.sample_surface(mesh, _DENSE_SAMPLES, seed=1)
    tree = cKDTree(dense)

    c, s = np.cos(2 * np.pi / order), np.sin(2 * np.pi / order)
    R = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])

    coarse_tree = cKDTree(dense[::_COARSER])

    def mean_to_surface(places: NDArray[np.float64]) -> float:
        distances, _ = tree.query(places, distance_upper_bound=_FAR_MM)
        far = np.isinf(distances)
        if far.any():
            distances[far], _ = coarse_tree.query(places[far])
        return float(distances.mean())

    # Average the distance from the copy to the original and that from the original to the copy. For
    # a half turn the two distances are equal.
    def mean_distance(shift: Shift) -> float:
        offset = np.append(shift, 0.0)
        there = mean_to_surface(points @ R.T + offset)
        back = there if order == 2 else mean_to_surface((points - offset) @ R)
        return float(there + back) / 2

    if not complete:
        # A shift changes the distance by at most its own length, so this is a lower bound.
        least = mean_distance(start) - _REACH_MM
        if least >= MOST_SURFACE_DISTANCE_MM:
            return least
    return _minimum(mean_distance, start, 0.5)[1]


def _minimum(function: Callable[[Shift], float], start: Shift, step: float) -> tuple[Shift, float]:
    """Minimizes a function near the shift `start`; returns the best shift and the minimum."""
    found = minimize(
        function,
        start,
        method="Nelder-Mead",
        options={
            "initial_simplex": start + step * np.array([[0, 0], [1, 0], [0, 1]]),
            "xatol": 0.01,
            "fatol": 1e-4,
        },
    )
    return found.x, float(found.fun)
