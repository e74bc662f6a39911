"""Rewards and causes of failure of the Ravens tasks, without physics."""

import math
from collections.abc import Sequence
from pathlib import Path

import pytest
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.tree import BodyIndex

from kitting_drake.tasks import (
    AlignBoxCorner,
    BlockInsertion,
    PalletizingBoxes,
    PlaceRedInGreen,
    StackBlockPyramid,
)
from kitting_drake.tasks.ravens.palletizing_boxes import volume_points
from kitting_drake.tasks.ravens.ravens_task import PREREQUISITE_MISSING, TOPPLED
from kitting_drake.tasks.task import (
    MISPLACED,
    NEVER_APPEARED,
    NEVER_PICKED,
    ActionRecord,
    Scene,
    TaskConfig,
)
from systems.placement import PlacedObject, Placement, evaluate_placements, total_reward
from systems.signals import PixelGrid, PlanarPose


def make_scene(task: TaskConfig, seed: int = 0) -> Scene:
    return task.make_scene(grid=PixelGrid(), seed=seed, base=Path())


def initial_poses(scene: Scene) -> list[RigidTransform]:
    return [item.X_WB for item in scene.objects]


def placements(scene: Scene, poses: Sequence[RigidTransform]) -> list[Placement]:
    objects = [
        PlacedObject(item.name, BodyIndex(index), item.p_BPoints, item.symmetry)
        for index, item in enumerate(scene.objects)
    ]
    return evaluate_placements(objects, scene.goals, scene.success, poses)


def reward(scene: Scene, poses: Sequence[RigidTransform]) -> float:
    return total_reward(scene.goals, placements(scene, poses))


def moved(X_WB: RigidTransform, *, x: float = 0.0, z: float = 0.0, yaw_deg: float = 0.0):
    """A pose that is rotated about its own origin, then moved along the world's x and z."""
    rotation = RigidTransform(RollPitchYaw(0, 0, math.radians(yaw_deg)), [0, 0, 0])
    return RigidTransform([x, 0, z]) @ X_WB @ rotation


@pytest.mark.parametrize("kind", [AlignBoxCorner, BlockInsertion])
def test_success_is_within_10_mm_and_15_degrees(kind: type[TaskConfig]):
    scene = make_scene(kind())
    assert reward(scene, initial_poses(scene)) == 0
    for X_WGoal in scene.goals[0].poses:
        assert reward(scene, [X_WGoal]) == 1
        assert reward(scene, [moved(X_WGoal, x=0.009, z=0.02)]) == 1
        assert reward(scene, [moved(X_WGoal, x=0.011)]) == 0
    (X_WGoal, *_) = scene.goals[0].poses
    # A rotation of the L-block about its origin also moves its middle, so rotate it by less.
    assert reward(scene, [moved(X_WGoal, yaw_deg=14 if kind is AlignBoxCorner else 10)]) == 1
    assert reward(scene, [moved(X_WGoal, yaw_deg=16)]) == 0


def test_any_corner_of_the_box_fills_the_marker():
    scene = make_scene(AlignBoxCorner())
    (marker,) = scene.fixtures
    corners = []
    for X_WGoal in scene.goals[0].poses:
        p_MarkerPoints = (marker.X_WF.inverse() @ X_WGoal).multiply(scene.objects[0].p_BPoints.T)
        assert p_MarkerPoints.min(axis=1) == pytest.approx([0, 0, 0], abs=1e-12)
        corners.append((X_WGoal.inverse() @ marker.X_WF.translation())[:2])
    assert {tuple(math.copysign(1, value) for value in corner) for corner in corners} == {
        (1, 1),
        (1, -1),
        (-1, 1),
        (-1, -1),
    }


def test_each_red_cube_in_a_green_bowl_earns_its_share():
    scene = next(
        s for s in (make_scene(PlaceRedInGreen(), i) for i in range(50)) if len(s.goals) == 3
    )
    bowls, poses = scene.goals[0].poses, initial_poses(scene)
    assert reward(scene, poses) == 0
    poses[0] = moved(bowls[0], x=0.049, yaw_deg=77)
    assert reward(scene, poses) == pytest.approx(1 / 3)
    poses[1] = moved(bowls[1], x=-0.049)
    assert reward(scene, poses) == pytest.approx(2 / 3)
    # Two cubes in one bowl both count.
    poses[2] = moved(bowls[1], x=0.03)
    assert reward(scene, poses) == pytest.approx(1)
    poses[2] = moved(bowls[1], x=0.051)
    assert reward(scene, poses) == pytest.approx(2 / 3)
    # A cube of another colour does not count.
    poses[2], poses[3] = scene.objects[2].X_WB, bowls[2]
    assert reward(scene, poses) == pytest.approx(2 / 3)


def test_a_pyramid_counts_row_by_row():
    scene = make_scene(StackBlockPyramid())
    places = [goal.poses[0] for goal in scene.goals]
    start = initial_poses(scene)
    assert reward(scene, start) == 0
    for done, expected in enumerate([0, 1 / 6, 2 / 6, 3 / 6, 4 / 6, 5 / 6, 1]):
        assert reward(scene, places[:done] + start[done:]) == pytest.approx(expected)
    # The cubes of a row are interchangeable, and each may be turned by 90 degrees.
    exchanged = [places[2], moved(places[0], yaw_deg=90), places[1], *places[3:]]
    assert reward(scene, exchanged) == pytest.approx(1)
    # A cube in another row than its own does not count.
    wrong = [places[5], *places[1:5], places[0]]
    assert reward(scene, wrong) == pytest.approx(2 / 6)
    # Cubes in rows above an incomplete row do not count.
    assert reward(scene, [start[0], *places[1:]]) == pytest.approx(2 / 6)


def test_cubes_of_the_pyramid_touch_those_below():
    scene = make_scene(StackBlockPyramid())
    heights = [goal.poses[0].translation()[2] for goal in scene.goals]
    assert heights == pytest.approx([0.005] * 3 + [0.045] * 2 + [0.085])


def test_boxes_earn_the_share_of_their_volume_in_the_zone():
    scene = make_scene(PalletizingBoxes())
    places = [goal.poses[0] for goal in scene.goals]
    start = initial_poses(scene)
    assert reward(scene, start) == 0
    assert reward(scene, places) == pytest.approx(1)
    # Each box counts by itself, wherever it is in the zone.
    assert reward(scene, [*start[:17], places[17]]) == pytest.approx(1 / 18)
    tilted = RigidTransform(RollPitchYaw(0.4, 0.3, 0.2), [0.45, 0.25, 0.15])
    assert reward(scene, [tilted, *start[1:]]) == pytest.approx(1 / 18)
    # Two of the box's five rows of points are beyond the zone's edge at x = 0.65: 3/5 counts.
    over_the_edge = RigidTransform([0.645, 0.25, 0.04])
    assert reward(scene, [over_the_edge, *start[1:]]) == pytest.approx(3 / 5 / 18)
    assert reward(scene, [moved(over_the_edge, x=0.05), *start[1:]]) == 0
    # Points above 0.30 m do not count.
    assert reward(scene, [moved(places[0], z=0.30), *start[1:]]) == 0


def test_a_box_that_never_appeared_has_its_own_cause():
    task = PalletizingBoxes()
    scene = make_scene(task)
    poses = initial_poses(scene)
    measured = placements(scene, poses)
    causes = [task.find_cause(scene, index, poses, measured[index], []) for index in (0, 1)]
    assert causes == [NEVER_PICKED, NEVER_APPEARED]
    assert set(causes) <= set(task.causes)


def test_boxes_are_filled_with_points_20_mm_apart():
    points = volume_points((0.085, 0.04, 0.04))
    assert points.shape == (20, 3)
    assert points.min(axis=0) == pytest.approx([-0.04, -0.01, 0.01])
    assert points.max(axis=0) == pytest.approx([0.04, 0.01, 0.03])


def test_causes_of_failure():
    task = StackBlockPyramid()
    scene = make_scene(task)
    places = [goal.poses[0] for goal in scene.goals]
    tilted = places[3] @ RigidTransform(RollPitchYaw(math.pi / 2, 0, 0), [0, 0, 0])
    poses = [scene.objects[0].X_WB, *places[1:3], tilted, places[4], moved(places[5], x=0.02)]
    measured = placements(scene, poses)
    pose = PlanarPose()
    records = [
        ActionRecord(item.name, "cube", "placed", pose, pose, 0.0, 0.0, 0.0, 0.0)
        for item in scene.objects[1:]
    ]
    causes = [task.find_cause(scene, i, poses, measured[i], records) for i in (0, 3, 4, 5)]
    assert causes == [NEVER_PICKED, TOPPLED, PREREQUISITE_MISSING, MISPLACED]
    assert set(causes) <= set(task.causes)
