"""Which tools are reversible: whether a half turn about z leaves a tool as it was.

A tool is reversible only if nobody could tell it from its half-turn copy, neither by its surface
nor by the fit in its cavity. Then the half turn in its cavity is the same placement.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.spatial import cKDTree

from kitting_drake.hkd.tools.collision import furthest
from kitting_drake.hkd.tools.tool import footprint

MOST_SURFACE_DISTANCE_MM = 0.5
"""The mean distance of a reversible tool from its half-turn copy is less than this."""

MOST_OUTLINE_DEVIATION_MM = 2.0
"""The largest distance of their outlines is less than this: the clearance of a cavity."""

_SAMPLES, _DENSE_SAMPLES = 4000, 400_000

Shift = NDArray[np.float64]


@dataclass(frozen=True)
class Reversal:
    """How a tool differs from its half-turn copy about the best centre."""

    outline_deviation_mm: float
    """The largest distance of a point of one outline from the other, 5 mm at most."""
    surface_distance_mm: float
    """The symmetric mean distance of the surfaces; infinite where the outlines decide."""

    @property
    def is_symmetric(self) -> bool:
        """Whether nobody could tell the two apart."""
        return (
            self.outline_deviation_mm < MOST_OUTLINE_DEVIATION_MM
            and self.surface_distance_mm < MOST_SURFACE_DISTANCE_MM
        )


def symmetry_order(triangles: NDArray[np.float64]) -> int:
    """The order of a tool's rotational symmetry about z: 2 for a reversible tool, else 1.

    Args:
        triangles: (n, 3, 3) of the surface in frame T, in metres.
    """
    return 2 if measure_reversal(triangles).is_symmetric else 1


def measure_reversal(triangles: NDArray[np.float64], *, complete: bool = False) -> Reversal:
    """Compares a tool with its half-turn copy.

    The copy is moved along x and y to where the area that only one of the outlines covers is least;
    from there, once to where the outlines' deviation is least, and once to where the surfaces'
    distance is.

    Args:
        triangles: (n, 3, 3) of the surface in frame T, in metres.
        complete: whether the surfaces are compared where the outlines already differ too much.
    """
    outline = footprint(triangles).scale((1e3, 1e3))
    copy = outline.rotate(180.0)

    def uncommon_area(shift: Shift) -> float:
        moved = copy.translate(tuple(shift))
        return float((moved - outline).area() + (outline - moved).area())

    def deviation(shift: Shift) -> float:
        moved = copy.translate(tuple(shift))
        return max(furthest(moved, outline), furthest(outline, moved))

    shift, _ = _minimum(uncommon_area, np.zeros(2), 2.0)
    outline_deviation = deviation(shift)
    # Where it is twice too large here, no other shift makes up for it.
    if complete or outline_deviation < 2 * MOST_OUTLINE_DEVIATION_MM:
        outline_deviation = _minimum(deviation, shift, 0.5)[1]
    if not complete and outline_deviation >= MOST_OUTLINE_DEVIATION_MM:
        return Reversal(outline_deviation, np.inf)
    return Reversal(outline_deviation, _surface_distance(1e3 * triangles, shift))


def _surface_distance(triangles: NDArray[np.float64], start: Shift) -> float:
    """The mean distance of a surface and its half-turn copy, moved from `start` to the best."""
    faces = np.arange(3 * len(triangles)).reshape(-1, 3)
    mesh = trimesh.Trimesh(triangles.reshape(-1, 3), faces, process=False)
    points, _ = trimesh.sample.sample_surface(mesh, _SAMPLES, seed=0)
    dense, _ = trimesh.sample.sample_surface(mesh, _DENSE_SAMPLES, seed=1)
    tree = cKDTree(dense)

    # A half turn undoes itself, so the distances from the copy to the original are those back.
    def mean_distance(shift: Shift) -> float:
        copies = points * (-1.0, -1.0, 1.0) + np.append(shift, 0.0)
        return float(tree.query(copies)[0].mean())

    return _minimum(mean_distance, start, 0.5)[1]


def _minimum(function: Callable[[Shift], float], start: Shift, step: float) -> tuple[Shift, float]:
    """The shift near `start` at which a function is least, and its value there."""
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
