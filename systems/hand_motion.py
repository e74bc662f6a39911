"""Smooth motions of the hand in (x, y, z, yaw), and how short its limits let them be."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from systems.signals import wrap_to_pi

# Peaks of the minimum-jerk polynomial 10 s^3 - 15 s^4 + 6 s^5 over a unit distance in unit time.
_PEAK_SPEED = 1.875
_PEAK_ACCELERATION = 10 / np.sqrt(3)


@dataclass(frozen=True)
class MotionLimits:
    """The most that a motion may reach: m/s, m/s^2, rad/s, rad/s^2."""

    speed: float
    acceleration: float
    yaw_speed: float
    yaw_acceleration: float


def motion_at(
    start: NDArray[np.float64],
    goal: NDArray[np.float64],
    start_rate: NDArray[np.float64],
    duration: float,
    elapsed: float,
) -> NDArray[np.float64]:
    """The quintic from a start, at its rate, to rest at a goal, unaccelerated at both ends.

    From rest it is the minimum-jerk motion.

    Args:
        start: (4) position.
        goal: (4) position.
        start_rate: (4) velocity at the start.
        duration: in s; at zero the goal is reached at once.
        elapsed: since the start, in s.

    Returns:
        (12) position, velocity, acceleration.
    """
    if duration <= 0:
        return np.concatenate([goal, np.zeros(8)])
    s = min(max(elapsed / duration, 0.0), 1.0)
    delta = goal - start
    t = duration
    return np.concatenate(
        [
            start
            + s**3 * (10 + s * (6 * s - 15)) * delta
            + s * (1 + s**2 * (s * (8 - 3 * s) - 6)) * t * start_rate,
            30 * s**2 * (1 - s) ** 2 / t * delta
            + (1 + s**2 * (s * (32 - 15 * s) - 18)) * start_rate,
            60 * s * (1 - s) * (1 - 2 * s) / t**2 * delta
            + s * (s * (96 - 60 * s) - 36) / t * start_rate,
        ]
    )


def motion_duration(displacement: NDArray[np.float64], limits: MotionLimits) -> float:
    """The shortest minimum-jerk motion over (dx, dy, dz, dyaw) within the limits, in s."""
    distance, turn = float(np.linalg.norm(displacement[:3])), abs(float(displacement[3]))
    return max(
        _PEAK_SPEED * distance / limits.speed,
        np.sqrt(_PEAK_ACCELERATION * distance / limits.acceleration),
        _PEAK_SPEED * turn / limits.yaw_speed,
        np.sqrt(_PEAK_ACCELERATION * turn / limits.yaw_acceleration),
    )


def braking_time(rate: NDArray[np.float64], limits: MotionLimits) -> float:
    """The shortest `motion_at` from (vx, vy, vz, vyaw) to rest half as far as it would go, in s."""
    return 1.5 * max(
        float(np.linalg.norm(rate[:3])) / limits.acceleration,
        abs(float(rate[3])) / limits.yaw_acceleration,
    )


def ramp(start: float, goal: float, rate: float, elapsed: float) -> tuple[float, float]:
    """Value and rate of a ramp at constant speed that stops at its goal."""
    distance = goal - start
    travelled = rate * max(elapsed, 0.0)
    if travelled >= abs(distance):
        return goal, 0.0
    return start + float(np.copysign(travelled, distance)), float(np.copysign(rate, distance))


def nearest_yaws(pick_yaw: float, place_yaw: float) -> tuple[float, float]:
    """The equivalent yaws that keep the wrist nearest its middle.

    The jaws are alike, so both yaws may be rotated by pi together, and either by 2 pi.

    Returns:
        (pick, place) in radians, the larger of whose magnitudes is smallest.
    """
    candidates = []
    for half_turn in (0.0, np.pi):
        pick, place = wrap_to_pi(pick_yaw + half_turn), wrap_to_pi(place_yaw + half_turn)
        candidates.append((pick, place))
    return min(candidates, key=lambda yaws: max(abs(yaws[0]), abs(yaws[1])))
