"""How the mass of an imported tool is distributed.

A mesh tells a tool's shape, not what it is made of. But no hammer balances at the middle of its
handle: its head is steel, and so is a screwdriver's blade, while their handles are light.
"""

import numpy as np
from manifold3d import Manifold
from numpy.typing import NDArray

from kitting_drake.hkd.tools import meshes
from kitting_drake.hkd.tools.mass import Body

_STEEL, _HANDLE = 7850.0, 1200.0

DENSITIES = {"pliers": 6000.0, "wrench": _STEEL}
"""The mean density of a tool of a category, with its grips, in kg/m^3."""
OTHER_DENSITY = 3000.0
"""The same for a tool of any other category."""

_SLICES = 60
_END = 0.3
"""Share of the length that is an end."""
_STEP_WIDTH = 1.5
"""By how much wider than the shaft a head or a handle is, at least."""


def bodies_of(solid: Manifold, category: str, density: float | None = None) -> list[Body]:
    """A tool in its frame T as one or two homogeneous bodies.

    The head of a hammer and the blade of a screwdriver, where they stand out or draw in clearly,
    are of steel, what is behind them is a handle.

    Args:
        solid: in mm, its working end toward +x.
        category: of the tool.
        density: of it all, in kg/m^3; None: that of the category.
    """
    if density is None and category in ("hammer", "screwdriver"):
        border = _border(solid, category)
        if border is not None:
            # The plane's normal is that of the first of the two, the working end.
            front, back = solid.split_by_plane((1.0, 0.0, 0.0), border)
            return [(front, _STEEL), (back, _HANDLE)]
    return [(solid, density or DENSITIES.get(category, OTHER_DENSITY))]


def _border(solid: Manifold, category: str) -> float | None:
    """The x at which the head or the blade begins; None if nothing tells."""
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
    """Places along x, and how wide the solid is there along y."""
    vertices, _ = meshes.vertices_and_faces(solid.refine_to_length(2.0))
    low, high = vertices[:, 0].min(), vertices[:, 0].max()
    edges = np.linspace(low, high, _SLICES + 1)
    index = np.clip(np.digitize(vertices[:, 0], edges) - 1, 0, _SLICES - 1)
    widest, narrowest = np.full(_SLICES, -np.inf), np.full(_SLICES, np.inf)
    np.maximum.at(widest, index, vertices[:, 1])
    np.minimum.at(narrowest, index, vertices[:, 1])
    return (edges[:-1] + edges[1:]) / 2, np.maximum(widest - narrowest, 0.0)
