import numpy as np
import pytest

from systems.hand_motion import (
    PARTS,
    SMOOTHING,
    MotionLimits,
    braking_time,
    motion_at,
    motion_duration,
    shortest_yaws,
    time_to_reach,
    travel,
    travel_time,
)

LIMITS = MotionLimits(speed=0.6, acceleration=3.0, yaw_speed=2.0, yaw_acceleration=8.0)
START, GOAL = np.array([0.4, 0.1, 0.1, 0.3]), np.array([0.5, -0.2, 0.15, -1.0])
RATE = np.array([0.3, -0.5, 0.1, 1.5])
AT_ONCE = np.zeros(3)


def sampled(goal, rate, delays=AT_ONCE, count=4001):
    times = np.linspace(0, motion_duration(START, goal, rate, LIMITS, delays), count)
    motion = np.array([motion_at(START, goal, rate, LIMITS, delays, time) for time in times])
    return times, *np.split(motion, 3, axis=1)


@pytest.mark.parametrize("rate", [np.zeros(4), RATE])
@pytest.mark.parametrize("delays", [AT_ONCE, np.array([0.2, 0.5, 0.0])])
def test_motion_starts_at_the_given_state_and_rests_at_the_goal(rate, delays):
    _, q, v, a = sampled(GOAL, rate, delays)
    np.testing.assert_allclose([q[0], v[0], a[0]], [START, rate, np.zeros(4)], atol=1e-12)
    np.testing.assert_allclose([q[-1], v[-1], a[-1]], [GOAL, np.zeros(4), np.zeros(4)], atol=1e-9)


@pytest.mark.parametrize("rate", [np.zeros(4), RATE])
def test_velocity_and_acceleration_are_the_derivatives(rate):
    times, q, v, a = sampled(GOAL, rate, np.array([0.1, 0.3, 0.0]))
    np.testing.assert_allclose(np.gradient(q, times, axis=0)[1:-1], v[1:-1], atol=1e-4)
    np.testing.assert_allclose(np.gradient(v, times, axis=0)[1:-1], a[1:-1], atol=2e-2)


@pytest.mark.parametrize("distance", [0.001, 0.02, 0.1, 1.0])
def test_travel_is_time_optimal_up_to_smoothing(distance):
    times = np.linspace(0, travel_time(distance, 0.6, 3.0), 2001)
    position, velocity, acceleration = np.array([travel(distance, 0.6, 3.0, t) for t in times]).T
    assert (np.diff(position) >= 0).all()
    assert velocity.max() <= 0.6 + 1e-9
    assert abs(acceleration).max() <= 3.0 + 1e-9
    # The duration of the fastest velocity profile without smoothing, a trapezoid or a triangle.
    trapezoid = max(2 * np.sqrt(distance / 3.0), distance / 0.6 + 0.6 / 3.0)
    assert times[-1] <= trapezoid + SMOOTHING + 1e-9
    # The jerk is largest where the acceleration reverses, at the middle of a short travel.
    assert abs(np.diff(acceleration) / np.diff(times)).max() <= 2 * 3.0 / SMOOTHING * (1 + 1e-6)


@pytest.mark.parametrize("part", [0.0, 0.01, 0.07, 0.099])
def test_time_to_reach(part):
    when = time_to_reach(part, 0.1, 0.6, 3.0)
    assert travel(0.1, 0.6, 3.0, when)[0] == pytest.approx(part, abs=1e-4)


def test_each_part_begins_after_its_delay():
    delays = np.array([0.2, 0.5, 0.0])
    times, q, _, _ = sampled(GOAL, np.zeros(4), delays)
    for part, delay in zip(PARTS, delays, strict=True):
        moved = (q[:, part] != START[part]).any(axis=1)
        assert times[moved][0] == pytest.approx(delay, abs=2e-3)


def test_motion_in_the_plane_is_straight():
    _, q, _, _ = sampled(GOAL, np.zeros(4))
    along = (q[:, :2] - START[:2]) / (GOAL - START)[:2]
    np.testing.assert_allclose(along[:, 0], along[:, 1], atol=1e-9)


def test_braking_never_reverses_and_keeps_the_limits():
    rest = START + RATE * braking_time(RATE, LIMITS) / 2
    _, _, v, a = sampled(rest, RATE)
    assert (v * np.sign(RATE) >= -1e-9).all()
    assert np.linalg.norm(a[:, :2], axis=1).max() <= LIMITS.acceleration * (1 + 1e-6)
    assert abs(a[:, 2]).max() <= LIMITS.acceleration * (1 + 1e-6)
    assert abs(a[:, 3]).max() <= LIMITS.yaw_acceleration * (1 + 1e-6)


@pytest.mark.parametrize(
    ("pick", "place", "present", "expected"),
    [
        (0.1, 0.4, 0.0, (0.1, 0.4)),
        (3.0, -3.0, 0.0, (3.0 - np.pi, np.pi - 3.0)),  # -8 and 8 degrees, not 172.
        (3.0, -3.0, 2.9, (3.0, 2 * np.pi - 3.0)),  # The place's yaw is beyond pi.
        (0.2, 0.2 + np.pi, 0.0, None),  # The object must turn by pi.
        (5.0, 11.0, 1.0, None),
        (-np.pi / 2, np.pi, -3.0, None),
    ],
)
def test_shortest_yaws(pick, place, present, expected):
    limit = 3.4
    rotated = shortest_yaws(pick, place, present, limit)
    if expected is not None:
        np.testing.assert_allclose(rotated, expected)
    assert max(map(abs, rotated)) <= limit
    # These yaws grasp and rotate the object in the same way as `pick` and `place`.
    half_turns = (rotated[0] - pick) / np.pi
    assert half_turns == pytest.approx(round(half_turns))
    turns = ((rotated[1] - rotated[0]) - (place - pick)) / (2 * np.pi)
    assert turns == pytest.approx(round(turns))
    # No equivalent pair of yaws within the limit makes the hand turn less.
    ways = [
        abs(a - present) + abs(b - a)
        for half in (0, 1)
        for i in range(-3, 4)
        for j in range(-3, 4)
        if abs(a := pick + np.pi * half + 2 * np.pi * i) <= limit
        and abs(b := place + np.pi * half + 2 * np.pi * j) <= limit
    ]
    way = abs(rotated[0] - present) + abs(rotated[1] - rotated[0])
    assert way == pytest.approx(min(ways), abs=1e-5)
