"""Scenes with several kits, with kits on risers, and with tilted kits."""

import math
from pathlib import Path

import numpy as np
import pytest
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.tree import BodyIndex

from kitting_drake.common.errors import UserError
from kitting_drake.hkd.kits.parameters import KitParameters
from kitting_drake.tasks import ArrangedKitting, Kitting, ToolsetKitting
from kitting_drake.tasks.kitting.kit_stands import KitPose
from kitting_drake.tasks.kitting.tool_poses import TablePose
from kitting_drake.tasks.task import Scene, TaskConfig
from systems.placement import PlacedObject, evaluate_placements
from systems.signals import PixelGrid

TOOLS = ["combination_wrench", "flat_screwdriver", "combination_wrench", "claw_hammer"]
WHOLE_TABLE = PixelGrid(x_min=0.0, y_min=-0.75, rows=320, cols=480)


def draw(task: TaskConfig, seed: int = 0, grid: PixelGrid | None = None) -> Scene:
    return task.make_scene(grid=grid or PixelGrid(), seed=seed, base=Path())


def placed(scene: Scene) -> list[PlacedObject]:
    return [
        PlacedObject(item.name, BodyIndex(i), item.p_BPoints, item.symmetry)
        for i, item in enumerate(scene.objects)
    ]


def test_tools_are_shared_out_between_kits():
    scene = draw(Kitting(tools=TOOLS, kits=2))
    assert [fixture.name for fixture in scene.fixtures] == ["kit", "kit_2"]
    for index, fixture in enumerate(scene.fixtures):
        own = [goal for goal in scene.goals if goal.fixture == index]
        assert len(own) == 2
        for goal in own:
            place = (fixture.X_WF.inverse() @ goal.poses[0]).translation()
            assert np.abs(place[:2]).max() < 0.14
    # The two equal wrenches may swap their cavities, even between kits.
    assert sorted(len(goal.objects) for goal in scene.goals) == [1, 1, 2, 2]


def test_a_tilted_kit_stands_with_its_lowest_edge_on_its_riser():
    task = Kitting(tools=TOOLS[:2], riser=[0.02, 0.03], tilt_deg=[3.0, 3.0])
    for seed in range(3):
        scene = draw(task, seed)
        kit, riser = scene.fixtures
        assert [kit.name, riser.name] == ["kit", "riser"]
        up = kit.X_WF.rotation().matrix()[:, 2]
        assert math.degrees(math.acos(up[2])) == pytest.approx(3.0, abs=1e-6)
        goal = scene.goals[0]
        assert goal.highest is not None and goal.rim_height is not None
        assert goal.highest > goal.rim_height > 0.07
        # The rim is in the plane of the block's tilted top.
        top = kit.X_WF @ np.array([0.0, 0.0, KitParameters().height])
        middle = goal.poses[0].translation()
        distance = (np.array([middle[0], middle[1], goal.rim_height]) - top) @ up
        assert abs(distance) < 0.005


def test_strict_success_is_measured_in_a_tilted_kits_frame():
    scene = draw(Kitting(tools=TOOLS[:1], riser=[0.03, 0.03], tilt_deg=[8.0, 8.0]))
    (goal,) = scene.goals
    X_WGoal = goal.poses[0]

    def measured(X_GoalB: RigidTransform):
        poses = [X_WGoal @ X_GoalB]
        return evaluate_placements(placed(scene), scene.goals, scene.success, poses)[0]

    assert measured(RigidTransform()).strict_success
    raised = measured(RigidTransform([0, 0, 0.003]))
    assert raised.height_error == pytest.approx(0.003, abs=1e-9)
    assert raised.position_error < 1e-9
    assert not raised.strict_success
    turned = measured(RigidTransform(RollPitchYaw(0, 0, 0.1), [0, 0, 0]))
    assert turned.angle_error == pytest.approx(0.1, abs=1e-9)


def test_a_given_kit_pose_may_be_raised_and_tilted():
    tools = {"combination_wrench": TablePose(x=0.5, y=0.3)}
    pose = KitPose(x=0.5, y=-0.1, yaw_deg=90.0, riser=0.03, pitch_deg=2.0)
    kit, riser = draw(ArrangedKitting(tools=tools, kit_pose=pose)).fixtures
    assert kit.X_WF.translation()[2] > 0.03
    assert riser.X_WF.translation()[2] == 0.0
    level = draw(ArrangedKitting(tools=tools, kit_pose=KitPose(x=0.5, y=-0.1)))
    assert [fixture.name for fixture in level.fixtures] == ["kit"]


@pytest.mark.parametrize("count", [4, pytest.param(10, marks=pytest.mark.slow)])
def test_long_tools_share_a_kit(count: int):
    task = ToolsetKitting(count=count, tool_length=[0.25, 0.30], kit=KitParameters(height=0.075))
    scene = draw(task, grid=WHOLE_TABLE)
    assert len({item.name for item in scene.objects}) == count
    lengths = [np.ptp(item.p_BPoints[:, 0]) for item in scene.objects]
    assert min(lengths) > 0.22 and max(lengths) < 0.305


def test_too_few_tools_and_reversed_ranges_are_refused():
    with pytest.raises(UserError, match=r"task\.kits is 2"):
        draw(Kitting(tools=TOOLS[:1], kits=2))
    with pytest.raises(ValueError, match=r"task\.riser must be \[least, greatest\]"):
        Kitting(riser=[0.03, 0.0]).validate()
