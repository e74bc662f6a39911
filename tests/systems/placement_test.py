import dataclasses
import math

import numpy as np
import pytest
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.tree import BodyIndex

from systems.placement import (
    Goal,
    PlacedObject,
    Placement,
    add_s,
    complete_stages,
    evaluate_placements,
    strict_reward,
    total_reward,
)
from systems.success import AddS, InZone, PoseWithin

SQUARE = np.array([[1.0, 1.0, 0.0], [-1.0, 1.0, 0.0], [-1.0, -1.0, 0.0], [1.0, -1.0, 0.0]])
"""The corners of a square with sides of 2, which a quarter rotation maps onto itself."""

GOAL = RigidTransform(RollPitchYaw(0, 0, 0.5), [0.5, -0.1, 0.03])
BAR = 0.5 * np.array([[x, y, z] for x in (-0.2, 0.2) for y in (-0.03, 0.03) for z in (0, 0.02)])
"""The corners of a bar of 200 x 30 x 10 mm, with the origin at the middle of its bottom."""


def planar(x: float, y: float, yaw: float = 0.0, z: float = 0.0) -> RigidTransform:
    return RigidTransform(RollPitchYaw(0, 0, yaw), [x, y, z])


def bar(index: int = 0, symmetry: int = 1) -> PlacedObject:
    return PlacedObject(f"bar {index}", BodyIndex(index + 1), BAR, symmetry)


def goal(*objects: int, pose: RigidTransform = GOAL, **fields) -> Goal:
    return Goal(**{"name": "", "objects": objects, "poses": (pose,), "reward": 1.0, **fields})


def place(item: PlacedObject, target: Goal, X_WB: RigidTransform, success=None) -> Placement:
    """The placement of an object, judged by one goal."""
    (placement,) = evaluate_placements([item], [target], success or AddS(), [X_WB])
    return placement


def test_add_s_of_a_small_translation_is_its_length():
    moved = RigidTransform([0.3, -0.4, 0.5])
    # The translation is shorter than half the square's side, so no other moved corner is nearer.
    assert add_s(SQUARE, RigidTransform(), moved) == pytest.approx(np.sqrt(0.5))


def test_add_s_takes_the_nearest_point_not_the_same_point():
    # Two of the goal's corners coincide with moved corners. The nearest moved corner is 2 away from
    # each of the other two: (0 + 0 + 2 + 2) / 4. ADD would be 2.
    assert add_s(SQUARE, RigidTransform(), RigidTransform([2.0, 0.0, 0.0])) == pytest.approx(1.0)


def test_add_s_measures_from_the_goal_to_the_actual_pose():
    """The distance depends on the direction; equation 9 measures from each of the goal's points."""
    points = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [3.0, 0.0, 0.0]])
    moved = RigidTransform([3.0, 0.0, 0.0])  # The object's points are at x = 3, 4, 6.
    assert add_s(points, RigidTransform(), moved) == pytest.approx((3 + 2 + 0) / 3)
    back = RigidTransform([-3.0, 0.0, 0.0])  # The object's points are at x = -3, -2, 0.
    assert add_s(points, RigidTransform(), back) == pytest.approx((0 + 1 + 3) / 3)


@pytest.mark.parametrize("quarters", [1, 2, 3])
def test_add_s_is_zero_for_rotations_of_the_symmetry(quarters: int):
    rotated = GOAL @ RigidTransform(RollPitchYaw(0, 0, quarters * np.pi / 2), [0, 0, 0])
    assert add_s(SQUARE, GOAL, rotated) == pytest.approx(0.0, abs=1e-12)
    assert add_s(SQUARE, GOAL, GOAL @ RigidTransform(RollPitchYaw(0, 0, np.pi / 4), [0, 0, 0])) > 0


def test_add_s_does_not_depend_on_the_frame():
    actual = RigidTransform(RollPitchYaw(0.1, -0.2, 0.9), [0.6, -0.3, 0.1])
    X = RigidTransform(RollPitchYaw(0.4, 0.5, 0.6), [1.0, 2.0, 3.0])
    assert add_s(SQUARE, X @ GOAL, X @ actual) == pytest.approx(add_s(SQUARE, GOAL, actual))


def test_errors_and_their_signs():
    there = planar(0.5 + 0.03, -0.1 - 0.04, 0.5 + 0.2, 0.03 - 0.02)
    placement = place(bar(), goal(0), there)
    assert placement.position_error == pytest.approx(0.05)
    assert placement.angle_error == pytest.approx(0.2)
    assert placement.height_error == pytest.approx(-0.02)
    assert placement.add_s == pytest.approx(add_s(BAR, GOAL, there))
    # The angle error is the smaller of the two angles between the headings.
    across = goal(0, pose=planar(0, 0, 3.0))
    assert place(bar(), across, planar(0, 0, -3.0)).angle_error == pytest.approx(2 * math.pi - 6)


def test_rolling_does_not_change_the_position_of_a_round_object():
    """The object's origin is below its axis, but positions are compared on the axis."""
    angles = np.arange(16) * np.pi / 8
    ring = np.stack([0 * angles, np.sin(angles), 1 + np.cos(angles)], axis=1)
    rolled = (
        GOAL @ RigidTransform(RollPitchYaw(np.pi, 0, 0), [0, 0, 1]) @ RigidTransform([0, 0, -1])
    )
    placement = place(PlacedObject("roll", BodyIndex(1), ring), goal(0), rolled)
    for error in (placement.add_s, placement.position_error, placement.height_error):
        assert error == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize(("symmetry", "strict"), [(1, False), (2, True)])
def test_a_declared_symmetry_ignores_half_a_rotation(symmetry: int, strict: bool):
    reversed_ = GOAL @ planar(0, 0, math.pi)
    placement = place(bar(symmetry=symmetry), goal(0), reversed_)
    assert placement.success
    assert placement.strict_success == strict
    assert abs(placement.angle_error) == pytest.approx(0.0 if strict else math.pi, abs=1e-9)


@pytest.mark.parametrize(
    ("offset", "strict"),
    [
        (planar(0, 0, 0, 0.0019), True),
        (planar(0, 0, 0, 0.0021), False),
        (planar(0, 0, math.radians(19)), True),
        (planar(0, 0, math.radians(21)), False),
    ],
)
def test_strict_success_checks_height_and_heading(offset: RigidTransform, strict: bool):
    placement = place(bar(), goal(0), GOAL @ offset, AddS(0.1))
    assert placement.success
    assert placement.strict_success == strict


def test_pose_within_thresholds():
    success = PoseWithin()
    assert place(bar(), goal(0), GOAL @ planar(0.009, 0, 0.25, 0.1), success).success
    assert not place(bar(), goal(0), GOAL @ planar(0.011, 0), success).success
    assert not place(bar(), goal(0), GOAL @ planar(0, 0, 0.27), success).success
    level = PoseWithin(height=0.003)
    assert place(bar(), goal(0), GOAL @ planar(0, 0, 0, 0.002), level).success
    assert not place(bar(), goal(0), GOAL @ planar(0, 0, 0, -0.004), level).success
    anyhow = goal(0, any_heading=True)
    assert place(bar(), anyhow, GOAL @ planar(0, 0, 2.0), success).strict_success


def test_in_zone_measures_the_share_of_the_volume():
    zone = InZone(GOAL, (0.2, 0.2, 0.3), BAR)
    assert place(bar(), goal(0), GOAL, zone).share == 1.0
    assert place(bar(), goal(0), GOAL @ planar(0.05, 0), zone).share == 0.5
    below = place(bar(), goal(0), GOAL @ planar(0, 0, 0, -0.005), zone)
    assert below.share == 0.5
    assert not below.success


def test_interchangeable_objects_fill_each_others_goals():
    left, right = planar(0, 0), planar(0, 0.1)
    goals = [goal(0, 1, pose=left, reward=0.5), goal(0, 1, pose=right, reward=0.5)]
    objects = [bar(0), bar(1)]
    for order in ([left, right], [right, left]):
        placements = evaluate_placements(objects, goals, AddS(), order)
        assert [item.success for item in placements] == [True, True]
        assert {item.goal for item in placements} == {0, 1}
    # A goal that belongs to one object is not filled by the other.
    fixed = [goal(0, pose=left, reward=0.5), goal(1, pose=right, reward=0.5)]
    assert not any(item.success for item in evaluate_placements(objects, fixed, AddS(), order))


def test_a_correct_row_keeps_its_goals_beside_another_object():
    """The first two objects are 2 mm from their goals, and the third lies before the row.

    If the third object took the first goal, and the others the second and third goals, the total
    displacement would be smaller. But then no object would be at its goal.
    """
    row = [planar(0, 0.05 * k) for k in range(3)]
    goals = [goal(0, 1, 2, pose=pose, reward=1 / 3) for pose in row]
    objects = [bar(k) for k in range(3)]
    off = planar(0, 0.002)
    beside = planar(0, -0.15)
    placements = evaluate_placements(objects, goals, AddS(), [row[0] @ off, row[1] @ off, beside])
    assert [item.success for item in placements] == [True, True, False]
    assert total_reward(goals, placements) == pytest.approx(2 / 3)


def test_an_object_with_a_pose_that_is_not_finite_fills_no_goal():
    objects, left = [bar(0), bar(1)], planar(0, 0)
    goals = [goal(0, 1, pose=left, reward=1.0)]
    nowhere = RigidTransform([np.nan, 0, 0])
    lost, placed = evaluate_placements(objects, goals, AddS(), [nowhere, left])
    assert (lost.goal, lost.success, placed.success) == (None, False, True)
    assert not np.isfinite(lost.add_s)


def test_any_pose_of_a_goal_fills_it():
    corners = tuple(GOAL @ planar(0, 0, k * math.pi / 2) for k in range(4))
    placement = place(bar(), goal(0, poses=corners), corners[2] @ planar(0.002, 0, 0.01))
    assert placement.pose == 2
    assert placement.success


def test_goals_count_only_after_their_prerequisites():
    poses = [planar(0, 0), planar(0, 0, 0, 0.01)]
    goals = [
        goal(0, pose=poses[0], reward=0.75),
        goal(1, pose=poses[1], reward=0.25, after=(0,)),
    ]
    objects = [bar(0), bar(1)]
    placements = evaluate_placements(objects, goals, AddS(), poses)
    assert total_reward(goals, placements) == strict_reward(goals, placements) == 1.0
    away = evaluate_placements(objects, goals, AddS(), [planar(1, 0), poses[1]])
    assert total_reward(goals, away) == 0.0
    assert away[1].add_s == pytest.approx(0.0, abs=1e-12)
    first = evaluate_placements(objects, goals, AddS(), [poses[0], planar(1, 0)])
    assert total_reward(goals, first) == 0.75


def test_a_complete_stage_keeps_its_reward():
    row = [planar(0, 0), planar(0.1, 0)]
    top = planar(0.05, 0, 0, 0.01)
    goals = [
        *(goal(0, 1, pose=pose, reward=0.25) for pose in row),
        goal(2, pose=top, reward=0.5, after=(0, 1)),
    ]
    objects = [bar(0), bar(1), bar(2)]

    def at(*poses: RigidTransform) -> list[Placement]:
        return evaluate_placements(objects, goals, AddS(), poses)

    away = planar(1, 0)
    half, whole, fallen = at(row[0], away, away), at(*row, away), at(row[0], away, away)
    assert complete_stages(goals, half) == frozenset()
    kept = complete_stages(goals, whole)
    assert kept == {0, 1}
    # A stage that was once complete still counts, once, after one of its objects has fallen.
    assert complete_stages(goals, fallen, kept) == kept
    assert (total_reward(goals, fallen), total_reward(goals, fallen, kept)) == (0.25, 0.5)
    assert total_reward(goals, at(*row, top), kept) == 1.0
    # If an object of a complete stage is moved later, the goals of later stages still count, as in
    # Ravens.
    moved = evaluate_placements(objects, goals, AddS(), [row[0], away, top], kept)
    assert (moved[1].success, moved[2].success) == (False, True)
    assert total_reward(goals, moved, kept) == 1.0
    assert total_reward(goals, at(row[0], away, top)) == 0.25
    # The last stage is not kept, because no other stage depends on it.
    assert complete_stages(goals, at(*row, top)) == kept
    assert strict_reward(goals, fallen) == 0.25


def test_an_object_without_a_goal_has_no_errors():
    placements = evaluate_placements([bar(0), bar(1)], [goal(0)], AddS(), [GOAL, GOAL])
    assert placements[1] == Placement()
    assert dataclasses.replace(placements[0], share=0.0).success is False
