"""The edges of a block, over which an object that lies the wrong way up is turned."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from systems.signals import PlanarPose

_OUTSIDE = (0.15, 0.6)
"""The centre of mass is let go outside the edge, by a share in this range of what is inside."""
_MOST_OUTSIDE = 0.008
"""Greatest distance outside, in metres."""
_BESIDE = 0.005
"""The object must lie on the block on both sides of its centre of mass, at least so far from it
along the edge, in metres."""
_FROM_CORNER = 0.02
"""Its distance from the block's corner along the edge, in metres. The object reaches beyond the
corner, where the hand can grip it again."""
_LANDING = 0.09
"""Width of the part of the table on which it lands, in metres."""
_ROOM = 0.015
"""Room beyond the object's ends there, in metres."""


@dataclass(frozen=True)
class Ledge:
    """A block on the table."""

    pose: PlanarPose
    """Its middle and its heading in the world."""
    size: tuple[float, float]
    """Extents along its heading and across it, in metres."""

    def turning_pose(
        self,
        outline: NDArray[np.float64],
        p_WCenter: NDArray[np.float64],
        others: NDArray[np.float64],
        area: tuple[tuple[float, float], tuple[float, float]],
        *,
        inner_side: int = 0,
    ) -> PlanarPose | None:
        """Where to let go of an object so that it tips over an edge and turns over.

        Args:
            outline: (k, 2) points of the object as it is held, from its centre of mass, along its
                heading and to the left of it, in metres.
            p_WCenter: its centre of mass, which picks the share outside and the edge: after a
                failure, the object lies elsewhere, and is let go differently.
            others: (m, 3) points of everything that may be in the way, in the world.
            area: where the object may land: lower and upper (x, y) corner.
            inner_side: which side lies on the block: 1 the left, -1 the right, 0 the wider one.

        Returns:
            The point of its centre of mass and its heading; None if all edges are obstructed.
        """
        low, high = np.array(area[0]), np.array(area[1])
        middle = np.array([self.pose.x, self.pose.y])
        length = float(np.ptp(outline[:, 0]))
        # Its left side, or after half a turn its right side, lies on the block.
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
                # Beside this edge, the object has been let go before.
                again = bool(np.linalg.norm(p_WCenter[:2] - edge) < _LANDING)
                if best is None or (count, again) < best[0]:
                    p_W = edge + outside * normal
                    theta = outward + math.pi / 2 + half_turn
                    best = (count, again), PlanarPose(float(p_W[0]), float(p_W[1]), theta)
        return best[1] if best is not None and best[0][0] == 0 else None


def _inside(outline: NDArray[np.float64]) -> float:
    """How far an object reaches to the left on both sides of its centre of mass, in metres."""
    u, v = outline.T
    reach = u.max() - u.min()
    sides = [(sign * u > _BESIDE) & (sign * u < 0.3 * reach) for sign in (-1, 1)]
    return min(float(v[side].max(initial=0.0)) for side in sides)


def moved_gripper(
    gripper: PlanarPose, p_WHeld: NDArray[np.float64], yaw: float, goal: PlanarPose
) -> PlanarPose:
    """The gripper's pose after it has carried an object.

    Args:
        gripper: its pose before.
        p_WHeld: a point of the object before.
        yaw: the object's heading before, in radians.
        goal: the point and the heading afterwards.
    """
    turn = goal.theta - yaw
    dx, dy = gripper.x - p_WHeld[0], gripper.y - p_WHeld[1]
    cos, sin = math.cos(turn), math.sin(turn)
    return PlanarPose(
        float(goal.x + cos * dx - sin * dy),
        float(goal.y + sin * dx + cos * dy),
        gripper.theta + turn,
    )
