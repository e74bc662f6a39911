import math

import numpy as np
import pytest
from pydrake.common.value import Value
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.tree import BodyIndex

from systems.oracle_policy import (
    OraclePolicy,
    OracleTarget,
    Rounding,
    grasp_taken,
    gripper_pose,
)
from systems.signals import PickPlaceAction, PixelGrid, PlanarPose, wrap_to_pi


def planar(x: float, y: float, yaw: float, z: float = 0.0) -> RigidTransform:
    return RigidTransform(RollPitchYaw(0, 0, yaw), [x, y, z])


HAMMER = OracleTarget("hammer", BodyIndex(2), planar(0.5, 0.1, 0.7), PlanarPose(0.05, 0.0), 0.013)
PLIERS = OracleTarget(
    "pliers", BodyIndex(1), planar(0.6, -0.2, -2.0, 0.03), PlanarPose(0.02, 0.01, 0.4), 0.010
)


def ask(
    poses: dict[int, RigidTransform], *targets: OracleTarget, rounding: Rounding | None = None
) -> PickPlaceAction:
    """The action for these body poses by body index."""
    oracle = OraclePolicy(targets=targets, rounding=rounding)
    context = oracle.CreateDefaultContext()
    everything = [poses.get(index, RigidTransform()) for index in range(3)]
    oracle.GetInputPort("body_poses").FixValue(context, Value(everything))
    return oracle.GetOutputPort("action").Eval(context)


def test_ports():
    oracle = OraclePolicy(targets=[HAMMER])
    assert oracle.num_input_ports() == oracle.num_output_ports() == 1
    assert oracle.GetInputPort("body_poses").Allocate().get_value() is not None
    assert oracle.GetOutputPort("action").Allocate().get_value() == PickPlaceAction()


def test_takes_the_first_object_in_order_that_is_not_at_its_goal():
    away = {1: planar(0.3, 0.0, 0.0), 2: planar(0.3, 0.3, 0.0)}
    at_pliers, at_hammer = (0.32, 0.01), (0.35, 0.3)
    for targets, expected in (((HAMMER, PLIERS), at_hammer), ((PLIERS, HAMMER), at_pliers)):
        action = ask(away, *targets)
        assert not action.stop
        np.testing.assert_allclose((action.pick.x, action.pick.y), expected, atol=1e-12)
    # Near its goal counts as at its goal, whatever its heading or height.
    seated = {1: away[1], 2: planar(0.52, 0.11, 3.0, 0.02)}
    np.testing.assert_allclose(ask(seated, HAMMER, PLIERS).pick.x, at_pliers[0])


def test_stops_when_all_are_at_their_goals():
    assert ask({1: PLIERS.X_WGoal, 2: HAMMER.X_WGoal}, HAMMER, PLIERS).stop


@pytest.mark.parametrize("kit_yaw", [0.0, 1.0, math.pi, -2.5])
def test_what_is_held_arrives_at_the_goal(kit_yaw: float):
    """The gripper carries the object rigidly; goal and object are turned by any angles."""
    goal = planar(0.5, 0.0, kit_yaw) @ planar(0.02, -0.03, 0.3, 0.033)
    target = OracleTarget("pliers", BodyIndex(1), goal, PLIERS.grasp, 0.010)
    X_WB = planar(0.35, 0.2, 2.9)
    action = ask({1: X_WB}, target)
    X_WPick = planar(action.pick.x, action.pick.y, action.pick.theta)
    X_WPlace = planar(action.place.x, action.place.y, action.place.theta)
    arrived = X_WPlace @ X_WPick.inverse() @ X_WB
    np.testing.assert_allclose(arrived.rotation().matrix(), goal.rotation().matrix(), atol=1e-12)
    np.testing.assert_allclose(arrived.translation()[:2], goal.translation()[:2], atol=1e-12)
    # The jaws close across the object where its annotation says.
    X_BPick = X_WB.inverse() @ X_WPick
    np.testing.assert_allclose(X_BPick.translation()[:2], (0.02, 0.01), atol=1e-12)
    assert RollPitchYaw(X_BPick.rotation()).yaw_angle() == pytest.approx(0.4)


def test_surface_height_follows_the_object():
    assert ask({1: planar(0.3, 0.0, 0.0, 0.04)}, PLIERS).surface_height == pytest.approx(0.05)


def test_no_targets_is_refused():
    with pytest.raises(ValueError, match="at least one target"):
        OraclePolicy(targets=[])


@pytest.mark.parametrize("yaw", [0.0, 2.0, -3.0])
def test_the_grasp_taken_is_the_inverse_of_the_gripper_pose(yaw: float):
    X_WB = planar(0.4, -0.1, yaw)
    taken = grasp_taken(X_WB, gripper_pose(X_WB, PLIERS.grasp))
    np.testing.assert_allclose(taken.as_array(), PLIERS.grasp.as_array(), atol=1e-12)


@pytest.mark.parametrize("orientations", [36, 180])
@pytest.mark.parametrize("yaw", [0.03, 1.234, 2.9, -2.0])
def test_rounded_answers_are_the_nearest_that_can_be_said(yaw: float, orientations: int):
    grid = PixelGrid()
    X_WB = planar(0.3512, 0.2034, yaw)
    action = ask({1: X_WB}, PLIERS, rounding=Rounding(grid, orientations))
    for pose in (action.pick, action.place):
        pixel = grid.to_pixel((pose.x, pose.y))
        np.testing.assert_allclose(pixel, np.round(pixel), atol=1e-9)
    turn = action.place.theta - action.pick.theta
    for angle in (action.pick.theta, turn):
        bins = angle * orientations / math.tau
        assert bins == pytest.approx(round(bins), abs=1e-9)

    pick = gripper_pose(X_WB, PLIERS.grasp)
    half_pixel, half_bin = grid.resolution / 2 + 1e-12, math.pi / orientations + 1e-12
    assert abs(action.pick.x - pick.x) <= half_pixel
    assert abs(action.pick.y - pick.y) <= half_pixel
    assert abs(wrap_to_pi(action.pick.theta - pick.theta)) <= half_bin
    assert abs(wrap_to_pi(turn - (-2.0 - yaw))) <= half_bin
    # The place is that of the rounded pick, not of the annotated grasp.
    X_WPick = planar(action.pick.x, action.pick.y, action.pick.theta)
    ideal = (PLIERS.X_WGoal @ X_WB.inverse() @ X_WPick).translation()
    assert abs(action.place.x - ideal[0]) <= half_pixel
    assert abs(action.place.y - ideal[1]) <= half_pixel


def test_rounding_stays_on_the_grid():
    rounding = Rounding(PixelGrid(), 36)
    assert rounding.position(0.0, 2.0) == pytest.approx((0.2515625, 0.4984375))
