"""The verdict on a pick and place in a random static scene."""

from types import SimpleNamespace

import numpy as np
import pytest
import trimesh
from manifold3d import CrossSection
from pydrake.math import RigidTransform

from kitting_drake.reproduction.benchmarks.judging import judge
from kitting_drake.static_scenes.drawing import LooseTool, Obstacle
from kitting_drake.tasks.kitting.tool_poses import outline_at
from systems.pick_place_parameters import PickPlaceParameters
from systems.signals import PickPlaceAction, PlanarPose

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


def verdict(loose: list[LooseTool], *, pick_x: float = 0.5, place_x: float = 0.6) -> str:
    action = PickPlaceAction(PlanarPose(pick_x, 0.0, 0.0), PlanarPose(place_x, 0.3, 0.0))
    return judge(action, loose, PickPlaceParameters())


def test_the_verdict_names_what_is_wrong():
    assert verdict(lying()) == "right"
    assert verdict(lying(), place_x=0.604) == "place"
    assert verdict(lying(), pick_x=0.8, place_x=0.9) == "no tool"
    block = Obstacle(outline_at(CrossSection.square((LENGTH, WIDTH), True), BESIDE))
    assert verdict(lying(block)) == "grasp"


@pytest.mark.parametrize(("height", "expected"), [(0.005, "right"), (0.02, "grasp")])
def test_fingers_may_come_down_above_a_low_neighbour(height: float, expected: str):
    assert verdict(lying(neighbour(height))) == expected
