import shutil
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import numpy as np
import pytest
import yaml
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.tree import BodyIndex

from kitting_drake.common.errors import UserError
from kitting_drake.common.paths import MODELS
from kitting_drake.hkd.kits.parameters import KitParameters
from kitting_drake.hkd.tools.tool import CATEGORIES, load_tool, tool_names
from kitting_drake.policies.data.learning import Learning
from kitting_drake.tasks import ArrangedKitting, Kitting, ToolsetKitting
from kitting_drake.tasks.kitting import diagnosis
from kitting_drake.tasks.kitting.tool_poses import TablePose
from kitting_drake.tasks.task import Scene, TaskConfig
from systems.placement import PlacedObject, Placement, evaluate_placements, total_reward
from systems.signals import PixelGrid

GRID, BASE = PixelGrid(), Path()
TWINS = Kitting(tools=["flat_screwdriver", "combination_wrench", "flat_screwdriver"])


def draw(seed: int, task: TaskConfig | None = None) -> Scene:
    return (task or Kitting()).make_scene(grid=GRID, seed=seed, base=BASE)


def poses(scene: Scene) -> list:
    goals = [X for goal in scene.goals for X in goal.poses]
    objects = [item.X_WB for item in scene.objects]
    return [X.GetAsMatrix4().tolist() for X in (scene.fixtures[0].X_WF, *objects, *goals)]


def names(scene: Scene) -> list[str]:
    return [item.name for item in scene.objects]


def yaw_deg(X: RigidTransform) -> float:
    return float(np.rad2deg(RollPitchYaw(X.rotation()).yaw_angle()))


def placements(scene: Scene, X_WB: list[RigidTransform]) -> list[Placement]:
    objects = [
        PlacedObject(item.name, BodyIndex(index), item.p_BPoints, item.symmetry)
        for index, item in enumerate(scene.objects)
    ]
    return evaluate_placements(objects, scene.goals, scene.success, X_WB)


def test_the_seed_determines_the_scene():
    scene, again = draw(3), draw(3)
    assert poses(scene) == poses(again)
    assert names(scene) == names(again)
    assert poses(scene) != poses(draw(4))


def test_poses_and_goals_follow_the_order():
    """In a random order, each tool has the same pose and cavity as in the listed order."""
    scene, listed = draw(0), draw(0, Kitting(random_order=False))
    assert names(listed) == Kitting().tools
    assert names(scene) != Kitting().tools
    (kit,) = scene.fixtures
    for index, (item, goal) in enumerate(zip(scene.objects, scene.goals, strict=True)):
        there = Kitting().tools.index(item.name)
        assert goal.objects == (index,)
        assert goal.name == f"cavity of {item.name}"
        ((X_WGoal,), (expected,)) = goal.poses, listed.goals[there].poses
        assert item.X_WB.IsExactlyEqualTo(listed.objects[there].X_WB)
        assert X_WGoal.IsExactlyEqualTo(expected)
        # At its goal, a tool is flush with the cavity's rim and aligned with the kit.
        tool = load_tool(item.name)
        assert (item.category, item.symmetry) == (tool.category, tool.symmetry)
        assert X_WGoal.translation()[2] + tool.height == pytest.approx(goal.rim_height)
        assert yaw_deg(X_WGoal) == pytest.approx(yaw_deg(kit.X_WF))
        assert goal.rim_height == pytest.approx(Kitting().kit.height)


def test_cavities_may_be_made_for_other_tools():
    task = Kitting(tools=["bracket_60x36x12"], cavities=["bracket_61x37x12"], yaw_range_deg=0.0)
    (goal,) = draw(0, task).goals
    (model,) = draw(0, Kitting(tools=task.cavities, yaw_range_deg=0.0)).goals
    moved = goal.poses[0].translation() - model.poses[0].translation()
    # The smaller bracket's goal is moved within the larger bracket's cavity.
    assert 0.0 < np.linalg.norm(moved) < 2e-3
    with pytest.raises(ValueError, match=r"task\.cavities names 1 tools, but must name"):
        Kitting(cavities=["claw_hammer"]).validate()


def test_tools_at_their_goals_earn_the_whole_reward():
    scene = draw(1)
    assert (scene.max_actions, scene.goal_objects) == (4, (0, 1, 2, 3))
    done = placements(scene, [goal.poses[0] for goal in scene.goals])
    assert all(item.strict_success for item in done)
    assert total_reward(scene.goals, done) == pytest.approx(1.0)
    # Success depends on the task's threshold.
    off = [RigidTransform([0.003, 0, 0]) @ goal.poses[0] for goal in scene.goals]
    assert total_reward(scene.goals, placements(scene, off)) == pytest.approx(1.0)
    strict = draw(1, Kitting(success_threshold=0.0005))
    assert total_reward(strict.goals, placements(strict, off)) == 0.0


def test_identical_tools_fill_each_others_cavities():
    scene = draw(0, TWINS)
    assert sorted(names(scene)) == ["combination_wrench", "flat_screwdriver", "flat_screwdriver_2"]
    wrench = names(scene).index("combination_wrench")
    one, other = sorted({0, 1, 2} - {wrench})
    assert [goal.objects for goal in scene.goals] == [
        (wrench,) if index == wrench else (one, other) for index in range(3)
    ]
    own = [goal.poses[0] for goal in scene.goals]
    assert not own[one].IsNearlyEqualTo(own[other], 0.01)
    swapped = list(own)
    swapped[one], swapped[other] = own[other], own[one]
    for X_WB, goals in ((own, (one, other)), (swapped, (other, one))):
        done = placements(scene, X_WB)
        assert (done[one].goal, done[other].goal) == goals
        assert all(item.success for item in done)
        assert total_reward(scene.goals, done) == pytest.approx(1.0)
    # If both tools are in one cavity, only one goal counts as filled.
    both = list(own)
    both[other] = own[one]
    assert total_reward(scene.goals, placements(scene, both)) == pytest.approx(2 / 3)


def test_identical_tools_have_distinct_names():
    scene = draw(0, Kitting(tools=["s_wrench"] * 3))
    assert names(scene) == ["s_wrench", "s_wrench_2", "s_wrench_3"]
    assert {goal.objects for goal in scene.goals} == {(0, 1, 2)}


@pytest.mark.parametrize(
    "count", [1, 2, *(pytest.param(many, marks=pytest.mark.slow) for many in (7, 12))]
)
def test_kits_of_any_number_of_tools(count: int):
    # With twelve tools, all categories occur, some of them repeatedly.
    tools = tool_names()[:: len(tool_names()) // 12][:count]
    scene = draw(0, Kitting(tools=tools))
    assert sorted(names(scene)) == sorted(tools)
    assert len(scene.goals) == scene.max_actions == count
    done = placements(scene, [goal.poses[0] for goal in scene.goals])
    assert all(item.success for item in done)
    assert total_reward(scene.goals, done) == pytest.approx(1.0)
    away = placements(scene, [item.X_WB for item in scene.objects])
    assert not any(item.success for item in away)


def test_arranged_kitting_has_the_given_poses():
    task = ArrangedKitting(
        tools={
            "flat_screwdriver": TablePose(x=0.3, y=0.2, yaw_deg=30.0),
            "claw_hammer": TablePose(x=0.4, y=-0.3, yaw_deg=-100.0),
        },
        kit_pose=TablePose(x=0.6, y=0.1, yaw_deg=45.0),
    )
    scene = draw(5, task)
    assert names(scene) == ["flat_screwdriver", "claw_hammer"]
    found = [scene.fixtures[0].X_WF, *(item.X_WB for item in scene.objects)]
    for X, pose in zip(found, (task.kit_pose, *task.tools.values()), strict=True):
        np.testing.assert_allclose(X.translation(), [pose.x, pose.y, 0], atol=1e-12)
        assert yaw_deg(X) == pytest.approx(pose.yaw_deg)


@pytest.mark.parametrize("split", [pytest.param("test", marks=pytest.mark.slow), "fresh"])
def test_toolsets_are_drawn_from_their_split(split: str):
    drawn = set()
    for seed in (0, 3):
        scene = draw(seed, ToolsetKitting(split=split))
        drawn |= set(names(scene))
        assert sorted(item.category for item in scene.objects) == sorted(CATEGORIES)
        assert {load_tool(name).split for name in names(scene)} == {split}
        lengths = [float(np.ptp(item.p_BPoints[:, 0])) for item in scene.objects]
        assert all(0.145 < length < 0.201 for length in lengths)
    assert len(drawn) > 4


def test_toolsets_are_drawn_from_a_pool():
    pool = ["ball_peen_hammer", "club_hammer", str(MODELS / "tools" / "t_handle_screwdriver")]
    task = ToolsetKitting(pool=pool, random_lengths=False)
    drawn = {tuple(sorted(names(draw(seed, task)))) for seed in range(6)}
    assert drawn == {(hammer, "t_handle_screwdriver") for hammer in pool[:2]}
    assert any(path.name == "club_hammer.sdf" for path in task.input_files(BASE))
    with pytest.raises(UserError, match=r"task\.pool.*no_such_tool"):
        draw(0, ToolsetKitting(pool=["no_such_tool"]))
    with pytest.raises(UserError, match=r"a\\x00b"):
        draw(0, ToolsetKitting(pool=["a\0b"]))


def test_tools_scaled_too_wide_for_the_jaws_raise(tmp_path: Path):
    folder = tmp_path / "wide"
    shutil.copytree(MODELS / "tools" / "stubby_screwdriver", folder)
    tool = load_tool(str(folder))
    record = yaml.safe_load((folder / "tool.yaml").read_text())
    # If the tool is scaled to a length of 0.2 m, its grasp is as wide as the open jaws.
    record["grasp"]["width"] = 0.08 * tool.length / 0.2
    (folder / "tool.yaml").write_text(yaml.safe_dump(record))
    draw(0, ToolsetKitting(pool=[str(folder)], tool_length=[0.15, 0.19]))
    with pytest.raises(UserError, match=r"'stubby_screwdriver' is 8\d mm wide"):
        draw(0, ToolsetKitting(pool=[str(folder)], tool_length=[0.201, 0.21]))


def test_lengths_are_drawn_only_with_random_lengths():
    def lengths(**fields: bool) -> dict[str, float]:
        scene = draw(0, ToolsetKitting(split="test", **fields))
        return {item.name: float(np.ptp(item.p_BPoints[:, 0])) for item in scene.objects}

    scaled = lengths()
    assert scaled == lengths()
    as_made = lengths(random_lengths=False)
    for name, length in as_made.items():
        assert length == pytest.approx(load_tool(name).length, rel=0.02)
    # The seed gives the same tools with and without random lengths.
    assert scaled.keys() == as_made.keys()
    assert scaled != as_made


def test_drawn_masses_change_models_and_the_order_of_grasps_only():
    tools = ["combination_wrench", "flat_screwdriver"]
    plain, heavy = (draw(0, Kitting(tools=tools, **more)) for more in ({}, {"tool_mass": [1, 2]}))
    assert poses(plain) == poses(heavy)
    for item, other in zip(plain.objects, heavy.objects, strict=True):
        assert item.name == other.name
        assert set(item.grasps) <= set(other.grasps)
        mass = float(ElementTree.parse(other.model).findtext(".//mass") or 0)
        assert 1.0 <= mass <= 2.0
    for wrong in ([2.0, 1.0], [0.0, 1.0]):
        with pytest.raises(ValueError, match=r"task\.tool_mass must be"):
            Kitting(tool_mass=wrong).validate()


def test_only_default_parameters_have_the_papers_title():
    assert Kitting().title == "kitting-seen-toolset"
    assert Kitting(spacing=0.01).title == "kitting"
    assert ToolsetKitting().title == "kitting-unseen-toolsets"
    assert ToolsetKitting(split="train").title == "kitting-train-toolsets"
    assert ToolsetKitting(split="fresh").title == "kitting-fresh-toolsets"
    assert ToolsetKitting(split="fresh", distractors=1).title == "kitting"
    assert ToolsetKitting(random_lengths=False).title == "kitting"
    assert ArrangedKitting().title == "arranged"


@pytest.mark.parametrize("task", [Kitting(), ToolsetKitting(), ArrangedKitting()])
def test_properties_of_the_kitting_tasks(task: TaskConfig):
    task.validate()
    assert task.learning == Learning(later_picks_possible=True, curvature=True, reflection=True)
    assert task.causes == diagnosis.CAUSES
    scene = draw(0, task)
    away = placements(scene, [item.X_WB for item in scene.objects])
    cause = task.find_cause(scene, 0, [item.X_WB for item in scene.objects], away[0], [])
    assert cause == "never picked"


def test_input_files():
    files = Kitting(tools=["claw_hammer"]).input_files(BASE)
    assert {"tool.yaml", "claw_hammer.sdf"} <= {path.name for path in files}
    assert ToolsetKitting().input_files(BASE) == []
    with pytest.raises(UserError, match=r"task\.tools: .*'spoon'"):
        ArrangedKitting(tools={"spoon": TablePose()}).input_files(BASE)


def test_an_error_names_the_field_of_a_missing_tool():
    with pytest.raises(UserError, match=r"task\.tools: .*'spoon'"):
        draw(0, Kitting(tools=["spoon"]))


def test_a_tool_may_have_the_name_of_another_body(tmp_path: Path, monkeypatch):
    for name in ("kit", "distractor_1"):
        shutil.copytree(load_tool("flat_screwdriver", BASE).directory, tmp_path / name)
        (tmp_path / name / "flat_screwdriver.sdf").rename(tmp_path / name / f"{name}.sdf")
        card = tmp_path / name / "tool.yaml"
        card.write_text(card.read_text().replace("flat_screwdriver", name, 1))
    monkeypatch.setenv("KITTING_DRAKE_TOOLS", str(tmp_path))
    scene = draw(0, Kitting(tools=["kit", "distractor_1"], distractors=1))
    assert {"kit_2", "distractor_1_2"} <= set(names(scene))


def test_an_error_names_the_field_of_a_kit_without_room():
    small = KitParameters(fixed_size=True, length=0.1, width=0.1)
    with pytest.raises(UserError, match=r"^task\.kit: "):
        draw(0, Kitting(tools=["claw_hammer"], kit=small))


def test_a_round_cavity_takes_a_tool_at_any_heading():
    # The socket has a hexagonal hole, so its own symmetry is of order 6.
    scene = draw(0, Kitting(tools=["socket_22x26", "bracket_60x36x12"]))
    turn = RigidTransform(RollPitchYaw(0, 0, np.radians(25)), [0, 0, 0])
    seated = [goal.poses[0] @ turn for goal in scene.goals]
    found = dict(zip(names(scene), placements(scene, seated), strict=True))
    assert found["socket_22x26"].strict_success
    assert not found["bracket_60x36x12"].strict_success
