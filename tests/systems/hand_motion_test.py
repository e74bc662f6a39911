import numpy as np
import pytest

from systems.hand_motion import MotionLimits, braking_time, motion_at, motion_duration

LIMITS = MotionLimits(speed=0.6, acceleration=3.0, yaw_speed=2.0, yaw_acceleration=8.0)
START, GOAL = np.array([0.4, 0.1, 0.1, 0.3]), np.array([0.5, -0.2, 0.15, -1.0])
RATE = np.array([0.3, -0.5, 0.0, 1.5])


def sampled(goal, rate, duration, count=2001):
    times = np.linspace(0, duration, count)
    motion = np.array([motion_at(START, goal, rate, duration, time) for time in times])
    return times, *np.split(motion, 3, axis=1)


@pytest.mark.parametrize("rate", [np.zeros(4), RATE])
def test_starts_as_told_and_comes_to_rest_at_the_goal(rate):
    _, q, v, a = sampled(GOAL, rate, 1.3)
    np.testing.assert_allclose([q[0], v[0], a[0]], [START, rate, np.zeros(4)], atol=1e-12)
    np.testing.assert_allclose([q[-1], v[-1], a[-1]], [GOAL, np.zeros(4), np.zeros(4)], atol=1e-12)


def test_velocity_and_acceleration_are_the_derivatives():
    times, q, v, a = sampled(GOAL, RATE, 1.3)
    np.testing.assert_allclose(np.gradient(q, times, axis=0)[1:-1], v[1:-1], atol=1e-4)
    np.testing.assert_allclose(np.gradient(v, times, axis=0)[1:-1], a[1:-1], atol=1e-3)


@pytest.mark.parametrize(
    "displacement", [[0.001, 0, 0, 0], [0.3, -0.2, 0.1, 0], [0, 0, 0, 3.0], [0.1, 0, 0, -0.01]]
)
def test_a_motion_is_as_short_as_its_limits_allow(displacement):
    displacement = np.array(displacement)
    duration = motion_duration(displacement, LIMITS)
    _, _, v, a = sampled(START + displacement, np.zeros(4), duration)
    shares = [
        np.linalg.norm(v[:, :3], axis=1).max() / LIMITS.speed,
        np.linalg.norm(a[:, :3], axis=1).max() / LIMITS.acceleration,
        abs(v[:, 3]).max() / LIMITS.yaw_speed,
        abs(a[:, 3]).max() / LIMITS.yaw_acceleration,
    ]
    assert max(shares) == pytest.approx(1.0, abs=1e-3)


def test_braking_never_turns_back_and_keeps_the_limits():
    duration = braking_time(RATE, LIMITS)
    _, _, v, a = sampled(START + RATE * duration / 2, RATE, duration)
    assert (v * np.sign(RATE) >= -1e-12).all()
    assert np.linalg.norm(a[:, :3], axis=1).max() <= LIMITS.acceleration * (1 + 1e-6)
    assert abs(a[:, 3]).max() <= LIMITS.yaw_acceleration * (1 + 1e-6)
