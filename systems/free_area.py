"""Finds a free part of the table for an object."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from systems.signals import PlanarPose

_CELL = 0.005
"""Side of the squares that are free or occupied, in metres."""
_STEP = 0.015
"""Spacing of the positions that are tried, in metres."""
_YAWS = 8
"""The number of headings that are tried, over a full turn."""
_LEAST = 0.010
"""Least clearance around the object, in metres."""
_AMPLE = 0.100
"""Clearance beyond this, in metres, has no benefit: the open hand already has room, beside a kit
that reaches up to its palm too."""
_WAY = 0.02
"""Each metre of distance from the wanted point counts as much as this loss of clearance, in
metres."""


def find_free_pose(
    outline: NDArray[np.float64],
    occupied: NDArray[np.float64],
    area: tuple[tuple[float, float], tuple[float, float]],
    *,
    near: NDArray[np.float64],
    yaw: float,
) -> PlanarPose | None:
    """Finds a pose in the world at which an object has much clearance; None if it fits nowhere.

    Args:
        outline: (k, 2) points that cover the object, in its frame, in metres.
        occupied: (m, 2) points that cover everything else, in the world, in metres.
        area: lower and upper (x, y) corners of the part of the table to search, in the world, in
            metres.
        near: (2,) point in the world, in metres. Among positions with similar clearance, those near
            it are preferred.
        yaw: one of the headings to try, in radians; the others are evenly spaced from it.
    """
    # Import SciPy lazily.
    from scipy import ndimage

    low, high = np.array(area[0]), np.array(area[1])
    shape = np.maximum(np.ceil((high - low) / _CELL).astype(int), 1)
    taken = np.zeros(shape, bool)
    cells = np.floor((occupied - low) / _CELL).astype(int)
    inside = ((cells >= 0) & (cells < shape)).all(axis=1)
    taken[tuple(cells[inside].T)] = True
    taken = ndimage.binary_closing(np.pad(taken, 2), np.ones((3, 3)))[2:-2, 2:-2] | taken
    room = ndimage.distance_transform_edt(~taken) * _CELL
    axes = [np.arange(a + _STEP, b, _STEP) for a, b in zip(low, high, strict=True)]
    places = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
    best: tuple[float, PlanarPose] | None = None
    for turn in range(_YAWS):
        theta = yaw + turn * math.tau / _YAWS
        cos, sin = math.cos(theta), math.sin(theta)
        turned = outline @ np.array([[cos, sin], [-sin, cos]])
        fits = (places + turned.min(axis=0) >= low + _LEAST).all(axis=1)
        fits &= (places + turned.max(axis=0) <= high - _LEAST).all(axis=1)
        if not fits.any():
            continue
        free = places[fits]
        where = np.floor((free[:, None] + turned[None] - low) / _CELL).astype(int)
        clearance = room[where[..., 0], where[..., 1]].min(axis=1)
        score = np.minimum(clearance, _AMPLE) - _WAY * np.linalg.norm(free - near, axis=1)
        score[clearance < _LEAST] = -np.inf
        index = int(np.argmax(score))
        if np.isfinite(score[index]) and (best is None or score[index] > best[0]):
            x, y = free[index].tolist()
            best = float(score[index]), PlanarPose(x, y, theta)
    return None if best is None else best[1]
