"""The stable poses of a rigid body on a table.

A body rests on a facet of its convex hull if the centre of mass, projected along the facet's
normal, lies inside the facet. `trimesh.poses.compute_stable_poses` treats every triangle as a facet
and ranks poses by their probability in a random toss. This module merges coplanar triangles and
returns the height of the centre of mass and the support margin instead.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError

Array = NDArray[np.float64]

# Triangles of the hull form one facet if their unit normals, rounded to this step, are equal.
_COPLANAR = 1e-3


@dataclass(frozen=True)
class StablePose:
    """A stable pose of a body, in the body's frame B, in the unit of the body's points."""

    normal: Array
    """The outward normal (3,) of the supporting facet, in B; it points down at rest."""
    height: float
    """The height of the centre of mass above the table."""
    margin: float
    """The horizontal distance of the centre of mass from the edge of the supporting facet."""

    def rotation(self, forward: Array) -> Array:
        """Returns R_TB (3, 3), which turns the normal to -z and `forward` into the xz plane, toward
        +x.

        Args:
            forward: (3,) a direction in B that is not parallel to the normal.
        """
        z = -self.normal
        x = forward - (forward @ z) * z
        x /= np.linalg.norm(x)
        return np.array([x, np.cross(z, x), z])


def stable_poses(points: Array, center_of_mass: Array) -> list[StablePose]:
    """Returns the stable poses of a body, in a deterministic order.

    Args:
        points: points (n, 3) in the body's frame B, with the same convex hull as the body.
        center_of_mass: the centre of mass (3,) in B.

    Raises:
        scipy.spatial.QhullError: the hull of the points has no volume.
    """
    hull = ConvexHull(points)
    normals = hull.equations[:, :3]
    _, group = np.unique(np.round(normals / _COPLANAR).astype(int), axis=0, return_inverse=True)
    group = group.reshape(-1)
    corners = points[hull.vertices]
    poses = []
    for index in range(group.max() + 1):
        members = np.flatnonzero(group == index)
        support = points[np.unique(hull.simplices[members])]
        margin = _support_margin(support, normals[members[0]], center_of_mass)
        if margin <= 0:
            continue
        # Of nearly coplanar triangles, use the normal of the triangle below the centre of mass.
        shares = [_least_share(hull, points, int(member), center_of_mass) for member in members]
        bearing = members[int(np.argmax(shares))]
        normal = normals[bearing]
        height = float((corners @ normal).max() - center_of_mass @ normal)
        poses.append((bearing, StablePose(normal, height, margin)))
    return [pose for _, pose in sorted(poses, key=lambda item: item[0])]


def _support_margin(support: Array, normal: Array, center_of_mass: Array) -> float:
    """Returns the distance of the centre of mass from the support's edge, seen along the normal.

    The distance is negative outside the support, and -1 if the support has no area.
    """
    axes = np.linalg.svd(normal[None])[2][1:]
    try:
        equations = ConvexHull(support @ axes.T).equations
    except (QhullError, ValueError):
        return -1.0
    return float(-(equations[:, :2] @ (axes @ center_of_mass) + equations[:, 2]).max())


def _least_share(hull: ConvexHull, points: Array, triangle: int, center_of_mass: Array) -> float:
    """Returns the smallest barycentric coordinate of the centre of mass over a triangle of the
    hull."""
    *normal, offset = hull.equations[triangle]
    foot = center_of_mass - (center_of_mass @ np.array(normal) + offset) * np.array(normal)
    corners = points[hull.simplices[triangle]]
    coordinates = np.linalg.lstsq(
        np.vstack([corners.T, np.ones(3)]), np.append(foot, 1.0), rcond=None
    )[0]
    return float(coordinates.min())
