"""The mass distribution of an imported tool.

A mesh does not state materials. This module assumes that the head of a hammer and the blade of a
screwdriver are of steel, and that their handles are lighter. The centre of mass is then not the
centroid of the volume.
"""

import numpy as np
from manifold3d import Manifold
from numpy.typing import NDArray

from kitting_drake.common.errors import UserError
from kitting_drake.hkd.tools import meshes
from kitting_drake.hkd.tools.mass import Body, mass_properties

_STEEL, _HANDLE = 7850.0, 1200.0

MATERIALS = {
    "steel": _STEEL,
    "aluminium": 2700.0,
    "brass": 8500.0,
    "titanium": 4430.0,
    "wood": 700.0,
    "plastic": 1150.0,
    "rubber": 1200.0,
}
"""The densities in kg/m^3 of the materials that `--material` accepts."""

DENSITIES = {"pliers": 6000.0, "wrench": _STEEL}
"""The mean density of a category's tools with their grips, in kg/m^3."""
OTHER_DENSITY = 3000.0
"""The mean density of a tool of any other category, in kg/m^3."""

DENSITY_RANGE = (50.0, 25_000.0)
"""The least and the largest mean density of a tool, in kg/m^3."""

_SLICES = 60
_END = 0.3
"""The length of each of a tool's two ends, as a share of the tool's length."""
_STEP_WIDTH = 1.5
"""A hammer or screwdriver is split into two bodies if its head or handle is at least this many
times as wide as its shaft."""


def bodies_of(solid: Manifold, category: str, density: float | None = None) -> list[Body]:
    """Splits a tool in its frame T into one or two homogeneous bodies.

    A hammer is split into a steel head and a light handle, and a screwdriver into a steel blade and
    a light handle. If the widths along the tool do not show where the handle ends, it is one body.
    Any other tool is one body, and so is a tool of a given density.

    Args:
        solid: the tool in mm, with its working end toward +x.
        category: the category of the tool.
        density: the density of the whole tool, in kg/m^3; by default that of the category.
    """
    if density is None and category in ("hammer", "screwdriver"):
        border = _border(solid, category)
        if border is not None:
            # The first part is the one to which the normal points: the working end.
            front, back = solid.split_by_plane((1.0, 0.0, 0.0), border)
            return [(front, _STEEL), (back, _HANDLE)]
    return [(solid, density or DENSITIES.get(category, OTHER_DENSITY))]


def weighed(bodies: list[Body], mass: float) -> list[Body]:
    """Scales the densities of bodies so that they have a given total mass in kg.

    Raises:
        UserError: the mean density would be out of range.
    """
    volume = 1e-9 * sum(solid.volume() for solid, _ in bodies)
    low, high = DENSITY_RANGE
    if not low * volume <= mass <= high * volume:
        raise UserError(
            f"a tool of {1e6 * volume:.3g} cm^3 cannot weigh {1e3 * mass:g} g, only "
            f"{1e3 * low * volume:.1g} to {1e3 * high * volume:.2g} g: check --mass_g and the "
            "length"
        )
    factor = mass / mass_properties(bodies)[0]
    return [(solid, factor * density) for solid, density in bodies]


def _border(solid: Manifold, category: str) -> float | None:
    """Returns the x at which the head or the blade begins; None if the widths do not show it."""
    x, widths = _widths(solid)
    ends = max(1, round(_END * len(x)))
    if category == "hammer":
        shaft, wide = float(np.median(widths[: len(x) // 2])), float(widths[-ends:].max())
    else:
        shaft, wide = float(np.median(widths[-ends:])), float(widths[:ends].max())
    if wide < _STEP_WIDTH * shaft:
        return None
    broad = widths > (shaft + wide) / 2
    if category == "hammer":
        return float(x[broad.argmax()]) if broad[-ends:].any() and not broad[:ends].any() else None
    return float(x[len(x) - 1 - broad[::-1].argmax()])


def _widths(solid: Manifold) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Returns positions (n) along x, and the solid's width (n) along y at each of them."""
    vertices, _ = meshes.vertices_and_faces(solid.refine_to_length(2.0))
    low, high = vertices[:, 0].min(), vertices[:, 0].max()
    edges = np.linspace(low, high, _SLICES + 1)
    index = np.clip(np.digitize(vertices[:, 0], edges) - 1, 0, _SLICES - 1)
    widest, narrowest = np.full(_SLICES, -np.inf), np.full(_SLICES, np.inf)
    np.maximum.at(widest, index, vertices[:, 1])
    np.minimum.at(narrowest, index, vertices[:, 1])
    return (edges[:-1] + edges[1:]) / 2, np.maximum(widest - narrowest, 0.0)
