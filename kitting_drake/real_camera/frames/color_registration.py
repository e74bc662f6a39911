"""Registers colour images of another lens to depth."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from kitting_drake.real_camera.calibrations.calibration import BenchCamera
from kitting_drake.real_camera.frames.point_clouds import project_points


def register_color(
    color: NDArray[np.uint8], depth: NDArray[np.float32], camera: BenchCamera
) -> NDArray[np.uint8]:
    """Returns the colour (height, width, 3) of each point that the depth camera sees.

    Pixels without depth, and points outside the colour camera's view, are black. A point that is
    hidden from the colour camera gets the colour of the surface that hides it.

    Args:
        color: (height, width, 3) an image of the camera's colour lens.
        depth: (height, width) in metres.
        camera: the camera. If it has no separate lens for colour, the image is returned unchanged.

    Raises:
        UserError: the distortion of the depth's lens cannot be inverted.
    """
    if camera.color is None:
        return color
    rays = camera.rays
    u, v = np.broadcast_arrays(rays.u, rays.v)
    with np.errstate(invalid="ignore"):
        seen = np.isfinite(depth) & (depth > 0)
    ray = np.stack([u[seen], v[seen], np.ones(seen.sum())], axis=-1).astype(float)
    X = camera.color.X_KC
    points = depth[seen, None] * ray @ X[:3, :3].T + X[:3, 3]
    height, width = color.shape[:2]
    result = np.zeros((*depth.shape, 3), np.uint8)
    before = points[:, 2] > 0
    points[~before] = (0, 0, 1)
    col, row = (np.rint(item) for item in project_points(points, camera.color.intrinsics))
    inside = before & (col >= 0) & (col < width) & (row >= 0) & (row < height)
    at = np.argwhere(seen)[inside]
    result[at[:, 0], at[:, 1]] = color[row[inside].astype(int), col[inside].astype(int)]
    return result
