r"""Computes motions along a path in joint space that are as fast as the joints' limits allow.

`fastest_times` solves the time-optimal path parameterization by the reachability analysis of Pham
and Pham, "A new approach to time-optimal path parameterization based on reachability analysis",
IEEE T-RO 34 (2018): with x = (ds/dt)^2 and u = d2s/dt2 each limit of acceleration is linear in x
and u. A backward pass finds the largest x from which the end can be reached. Then a forward pass
takes the largest u at each point.

`SmoothMotion` averages such a motion over the last few milliseconds. This limits the jerk. All
other limits still hold: the states that they allow form a convex set, and the average of states in
a convex set is also in the set. For velocities the set is convex because the largest velocity is a
concave function of the position.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from systems.arm_inertia import ArmInertia
from systems.arm_limits import ArmLimits

TICK = 1 / 1024
"""Time between the samples of a motion, in s."""
AVERAGED, _MOST_AVERAGED = 6, 80
"""Least and largest number of ticks over which the acceleration is averaged."""
_SHARE = 0.98
"""Share of the limits that a motion uses at the path's points. Between them it uses a little
more."""
_RATE_SHARE = 0.9
"""Share of the limits of torque rates that a motion uses. It is less than `_SHARE`, because the
model of the inertia is not exact."""
_LEAST, _UNLIMITED = 1e-9, 1e12


@dataclass(frozen=True)
class RowLimits:
    """Limits along a path. A row is a joint's position, or another quantity that depends on the
    joints."""

    low: NDArray[np.float64]
    """(n, rows) lowest velocities at the path's points, negative. `high` holds the highest
    velocities."""
    high: NDArray[np.float64]
    acceleration: NDArray[np.float64]
    """(rows) largest accelerations; all must be finite."""


def fastest_times(
    points: NDArray[np.float64], limits: RowLimits
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The times at which to pass the points of a path, and the speeds there, from rest to rest.

    Args:
        points: (n, rows) at least 3 points, evenly spaced in the path's parameter.
        limits: limits of each row.

    Returns:
        (n) times since the start, in s, and (n) rates ds/dt, where the parameter s is the index of
        the point.
    """
    spline = CubicSpline(np.arange(len(points)), points)
    slopes = spline.c[2]
    first = np.vstack([slopes, spline(len(points) - 1, 1)])
    second = spline(np.arange(len(points)), 2)
    # The limits of acceleration require -b - k x <= u <= b - k x in each row.
    steep = np.where(np.abs(first) < _LEAST, _LEAST, first)
    b, k = limits.acceleration / np.abs(steep), second / steep
    speed = np.where(steep > 0, limits.high, limits.low) / steep
    highest = np.minimum(speed.min(axis=1) ** 2, _solvable(b, k))
    highest[0] = highest[-1] = 0.0
    x = _largest(highest.tolist(), b, k)
    rates = np.sqrt(np.maximum(x, 0.0))
    steps = 2 / np.maximum(rates[:-1] + rates[1:], _LEAST)
    return np.concatenate([[0.0], np.cumsum(steps)]), rates


def _solvable(b: NDArray[np.float64], k: NDArray[np.float64]) -> NDArray[np.float64]:
    """(n) at each point, the largest x for which there is a u with |u + k x| <= b in all rows."""
    gap = k[:, :, None] - k[:, None, :]
    room = b[:, :, None] + b[:, None, :]
    with np.errstate(divide="ignore", invalid="ignore"):
        bound = np.where(gap > _LEAST, room / gap, np.inf)
    return np.asarray(bound.min(axis=(1, 2)))


def _largest(
    highest: list[float], b: NDArray[np.float64], k: NDArray[np.float64]
) -> NDArray[np.float64]:
    """(n) the largest x = (ds/dt)^2 at each point, from one pass backwards and one forwards."""
    # Up to the next point, x can fall by at most 2 (b + k x) in each row. So if the next point
    # allows x <= e, this point must have x (1 - 2 k) <= e + 2 b.
    with np.errstate(divide="ignore"):
        gain = np.where(1 - 2 * k > 0, 1 / (1 - 2 * k), _UNLIMITED)
    rise = 2 * b * gain
    x = list(highest)
    for i in range(len(x) - 2, -1, -1):
        x[i] = min(x[i], float((gain[i] * x[i + 1] + rise[i]).min()))
    for i in range(len(x) - 1):
        most = x[i] + 2 * float((b[i] - k[i] * x[i]).min())
        x[i + 1] = min(x[i + 1], max(most, 0.0))
    return np.array(x)


class SmoothMotion:
    """A motion of the joints from rest to rest, sampled at every `TICK`.

    Between samples the jerk is constant.
    """

    def __init__(self, position: NDArray[np.float64], averaged: int = AVERAGED) -> None:
        """
        Args:
            position: (n, joints) positions at every tick, before averaging. The motion begins and
                ends at rest.
            averaged: number of ticks over which the acceleration is averaged.
        """
        rest = [position[:1]] * 2, [position[-1:]] * (averaged + 2)
        padded = np.concatenate([*rest[0], position, *rest[1]])
        raw = np.diff(padded, 2, axis=0) / TICK**2
        total = np.cumsum(raw, axis=0)
        total[averaged:] -= total[:-averaged].copy()
        acceleration = total / averaged
        acceleration[-1] = 0.0
        velocity = np.zeros_like(acceleration)
        np.cumsum((acceleration[1:] + acceleration[:-1]) * (TICK / 2), axis=0, out=velocity[1:])
        moved = velocity[:-1] * TICK + (2 * acceleration[:-1] + acceleration[1:]) * (TICK**2 / 6)
        place = np.concatenate([position[:1], position[:1] + np.cumsum(moved, axis=0)])
        self.samples = np.hstack([place, velocity, acceleration])
        """(n, 3 * joints) positions, velocities and accelerations at every tick."""
        self.goal = position[-1]
        self.duration = (len(self.samples) - 1) * TICK

    def at(self, time: float) -> NDArray[np.float64]:
        """(3 * joints) positions, velocities and accelerations at a time in s. The joints are at
        rest before and after the motion."""
        if time <= 0:
            return self._rest(self.samples[0, : len(self.goal)])
        if time >= self.duration:
            return self._rest(self.goal)
        index = int(time / TICK)
        h = time - index * TICK
        q, v, a = self.samples[index].reshape(3, -1)
        jerk = (self.samples[index + 1, 2 * len(q) :] - a) / TICK
        change = a + h * jerk
        return np.concatenate(
            [q + h * (v + h * (a / 2 + h / 6 * jerk)), v + h * (a + h / 2 * jerk), change]
        )

    def _rest(self, position: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.concatenate([position, np.zeros(2 * len(position))])

    def excess(self, limits: ArmLimits) -> float:
        """The factor by which the motion must be slowed down to stay within the limits; 1 if it
        stays within."""
        q, v, a = np.split(self.samples, 3, axis=1)
        low, high = braking_bounds(limits, q)
        speed = np.maximum(v / np.maximum(high, _LEAST), v / np.minimum(low, -_LEAST))
        change = np.abs(a) / limits.acceleration
        jerk = np.abs(np.diff(a, axis=0)) / TICK / limits.jerk
        return max(1.0, speed.max(), math.sqrt(change.max()), float(np.cbrt(jerk.max())))

    def torque_rate(self, limits: ArmLimits, inertia: ArmInertia) -> float:
        """The largest ratio of a joint's torque rate to the rate that a motion may use."""
        q, _, a = np.split(self.samples, 3, axis=1)
        rates = np.abs(np.diff(inertia.torques(q, a), axis=0)) / TICK
        return float((rates / limits.torque_rate).max()) / _RATE_SHARE


def braking_bounds(
    limits: ArmLimits, q: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Returns `ArmLimits.velocity_bounds`, lowered near the ends of the ranges so that each joint
    can stop in time."""
    low, high = limits.velocity_bounds(q)
    # Assume half of the limit of acceleration, because limited jerk delays the braking.
    brakes = np.array(limits.acceleration)
    return (
        np.maximum(low, -np.sqrt(np.maximum(brakes * (q - limits.lower), 0.0))),
        np.minimum(high, np.sqrt(np.maximum(brakes * (np.array(limits.upper) - q), 0.0))),
    )


def plan_motion(
    points: NDArray[np.float64],
    limits: ArmLimits,
    extra: NDArray[np.float64],
    bounds: RowLimits,
    inertia: ArmInertia | None = None,
) -> SmoothMotion:
    """The fastest motion along a path, from rest to rest.

    Args:
        points: (n, 7) joint positions, evenly spaced in the path's parameter, at least 3.
        limits: limits of the joints; they hold exactly.
        extra: (n, rows) other quantities that are limited along the path, such as a height.
        bounds: limits of the rows of `extra`; a motion may exceed them by a few percent.
        inertia: model of the arm's inertia; if None, torque rates are not limited.
    """
    low, high = braking_bounds(limits, points)
    rows = RowLimits(
        low=_SHARE * np.hstack([low, bounds.low]),
        high=_SHARE * np.hstack([high, bounds.high]),
        acceleration=_SHARE * np.concatenate([limits.acceleration, bounds.acceleration]),
    )
    times, rates = fastest_times(np.hstack([points, extra]), rows)
    spline = CubicSpline(np.arange(len(points)), points)
    slower, averaged = 1.0, AVERAGED
    for _ in range(12):
        motion = SmoothMotion(_sample(spline, times * slower, rates / slower), averaged)
        excess = motion.excess(limits)
        if excess > 1.0:
            slower *= 1.001 * excess
            continue
        rate = motion.torque_rate(limits, inertia) if inertia else 0.0
        if rate <= 1.0 or averaged == _MOST_AVERAGED:
            return motion
        averaged = min(max(math.ceil(averaged * rate), averaged + 1), _MOST_AVERAGED)
    raise RuntimeError("no motion along the path stays within the limits of the joints")


def _sample(
    spline: CubicSpline, times: NDArray[np.float64], rates: NDArray[np.float64]
) -> NDArray[np.float64]:
    """(n, 7) joint positions at every tick, with constant d2s/dt2 between the path's points."""
    ticks = np.arange(math.ceil(times[-1] / TICK)) * TICK
    index = np.clip(np.searchsorted(times, ticks, side="right") - 1, 0, len(times) - 2)
    since = ticks - times[index]
    change = (rates[index + 1] - rates[index]) / (times[index + 1] - times[index])
    s = index + since * (rates[index] + since * change / 2)
    return np.asarray(spline(np.append(np.minimum(s, len(times) - 1), len(times) - 1)))
