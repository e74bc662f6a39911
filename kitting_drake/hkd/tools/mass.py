"""Mass properties of rigid bodies composed of homogeneous solids."""

from collections.abc import Iterable

import numpy as np
import trimesh
from manifold3d import Manifold

from kitting_drake.hkd.tools.meshes import vertices_and_faces

Body = tuple[Manifold, float]
"""A solid in mm, and its density in kg/m^3."""


def mass_properties(bodies: Iterable[Body]) -> tuple[float, np.ndarray, np.ndarray]:
    """Returns the mass (kg), the centre of mass (3,) in m, and the inertia (3, 3) about it in kg
    m^2."""
    single = []
    for solid, density in bodies:
        vertices, faces = vertices_and_faces(solid)
        p = trimesh.triangles.mass_properties(1e-3 * vertices[faces], density=density)
        single.append((p["mass"], p["center_mass"], p["inertia"]))
    mass = sum(m for m, _, _ in single)
    center = sum(m * c for m, c, _ in single) / mass
    inertia = np.zeros((3, 3))
    for m, c, about_center in single:
        d = c - center
        inertia += about_center + m * (d @ d * np.eye(3) - np.outer(d, d))
    return mass, center, inertia
