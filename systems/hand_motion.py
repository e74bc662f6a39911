"""Smooth motions of the hand in (x, y, z, yaw), as fast as the limits allow."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from systems.signals import wrap_to_pi

SMOOTHING = 1 / 16
"""Rise time of the acceleration, in s."""

PARTS = ([0, 1], [2], [3])
"""Indices of the axes of each part of a motion: (x, y), which move in step, then z, then yaw."""


@dataclass(frozen=True)
class MotionLimits:
    """Limits of speed (m/s, rad/s) and acceleration (m/s^2, rad/s^2) of (x, y), z and yaw."""

    speed: float
    acceleration: float
    yaw_speed: float
    yaw_acceleration: float

    def of_parts(self) -> tuple[tuple[float, float], ...]:
        """(speed, acceleration) limits of each of the `PARTS`."""
        linear = (self.speed, self.acceleration)
        return (linear, linear, (self.yaw_speed, self.yaw_acceleration))


@dataclass(frozen=True)
class Leg:
    """A part of a motion along z with its own speed."""

    way: float
    """Displacement along z, signed, in m."""
    speed: float
    """Largest speed, in m/s."""
    delay: float
    """Time at which the leg begins, in s after the start of the motion."""


def blended_legs(
    ways: Sequence[float], speeds: Sequence[float], acceleration: float
) -> tuple[Leg, ...]:
    """Computes legs with different speeds along one line, without stops between them.

    Each leg begins when the one before begins to brake. The sum of the two motions then changes
    smoothly from one speed to the other. A leg is shortened by the distance that the next leg
    covers during this time, so that their total distance stays the same. If nothing is left of a
    leg, the next leg covers its whole distance.

    Args:
        ways: the lengths of the legs, in order, in m; all of one sign, or zero.
        speeds: the largest speed of each leg, in m/s.
        acceleration: the largest acceleration, in m/s^2.

    Returns:
        One leg for each element of `ways`. Its displacement is zero if the next leg covers it.
    """
    legs = [Leg(0.0, speed, 0.0) for speed in speeds]
    used = [index for index, way in enumerate(ways) if way]
    delay, left = 0.0, 0.0
    for index, following in zip(used, [*used[1:], None], strict=True):
        length, speed = abs(ways[index]) + left, speeds[index]
        left = 0.0
        if following is not None:
            # Shorten this leg by the distance that the next leg covers while this leg brakes.
            stopping = min(speed, math.sqrt(length * acceleration)) / acceleration + SMOOTHING
            ahead = travel(abs(ways[following]), speeds[following], acceleration, stopping)
            left = min(ahead[0], length)
        length -= left
        if length > 0:
            legs[index] = Leg(math.copysign(length, ways[index]), speed, delay)
            top = min(speed, math.sqrt(length * acceleration))
            delay += travel_time(length, speed, acceleration) - top / acceleration - SMOOTHING
    return tuple(legs)


def travel(
    distance: float, speed: float, acceleration: float, elapsed: float
) -> tuple[float, float, float]:
    """Position, velocity and acceleration, at a given time, of a motion from rest to rest.

    The velocity is a trapezoid, or a triangle over short distances, averaged over the last
    `SMOOTHING` seconds. The acceleration is therefore continuous. The position is a sum of
    truncated cubics, one for each of the eight corners of the acceleration.

    Args:
        distance: length of the motion, not negative, in m or rad.
        speed: largest speed, in m/s or rad/s.
        acceleration: largest acceleration, in m/s^2 or rad/s^2.
        elapsed: time since the start, in s. Before the start the motion is at rest at zero.
    """
    if elapsed <= 0 or distance <= 0:
        return 0.0, 0.0, 0.0
    if elapsed >= travel_time(distance, speed, acceleration):
        return distance, 0.0, 0.0
    top = min(speed, math.sqrt(distance * acceleration))
    ramp_time, cruise_end = top / acceleration, distance / top
    position = velocity = change = 0.0
    for start, sign in (
        (0.0, 1.0),
        (ramp_time, -1.0),
        (cruise_end, -1.0),
        (cruise_end + ramp_time, 1.0),
    ):
        for begin, weight in ((start, sign), (start + SMOOTHING, -sign)):
            since = elapsed - begin
            if since > 0:
                position += weight * since**3
                velocity += weight * since**2
                change += weight * since
    jerk = acceleration / SMOOTHING
    return jerk / 6 * position, jerk / 2 * velocity, jerk * change


def travel_time(distance: float, speed: float, acceleration: float) -> float:
    """Duration of the motion that `travel` computes, in s."""
    if distance <= 0:
        return 0.0
    top = min(speed, math.sqrt(distance * acceleration))
    return distance / top + top / acceleration + SMOOTHING


def time_to_reach(part: float, distance: float, speed: float, acceleration: float) -> float:
    """Time after which `travel` has covered the first `part` metres or radians, in s."""
    low, high = 0.0, travel_time(distance, speed, acceleration)
    if part >= distance:
        return high
    while high - low > 1e-4:
        middle = (low + high) / 2
        low, high = (
            (middle, high)
            if travel(distance, speed, acceleration, middle)[0] < part
            else (low, middle)
        )
    return high


def braking_time(rate: NDArray[np.float64], limits: MotionLimits) -> float:
    """The shortest time in which all axes can stop, in s.

    The velocity follows a cubic with zero acceleration at both ends, so the stopping distance is
    half of rate times braking time.

    Args:
        rate: (4) velocities of x, y, z and yaw, in m/s and rad/s.
        limits: only the accelerations are used.
    """
    vx, vy, vz, vyaw = rate.tolist()
    if not (vx or vy or vz or vyaw):
        return 0.0
    return 1.5 * max(
        math.hypot(vx, vy) / limits.acceleration,
        abs(vz) / limits.acceleration,
        abs(vyaw) / limits.yaw_acceleration,
    )


def motion_at(
    start: NDArray[np.float64],
    goal: NDArray[np.float64],
    start_rate: NDArray[np.float64],
    limits: MotionLimits,
    delays: NDArray[np.float64],
    elapsed: float,
    legs: Sequence[Leg] = (),
) -> NDArray[np.float64]:
    """The state, at a given time, of a motion that starts with a velocity and ends at rest.

    The motion is the sum of braking from the start velocity (see `braking_time`) and, for each of
    the `PARTS`, a `travel` over the remaining distance. Each `travel` begins after the delay of its
    part.

    Args:
        start: (4) position x, y, z, yaw at the start, in m and rad.
        goal: (4) position at the goal.
        start_rate: (4) velocity at the start, in m/s and rad/s.
        limits: the limits of each of the `PARTS`.
        delays: (3) when the `travel` of each part begins, in s after the start.
        elapsed: time since the start, in s.
        legs: if given, the legs along z, which replace the single `travel` along z.

    Returns:
        (12) position, velocity, acceleration.
    """
    # Use plain floats: this runs at every step, and NumPy is slower for four elements.
    position, velocity, acceleration = start.tolist(), [0.0] * 4, [0.0] * 4
    braking = braking_time(start_rate, limits)
    if braking > 0:
        s = min(max(elapsed / braking, 0.0), 1.0)
        for i, rate in enumerate(start_rate.tolist()):
            position[i] += rate * braking * (s - s**3 + s**4 / 2)
            velocity[i] += rate * (1 - s**2 * (3 - 2 * s))
            acceleration[i] -= rate * 6 * s * (1 - s) / braking
    for part, delta, distance, limit, delay in _ways(
        start, goal, start_rate, braking, limits, delays, legs
    ):
        if distance > 0:
            gone, rate, change = travel(distance, *limit, elapsed - delay)
            for i, way in zip(part, delta, strict=True):
                position[i] += way * (gone / distance)
                velocity[i] += way * (rate / distance)
                acceleration[i] += way * (change / distance)
    return np.array([*position, *velocity, *acceleration])


def motion_duration(
    start: NDArray[np.float64],
    goal: NDArray[np.float64],
    start_rate: NDArray[np.float64],
    limits: MotionLimits,
    delays: NDArray[np.float64],
    legs: Sequence[Leg] = (),
) -> float:
    """Duration of the motion that `motion_at` computes, in s."""
    braking = braking_time(start_rate, limits)
    ends = [
        delay + travel_time(distance, *limit)
        for _, _, distance, limit, delay in _ways(
            start, goal, start_rate, braking, limits, delays, legs
        )
        if distance > 0
    ]
    return max([*ends, braking])


def _ways(
    start: NDArray[np.float64],
    goal: NDArray[np.float64],
    start_rate: NDArray[np.float64],
    braking: float,
    limits: MotionLimits,
    delays: NDArray[np.float64],
    legs: Sequence[Leg],
) -> Iterator[tuple[list[int], list[float], float, tuple[float, float], float]]:
    """Yields, for each of the `PARTS` or each leg: the indices of its axes, its displacement after
    braking, the norm of the displacement, its (speed, acceleration) limits, and its delay in s."""
    rates = start_rate.tolist()
    ways = [
        end - begin - rate * braking / 2
        for begin, end, rate in zip(start.tolist(), goal.tolist(), rates, strict=True)
    ]
    for part, limit, delay in zip(PARTS, limits.of_parts(), delays.tolist(), strict=True):
        if legs and part == PARTS[1]:
            for leg in legs:
                yield part, [leg.way], abs(leg.way), (leg.speed, limits.acceleration), leg.delay
            continue
        way = [ways[i] for i in part]
        yield part, way, math.hypot(*way), limit, delay


def ramp(start: float, goal: float, rate: float, elapsed: float) -> tuple[float, float]:
    """Value and rate of a ramp at the time `elapsed` after its start. The ramp goes from `start` to
    `goal` at a constant rate, and stops there."""
    distance = goal - start
    travelled = rate * max(elapsed, 0.0)
    if travelled >= abs(distance):
        return goal, 0.0
    return start + float(np.copysign(travelled, distance)), float(np.copysign(rate, distance))


def shortest_yaws(
    pick_yaw: float, place_yaw: float, present_yaw: float, limit: float
) -> tuple[float, float]:
    """Of all equivalent pick and place yaws within a limit, chooses those that rotate the wrist
    least.

    The jaws are symmetric: both yaws may be rotated by pi together, and each by 2 pi.

    Args:
        pick_yaw: the wrist's yaw at the pick, in rad.
        place_yaw: the wrist's yaw at the place, in rad.
        present_yaw: the wrist's present yaw, in rad.
        limit: the largest magnitude of a yaw, in rad; at least pi, so that a solution exists.

    Returns:
        (pick, place) yaws in rad.
    """
    candidates = []
    for half_turn in (0.0, math.pi):
        for pick in _within(pick_yaw + half_turn, limit):
            for place in _within(place_yaw + half_turn, limit):
                candidates.append((pick, place))
    # If two choices rotate the wrist equally, prefer yaws near the middle of the range.
    return min(
        candidates,
        key=lambda yaws: (
            round(abs(yaws[0] - present_yaw) + abs(yaws[1] - yaws[0]), 6),
            max(abs(yaws[0]), abs(yaws[1])),
        ),
    )


def _within(yaw: float, limit: float) -> list[float]:
    yaw = wrap_to_pi(yaw)
    return [turned for turned in (yaw - math.tau, yaw, yaw + math.tau) if abs(turned) <= limit]
