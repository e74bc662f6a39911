"""Finds where surfaces end in a depth image, more precisely than to a sample.

A camera sees a surface at samples. Where the surface ends on the side that faces away from the
camera, the edge lies between two samples, on average midway. So the surface looks too short there,
by half the distance of the samples. On the side that faces the camera this does not happen, because
the wall below the edge is seen. With one oblique camera, objects and recesses therefore seem nearer
to the camera than they are.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

_JUMP = 0.008
"""A surface ends between two pixels if the depth grows by more than this, in metres."""
_LEVEL = 0.005
"""A surface is level at two pixels if their heights differ by less than this, in metres."""
_LOWER = 0.002
"""What begins behind a surface's edge is lower than the surface by more than this, in metres."""
_FARTHEST = 1.25
"""Samples must be closer together than this many rows or columns. Otherwise there are gaps between
the samples of a surface, and its edges say little."""
_AHEAD = 0.5
"""An edge faces away from the camera if the cosine between the step to the lower pixel and the
direction away from the camera, seen from above, is more than this."""


def surface_edges(
    depth: NDArray[np.float32],
    height: NDArray[np.float32],
    rays: tuple[NDArray[np.float32], NDArray[np.float32]],
    X_GD: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Returns points at the edges of level surfaces that face away from an oblique camera.

    Where a surface ends between two neighbouring pixels, the point is midway between their rays, at
    the height of the surface. There is such a point only if the strip that the surface hides is
    wider than the distance of two samples, and if the depth grows by 8 mm or more. At 45 degrees,
    that is the case for surfaces that are 6 mm or more above what lies behind. There is none where
    samples are 1.25 rows or columns apart or more.

    Args:
        depth: (height, width) depth of each pixel along the optical axis, in metres; NaN where
            there is none.
        height: (height, width) height of the point that each pixel sees, in metres; NaN where there
            is none.
        rays: x and y of each pixel's ray at depth 1, in the camera's optical frame D; each is
            (height, width) or can be broadcast to it.
        X_GD: (3, 4), the affine map from D to the coordinates G of the result: row, column, and
            height in metres.

    Returns:
        (n, 3) the points' coordinates in G.
    """
    width = depth.shape[1]
    d, z = depth.ravel(), height.ravel()
    found = []
    for offset in (1, width):
        jump = d[offset:] - d[:-offset]
        first = np.flatnonzero(np.abs(jump) > _JUMP)
        is_nearer = jump[first] > 0
        # From each nearer pixel, `step` leads to the farther one.
        upper = np.where(is_nearer, first, first + offset)
        step = np.where(is_nearer, offset, -offset)
        behind = upper - step
        inside = (behind >= 0) & (behind < z.size)
        # In the flat arrays, the last pixel of a row is not beside the first one of the next row.
        inside &= np.abs((upper + step) % width - behind % width) <= 2
        upper, step = upper[inside], step[inside]
        level = np.abs(z[upper - step] - z[upper]) < _LEVEL
        level &= z[upper] - z[upper + step] > _LOWER
        found.append((upper[level], (upper + step)[level]))
    upper, lower = (np.concatenate(part) for part in zip(*found, strict=True))
    row, col = np.divmod(np.stack([upper, lower]), width)
    u, v = (np.broadcast_to(ray, depth.shape)[row, col] for ray in rays)
    # Add the rays midway between the two pixels, and follow all rays to the height of the surface.
    along = np.stack([[u[0], u.mean(axis=0)], [v[0], v.mean(axis=0)]], axis=-1)
    along = along @ X_GD[:, :2].T + X_GD[:, 2]
    along *= ((z[upper] - X_GD[2, 3]) / along[..., 2])[..., None]
    sample, edge = along
    away, forward = sample[:, :2], (edge - sample)[:, :2]
    far, half = np.linalg.norm(away, axis=1), np.linalg.norm(forward, axis=1)
    # The width of the strip that the surface hides. A wall of this height is seen as wide.
    hidden = far * (z[upper] - z[lower]) / np.abs(sample[:, 2])
    ahead = (forward * away).sum(axis=1) > _AHEAD * far * half
    dense = 2 * half < _FARTHEST
    return edge[ahead & dense & (hidden > 2 * half)] + X_GD[:, 3]
