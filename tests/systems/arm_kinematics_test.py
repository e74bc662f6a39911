import math

import numpy as np

from systems.arm_kinematics import (
    ArmBase,
    fingertips,
    hand_state,
    inverse,
    inverse_of_flange,
    jacobian,
    joint_frames,
    joint_seven,
    uprightness,
)
from systems.arm_limits import FR3, PANDA

RNG = np.random.default_rng(7)
BASE = ArmBase(0.1, -0.2, 0.05, 0.7)


def test_inverse_kinematics_finds_every_configuration_again():
    for limits in (FR3, PANDA):
        q = RNG.uniform(limits.lower, limits.upper, (500, 7))
        rotations, origins = joint_frames(q)
        found = inverse_of_flange(rotations[:, 7], origins[:, 7], q[:, 6])
        apart = np.abs(found - q[:, None]).max(-1)
        assert np.nanmin(apart, axis=1).max() < 1e-8
        again, there = joint_frames(found)
        exists = np.isfinite(found).all(-1)
        assert np.abs(again[:, :, 7] - rotations[:, None, 7])[exists].max() < 1e-9
        assert np.abs(there[:, :, 7] - origins[:, None, 7])[exists].max() < 1e-9


def test_the_hand_points_down_at_the_pose():
    pose = np.array([0.6, 0.1, 0.03, 0.4])
    x, y, z, yaw = BASE.to_base(pose)
    azimuth = math.atan2(y, x)
    q7 = joint_seven(azimuth, yaw)
    solutions = inverse(np.array([x, y, z]), q7, yaw)
    solutions = solutions[np.isfinite(solutions).all(-1)]
    assert len(solutions) >= 2
    for q in solutions:
        np.testing.assert_allclose(hand_state(q.tolist(), [0.0] * 7, BASE)[:4], pose, atol=1e-9)
        np.testing.assert_allclose(joint_frames(q)[0][7, :, 2], [0, 0, -1], atol=1e-9)
    # In one of the solutions, the arm is in the vertical plane through its base and the hand.
    assert np.abs(solutions[:, [2, 4]]).max(axis=1).min() < 1e-6
    np.testing.assert_allclose(BASE.to_world(fingertips(solutions)), [pose[:3]] * len(solutions))


def test_uprightness_is_the_cosine_of_the_tilt():
    q = np.random.default_rng(1).uniform(-3.0, 3.0, (20, 7))
    np.testing.assert_allclose(uprightness(q), -joint_frames(q)[0][:, 7, 2, 2], atol=1e-12)


def test_velocities_are_derivatives_of_positions():
    q, v = RNG.uniform(-1, 1, (2, 7))
    step = 1e-6
    ahead = np.array(hand_state((q + step * v).tolist(), v.tolist(), BASE))
    behind = np.array(hand_state((q - step * v).tolist(), v.tolist(), BASE))
    rates = hand_state(q.tolist(), v.tolist(), BASE)[4:]
    np.testing.assert_allclose((ahead - behind)[:4] / (2 * step), rates, atol=1e-6)
    moved = (fingertips(q + step * v) - fingertips(q - step * v)) / (2 * step)
    np.testing.assert_allclose(moved, jacobian(q)[3:] @ v, atol=1e-6)


def test_the_velocity_limits_of_an_fr3_depend_on_the_position():
    q = np.array([0.0, 0.0, 0.0, -1.5, 0.0, 2.0, 0.0])
    low, high = FR3.velocity_bounds(q)
    np.testing.assert_allclose(high[[0, 4, 6]], [2.62, 5.26, 5.26])
    q[1] = 1.7
    low, high = FR3.velocity_bounds(q)
    assert high[1] < 0.5
    assert low[1] == -2.62
    # At the upper ends of the joints' ranges, the limits of upward velocities are small.
    assert np.abs(FR3.velocity_bounds(np.array(FR3.upper))[1]).max() < 0.2
    np.testing.assert_array_equal(PANDA.velocity_bounds(q)[1], PANDA.velocity)
