import math
from pathlib import Path

import numpy as np
import pytest
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.systems.framework import Context

from kitting_drake.cell.cell import Cell, build_cell
from kitting_drake.episode.action_log import ActionRecord, ActionRecorder, find_cause, object_poses
from kitting_drake.scenario.schema import Scenario
from systems.oracle_policy import gripper_pose
from systems.pick_place_parameters import Mode
from systems.signals import PlanarPose

TOOL = 0


@pytest.fixture(scope="module")
def cell() -> Cell:
    return build_cell(Scenario(cameras={}), seed=0, base=Path())


def planar(x: float, y: float, yaw: float = 0.0, z: float = 0.0) -> RigidTransform:
    return RigidTransform(RollPitchYaw(0, 0, yaw), [x, y, z])


class Watched:
    """A recorder that is shown one action, mode by mode, and objects that are where one says."""

    def __init__(self, cell: Cell, pick: PlanarPose, place: PlanarPose) -> None:
        self.cell = cell
        self.root: Context = cell.diagram.CreateDefaultContext()
        self.context = cell.plant.GetMyMutableContextFromRoot(self.root)
        self.recorder = ActionRecorder(cell)
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(cell.planner, "action", lambda _: (pick, place))
            self.show(Mode.OBSERVE, Mode.APPROACH)

    def show(self, *modes: Mode) -> "Watched":
        for mode in modes:
            self.recorder.look(self.root, mode)
            self.recorder.look(self.root, mode)  # A mode lasts for many steps.
        return self

    def put(self, index: int, X_WB: RigidTransform) -> None:
        self.cell.plant.SetFreeBodyPose(self.context, self.cell.tool_bodies[index], X_WB)

    @property
    def record(self) -> ActionRecord:
        (record,) = self.recorder.records
        return record


def right_action(cell: Cell, index: int) -> tuple[PlanarPose, PlanarPose]:
    """What an oracle does with an object."""
    grasp = cell.scene.tools[index].grasp
    held = PlanarPose(grasp.x, grasp.y, grasp.theta)
    return (
        gripper_pose(cell.scene.X_WTools[index], held),
        gripper_pose(cell.scene.X_WGoals[index], held),
    )


@pytest.mark.parametrize("index", range(4))
def test_the_right_answer_has_no_error(cell: Cell, index: int):
    record = Watched(cell, *right_action(cell, index)).record
    tool = cell.scene.tools[index]
    assert (record.object, record.category) == (tool.name, tool.category)
    assert record.outcome == "unfinished"
    assert record.pick_position_error_mm == pytest.approx(0.0, abs=1e-9)
    assert record.pick_angle_error_deg == pytest.approx(0.0, abs=1e-9)
    assert record.place_position_error_mm == pytest.approx(0.0, abs=1e-9)
    assert record.place_angle_error_deg == pytest.approx(0.0, abs=1e-9)


def test_an_answer_is_judged_by_where_it_would_bring_the_object(cell: Cell):
    pick, place = right_action(cell, TOOL)
    # Another grasp, to which the place is suited: only the pick is off.
    off = planar(3e-3, -4e-3, math.radians(7.0))
    shifted = [planar(pose.x, pose.y, pose.theta) @ off for pose in (pick, place)]
    poses = [
        PlanarPose(*X.translation()[:2], RollPitchYaw(X.rotation()).yaw_angle()) for X in shifted
    ]
    record = Watched(cell, *poses).record
    assert record.pick_position_error_mm == pytest.approx(5.0)
    assert record.pick_angle_error_deg == pytest.approx(7.0)
    assert record.place_position_error_mm == pytest.approx(0.0, abs=1e-9)
    assert record.place_angle_error_deg == pytest.approx(0.0, abs=1e-9)


def test_a_half_turn_of_the_jaws_is_nothing_and_of_the_object_much(cell: Cell):
    pick, place = right_action(cell, TOOL)
    turned = PlanarPose(pick.x, pick.y, pick.theta + math.pi)
    record = Watched(cell, turned, place).record
    assert record.pick_angle_error_deg == pytest.approx(0.0, abs=1e-9)
    assert record.place_angle_error_deg == pytest.approx(180.0)
    # About the grasp, which takes the middle of the object to its other side.
    grasp = cell.scene.tools[TOOL].grasp
    assert record.place_position_error_mm == pytest.approx(2e3 * math.hypot(grasp.x, grasp.y))


def test_outcomes_by_the_modes_gone_through(cell: Cell):
    action = right_action(cell, TOOL)
    grasp = (Mode.DESCEND, Mode.CLOSE, Mode.CHECK)
    for modes, outcome in (
        ((*grasp, Mode.RETREAT), "missed"),
        ((*grasp, Mode.LIFT, Mode.RETREAT), "dropped"),
        ((*grasp, Mode.LIFT, Mode.CARRY, Mode.RETREAT), "dropped"),
        ((*grasp, Mode.LIFT, Mode.CARRY, Mode.LOWER, Mode.RETREAT), "dropped"),
        ((*grasp, Mode.LIFT, Mode.CARRY, Mode.LOWER, Mode.RELEASE, Mode.RETREAT), "placed"),
        ((*grasp, Mode.LIFT), "unfinished"),
    ):
        assert Watched(cell, *action).show(*modes, Mode.OBSERVE).record.outcome == outcome


def test_what_was_lifted_is_what_was_picked(cell: Cell):
    watched = Watched(cell, *right_action(cell, 0))
    watched.show(Mode.DESCEND, Mode.CLOSE, Mode.CHECK, Mode.LIFT)
    watched.put(2, planar(0.0, 0.0, 0.0, 0.05) @ cell.scene.X_WTools[2])
    watched.show(Mode.CARRY, Mode.LOWER, Mode.RELEASE)
    assert watched.record.object == cell.scene.tools[2].name
    assert watched.record.outcome == "placed"
    # Judged by the pose before it was lifted, against the goal of what was lifted.
    between = cell.scene.X_WTools[2].translation() - cell.scene.X_WTools[0].translation()
    assert watched.record.pick_position_error_mm > 1e3 * np.linalg.norm(between) / 2
    assert watched.record.place_position_error_mm > 30.0


def record(cell: Cell, outcome: str, *, place_error_mm: float = 1.0) -> ActionRecord:
    tool = cell.scene.tools[TOOL]
    nowhere = PlanarPose()
    return ActionRecord(
        tool.name, tool.category, outcome, nowhere, nowhere, 1.0, 1.0, place_error_mm, 1.0
    )


def cause(cell: Cell, X_GoalB: RigidTransform, *records: ActionRecord) -> str:
    """Of an object that ended at a pose given in its goal's frame."""
    return find_cause(cell, TOOL, cell.scene.X_WGoals[TOOL] @ X_GoalB, records)


def test_causes_of_what_was_never_held(cell: Cell):
    beside = planar(0.3, 0.0)
    assert cause(cell, beside) == "never picked"
    assert cause(cell, beside, record(cell, "unfinished")) == "never picked"
    assert cause(cell, beside, record(cell, "missed")) == "missed grasp"
    other = record(cell, "placed")
    other.object = cell.scene.tools[1].name
    assert cause(cell, beside, other) == "never picked"


@pytest.mark.parametrize("outcome", ["placed", "dropped"])
def test_causes_at_its_own_cavity(cell: Cell, outcome: str):
    done = record(cell, outcome)
    # A grasp that was missed when it was to be taken out again changes nothing.
    for records in ([done], [done, record(cell, "missed")]):
        assert cause(cell, planar(0.004, 0.01, 0.2, 0.012), *records) == "jammed"
        assert cause(cell, planar(0.0, 0.0, math.pi - 0.1), *records) == "flipped"
        face_down = RigidTransform(RollPitchYaw(math.pi, 0, 0), [0, 0, 0.02])
        assert cause(cell, face_down, *records) == "flipped"


def test_a_half_turn_about_the_grasp_is_a_flip(cell: Cell):
    tool = cell.scene.tools[TOOL]
    X_BGrasp = planar(tool.grasp.x, tool.grasp.y)
    flipped = X_BGrasp @ planar(0, 0, math.pi) @ X_BGrasp.inverse()
    assert cause(cell, flipped, record(cell, "placed")) == "flipped"


def test_causes_elsewhere(cell: Cell):
    placed, dropped = record(cell, "placed"), record(cell, "dropped")
    meant_elsewhere = record(cell, "placed", place_error_mm=90.0)
    off_the_kit = planar(0.3, 0.0)
    assert cause(cell, off_the_kit, dropped) == "slipped"
    assert cause(cell, off_the_kit, placed) == "slipped"
    assert cause(cell, off_the_kit, meant_elsewhere) == "misplaced"
    across = planar(0.0, 0.0, math.pi / 2)
    assert cause(cell, across, placed) == "misplaced"
    over_another = cell.scene.X_WGoals[TOOL].InvertAndCompose(cell.scene.X_WGoals[1])
    assert cause(cell, over_another, meant_elsewhere) == "wrong cavity"
    assert cause(cell, over_another @ planar(0, 0, math.pi), placed) == "wrong cavity"
    assert cause(cell, over_another, dropped) == "slipped"


def test_object_poses(cell: Cell):
    poses = object_poses(cell, cell.diagram.CreateDefaultContext())
    for X_WB, expected in zip(poses, cell.scene.X_WTools, strict=True):
        assert X_WB.IsNearlyEqualTo(expected, 1e-12)
