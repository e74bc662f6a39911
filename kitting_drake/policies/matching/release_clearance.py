"""Measures in o_t how much room the fingers have at the place.

A symmetric object such as a cube can be placed in several rotations. The networks cannot choose
among them, because their features do not encode how the jaws hold the object. The choice matters if
other objects stand beside the place. This module uses only heights and is not in the paper.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from kitting_drake.policies.data.images import rotation_matrix
from kitting_drake.policies.matching.jaw_clearance import tip_height
from systems.hand_geometry import FINGER_LENGTH, FINGERTIP_DEPTH
from systems.pick_place_parameters import PickPlaceParameters

Array = NDArray[np.float64]

_STEP = 0.001
"""The distance between samples along the jaws' path, in metres."""
_LINES = 7
"""The number of sampled lines along the fingers' length."""
_SUPPORT_REACH = 0.06
"""Half the side, in metres, of the square around the pick in which the height of the object's
support is estimated."""
_SUPPORT_PERCENTILE = 10.0
"""This percentile of the heights around the pick is taken as the height of the object's support."""
_UNDER = 0.009
"""Half the side, in metres, of a square around the place. Its highest point is taken as the height
of the support there."""
_LEAST = 0.004
"""What is higher than the fingertips by more than this, in metres, counts as an obstacle."""


def blocked_at_place(
    height: NDArray[np.float32],
    resolution: float,
    pick: Array,
    theta: float,
    rotation: float,
    place: Array,
    planner: PickPlaceParameters,
) -> float:
    """Returns the blocked share, from 0 to 1, of the space that the fingers need at the place.

    Args:
        height: (rows, cols) heights of o_t, in metres.
        resolution: the side of a pixel, in metres.
        pick: (row, col) where the object is gripped.
        theta: the angle of the gripper at the pick, in radians.
        rotation: the rotation of the object from pick to place, in radians.
        place: (row, col) where the gripper releases the object.
        planner: parameters that give the depth of the fingertips, and how far the jaws open at
            release.
    """
    top = _highest(height, pick, resolution, resolution)
    around = _window(height, pick, _SUPPORT_REACH / resolution)
    support = float(np.percentile(around, _SUPPORT_PERCENTILE))
    tip = float(tip_height(np.array(top), support, planner))
    across = np.array([-math.sin(theta), math.cos(theta)])
    ways = np.arange(0.0, planner.open_width / 2, _STEP)
    reach = FINGERTIP_DEPTH + planner.release_clearance
    along = np.array([math.cos(theta), math.sin(theta)])
    lines = np.linspace(-FINGER_LENGTH / 2, FINGER_LENGTH / 2, _LINES)
    bottom = _highest(height, place, resolution, _UNDER)
    turn = rotation_matrix(rotation)
    taken = []
    for side in (1.0, -1.0):
        held = _sample(height, pick + side * ways[:, None] * across / resolution) > tip
        face = ways[int(held.argmin())] if not held.all() else ways[-1]
        out = face + np.arange(_STEP, reach, _STEP)
        offsets = side * out[:, None, None] * across + lines[None, :, None] * along
        there = place + offsets.reshape(-1, 2) @ turn.T / resolution
        taken.append(_sample(height, there) > bottom + (tip - support) + _LEAST)
    return float(np.concatenate(taken).mean())


def _sample(height: NDArray[np.float32], positions: Array) -> Array:
    """Returns the heights (n,) at positions (n, 2) in pixels; zero outside the image."""
    return ndimage.map_coordinates(height, positions.T, order=1, mode="constant", cval=0.0)


def _window(height: NDArray[np.float32], pixel: Array, reach: float) -> NDArray[np.float32]:
    """Returns the heights within `reach` rows and columns of a pixel. A pixel outside the image is
    first moved to its edge."""
    size = np.array(height.shape)
    middle = np.clip(np.rint(pixel), 0, size - 1)
    (top, left), (bottom, right) = (
        np.clip(middle + sign * math.ceil(reach), 0, size - 1).astype(int) for sign in (-1, 1)
    )
    return height[top : bottom + 1, left : right + 1]


def _highest(height: NDArray[np.float32], pixel: Array, resolution: float, reach: float) -> float:
    return float(_window(height, pixel, reach / resolution).max())
