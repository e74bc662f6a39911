from pathlib import Path

import numpy as np
import pytest
from manifold3d import CrossSection
from pydrake.math import RigidTransform, RollPitchYaw

from kitting_drake.common.errors import UserError
from kitting_drake.scenario.schema import ArrangedKitting, Kitting, Placement
from kitting_drake.tasks.kitting.scene import TABLE, KittingScene, make_scene
from systems.signals import PixelGrid

GRID, BASE = PixelGrid(), Path()


def draw(seed: int, task: Kitting | None = None, grid: PixelGrid = GRID) -> KittingScene:
    return make_scene(task or Kitting(), grid=grid, seed=seed, base=BASE)


def poses(scene: KittingScene) -> list:
    return [X.GetAsMatrix4().tolist() for X in (scene.X_WKit, *scene.X_WTools, *scene.X_WGoals)]


def yaw_deg(X: RigidTransform) -> float:
    return float(np.rad2deg(RollPitchYaw(X.rotation()).yaw_angle()))


def seen_from_above(scene: KittingScene) -> list[CrossSection]:
    """The outlines of kit and tools on the table."""
    block = CrossSection.square((scene.kit.parameters.length, scene.kit.parameters.width), True)
    shapes = [block, *(tool.silhouette for tool in scene.tools)]
    return [
        shape.rotate(yaw_deg(X)).translate(tuple(X.translation()[:2]))
        for shape, X in zip(shapes, (scene.X_WKit, *scene.X_WTools), strict=True)
    ]


def test_the_seed_is_the_scene():
    assert poses(draw(3)) == poses(draw(3))
    assert [tool.name for tool in draw(3).tools] == [tool.name for tool in draw(3).tools]
    assert poses(draw(3)) != poses(draw(4))


def test_twenty_seeds_lie_free_and_inside_the_workspace():
    orders, turns = set(), []
    names = sorted(Kitting().tools)
    for seed in range(20):
        scene = draw(seed)
        shapes = seen_from_above(scene)
        for i, shape in enumerate(shapes):
            grown = shape.offset(0.0079)  # The spacing is 8 mm.
            for other in shapes[i + 1 :]:
                assert (grown ^ other).area() < 1e-9, seed
            x_min, y_min, x_max, y_max = shape.bounds()
            assert x_min >= 0.25, seed
            assert x_max <= 0.75, seed
            assert y_min >= -0.5, seed
            assert y_max <= 0.5, seed
        order = tuple(tool.name for tool in scene.tools)
        assert sorted(order) == names
        orders.add(order)
        turns += [yaw_deg(X) for X in (scene.X_WKit, *scene.X_WTools)]
    assert len(orders) > 5
    assert min(turns) < -120
    assert max(turns) > 120


def test_poses_and_goals_follow_the_order():
    """Whatever the order, each tool keeps its own pose, and its goal is in its own cavity."""
    scene = draw(0)
    listed = draw(0, Kitting(random_order=False))
    assert [tool.name for tool in listed.tools] == Kitting().tools
    assert [tool.name for tool in scene.tools] != Kitting().tools
    for tool, X_WT, X_WGoal in zip(scene.tools, scene.X_WTools, scene.X_WGoals, strict=True):
        index = Kitting().tools.index(tool.name)
        assert X_WT.IsExactlyEqualTo(listed.X_WTools[index])
        assert X_WGoal.IsExactlyEqualTo(listed.X_WGoals[index])
        top = X_WGoal.translation()[2] + tool.height
        assert top == pytest.approx(scene.kit.parameters.height)
        assert yaw_deg(X_WGoal) == pytest.approx(yaw_deg(scene.X_WKit))


def test_the_range_of_turns_is_kept():
    scene = draw(1, Kitting(yaw_range_deg=5.0))
    assert all(abs(yaw_deg(X)) <= 5 for X in (scene.X_WKit, *scene.X_WTools))


def test_arranged_stands_where_you_say():
    task = ArrangedKitting(
        tools={
            "flat_screwdriver": Placement(x=0.3, y=0.2, yaw_deg=30.0),
            "claw_hammer": Placement(x=0.4, y=-0.3, yaw_deg=-100.0),
        },
        kit_pose=Placement(x=0.6, y=0.1, yaw_deg=45.0),
    )
    scene = make_scene(task, grid=GRID, seed=5, base=BASE)
    assert [tool.name for tool in scene.tools] == ["flat_screwdriver", "claw_hammer"]
    placements = (task.kit_pose, *task.tools.values())
    for X, placement in zip((scene.X_WKit, *scene.X_WTools), placements, strict=True):
        np.testing.assert_allclose(X.translation(), [placement.x, placement.y, 0], atol=1e-12)
        assert yaw_deg(X) == pytest.approx(placement.yaw_deg)


@pytest.mark.parametrize(
    ("kit_x", "tools", "words"),
    [
        (0.9, {"claw_hammer": Placement(x=0.3, y=0.4)}, "task.kit_pose is not whole on the table"),
        (0.6, {"claw_hammer": Placement(x=0.3, y=0.8)}, "task.tools.claw_hammer is not whole"),
        (
            0.6,
            {"claw_hammer": Placement(x=0.6, y=0.1)},
            "task.kit_pose and task.tools.claw_hammer are within",
        ),
        (
            0.6,
            {
                "claw_hammer": Placement(x=0.3, y=0.3),
                "flat_screwdriver": Placement(x=0.3, y=0.31),
            },
            "task.tools.claw_hammer and task.tools.flat_screwdriver are within each other",
        ),
    ],
)
def test_an_arrangement_that_cannot_stand_is_refused(
    kit_x: float, tools: dict[str, Placement], words: str
):
    task = ArrangedKitting(tools=tools, kit_pose=Placement(x=kit_x, y=0.0))
    with pytest.raises(UserError, match=words.replace(".", r"\.")):
        make_scene(task, grid=GRID, seed=0, base=BASE)


def test_what_is_drawn_lies_on_the_table_however_far_one_sees():
    for seed in range(5):
        scene = draw(seed, grid=PixelGrid(rows=640))
        assert all(X.translation()[0] < TABLE[1][0] for X in (scene.X_WKit, *scene.X_WTools))


def test_no_free_space_is_told_with_the_fields_to_change():
    with pytest.raises(UserError, match=r"no free space.*heightmap\.rows.*task\.spacing"):
        draw(0, grid=PixelGrid(rows=110, cols=110))


@pytest.mark.parametrize("tools", [["spoon"], ["claw_hammer", "claw_hammer"]])
def test_tools_that_cannot_be_had_are_told_by_their_field(tools: list[str]):
    with pytest.raises(UserError, match=r"task\.tools"):
        draw(0, Kitting(tools=tools))
