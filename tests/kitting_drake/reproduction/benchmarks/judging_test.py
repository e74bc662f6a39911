"""The verdict on a pick and place in a random static scene."""

from types import SimpleNamespace

import numpy as np
import pytest
import trimesh
from manifold3d import CrossSection
from pydrake.math import RigidTransform, RollPitchYaw

from kitting_drake.reproduction.benchmarks.judging import judge
from kitting_drake.static_scenes.drawing import LooseTool, Obstacle
from kitting_drake.tasks.kitting.tool_poses import outline_at
from systems.pick_place_parameters import PickPlaceParameters
from systems.signals import Observation, PickPlaceAction, PixelGrid, PlanarPose

LENGTH, WIDTH, HEIGHT = 0.12, 0.02, 0.02
BESIDE = RigidTransform([0.5, 0.05, 0.0])
GOAL = RigidTransform([0.6, 0.3, 0.02])


def bar(height: float) -> SimpleNamespace:
    box = trimesh.creation.box((LENGTH, WIDTH, height)).apply_translation((0, 0, height / 2))
    footprint = CrossSection.square((LENGTH, WIDTH), True)
    return SimpleNamespace(footprint=footprint, triangles=np.asarray(box.triangles))


def lying(*around: Obstacle) -> list[LooseTool]:
    return [LooseTool(bar(HEIGHT), RigidTransform([0.5, 0.0, 0.0]), GOAL, around)]


def neighbour(height: float) -> Obstacle:
    tool = bar(height)
    return Obstacle(outline_at(tool.footprint, BESIDE), tool, BESIDE)


def seen(*boxes: tuple[float, float, float, float, float]) -> Observation:
    """An image of boxes, each given as low x, high x, low y, high y and height, in metres."""
    grid = PixelGrid()
    x, y = np.moveaxis(grid.to_world(np.stack(np.indices(grid.shape), -1).reshape(-1, 2)), -1, 0)
    height = np.zeros(grid.shape)
    for x_low, x_high, y_low, y_high, top in boxes:
        inside = (x > x_low) & (x < x_high) & (y > y_low) & (y < y_high)
        height = np.maximum(height, top * inside.reshape(grid.shape))
    image = np.zeros((4, *grid.shape), np.float32)
    image[3] = height
    return Observation(image, grid, np.ones(grid.shape, bool))


def verdict(
    loose: list[LooseTool],
    *,
    pick_x: float = 0.5,
    place_x: float = 0.6,
    observation: Observation | None = None,
) -> str:
    action = PickPlaceAction(PlanarPose(pick_x, 0.0, 0.0), PlanarPose(place_x, 0.3, 0.0))
    return judge(action, loose, PickPlaceParameters(), observation or Observation())


def test_the_verdict_names_what_is_wrong():
    assert verdict(lying()) == "right"
    assert verdict(lying(), place_x=0.604) == "place"
    assert verdict(lying(), pick_x=0.8, place_x=0.9) == "no tool"
    block = Obstacle(outline_at(CrossSection.square((LENGTH, WIDTH), True), BESIDE))
    assert verdict(lying(block)) == "grasp"


@pytest.mark.parametrize(("height", "expected"), [(0.005, "right"), (0.02, "grasp")])
def test_fingers_may_come_down_above_a_low_neighbour(height: float, expected: str):
    assert verdict(lying(neighbour(height))) == expected


def test_the_jaws_open_no_wider_than_the_object_that_they_see():
    bar_seen, block_seen = (0.44, 0.56, -0.01, 0.01, 0.02), (0.44, 0.56, 0.04, 0.06, 0.02)
    loose = lying(neighbour(HEIGHT))
    assert verdict(loose, observation=seen(bar_seen, block_seen)) == "right"


def test_the_upper_one_of_two_crossed_tools_is_picked():
    # The lower tool has the larger part between the open jaws.
    lower = LooseTool(bar(0.01), RigidTransform(RollPitchYaw(0, 0, 1.57), [0.5, 0, 0]), GOAL, ())
    upper = LooseTool(bar(HEIGHT), RigidTransform([0.5, 0.0, 0.01]), GOAL, ())
    assert verdict([lower, upper]) == "right"


def test_fingers_may_come_down_above_a_low_part_of_the_picked_tool():
    head = trimesh.creation.box((0.03, 0.02, 0.04)).apply_translation((0, 0, 0.02))
    for height, expected in ((0.01, "right"), (0.035, "grasp")):
        handle = trimesh.creation.box((0.01, 0.12, height)).apply_translation((0, 0, height / 2))
        both = trimesh.boolean.union([head, handle], engine="manifold")
        footprint = CrossSection.square((0.03, 0.02), True) + CrossSection.square(
            (0.01, 0.12), True
        )
        tool = SimpleNamespace(footprint=footprint, triangles=np.asarray(both.triangles))
        assert verdict([LooseTool(tool, RigidTransform([0.5, 0, 0]), GOAL, ())]) == expected
