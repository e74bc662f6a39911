import dataclasses
import functools
import itertools

import numpy as np
import pytest

from systems.arm_kinematics import ArmBase
from systems.arm_limits import ARM_LIMITS, FR3, limits_used
from systems.arm_motion import ArmMotion
from systems.arm_trajectory import ArmTrajectory, plan_action, quintic
from systems.pick_place_parameters import PickPlaceParameters
from systems.signals import PickPlaceAction, PlanarPose, SurfaceHeights

PARAMETERS = PickPlaceParameters()
ACTION = PickPlaceAction(PlanarPose(0.45, 0.2, 0.3), PlanarPose(0.55, -0.1, 1.2))
PRESS = PickPlaceAction(PlanarPose(0.45, 0.2, 0.3), press=True)
SURFACES = SurfaceHeights(
    pick_top=0.02, place_rim=0.05, place_floor=0.03, near_pick=0.02, near_place=0.05, highest=0.05
)


@functools.cache
def plan(
    model: str = "fr3",
    action: PickPlaceAction = ACTION,
    rate: int = 1000,
    surfaces: SurfaceHeights = SURFACES,
) -> ArmTrajectory:
    motion = ArmMotion(PARAMETERS, ARM_LIMITS[model], ArmBase())
    trajectory = plan_action(motion, PARAMETERS, action, surfaces, rate=rate)
    assert isinstance(trajectory, ArmTrajectory), trajectory
    return trajectory


@pytest.mark.parametrize(
    ("model", "action", "rate"),
    [
        ("fr3", ACTION, 1000),
        pytest.param("panda", ACTION, 400, marks=pytest.mark.slow),
        ("fr3", PRESS, 1000),
    ],
)
def test_the_whole_action_keeps_all_limits(model: str, action: PickPlaceAction, rate: int):
    trajectory, limits = plan(model, action, rate), ARM_LIMITS[model]
    # Sample the trajectory at 1 kHz, as a controller would interpolate it.
    samples = np.array([trajectory.at(k / 1000) for k in range(int(1000 * trajectory.duration))])
    for name, share in limits_used(samples, limits, 1000):
        assert share <= (1.0 if rate == 1000 else 1.02), name
    assert all(share <= 1.0 for _, share in trajectory.limits_used)
    q, v, a = trajectory.positions, trajectory.velocities, trajectory.accelerations
    np.testing.assert_array_equal([v[0], a[0], v[-1], a[-1]], 0.0)
    # Velocities and accelerations must be derivatives of the positions.
    step = 1 / rate
    np.testing.assert_allclose(np.diff(q, axis=0), step * (v[1:] + v[:-1]) / 2, atol=1e-5)
    np.testing.assert_allclose(np.diff(v, axis=0), step * (a[1:] + a[:-1]) / 2, atol=2e-3)


def test_the_hand_is_where_the_action_says():
    trajectory, motion = plan(), ArmMotion(PARAMETERS, FR3, ArmBase())
    ends = {
        it.mode: motion.postures.hand_pose(trajectory.positions[it.last])
        for it in trajectory.segments
    }
    # At the pick, the fingertips end 10 mm below the object's top. At the place, they end at the
    # height of the cavity's rim.
    np.testing.assert_allclose(ends["DESCEND"][:3], [0.45, 0.2, 0.01], atol=1e-3)
    np.testing.assert_allclose(ends["LOWER"][:3], [0.55, -0.1, 0.05], atol=1e-3)
    turned = ends["LOWER"][3] - ends["DESCEND"][3]
    assert np.remainder(turned, 2 * np.pi) == pytest.approx(0.9, abs=1e-3)
    assert ends["CARRY"][2] > 0.07
    assert ends["RETREAT"][2] == pytest.approx(PARAMETERS.home[2], abs=1e-3)


def test_the_object_is_lowered_to_the_floor_where_the_fingers_have_room():
    shallow = dataclasses.replace(SURFACES, place_rim=0.035)
    trajectory, motion = plan(surfaces=shallow), ArmMotion(PARAMETERS, FR3, ArmBase())
    end = next(it.last for it in trajectory.segments if it.mode == "LOWER")
    # The object stands on the place's floor; the fingertips hold it 10 mm above its bottom.
    assert motion.postures.hand_pose(trajectory.positions[end])[2] == pytest.approx(0.04, abs=1e-3)


def test_segments_and_jaws():
    trajectory = plan()
    segments = trajectory.segments
    for one, following in itertools.pairwise(segments):
        assert one.last == following.first
    assert (segments[0].first, segments[-1].last) == (0, len(trajectory.positions) - 1)
    guarded = {it.mode: it.stop_force for it in segments if it.stop_force is not None}
    assert guarded == {"DESCEND": 4.0, "LOWER": 4.0}
    starts = {it.mode: it.first / 1000 for it in segments}
    assert [(it.time, it.width, it.force) for it in trajectory.jaws] == [
        (0.0, 0.08, 0.0),
        (starts["CLOSE"], 0.0, 30.0),
        (starts["RELEASE"], 0.08, 0.0),
    ]
    # The arm waits until the jaws have closed or opened all the way.
    assert trajectory.width_at(starts["CLOSE"] + 0.4) == pytest.approx((0.04, -0.1))
    assert trajectory.width_at(starts["CHECK"])[0] == pytest.approx(0.0)
    assert trajectory.width_at(starts["RETREAT"] + 0.01) == pytest.approx((0.08, 0.0))
    assert trajectory.force_at(starts["LIFT"]) == 30.0
    assert trajectory.force_at(starts["RETREAT"]) == 0.0
    pressed = plan(action=PRESS)
    assert [(it.mode, it.stop_force) for it in pressed.segments] == [
        ("APPROACH", None),
        ("DESCEND", PARAMETERS.press_stop_force),
        ("RETREAT", None),
    ]
    assert pressed.width_at(pressed.duration)[0] == 0.0
    # A press may go 20 mm below the object's top. Here that would be down to the table, so the
    # press ends sooner, at the floor clearance.
    motion = ArmMotion(PARAMETERS, FR3, ArmBase())
    lowest = motion.postures.hand_pose(pressed.positions[pressed.segments[1].last])[2]
    assert lowest == pytest.approx(PARAMETERS.floor_clearance, abs=1e-4)


def test_it_starts_where_the_arm_is():
    motion = ArmMotion(PARAMETERS, FR3, ArmBase())
    joints = motion.home_joints + 0.1
    found = plan_action(motion, PARAMETERS, ACTION, SURFACES, joints=joints)
    assert isinstance(found, ArmTrajectory)
    np.testing.assert_array_equal(found.positions[0], joints)


def test_what_is_out_of_reach_is_said():
    motion = ArmMotion(PARAMETERS, FR3, ArmBase())
    far = PickPlaceAction(ACTION.pick, PlanarPose(0.9, 0.4, 0.0))
    problem = plan_action(motion, PARAMETERS, far, SURFACES)
    assert isinstance(problem, str)
    assert problem.startswith("the place at (0.900, 0.400) m is out of the arm's reach")


def test_a_quintic_fits_both_ends():
    q, v, a = np.random.default_rng(0).normal(size=(3, 2, 7))
    for i, since in enumerate((0.0, 0.3)):
        found = quintic(q, v, a, step=0.3, since=since)
        np.testing.assert_allclose(found, np.concatenate([q[i], v[i], a[i]]), atol=1e-12)
