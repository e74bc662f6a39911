"""Closes the flat openings of a surface, for instance at the underside of a scanned tool."""

import numpy as np
from manifold3d import triangulate
from numpy.typing import NDArray

Array = NDArray[np.float64]
Faces = NDArray[np.int64]

# The largest distance of an opening's rim from the plane fitted to it. The rims of scans are not
# quite flat.
_FLAT_MM = 2.0


def capped(vertices: Array, faces: Faces) -> Faces | None:
    """Closes the openings of a surface with flat caps.

    Openings in the same plane are closed together, so a rim inside another rim stays a hole.

    Args:
        vertices: the vertices (n, 3) in mm; the surface is scaled to a length of about 180 mm.
        faces: the triangles (m, 3), consistently wound.

    Returns:
        The triangles (k, 3) of the surface and the caps. None if there is no opening, or if an
        opening is not flat or its rim touches itself.
    """
    loops = _rims(faces)
    if not loops:
        return None
    # Start with the largest rim, because it sets the plane of the rims inside it.
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
    """Returns the rims of the openings as vertex indices, each wound like its cap.

    The list is empty if a rim touches itself.
    """
    edges = np.vstack([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    known = set(map(tuple, edges.tolist()))
    # Along a shared edge, the cap's triangle runs in the opposite direction to the surface's.
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
    """Returns the normal (3,) of a closed polygon (n, 3), with the polygon's area as its length."""
    points = points - points.mean(axis=0)
    return np.cross(points, np.roll(points, -1, axis=0)).sum(axis=0) / 2
