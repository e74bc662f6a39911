"""Closes the flat openings of a surface, for instance the underside of a scanned tool."""

import numpy as np
from manifold3d import triangulate
from numpy.typing import NDArray

Array = NDArray[np.float64]
Faces = NDArray[np.int64]

# The rim of an opening may be this far from its plane: a scan's is not straight.
_FLAT_MM = 2.0


def capped(vertices: Array, faces: Faces) -> Faces | None:
    """Closes the openings of a surface with flat caps.

    Rims in one plane are closed together, so that a ring stays a ring.

    Args:
        vertices: (n, 3), in mm, for a surface about 180 mm long.
        faces: (m, 3), of consistent winding.

    Returns:
        The triangles of the surface and the caps, or None if an opening is not flat or its rim
        touches itself.
    """
    loops = _rims(faces)
    if not loops:
        return None
    # The largest first: it sets the plane of those inside it.
    loops.sort(key=lambda loop: -float(np.linalg.norm(_area_vector(vertices[loop]))))
    caps = [faces]
    while loops:
        normal = _area_vector(vertices[loops[0]])
        size = float(np.linalg.norm(normal))
        if size < 1e-9:
            return None
        normal = normal / size
        origin = vertices[loops[0]].mean(axis=0)
        offset = [np.abs((vertices[loop] - origin) @ normal).max() for loop in loops]
        if offset[0] > _FLAT_MM:
            return None
        together = [loop for loop, away in zip(loops, offset, strict=True) if away <= _FLAT_MM]
        loops = [loop for loop, away in zip(loops, offset, strict=True) if away > _FLAT_MM]
        u = np.cross(normal, np.eye(3)[np.abs(normal).argmin()])
        plane = np.column_stack([u / np.linalg.norm(u), np.cross(normal, u / np.linalg.norm(u))])
        corners = triangulate([(vertices[loop] - origin) @ plane for loop in together])
        caps.append(np.concatenate(together)[np.asarray(corners, dtype=np.int64)])
    return np.vstack(caps)


def _rims(faces: Faces) -> list[NDArray[np.int64]]:
    """The rims of the openings, each wound like its cap; none if a rim touches itself."""
    edges = np.vstack([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    known = set(map(tuple, edges.tolist()))
    # The cap's edges run against those of the surface.
    free = [(b, a) for a, b in known if (b, a) not in known]
    following = dict(free)
    if len(following) != len(free) or set(following) != set(following.values()):
        return []
    rims = []
    for start in sorted(following):
        rim = []
        while start in following:
            rim.append(start)
            start = following.pop(start)
        if rim:
            rims.append(np.array(rim))
    return rims


def _area_vector(points: Array) -> Array:
    """The normal of a closed polygon (n, 3), as long as its area."""
    points = points - points.mean(axis=0)
    return np.cross(points, np.roll(points, -1, axis=0)).sum(axis=0) / 2
