"""Divides tools that have no model files into convex pieces, so that they can be simulated."""

import itertools

import numpy as np
import trimesh
from manifold3d import Manifold, Mesh
from numpy.typing import NDArray
from scipy.spatial import QhullError

from kitting_drake.hkd.tools.collision import thinned
from kitting_drake.hkd.tools.tool import Tool
from kitting_drake.tasks.kitting.settling import ConvexBody

_SLAB = 0.02
"""Largest thickness of the slabs along x into which a tool is cut, in metres."""
_LEAST_VOLUME = 1e-9
"""Pieces with a volume below this, in m^3, are left out."""
_THINNED_MM = 0.2
"""Pieces are simplified so that their surfaces move by no more than about this, in mm."""
_MASS = 0.1
"""The mass that is assumed for a tool without a mass, in kg. The resting pose hardly depends on
it."""


def solid_of(tool: Tool) -> Manifold:
    """Makes the solid of a tool in its frame T, in metres."""
    mesh = _mesh(tool)
    return Manifold(Mesh(np.asarray(mesh.vertices, np.float32), np.asarray(mesh.faces, np.uint32)))


def _mesh(tool: Tool) -> trimesh.Trimesh:
    corners = np.arange(3 * len(tool.triangles)).reshape(-1, 3)
    mesh = trimesh.Trimesh(tool.triangles.reshape(-1, 3), corners)
    mesh.merge_vertices(digits_vertex=7)
    return mesh


def convex_body(tool: Tool) -> ConvexBody:
    """Cuts a tool into slabs along its length. Each connected part of a slab becomes a convex
    piece.

    Pieces are convex hulls, so notches narrower than the thickness of a slab are filled.
    """
    mesh = _mesh(tool)
    solid = solid_of(tool)
    low, high = mesh.bounds[:, 0]
    edges = np.linspace(low, high, max(1, round((high - low) / _SLAB)) + 1)
    hulls = []
    for start, end in itertools.pairwise(edges.tolist()):
        slab = solid.trim_by_plane((1, 0, 0), float(start)).trim_by_plane((-1, 0, 0), -float(end))
        for part in slab.decompose():
            hull = part.hull()
            if hull.volume() > _LEAST_VOLUME:
                points = _thinned(np.asarray(hull.to_mesh().vert_properties, float)[:, :3])
                hulls += [] if points is None else [points]
    if not hulls:
        points = np.asarray(mesh.vertices, float)
        thin = _thinned(points)
        hulls = [points if thin is None else thin]
    parts = [trimesh.Trimesh(points).convex_hull for points in hulls]
    whole = trimesh.util.concatenate(parts)
    whole.density = (tool.mass or _MASS) / sum(part.volume for part in parts)
    return ConvexBody(
        tuple(np.asarray(part.vertices, float) for part in parts),
        mass=float(whole.mass),
        center_of_mass=np.asarray(whole.center_mass, float),
        inertia=np.asarray(whole.moment_inertia, float),
    )


def _thinned(points: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """Simplifies a convex hull so that it has no thin slivers, which break contact computations.

    Returns:
        (m, 3) the corners of the simplified hull; None if the whole hull is a sliver.
    """
    try:
        return thinned(1e3 * points, _THINNED_MM) / 1e3
    except QhullError:
        return None
