"""Maps where a Franka arm can bring its hand, pointing down, within the ranges of its joints."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from systems.arm_kinematics import ArmBase, inverse, joint_seven, planar
from systems.arm_limits import ArmLimits

MARGIN = 0.1
"""Least distance of a posture from the ends of the joints' ranges, in rad."""
YAWS = 12
"""Number of yaws that are tried. They cover half a turn, because the jaws are symmetric."""
_SWIVELS = np.arange(-31, 32) / 10
"""The swivels that are tried, in rad: angles of the wrist to the vertical plane through base and
hand, as in `systems.arm_postures`."""
_STEP = 0.005
"""Postures are computed for distances of the hand from the base's axis in steps of this, in m."""
_FARTHEST = 1.0
"""Postures are computed up to this distance of the hand from the base's axis, in m."""
_CHUNK = 256


class ReachMap:
    """The reach of an arm at given heights, for any pose of its base.

    Joints 2 to 6 depend only on the hand's distance from the base's axis, its height, and the
    swivel. The azimuth of the hand adds to joint 1, and its yaw to joint 7. So the postures are
    computed only once for each distance.

    Collisions are not considered. A distance is rounded to 5 mm.
    """

    def __init__(self, limits: ArmLimits, heights: NDArray[np.float64]) -> None:
        """
        Args:
            limits: limits of the joints.
            heights: (m) heights of the fingertips above the base, in m.
        """
        self._lower = np.array(limits.lower) + MARGIN
        self._upper = np.array(limits.upper) - MARGIN
        radii = np.arange(round(_FARTHEST / _STEP) + 1) * _STEP
        x, z = np.meshgrid(radii, heights, indexing="ij")
        tips = np.stack([x, np.zeros_like(x), z], -1).reshape(-1, 3)
        parts = [self._postures(part) for part in np.array_split(tips, len(tips) // _CHUNK + 1)]
        shape = (*x.shape, len(_SWIVELS), 8)
        self._inside = np.concatenate([inside for inside, _ in parts]).reshape(shape)
        self._first = np.concatenate([first for _, first in parts]).reshape(shape)

    def _postures(self, tips: NDArray[np.float64]) -> tuple[NDArray[np.bool_], NDArray[np.float64]]:
        """(n, swivels, 8) whether joints 2 to 6 are inside their ranges, and (n, swivels, 8)
        positions of joint 1 in rad."""
        zero = np.zeros((len(tips), len(_SWIVELS)))
        q7 = np.broadcast_to(joint_seven(_SWIVELS, 0.0), zero.shape)
        points = np.broadcast_to(tips[:, None, :], (*zero.shape, 3))
        found = inverse(points, q7, zero)
        # At a swivel of zero `inverse` is singular, so use `planar`.
        middle = len(_SWIVELS) // 2
        found[:, middle] = planar(tips, q7[:, middle])[:, None, :]
        with np.errstate(invalid="ignore"):
            inside = (found >= self._lower) & (found <= self._upper)
        return np.asarray(inside[..., 1:6].all(-1)), found[..., 0]

    def shares(self, base: ArmBase, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Returns (n, m) the fraction of all yaws that the hand can have at each point and height.

        Args:
            base: pose of the arm's base in the world; its height is not used.
            points: (n, 2) x and y of the points in the world, in m.
        """
        placed = base.to_base_points(np.column_stack([points, np.full(len(points), base.z)]))
        radius = np.hypot(placed[:, 0], placed[:, 1])
        azimuth = np.arctan2(placed[:, 1], placed[:, 0])
        index = np.rint(radius / _STEP).astype(int)
        found = np.zeros((len(points), self._inside.shape[1]))
        near = np.flatnonzero(index < len(self._inside))
        for part in np.array_split(near, len(near) // _CHUNK + 1):
            found[part] = self._near_shares(base, index[part], azimuth[part])
        return found

    def _near_shares(
        self, base: ArmBase, index: NDArray[np.int_], azimuth: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        first = _wrapped(self._first[index] + azimuth[:, None, None, None])
        turned = (first >= self._lower[0]) & (first <= self._upper[0])
        stands = (self._inside[index] & turned).any(-1)
        yaws = np.arange(YAWS) * math.pi / YAWS - base.yaw
        wrist = azimuth[:, None] + _SWIVELS
        q7 = joint_seven(wrist[..., None], yaws)
        other = _wrapped(q7 + math.pi)
        low, high = self._lower[6], self._upper[6]
        turns = ((q7 >= low) & (q7 <= high)) | ((other >= low) & (other <= high))
        # Matrix product of (n, heights, swivels) and (n, swivels, yaws).
        return np.asarray((stands.astype(np.float32) @ turns.astype(np.float32) > 0).mean(-1))


def _wrapped(angle: NDArray[np.float64]) -> NDArray[np.float64]:
    return angle - math.tau * np.rint(angle / math.tau)
