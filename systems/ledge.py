"""Finds poses at which an object that lies upside down tips over the edge of a block and turns
over."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from systems.signals import PlanarPose

_OUTSIDE = (0.15, 0.6)
"""Range of the distance of the object's centre of mass beyond the block's edge when the object is
released. The unit is the width of the side that rests on the block."""
_MOST_OUTSIDE = 0.008
"""Upper limit of this distance, in metres."""
_BESIDE = 0.005
"""Along the edge, the object must rest on the block on both sides of its centre of mass. Points
closer to the centre of mass than this, in metres, do not count."""
_FROM_CORNER = 0.02
"""Distance of the centre of mass from the block's corner along the edge, in metres. The object then
reaches beyond the corner, where the hand can grip it again."""
_LANDING = 0.09
"""Width of the part of the table that must be free for the object to land on, in metres."""
_ROOM = 0.015
"""Free space required beyond the object's ends where it lands, in metres."""


@dataclass(frozen=True)
class Ledge:
    """A block on the table over whose edges objects can be turned."""

    pose: PlanarPose
    """The block's middle and heading in the world."""
    size: tuple[float, float]
    """Extents of the block along its heading and across it, in metres."""

    def turning_pose(
        self,
        outline: NDArray[np.float64],
        p_WCenter: NDArray[np.float64],
        others: NDArray[np.float64],
        area: tuple[tuple[float, float], tuple[float, float]],
        *,
        inner_side: int = 0,
    ) -> PlanarPose | None:
        """Finds where to release an object so that it tips over an edge and turns over.

        Args:
            outline: (k, 2) points of the held object relative to its centre of mass, first along
                its heading and then to the left of it, in metres.
            p_WCenter: the object's centre of mass in the world, in metres. The edge and the
                distance from it depend on this position, so that the next try after a failure
                differs.
            others: (m, 3) points of everything that may be in the way, in the world.
            area: lower and upper (x, y) corners of the area in which the object may land.
            inner_side: the side of the object that rests on the block: 1 for the left one, -1 for
                the right one, 0 for the wider one.

        Returns:
            The position of the object's centre of mass and its heading; None if all edges are
            obstructed.
        """
        low, high = np.array(area[0]), np.array(area[1])
        middle = np.array([self.pose.x, self.pose.y])
        length = float(np.ptp(outline[:, 0]))
        # Either the left side rests on the block or, after half a turn, the right side.
        left, right = _inside(outline), _inside(-outline)
        options = {1: (left, 0.0), -1: (right, math.pi)}
        inside, half_turn = options.get(inner_side, max(options.values()))
        least, most = _OUTSIDE
        varied = 1e3 * float(p_WCenter[0] + p_WCenter[1]) % 1.0
        outside = min((least + (most - least) * varied) * inside, _MOST_OUTSIDE)
        best: tuple[tuple[int, bool], PlanarPose] | None = None
        for quarter in range(4):
            half, other_half = np.roll(np.array(self.size) / 2, quarter)
            outward = self.pose.theta + quarter * math.pi / 2
            normal = np.array([math.cos(outward), math.sin(outward)])
            along = np.array([-normal[1], normal[0]])
            for end in (-1, 1):
                distance = end * max(other_half - _FROM_CORNER, 0.0)
                edge = middle + half * normal + distance * along
                corners = [
                    edge + u * along + v * normal
                    for u in (-length / 2, length / 2)
                    for v in (0.0, _LANDING)
                ]
                if (np.array(corners) < low).any() or (np.array(corners) > high).any():
                    continue
                delta = others[:, :2] - edge
                u, v = delta @ along, delta @ normal
                count = int(((np.abs(u) < length / 2 + _ROOM) & (v > -0.05) & (v < _LANDING)).sum())
                # An object beside this edge was probably released here before: prefer other edges.
                again = bool(np.linalg.norm(p_WCenter[:2] - edge) < _LANDING)
                if best is None or (count, again) < best[0]:
                    p_W = edge + outside * normal
                    theta = outward + math.pi / 2 + half_turn
                    best = (count, again), PlanarPose(float(p_W[0]), float(p_W[1]), theta)
        return best[1] if best is not None and best[0][0] == 0 else None


def _inside(outline: NDArray[np.float64]) -> float:
    """How far an object extends to the left of its centre of mass, in metres. This is measured just
    ahead of the centre of mass and just behind it, and the smaller value counts."""
    u, v = outline.T
    reach = u.max() - u.min()
    sides = [(sign * u > _BESIDE) & (sign * u < 0.3 * reach) for sign in (-1, 1)]
    return min(float(v[side].max(initial=0.0)) for side in sides)


def moved_gripper(
    gripper: PlanarPose, p_WHeld: NDArray[np.float64], yaw: float, goal: PlanarPose
) -> PlanarPose:
    """The gripper's pose after it has carried an object to a goal.

    Args:
        gripper: the gripper's pose before the motion.
        p_WHeld: a point of the object before the motion, in the world.
        yaw: the object's heading before the motion, in radians.
        goal: the same point and the object's heading after the motion.
    """
    turn = goal.theta - yaw
    dx, dy = gripper.x - p_WHeld[0], gripper.y - p_WHeld[1]
    cos, sin = math.cos(turn), math.sin(turn)
    return PlanarPose(
        float(goal.x + cos * dx - sin * dy),
        float(goal.y + sin * dx + cos * dy),
        gripper.theta + turn,
    )
