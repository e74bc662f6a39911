"""Measures, in the observation o_t, how much room the jaws and the palm have."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from systems.hand_geometry import FINGER_LENGTH, FINGERTIP_DEPTH, MAX_OPENING, PALM_SIZE
from systems.signals import PixelGrid, PlanarPose

_LEVEL = 0.3
"""The width is measured at this fraction of the object's height above its support. The pads grip
higher."""
_ROOM = 0.005
"""The gap between the object and each finger, in m. Nothing may stand in it."""
_LINES = 7
"""The width is measured along this many lines across the pads."""


def object_width(
    height: NDArray[np.float32], grid: PixelGrid, pick: PlanarPose, support: float, top: float
) -> float:
    """Measures the width of an object between the jaws: twice the distance from the pick to the
    farther side of the object.

    Args:
        height: (rows, cols) heights above the bottom of the grid, in m.
        grid: pixel grid of the heights.
        pick: pose of the hand in the world; the jaws close along its y axis.
        support: height of the surface on which the object stands, in m.
        top: height of the object's top at the pick, in m.

    Returns:
        The width in m; infinite if the object is not seen at the pick or is wider than the open
            jaws, or if something stands where half-open fingers would go down.
    """
    level = support + _LEVEL * (top - support)
    farthest = MAX_OPENING / 2 + FINGERTIP_DEPTH
    half = np.arange(0.0, farthest, grid.resolution / 2)
    along = np.linspace(-FINGER_LENGTH / 2, FINGER_LENGTH / 2, _LINES)
    across = np.concatenate([half, -half])
    cos, sin = math.cos(pick.theta), math.sin(pick.theta)
    u, v = np.meshgrid(along, across)
    points = np.stack([pick.x + cos * u - sin * v, pick.y + sin * u + cos * v], -1)
    row, col = np.moveaxis(np.rint(grid.to_pixel(points)).astype(int), -1, 0)
    inside = (row >= 0) & (row < grid.rows) & (col >= 0) & (col < grid.cols)
    found = height[row.clip(0, grid.rows - 1), col.clip(0, grid.cols - 1)]
    high = ((found > level) & inside).any(axis=1).reshape(2, -1).any(axis=0)
    if not high[0] or high.all():
        return math.inf
    side = int(np.argmin(high))
    # The fingers stand beside the object, up to this distance from the pick.
    reach = half[side] + _ROOM + FINGERTIP_DEPTH
    if reach > farthest or high[side:][half[side:] < reach].any():
        return math.inf
    return float(2 * half[side])


def heights_below_palm(
    height: NDArray[np.float32],
    centres: NDArray[np.float64],
    thetas: NDArray[np.float64],
    resolution: float,
    step: float = 1.0,
) -> NDArray[np.float32]:
    """Samples the heights below the palm, and up to a pixel beside it, at n poses of the hand.

    Args:
        height: (rows, cols) heights above the bottom of the grid, in m.
        centres: (n, 2) row and column midway between the pads.
        thetas: (n) the hand's angles, in rad. The palm's long side is across them.
        resolution: side of a pixel, in m.
        step: greatest distance of the points, in pixels.

    Returns:
        (n, k) heights at k points, in m. Points off the grid have the height of its nearest pixel.
    """
    halves = (side / 2 / resolution + 1.0 for side in PALM_SIZE)
    u, s = (np.linspace(-half, half, math.ceil(2 * half / step) + 1) for half in halves)
    u, s = (values.ravel() for values in np.meshgrid(u, s))
    cos, sin = np.cos(thetas)[:, None], np.sin(thetas)[:, None]
    row = np.rint(centres[:, :1] + cos * u - sin * s).astype(int)
    col = np.rint(centres[:, 1:] + sin * u + cos * s).astype(int)
    rows, cols = height.shape
    return height[row.clip(0, rows - 1), col.clip(0, cols - 1)]
