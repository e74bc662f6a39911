import dataclasses
import math

import numpy as np
import pytest
from pydrake.common.value import Value
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.tree import BodyIndex

from systems.action_quantizer import ActionQuantizer
from systems.grasp import Grasp
from systems.oracle_policy import OraclePolicy, grasp_taken, gripper_pose
from systems.placement import Goal, PlacedObject, SuccessPredicate
from systems.signals import PickPlaceAction, PixelGrid, wrap_to_pi
from systems.success import AddS, PoseWithin

BOX = 0.5 * np.array([[x, y, z] for x in (-0.1, 0.1) for y in (-0.04, 0.04) for z in (0, 0.04)])
"""The corners of a box of 100 x 40 x 20 mm, with the origin at the middle of its bottom."""
ALONG_Y = Grasp(0.0, 0.0, 0.0, 0.04, 0.02)
ALONG_X = Grasp(0.0, 0.0, math.pi / 2, 0.05, 0.02)


def planar(x: float, y: float, yaw: float = 0.0, z: float = 0.0) -> RigidTransform:
    return RigidTransform(RollPitchYaw(0, 0, yaw), [x, y, z])


HAMMER, PLIERS = (PlacedObject(name, BodyIndex(i + 1), BOX) for i, name in enumerate(("h", "p")))
HAMMER_GRASP = Grasp(0.05, 0.0, 0.0, 0.014, 0.013)
PLIERS_GRASP = Grasp(0.02, 0.01, 0.4, 0.02, 0.010)
HAMMER_GOAL = Goal("h", (0,), (planar(0.5, 0.1, 0.7),), 0.5)
PLIERS_GOAL = Goal("p", (1,), (planar(0.6, -0.2, -2.0, 0.03),), 0.5, rim_height=0.05)


def ask(
    poses: list[RigidTransform],
    goals: list[Goal],
    *,
    objects: list[PlacedObject] | None = None,
    grasps: list[tuple[Grasp, ...]] | None = None,
    success: SuccessPredicate | None = None,
    quantizer: ActionQuantizer | None = None,
    kept: list[float] | None = None,
) -> PickPlaceAction:
    """The oracle's action for these object poses and goals."""
    oracle = OraclePolicy(
        objects=objects or [HAMMER, PLIERS],
        grasps=grasps or [(HAMMER_GRASP,), (PLIERS_GRASP,)],
        goals=goals,
        success=success or AddS(),
        quantizer=quantizer,
    )
    context = oracle.CreateDefaultContext()
    oracle.GetInputPort("body_poses").FixValue(context, Value([RigidTransform(), *poses]))
    if kept is not None:
        oracle.GetInputPort("kept_goals").FixValue(context, kept)
    return oracle.GetOutputPort("action").Eval(context)


def ask_boxes(poses: list[RigidTransform], goals: list[Goal], **more) -> PickPlaceAction:
    """The oracle's action for identical boxes."""
    objects = [PlacedObject(f"box {i}", BodyIndex(i + 1), BOX, 2) for i in range(len(poses))]
    grasps = more.pop("grasps", (ALONG_Y,))
    return ask(poses, goals, objects=objects, grasps=[grasps] * len(poses), **more)


def test_ports():
    oracle = OraclePolicy(
        objects=[HAMMER], grasps=[(HAMMER_GRASP,)], goals=[HAMMER_GOAL], success=AddS()
    )
    assert (oracle.num_input_ports(), oracle.num_output_ports()) == (5, 1)
    assert oracle.GetInputPort("kept_goals").size() == 1
    assert oracle.GetInputPort("body_poses").Allocate().get_value() is not None
    assert oracle.GetOutputPort("action").Allocate().get_value() == PickPlaceAction()


def test_kept_goals_are_not_filled_again():
    """A complete stage that was nudged is not repaired, because later stages rest on it."""
    nudged = [HAMMER_GOAL.poses[0] @ planar(0.02, 0), planar(0.3, 0.0)]
    goals = [HAMMER_GOAL, dataclasses.replace(PLIERS_GOAL, after=(0,))]
    hammer = gripper_pose(nudged[0], HAMMER_GRASP)
    pliers = gripper_pose(nudged[1], PLIERS_GRASP)
    action = ask(nudged, goals)
    np.testing.assert_allclose((action.pick.x, action.pick.y), (hammer.x, hammer.y), atol=1e-12)
    action = ask(nudged, goals, kept=[1.0, 0.0])
    np.testing.assert_allclose((action.pick.x, action.pick.y), (pliers.x, pliers.y), atol=1e-12)
    done = [nudged[0], PLIERS_GOAL.poses[0]]
    assert ask(done, goals, kept=[1.0, 0.0]).stop
    assert not ask(done, goals).stop


def test_takes_the_first_goal_in_order_that_is_not_filled():
    away = [planar(0.3, 0.3), planar(0.3, 0.0)]
    at_hammer, at_pliers = (0.35, 0.3), gripper_pose(away[1], PLIERS_GRASP)
    action = ask(away, [HAMMER_GOAL, PLIERS_GOAL])
    np.testing.assert_allclose((action.pick.x, action.pick.y), at_hammer, atol=1e-12)
    action = ask(away, [PLIERS_GOAL, HAMMER_GOAL])
    assert (action.pick.x, action.pick.y) == pytest.approx((at_pliers.x, at_pliers.y))
    seated = [HAMMER_GOAL.poses[0], away[1]]
    assert ask(seated, [HAMMER_GOAL, PLIERS_GOAL]).pick.x == pytest.approx(at_pliers.x)


def test_a_goal_with_a_misplaced_object_comes_last():
    protruding = HAMMER_GOAL.poses[0] @ planar(0, 0, 0, 0.012)
    away = planar(0.3, 0.0)
    goals = [HAMMER_GOAL, PLIERS_GOAL]
    assert ask([protruding, away], goals).pick.x == pytest.approx(
        gripper_pose(away, PLIERS_GRASP).x
    )
    again = ask([protruding, PLIERS_GOAL.poses[0]], goals)
    assert again.pick.x == pytest.approx(gripper_pose(protruding, HAMMER_GRASP).x)


def test_stops_when_every_goal_is_filled():
    assert ask([HAMMER_GOAL.poses[0], PLIERS_GOAL.poses[0]], [HAMMER_GOAL, PLIERS_GOAL]).stop


@pytest.mark.parametrize("goal_yaw", [0.0, 1.0, math.pi, -2.5])
def test_the_action_brings_the_object_to_its_goal(goal_yaw: float):
    """The gripper carries the object rigidly, so for any yaw the object arrives at its goal."""
    X_WGoal = planar(0.5, 0.0, goal_yaw) @ planar(0.02, -0.03, 0.3, 0.033)
    X_WB = planar(0.35, 0.2, 2.9)
    action = ask([planar(0, 0), X_WB], [Goal("p", (1,), (X_WGoal,), 1.0)])
    X_WPick = planar(action.pick.x, action.pick.y, action.pick.theta)
    X_WPlace = planar(action.place.x, action.place.y, action.place.theta)
    arrived = X_WPlace @ X_WPick.inverse() @ X_WB
    np.testing.assert_allclose(arrived.rotation().matrix(), X_WGoal.rotation().matrix(), atol=1e-12)
    np.testing.assert_allclose(arrived.translation()[:2], X_WGoal.translation()[:2], atol=1e-12)
    # In the object's frame, the pick is the annotated grasp.
    X_BPick = X_WB.inverse() @ X_WPick
    np.testing.assert_allclose(X_BPick.translation()[:2], (0.02, 0.01), atol=1e-12)
    assert RollPitchYaw(X_BPick.rotation()).yaw_angle() == pytest.approx(0.4)


def test_heights_are_the_true_heights():
    heights = ask([planar(0, 0), planar(0.3, 0.0, 0.0, 0.04)], [PLIERS_GOAL]).heights
    assert heights is not None
    assert heights.pick_top == pytest.approx(0.05)
    assert heights.support == pytest.approx(0.04)
    assert heights.place_rim == pytest.approx(0.05)
    assert heights.highest == pytest.approx(0.06)


def test_goals_wait_for_their_prerequisites():
    ground, top = planar(0.5, 0), planar(0.5, 0, 0, 0.02)
    goals = [
        Goal("top", (0, 1), (top,), 0.5, after=(1,)),
        Goal("ground", (0, 1), (ground,), 0.5),
    ]
    away = planar(0.3, 0.3), planar(0.3, -0.3)
    assert ask_boxes(list(away), goals).place.x == pytest.approx(0.5)
    first = ask_boxes([ground, away[1]], goals)
    assert first.pick.y == pytest.approx(-0.3)


def test_the_highest_suitable_object_is_picked():
    stack = [planar(0.3, 0.2, 0, 0.02 * level) for level in (0, 2, 1)]
    goals = [Goal("anywhere", (0, 1, 2), (planar(0.5, 0),), 1.0)]
    heights = ask_boxes(stack, goals).heights
    assert heights is not None
    assert heights.support == pytest.approx(0.04)


def test_the_free_goal_pose_that_rotates_least_is_chosen():
    corners = tuple(planar(0.5, 0, k * math.pi / 2) for k in range(4))
    goals = [Goal("corner", (0,), corners, 1.0)]
    action = ask_boxes([planar(0.3, 0.3, 1.5)], goals)
    assert wrap_to_pi(action.place.theta - action.pick.theta) == pytest.approx(math.pi / 2 - 1.5)
    bowls = (planar(0.5, 0.0), planar(0.6, 0.0))
    goals = [Goal("bowl", (0, 1), bowls, 1.0, any_heading=True)]
    success = PoseWithin(0.02, 0.3)
    action = ask_boxes([bowls[0], planar(0.3, 0.3, 0.4)], [*goals, *goals], success=success)
    assert action.place.x == pytest.approx(0.6)
    # The heading is 0.4 for the object and 0 for the free bowl, so the object rotates by -0.4.
    assert action.place.theta == pytest.approx(action.pick.theta - 0.4)


@pytest.mark.parametrize(
    ("neighbour", "expected"),
    [
        (planar(0.3, 0.05), math.pi / 2),
        (planar(0.38, 0.0), 0.0),
        (planar(0.5, 0.045), math.pi / 2),
        (planar(0.9, 0.9), 0.0),
    ],
    ids=["beside the pick", "at its end", "beside the place", "nowhere"],
)
def test_the_first_grasp_with_free_fingers_is_chosen(neighbour: RigidTransform, expected: float):
    axes = (np.linspace(low, high, 9) for low, high in zip(BOX.min(0), BOX.max(0), strict=True))
    dense = np.stack(np.meshgrid(*axes))
    objects = [PlacedObject(str(i), BodyIndex(i + 1), dense.reshape(3, -1).T, 2) for i in range(2)]
    action = ask(
        [planar(0.3, 0.0), neighbour],
        [Goal("there", (0,), (planar(0.5, 0.0),), 1.0)],
        objects=objects,
        grasps=[(ALONG_Y, ALONG_X), ()],
    )
    assert action.pick.theta == pytest.approx(expected)


def test_missing_goals_or_grasps_raise():
    with pytest.raises(ValueError, match="goal"):
        ask([], [])
    with pytest.raises(ValueError, match="grasp"):
        ask([planar(0, 0)] * 2, [HAMMER_GOAL], grasps=[(), (PLIERS_GRASP,)])


@pytest.mark.parametrize("yaw", [0.0, 2.0, -3.0])
def test_grasp_taken_inverts_gripper_pose(yaw: float):
    X_WB = planar(0.4, -0.1, yaw)
    taken = grasp_taken(X_WB, gripper_pose(X_WB, PLIERS_GRASP))
    expected = (PLIERS_GRASP.x, PLIERS_GRASP.y, PLIERS_GRASP.theta)
    np.testing.assert_allclose(taken.as_array(), expected, atol=1e-12)


@pytest.mark.parametrize("orientations", [36, 180])
@pytest.mark.parametrize("yaw", [0.03, 1.234, 2.9, -2.0])
def test_quantized_actions_are_the_nearest_possible(yaw: float, orientations: int):
    grid = PixelGrid()
    X_WB = planar(0.3512, 0.2034, yaw)
    quantizer = ActionQuantizer(grid, orientations)
    action = ask([planar(0, 0), X_WB], [PLIERS_GOAL], quantizer=quantizer)
    for pose in (action.pick, action.place):
        pixel = grid.to_pixel((pose.x, pose.y))
        np.testing.assert_allclose(pixel, np.round(pixel), atol=1e-9)
    rotation = action.place.theta - action.pick.theta
    for angle in (action.pick.theta, rotation):
        bins = angle * orientations / math.tau
        assert bins == pytest.approx(round(bins), abs=1e-9)

    pick = gripper_pose(X_WB, PLIERS_GRASP)
    half_pixel, half_bin = grid.resolution / 2 + 1e-12, math.pi / orientations + 1e-12
    assert abs(action.pick.x - pick.x) <= half_pixel
    assert abs(action.pick.y - pick.y) <= half_pixel
    assert abs(wrap_to_pi(action.pick.theta - pick.theta)) <= half_bin
    assert abs(wrap_to_pi(rotation - (-2.0 - yaw))) <= half_bin
    # The place is computed from the rounded pick, not from the annotated grasp.
    X_WPick = planar(action.pick.x, action.pick.y, action.pick.theta)
    ideal = (PLIERS_GOAL.poses[0] @ X_WB.inverse() @ X_WPick).translation()
    assert abs(action.place.x - ideal[0]) <= half_pixel
    assert abs(action.place.y - ideal[1]) <= half_pixel


def test_quantized_positions_stay_on_the_grid():
    quantizer = ActionQuantizer(PixelGrid(), 36)
    assert quantizer.position(0.0, 2.0) == pytest.approx((0.2515625, 0.4984375))
