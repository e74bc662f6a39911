import numpy as np
import pytest
from numpy.typing import NDArray
from pydrake.common.value import Value
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.tree import BodyIndex

from systems.placement_monitor import PlacementGoal, PlacementMonitor, add_s

SQUARE = np.array([[1.0, 1.0, 0.0], [-1.0, 1.0, 0.0], [-1.0, -1.0, 0.0], [1.0, -1.0, 0.0]])
"""Four points, 2 apart, which a quarter turn maps onto themselves."""

GOAL = RigidTransform(RollPitchYaw(0, 0, 0.5), [0.5, -0.1, 0.03])


def evaluate(*pairs: tuple[RigidTransform, RigidTransform]) -> dict[str, NDArray]:
    """All outputs for pairs of goal and actual pose."""
    monitor = PlacementMonitor(
        goals=[
            PlacementGoal(f"object {i}", BodyIndex(i + 1), goal, SQUARE)
            for i, (goal, _) in enumerate(pairs)
        ]
    )
    context = monitor.CreateDefaultContext()
    poses = [RigidTransform(), *(actual for _, actual in pairs)]
    monitor.GetInputPort("body_poses").FixValue(context, Value(poses))
    names = ("add_s", "position_error", "angle_error", "height_error")
    return {name: monitor.GetOutputPort(name).Eval(context) for name in names}


def test_ports():
    goals = [PlacementGoal(name, BodyIndex(1), GOAL, SQUARE) for name in ("a", "b", "c")]
    monitor = PlacementMonitor(goals=goals)
    assert monitor.num_input_ports() == 1
    assert monitor.GetInputPort("body_poses").get_index() == 0
    names = ["add_s", "position_error", "angle_error", "height_error"]
    assert [monitor.get_output_port(i).get_name() for i in range(4)] == names
    assert monitor.num_output_ports() == 4
    assert all(monitor.GetOutputPort(name).size() == 3 for name in names)


def test_add_s_of_a_small_translation_is_its_length():
    moved = RigidTransform([0.3, -0.4, 0.5])  # Less than half the points' distance.
    assert add_s(SQUARE, RigidTransform(), moved) == pytest.approx(np.sqrt(0.5))


def test_add_s_takes_the_nearest_point_not_the_same_point():
    # Two points onto their neighbours, two left behind: (0 + 0 + 2 + 2) / 4. ADD would say 2.
    assert add_s(SQUARE, RigidTransform(), RigidTransform([2.0, 0.0, 0.0])) == pytest.approx(1.0)


def test_add_s_measures_from_the_goal_to_the_actual_pose():
    """The two directions differ for a shape that is not symmetric; equation 9 has this one."""
    points = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [3.0, 0.0, 0.0]])
    moved = RigidTransform([3.0, 0.0, 0.0])  # Goal 0, 1, 3; actual 3, 4, 6.
    assert add_s(points, RigidTransform(), moved) == pytest.approx((3 + 2 + 0) / 3)
    back = RigidTransform([-3.0, 0.0, 0.0])  # Goal 0, 1, 3; actual -3, -2, 0.
    assert add_s(points, RigidTransform(), back) == pytest.approx((0 + 1 + 3) / 3)


@pytest.mark.parametrize("quarters", [1, 2, 3])
def test_a_turn_that_maps_the_object_onto_itself_costs_nothing(quarters: int):
    turned = GOAL @ RigidTransform(RollPitchYaw(0, 0, quarters * np.pi / 2), [0, 0, 0])
    assert add_s(SQUARE, GOAL, turned) == pytest.approx(0.0, abs=1e-12)
    assert add_s(SQUARE, GOAL, GOAL @ RigidTransform(RollPitchYaw(0, 0, np.pi / 4), [0, 0, 0])) > 0


def test_add_s_does_not_depend_on_the_frame():
    actual = RigidTransform(RollPitchYaw(0.1, -0.2, 0.9), [0.6, -0.3, 0.1])
    X = RigidTransform(RollPitchYaw(0.4, 0.5, 0.6), [1.0, 2.0, 3.0])
    assert add_s(SQUARE, X @ GOAL, X @ actual) == pytest.approx(add_s(SQUARE, GOAL, actual))


def test_errors_of_each_object_and_their_signs():
    left_and_low = RigidTransform(RollPitchYaw(0, 0, 0.5 + 0.2), [0.5 + 0.03, -0.1 - 0.04, 0.01])
    right_and_high = RigidTransform(RollPitchYaw(0, 0, 0.5 - 0.1), [0.5, -0.1, 0.04])
    result = evaluate((GOAL, left_and_low), (GOAL, GOAL), (GOAL, right_and_high))
    np.testing.assert_allclose(result["position_error"], [0.05, 0, 0], atol=1e-12)
    np.testing.assert_allclose(result["angle_error"], [0.2, 0, -0.1], atol=1e-12)
    np.testing.assert_allclose(result["height_error"], [-0.02, 0, 0.01], atol=1e-12)
    np.testing.assert_allclose(
        result["add_s"], [add_s(SQUARE, GOAL, left_and_low), 0, result["add_s"][2]], atol=1e-12
    )
    assert result["add_s"][2] > 0.01


def test_a_round_object_that_rolls_stays_where_it_is():
    """The origin is on the table, below the axis; positions are compared on the axis."""
    turns = np.arange(16) * np.pi / 8
    ring = np.stack([0 * turns, np.sin(turns), 1 + np.cos(turns)], axis=1)
    rolled = GOAL @ RigidTransform(RollPitchYaw(np.pi, 0, 0), [0, 0, 1])
    rolled = rolled @ RigidTransform([0, 0, -1])
    monitor = PlacementMonitor(goals=[PlacementGoal("roll", BodyIndex(1), GOAL, ring)])
    context = monitor.CreateDefaultContext()
    monitor.GetInputPort("body_poses").FixValue(context, Value([RigidTransform(), rolled]))
    for name in ("add_s", "position_error", "height_error"):
        assert monitor.GetOutputPort(name).Eval(context)[0] == pytest.approx(0.0, abs=1e-9)


def test_angle_error_goes_the_short_way_round():
    goal = RigidTransform(RollPitchYaw(0, 0, 3.0), [0, 0, 0])
    actual = RigidTransform(RollPitchYaw(0, 0, -3.0), [0, 0, 0])
    np.testing.assert_allclose(evaluate((goal, actual))["angle_error"], [2 * np.pi - 6])


def test_goals_that_cannot_be_scored_are_refused():
    with pytest.raises(ValueError, match="at least one goal"):
        PlacementMonitor(goals=[])
    with pytest.raises(ValueError, match="the points of spoon must be"):
        PlacementMonitor(goals=[PlacementGoal("spoon", BodyIndex(1), GOAL, np.zeros((0, 3)))])
