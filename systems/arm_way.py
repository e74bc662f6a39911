"""Plans a *way*, which is one motion of a Franka arm: the arm first brakes to a stop, then follows
a path."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from systems.arm_inertia import ArmInertia
from systems.arm_kinematics import fingertips, uprightness
from systems.arm_limits import JOINTS
from systems.arm_postures import ArmPostures
from systems.arm_stop import ArmStop
from systems.hand_geometry import FINGER_DEPTH, MAX_OPENING, PALM_HEIGHT, PALM_SIZE
from systems.path_timing import TICK, RowLimits, SmoothMotion, plan_motion
from systems.vector_view import Array, Number, VectorView

_LINE_POINTS = 17
"""Number of points at which joint positions are computed for a straight motion of the hand."""
_SPACING = 0.010
"""Spacing of a path's points, in s: the time from one point to the next, if the slowest joint moves
at full speed."""
_ROUNDING, _WIDER = 0.15, 0.3
"""Length of the rounded part at each corner of a path. Like `_SPACING`, it is a time, in s.
`_WIDER` is for paths with only one corner."""
_FEWEST, _MOST = 40, 200
"""Least and largest number of points of a path."""
_TRIES, _PATIENCE = 8, 3
"""If a path is too low, a higher one is tried, up to `_TRIES` paths in all. After try number
`_PATIENCE`, counted from 0, the added height is doubled once more at each try."""
_ANY_ACCELERATION = 1e3
"""Acceleration of the yaw on a straight line, in rad/s^2. It is so large that only the joints'
limits matter."""
_LIGHT = 4.0
"""If one of the joints 1 to 6 turns by more than this per metre of a straight line of the hand, in
rad/m, the hand moves more slowly below the first mark of the line, and in a search."""
_SLOWEST = 0.1
"""The least factor by which the hand slows down."""
_TOO_LOW = 0.001
"""If a path sinks below the clear height by more than this, in m, a higher one is tried."""
_NEARLY_THERE = 0.02
"""Within this horizontal distance of the path's end, in m, the hand may sink below the clear
height."""
_STRAIGHT_UP = 0.006
"""Within this horizontal distance of the path's start, in m, the hand may be below the clear
height."""
_HALF_JAWS, _HALF_PALM = MAX_OPENING / 2 + FINGER_DEPTH, max(PALM_SIZE) / 2
"""How far the open jaws and the palm reach to the side, in m."""
_INSTANT = 1e-9
_COARSE = 16
"""Every 16th sample is checked for collisions."""
_STRIDE = 4 * TICK
"""Time between the stored accelerations of the fingertips, in s."""


class WayVector(VectorView):
    """All numbers that define a motion, in SI units. Fields that do not apply are NaN.

    The motion follows either a straight line of the hand (`line`), or a path that rises, crosses at
    a safe height and sinks (`over`)."""

    start = Array(3 * JOINTS)
    """Joint positions, velocities and accelerations at the beginning of the motion."""
    line = Array(4)
    """Goal of a straight line of the hand: x, y, z, yaw in the world."""
    marks = Array(2)
    """Two heights on the line. The hand slows down below the first, where it may touch something,
    and once more below the second."""
    speeds = Array(3)
    """Largest speeds of the hand on the line: above the marks, between them, and below them."""
    yaw_speed = Number()
    """Largest rate of the yaw on the line."""
    over = Array(JOINTS)
    """Goal of an `over` path: joint positions with the hand at or above the clear height. From
    there the hand sinks to `sink`."""
    clear = Number()
    """The clear height: the hand may travel while its fingertips are above it."""
    sink = Number()
    """Height to which the hand sinks at the end of an `over` path."""
    reach = Number()
    """How far a held object reaches to the side of the fingertips. The object's end hangs lower if
    the hand tilts."""
    speed = Number()
    """Highest linear speed of the hand on an `over` path. `acceleration` is the highest linear
    acceleration on any path."""
    acceleration = Number()


@dataclass(frozen=True)
class _Path:
    """Evenly spaced joint positions (n, 7), and the fingertips' positions there in the world,
    (n, 3)."""

    points: NDArray[np.float64]
    tips: NDArray[np.float64]


class ArmWay:
    """One motion of the arm as a function of the time since its beginning."""

    def __init__(
        self,
        vector: NDArray[np.float64],
        postures: ArmPostures,
        inertia: ArmInertia | None = None,
    ) -> None:
        """
        Args:
            vector: the elements of a `WayVector`.
            postures: chooses the arm's postures.
            inertia: model of the arm's inertia; if None, torque rates are not limited.
        """
        self._inertia = inertia
        self._postures, self._limits = postures, postures.limits
        way = WayVector(vector)
        q, v, a = way.start.reshape(3, -1)
        self._stop = ArmStop(q, v, a, self._limits, inertia)
        self._stopping, self._rest = self._stop.duration, self._stop.goal
        self.missing = 0.0
        """How far, in m, the hand or the held object sinks below the clear height on an `over`
        path, where it should stay above; zero or less if it does."""
        self._motion = self._plan(way, self._rest)
        self.duration = self._stopping + (self._motion.duration if self._motion else 0.0)
        self._accelerations = self._hand_accelerations()

    def at(self, time: float) -> NDArray[np.float64]:
        """(21) joint positions, velocities and accelerations, in rad and s. The time, in s, is
        counted from the beginning of the motion."""
        if time >= self.duration - _INSTANT:
            goal = self._motion.goal if self._motion else self._rest
            return np.concatenate([goal, np.zeros(2 * JOINTS)])
        if time < self._stopping:
            return self._stop.at(time)
        assert self._motion is not None
        return self._motion.at(time - self._stopping)

    def positions(self) -> NDArray[np.float64]:
        """(n, 7) joint positions along the motion, in rad."""
        if self._motion is None:
            return self._rest[None]
        return self._motion.samples[::_COARSE, :JOINTS]

    def hand_acceleration(self, time: float) -> NDArray[np.float64]:
        """(3) acceleration of the fingertips in the world, in m/s^2."""
        index = min(max(round(time / _STRIDE), 0), len(self._accelerations) - 1)
        return self._accelerations[index]

    def _hand_accelerations(self) -> NDArray[np.float64]:
        """(n, 3) accelerations of the fingertips in the world, in m/s^2, at intervals of
        `_STRIDE`."""
        count = math.ceil(self.duration / _STRIDE) + 2
        q = np.empty((count, JOINTS))
        stopping = min(math.ceil(self._stopping / _STRIDE), count)
        for i in range(stopping):
            q[i] = self._stop.at(i * _STRIDE)[:JOINTS]
        q[stopping:] = self._rest
        if self._motion is not None:
            # Round to whole ticks, so that the samples are evenly spaced.
            first = round((stopping * _STRIDE - self._stopping) / TICK)
            index = first + round(_STRIDE / TICK) * np.arange(count - stopping)
            q[stopping:] = self._motion.samples[
                index.clip(0, len(self._motion.samples) - 1), :JOINTS
            ]
        tips = self._postures.base.to_world(fingertips(q))
        found = np.zeros_like(tips)
        found[1:-1] = np.diff(tips, 2, axis=0) / _STRIDE**2
        return found

    def _plan(self, way: WayVector, q: NDArray[np.float64]) -> SmoothMotion | None:
        if np.isfinite(way.over).all():
            path = self._across(way, q)
            count = len(path.points)
            high = np.full((count, 3), way.speed)
            return self._timed(path.points, path.tips, high, np.full(3, way.acceleration))
        if np.isfinite(way.line).all():
            return self._straight(way, q)
        return None

    def _timed(
        self,
        points: NDArray[np.float64],
        rows: NDArray[np.float64],
        high: NDArray[np.float64],
        acceleration: NDArray[np.float64],
    ) -> SmoothMotion:
        bounds = RowLimits(-high, high, acceleration)
        return plan_motion(points, self._limits, rows, bounds, self._inertia)

    def _line(
        self, q: NDArray[np.float64], goal: NDArray[np.float64], points: int = _LINE_POINTS
    ) -> NDArray[np.float64]:
        """(n, 7) joint positions that move the hand in a straight line, up to the first point out
        of reach."""
        start = self._postures.hand_pose(q)
        way = goal - start
        way[3] = np.remainder(way[3] + np.pi, 2 * np.pi) - np.pi
        share = np.linspace(0.0, 1.0, points)[:, None]
        line = self._postures.along(start + share * way, q)
        if not np.isfinite(line[0]).all():
            return q[None]
        # After a stop the hand may be slightly tilted. Correct this gradually along the line.
        line += (1 - share) * (q - line[0])
        inside = self._postures.within(line)
        beyond = np.flatnonzero(~inside)
        return line[: max(int(beyond[0]), 1)] if len(beyond) else line

    def _straight(self, way: WayVector, q: NDArray[np.float64]) -> SmoothMotion | None:
        line = self._line(q, way.line)
        path = self._evenly(line, rounding=0.0)
        if path is None:
            return None
        poses = np.array([self._postures.hand_pose(point) for point in path.points])
        yaw = np.unwrap(poses[:, 3])
        fast, middle, slow = way.speeds.tolist()
        # The speed limit at a point depends on the lower of two heights: the point's and the next
        # point's.
        below = np.minimum(poses[:, 2], np.append(poses[1:, 2], poses[-1, 2]))
        limit = np.where(below < way.marks[1], slow, np.where(below < way.marks[0], middle, fast))
        limit = np.where(below < way.marks[0], limit * _lightness(path), limit)
        high = np.column_stack([np.repeat(limit[:, None], 3, 1), np.full(len(yaw), way.yaw_speed)])
        rows = np.column_stack([path.tips, yaw])
        acceleration = np.array([*[way.acceleration] * 3, _ANY_ACCELERATION])
        return self._timed(path.points, rows, high, acceleration)

    def _across(self, way: WayVector, q: NDArray[np.float64]) -> _Path:
        """A path that rises above the clear height, crosses straight in joint space, and sinks near
        the goal."""
        over = way.over
        end = self._postures.hand_pose(over)
        single = self._postures.hand_pose(q)[2] >= way.clear or way.sink >= way.clear
        rounding = _WIDER if single else _ROUNDING
        raised, found = 0.0, []
        for attempt in range(_TRIES):
            up = self._up(q, way.clear + raised)
            down = self._down(over, end, max(way.clear + raised, way.sink), way.sink)
            path = self._evenly(np.concatenate([up, down]), rounding)
            if path is None:
                # The path has no length, so the arm stays where it is.
                points = np.repeat(q[None], 3, axis=0)
                return _Path(points, self._postures.base.to_world(fingertips(points)))
            missing = self._missing(path, float(way.clear), float(way.reach))
            found.append((missing, path))
            if missing <= _TOO_LOW:
                break
            # Near a rounded corner a little more height may not help, so later tries raise the path
            # by more.
            raised += (missing + 0.005) * 2 ** max(attempt - _PATIENCE, 0)
        self.missing, path = min(found, key=lambda pair: pair[0])
        return path

    def _up(self, q: NDArray[np.float64], height: float) -> NDArray[np.float64]:
        pose = self._postures.hand_pose(q)
        if pose[2] >= height:
            return q[None]
        pose[2] = height
        return self._line(q, pose)

    def _down(
        self, over: NDArray[np.float64], end: NDArray[np.float64], top: float, bottom: float
    ) -> NDArray[np.float64]:
        high, low = end.copy(), end.copy()
        high[2], low[2] = top, bottom
        above = self._line(over, high)
        below = self._line(above[-1], low)
        return below if len(below) > 1 else above[-1:]

    def _missing(self, path: _Path, clear: float, reach: float) -> float:
        """How far, in m, the hand or the held object sinks below the clear height between start and
        end; zero or less if both stay above it."""
        tips, low = path.tips, path.tips[:, 2]
        if path.points[:, [2, 4]].any():
            low = low - _reach_below(path.points, reach)
        away = np.linalg.norm(tips[:, :2] - tips[0, :2], axis=1) > _STRAIGHT_UP
        before = np.linalg.norm(tips[:, :2] - tips[-1, :2], axis=1) > _NEARLY_THERE
        crossing = low[away & before]
        return float(clear - crossing.min()) if len(crossing) else 0.0

    def _evenly(self, corners: NDArray[np.float64], rounding: float) -> _Path | None:
        """An evenly spaced path through the corners, which are rounded; None if it has no
        length."""
        steps = np.abs(np.diff(corners, axis=0)) / self._limits.velocity
        along = np.concatenate([[0.0], np.cumsum(steps.max(axis=1, initial=0.0))])
        if along[-1] < 1e-7:
            return None
        count = int(np.clip(np.ceil(along[-1] / _SPACING) + 1, _FEWEST, _MOST))
        grid = np.linspace(0.0, along[-1], count)
        points = np.stack([np.interp(grid, along, column) for column in corners.T], -1)
        half = round(rounding / 4 / (along[-1] / (count - 1)))
        for _ in range(2):
            points = _averaged(points, max(half, 1))
        return _Path(points, self._postures.base.to_world(fingertips(points)))


def _lightness(path: _Path) -> NDArray[np.float64]:
    """(n) factors from `_SLOWEST` to 1 for the hand's speed along a path, which make impacts
    gentler. Let r be how far the joints turn per way of the hand. The arm's mass m at the
    fingertips grows as r^2, and the force of an impact at speed v as v sqrt(m)."""
    turned = np.abs(np.diff(path.points[:, :-1], axis=0)).max(axis=1)
    moved = np.linalg.norm(np.diff(path.tips, axis=0), axis=1)
    # Avoid 0/0 where neither moves.
    factor = np.ones(len(moved))
    moves = turned > _LIGHT * moved
    factor[moves] = np.maximum(_LIGHT * moved[moves] / turned[moves], _SLOWEST)
    return np.append(factor, factor[-1])


def _reach_below(q: NDArray[np.float64], reach: float) -> NDArray[np.float64]:
    """(n) how far, in m, the tilted hand or the held object reaches below the point between the
    fingertips.

    Args:
        q: (n, 7) joint positions, in rad.
        reach: how far the object reaches to the side, in m; NaN if the hand is empty.
    """
    down = uprightness(q)
    across = np.sqrt(1 - np.minimum(down, 1.0) ** 2)
    return np.maximum(np.fmax(reach, _HALF_JAWS) * across, _HALF_PALM * across - PALM_HEIGHT * down)


def _averaged(points: NDArray[np.float64], half: int) -> NDArray[np.float64]:
    """Replaces each point by the mean of itself and `half` neighbours on each side. The two ends
    stay."""
    half = min(half, len(points) - 1)
    before = 2 * points[0] - points[half:0:-1]
    after = 2 * points[-1] - points[-2 : -half - 2 : -1]
    total = np.cumsum(np.concatenate([0 * points[:1], before, points, after]), axis=0)
    width = 2 * half + 1
    mean = (total[width:] - total[:-width]) / width
    mean[0], mean[-1] = points[0], points[-1]
    return np.asarray(mean)
