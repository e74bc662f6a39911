"""Chooses joint positions of a Franka arm for poses of its hand, which points down."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from systems.arm_collisions import Capsule, collision
from systems.arm_kinematics import (
    HAND_TURN,
    ArmBase,
    fingertips,
    hand_state,
    inverse,
    joint_seven,
    planar,
    uprightness,
)
from systems.arm_limits import JOINTS, ArmLimits

MARGIN = 0.03
"""Least distance of a posture from the ends of the joints' ranges, in rad."""
_SWIVELS = np.concatenate([sign * np.arange(0.1, 3.15, 0.1) for sign in (1.0, -1.0)])
"""The swivels, in rad, that are tried if the arm cannot lie in the vertical plane. `ArmPostures`
defines the swivel."""
_CHECKED = 12
"""Number of points of a path that are checked for collisions."""
_JUMP = 1.5
"""Largest allowed change of a joint while the hand moves straight up or down, in rad."""
_SHARES = np.array([0.0, 0.25, 0.5, 0.75, 0.9, 1.0])[:, None, None]
"""The points at which a straight line in joint space is examined. Near its end, where the hand is
low, they are closer."""
_PER_METRE = 30.0
"""A way on which the fingertips sink by a metre between its ends counts as slower by this, in s."""
_PER_RADIAN = 1.0
"""A posture from which a joint turns by a radian while the hand goes straight down counts as slower
by this, in s. Near such postures the arm's mass at the fingertips is large, and so is the force of
an impact."""
_DEEPEST = 0.02
"""If possible, the fingertips sink by at most this between the ends of a way, in m."""
_TILTS = (math.radians(2.0), math.radians(20.0), math.pi)
"""Limits of the hand's tilt between two stops, in rad. The smallest limit that allows a motion is
used: if the hand tilts, one end of a long object hangs lower."""
_PLANAR = 1e-6
"""If the swivel is smaller than this, in rad, the arm counts as lying in the vertical plane."""


@dataclass(frozen=True)
class HandStop:
    """A place where the hand goes down and up again: x and y in the world in m, and yaw in rad."""

    name: str
    x: float
    y: float
    yaw: float
    low: float
    """Lowest height of the fingertips, in m."""
    high: float
    """Highest height of the fingertips, in m."""
    surface: float
    """Height of the highest surface below the wrist, in m."""
    highest: float | None = None
    """Height of the highest surface below forearm and elbow, in m; None for `surface`."""


@dataclass(frozen=True)
class _Option:
    """A possible posture at a stop."""

    half_turn: int
    """Number of half turns of the jaws, 0 or 1."""
    q: NDArray[np.float64]
    """(7) joint positions at the height `high`, in rad."""
    delay: float
    """How much slower the posture counts because of the way down from it, in s."""


class ArmPostures:
    """Chooses among the joint positions that bring the hand to a pose.

    If possible, the arm lies in the vertical plane through its base and the hand. Otherwise its
    wrist lies beside this plane. The *swivel* is the angle between the plane and the wrist, about
    the hand's vertical axis.
    """

    def __init__(self, limits: ArmLimits, base: ArmBase, obstacles: Sequence[Capsule] = ()) -> None:
        """
        Args:
            limits: limits of the joints.
            base: pose of the arm's base in the world.
            obstacles: capsules around fixed bodies that the arm must not touch, in the world.
        """
        self.limits, self.base, self._obstacles = limits, base, tuple(obstacles)
        self._lower = np.array(limits.lower) + MARGIN
        self._upper = np.array(limits.upper) - MARGIN
        self._velocity = np.array(limits.velocity)
        self._acceleration = np.array(limits.acceleration)

    def hand_pose(self, q: NDArray[np.float64]) -> NDArray[np.float64]:
        """(4) x, y, z, yaw of the hand in the world, in m and rad, at joint positions (7)."""
        return np.array(hand_state(q.tolist(), [0.0] * JOINTS, self.base)[:4])

    def within(self, q: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Whether joint positions (..., 7) are at least `MARGIN` away from the ends of their
        ranges, as an array (...); False for NaN."""
        with np.errstate(invalid="ignore"):
            return np.asarray(((q >= self._lower) & (q <= self._upper)).all(-1))

    def along(self, poses: NDArray[np.float64], near: NDArray[np.float64]) -> NDArray[np.float64]:
        """(n, 7) joint positions along a path of the hand, NaN where it is out of reach.

        Args:
            poses: (n, 4) x, y, z, yaw of the hand in the world, close to each other. The swivel
                stays that of `near`.
            near: (7) joint positions close to those of the first pose.
        """
        x, y, z, yaw = np.moveaxis(self.base.to_base(poses), -1, 0)
        azimuth = np.arctan2(y, x)
        swivel = self._swivel(near)
        q7 = near[6] + _wrap(joint_seven(azimuth + swivel, yaw) - near[6])
        tip = np.stack([x, y, z], -1)
        if abs(swivel) < _PLANAR:
            return planar(tip, q7)
        found = inverse(tip, q7, yaw)
        way = np.empty((len(found), JOINTS))
        for i, solutions in enumerate(found):
            apart = np.abs(solutions - near).max(-1)
            # If even the nearest solution is far away, it belongs to another branch: mark the pose
            # as out of reach.
            best = int(np.argmin(np.where(np.isfinite(apart), apart, np.inf)))
            near = way[i] = solutions[best] if apart[best] < 0.5 else np.full(JOINTS, np.nan)
        return way

    def _swivel(self, q: NDArray[np.float64]) -> float:
        x, y, _, yaw = self.base.to_base(self.hand_pose(q)).tolist()
        swivel = math.remainder(q[6] + yaw + HAND_TURN - math.atan2(y, x), math.tau)
        return 0.0 if abs(swivel) < _PLANAR else swivel

    def choose(
        self, stops: Sequence[HandStop], now: NDArray[np.float64]
    ) -> tuple[list[NDArray[np.float64]], str]:
        """Chooses a posture at the height `high` of each stop. The whole motion is kept short, the
        hand tilts as little as possible between two stops, and the joints turn little while it goes
        down.

        The jaws are symmetric, so the yaws may be turned by pi, but only at all stops together.

        Args:
            stops: the stops, in the order in which the hand visits them.
            now: (7) present joint positions, in rad.

        Returns:
            (7) joint positions for each stop, and a sentence that says why the arm cannot reach the
            stops. The sentence is empty if the arm can.
        """
        options: list[list[_Option]] = []
        problem = ""
        for swivels, tilts in ((np.zeros(1), _TILTS[:1]), (_SWIVELS, _TILTS)):
            options = [
                (options[i] if options else []) + self._options(stop, swivels)
                for i, stop in enumerate(stops)
            ]
            for tilt in tilts:
                best = self._fastest(options, now, tilt)
                touches = self._problem_on_the_way(stops, [now, *best]) if best else ""
                if best and not touches:
                    return best, ""
                problem = problem or touches
        if problem:
            return [], problem
        for stop, found in zip(stops, options, strict=True):
            if not found:
                return [], self._problem(stop)
        names = " and ".join(stop.name for stop in stops)
        return [], f"no turn of the hand keeps joint 7 inside its range at both {names}"

    def _problem_on_the_way(self, stops: Sequence[HandStop], way: list[NDArray[np.float64]]) -> str:
        share = np.linspace(0.0, 1.0, _CHECKED)[:, None]
        ways = [start + share * (end - start) for start, end in itertools.pairwise(way)]
        top = max(stops, key=lambda stop: stop.surface)
        if not self.collision(np.concatenate(ways), top.surface, highest=top.highest):
            return ""
        for stop, points in zip(stops, ways, strict=True):
            touched = self.collision(points, stop.surface, highest=stop.highest)
            if touched:
                return f"on the way to {stop.name} the arm would collide with {touched}"
        return ""

    def _fastest(
        self,
        options: list[list[_Option]],
        now: NDArray[np.float64],
        tilt: float,
    ) -> list[NDArray[np.float64]]:
        best: list[NDArray[np.float64]] = []
        least = math.inf
        for half_turn in (0, 1):
            # For each possible posture at the previous stop: the fastest way to this posture, as
            # (time, postures).
            ways = [(0.0, [now])]
            for found in options:
                following = []
                for option in found:
                    if option.half_turn != half_turn:
                        continue
                    found_way = self._fastest_to(option.q, ways, tilt)
                    if found_way is not None:
                        time, way = found_way
                        following.append((time + option.delay, way))
                ways = following
                if not ways:
                    break
            for time, way in ways:
                if time < least - 1e-9:
                    least, best = time, way[1:]
        return best

    def _fastest_to(
        self,
        q: NDArray[np.float64],
        ways: list[tuple[float, list[NDArray[np.float64]]]],
        tilt: float,
    ) -> tuple[float, list[NDArray[np.float64]]] | None:
        """Returns the time, in s, and the postures of the fastest way to a posture. Returns None if
        each way would tilt the hand too far while it may hold an object, or let it sink too far.

        A way on which the hand sinks counts as slower, because it must be led higher.

        Args:
            q: (7) the posture.
            ways: times and postures of the ways so far, each from the present posture.
            tilt: limit of the tilt, in rad.
        """
        starts = np.array([way[-1] for _, way in ways])
        times = np.array([time for time, _ in ways]) + self._times(starts, q)
        line = starts + _SHARES * (q - starts)
        sinks = _sinks(line)
        times += _PER_METRE * sinks
        if tilt < math.pi:
            times[sinks > _DEEPEST] = np.inf
        if len(ways[0][1]) > 1:
            times[_tilts(line) > tilt] = np.inf
        best = int(np.argmin(times))
        return (float(times[best]), [*ways[best][1], q]) if np.isfinite(times[best]) else None

    def _times(self, starts: NDArray[np.float64], end: NDArray[np.float64]) -> NDArray[np.float64]:
        """(n) the approximate time, in s, of a straight motion in joint space from each of the
        postures `starts` (n, 7) to the posture `end`."""
        way = np.abs(end - starts)
        top = np.minimum(self._velocity, np.sqrt(way * self._acceleration))
        return np.asarray((way / np.maximum(top, 1e-9) + top / self._acceleration).max(-1))

    def _options(self, stop: HandStop, swivels: NDArray[np.float64]) -> list[_Option]:
        """All possible postures at a stop."""
        found = [
            (half_turn, way)
            for half_turn in (0, 1)
            for way in self._ways(stop, stop.yaw + half_turn * math.pi, swivels)
            if self.within(way).all() and self._is_continuous(way)
        ]

        # Usually nothing collides, so check all postures in one call first.
        def touches(way: NDArray[np.float64]) -> bool:
            return bool(self.collision(way, stop.surface, highest=stop.highest))

        if found and touches(np.concatenate([way for _, way in found])):
            found = [item for item in found if not touches(item[1])]
        return [
            _Option(turned, way[-1], _PER_RADIAN * float(np.abs(way[-1] - way[0]).max()))
            for turned, way in found
        ]

    def _is_continuous(self, way: NDArray[np.float64]) -> bool:
        """Whether the arm can move its hand straight down from the height `high` to `low`.

        Args:
            way: an array from `_ways`.
        """
        if not way[:, [2, 4]].any():
            return True
        if np.abs(way[-1] - way[0]).max() > _JUMP:
            return False
        top, bottom = self.hand_pose(way[-1]), self.hand_pose(way[0])
        line = self.along(np.linspace(top, bottom, _CHECKED), way[-1])
        return bool(self.within(line).all())

    def collision(
        self,
        way: NDArray[np.float64],
        surface: float | NDArray[np.float64],
        held: float = 0.0,
        highest: float | None = None,
    ) -> str:
        """Names what the arm collides with; see `arm_collisions.collision`."""
        return collision(way, self.base, surface, self._obstacles, held, highest)

    def _ways(
        self, stop: HandStop, yaw: float, swivels: NDArray[np.float64]
    ) -> list[NDArray[np.float64]]:
        """Returns an array for each posture: (k, 7) joint positions at k heights from `low` up to
        `high`. Rows for heights out of reach are NaN."""
        heights = np.linspace(stop.low, stop.high, 5)
        poses = np.array([[stop.x, stop.y, z, yaw] for z in heights])
        x, y, z, yaws = np.moveaxis(self.base.to_base(poses), -1, 0)
        tip = np.stack([x, y, z], -1)
        azimuth = math.atan2(y[0], x[0])
        ways = []
        for swivel in swivels.tolist():
            turned = float(joint_seven(azimuth + swivel, yaws[0]))
            sevens = [turned + k * math.tau for k in (-1, 0, 1)]
            inside = [q7 for q7 in sevens if self._lower[6] <= q7 <= self._upper[6]]
            for q7 in inside:
                seven = np.full(len(heights), q7)
                if swivel == 0.0:
                    ways.append(planar(tip, seven))
                else:
                    ways.extend(np.moveaxis(inverse(tip, seven, yaws), 1, 0))
        return ways

    def _problem(self, stop: HandStop) -> str:
        """A sentence that says why there is no posture at a stop."""
        where = f"{stop.name} at ({stop.x:.3f}, {stop.y:.3f}) m"
        every = np.concatenate([np.zeros(1), _SWIVELS])

        def reached(*yaws: float) -> list[NDArray[np.float64]]:
            ways = [way for yaw in yaws for way in self._ways(stop, yaw, every)]
            return [way for way in ways if self.within(way).all()]

        found = reached(stop.yaw, stop.yaw + math.pi)
        touched = [self.collision(way, stop.surface, highest=stop.highest) for way in found]
        if found and all(touched):
            return f"for {where} the arm would collide with {touched[0]}"
        if found:
            return f"the arm cannot lower its hand in a straight line to {where}"
        # The yaw affects only joint 7. If another yaw brings the stop within reach, it is joint 7
        # that is out of range.
        if reached(*np.linspace(0.0, math.pi, 5)[:-1].tolist()):
            return f"{where} would take joint 7 out of its range"
        heights = f"between {stop.low:.3f} and {stop.high:.3f} m"
        return f"{where} is out of the arm's reach at heights {heights}"


def _tilts(lines: NDArray[np.float64]) -> NDArray[np.float64]:
    """(n) the hand's largest tilt, in rad, on n lines in joint space, whose postures are (k, n,
    7)."""
    return np.asarray(np.arccos(np.clip(uprightness(lines).min(0), -1.0, 1.0)))


def _sinks(lines: NDArray[np.float64]) -> NDArray[np.float64]:
    """(n) how far, in m, the fingertips sink below both ends of n lines in joint space, whose
    postures are (k, n, 7)."""
    heights = fingertips(lines)[..., 2]
    return np.maximum(np.minimum(heights[0], heights[-1]) - heights.min(0), 0.0)


def _wrap(angle: NDArray[np.float64]) -> NDArray[np.float64]:
    return angle - math.tau * np.round(angle / math.tau)
