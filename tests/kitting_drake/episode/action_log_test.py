import dataclasses
import math

import numpy as np
import pytest
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.systems.framework import Context

from kitting_drake.episode import ModeChange
from kitting_drake.episode.action_log import ActionLog, nearest_object
from kitting_drake.scenario import Scenario
from kitting_drake.station import KittingStation, build_station
from kitting_drake.tasks import Kitting
from kitting_drake.tasks.task import ActionRecord
from systems.oracle_policy import gripper_pose
from systems.pick_place_parameters import Mode
from systems.signals import PickPlaceAction, PlanarPose

OBJECT = 0
GRASP = (Mode.DESCEND, Mode.CLOSE, Mode.CHECK)


@pytest.fixture(scope="module")
def station() -> KittingStation:
    return build_station(Scenario(cameras={}))


def flat(x: float, y: float, yaw: float = 0.0, z: float = 0.0) -> RigidTransform:
    return RigidTransform(RollPitchYaw(0, 0, yaw), [x, y, z])


def planar(X: RigidTransform) -> PlanarPose:
    return PlanarPose(*X.translation()[:2], RollPitchYaw(X.rotation()).yaw_angle())


class Action:
    """An ActionLog that is driven through one action, mode by mode, with given object poses."""

    def __init__(self, station: KittingStation, pick: PlanarPose, place: PlanarPose) -> None:
        self.station = station
        self.root: Context = station.CreateDefaultContext()
        self.context = station.plant.GetMyMutableContextFromRoot(self.root)
        self.log = ActionLog(station)
        self._mode = Mode.OBSERVE
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(station, "accepted_action", lambda _: PickPlaceAction(pick, place))
            self.go(Mode.APPROACH)

    def go(self, *modes: Mode) -> "Action":
        for mode in modes:
            self.log.observe(ModeChange(self._mode, mode, self.root))
            self._mode = mode
        return self

    def put(self, index: int, X_WB: RigidTransform) -> None:
        body = self.station.plant.get_body(self.station.objects[index].body)
        self.station.plant.SetFreeBodyPose(self.context, body, X_WB)

    @property
    def record(self) -> ActionRecord:
        (record,) = self.log.records
        return record


def right_action(station: KittingStation, index: int) -> tuple[PlanarPose, PlanarPose]:
    """The expert's action for an object."""
    item = station.scene.objects[index]
    (X_WGoal,) = station.scene.goals[index].poses
    return gripper_pose(item.X_WB, item.grasps[0]), gripper_pose(X_WGoal, item.grasps[0])


@pytest.mark.parametrize("index", range(4))
def test_the_right_action_has_no_error(station: KittingStation, index: int):
    record = Action(station, *right_action(station, index)).record
    item = station.scene.objects[index]
    assert (record.object, record.category) == (item.name, item.category)
    assert record.outcome == "unfinished"
    assert record.pick_position_error_mm == pytest.approx(0.0, abs=1e-9)
    assert record.pick_angle_error_deg == pytest.approx(0.0, abs=1e-9)
    assert record.place_position_error_mm == pytest.approx(0.0, abs=1e-9)
    assert record.place_angle_error_deg == pytest.approx(0.0, abs=1e-9)


def test_an_action_on_a_placed_object_is_recorded_as_such(station: KittingStation):
    pick, place = right_action(station, OBJECT)
    (X_WGoal,) = station.scene.goals[OBJECT].poses
    grasp = station.scene.objects[OBJECT].grasps[0]
    action = Action(station, pick, place)
    assert not action.record.was_placed
    action.put(OBJECT, X_WGoal)
    with pytest.MonkeyPatch.context() as patch:
        again = PickPlaceAction(gripper_pose(X_WGoal, grasp), pick)
        patch.setattr(station, "accepted_action", lambda _: again)
        action.go(Mode.RETREAT, Mode.OBSERVE, Mode.APPROACH)
    assert action.log.records[-1].was_placed


def test_place_errors_are_those_of_the_arrival_pose(station: KittingStation):
    pick, place = right_action(station, OBJECT)
    # If the place moves with the grasp, the object still reaches its goal: only the pick is wrong.
    off = flat(3e-3, -4e-3, math.radians(7.0))
    shifted = [planar(flat(pose.x, pose.y, pose.theta) @ off) for pose in (pick, place)]
    record = Action(station, *shifted).record
    assert record.pick_position_error_mm == pytest.approx(5.0)
    assert record.pick_angle_error_deg == pytest.approx(7.0)
    assert record.place_position_error_mm == pytest.approx(0.0, abs=1e-9)
    assert record.place_angle_error_deg == pytest.approx(0.0, abs=1e-9)


def test_half_a_rotation_is_ignored_for_the_jaws_but_not_for_the_object(station: KittingStation):
    pick, place = right_action(station, OBJECT)
    rotated = PlanarPose(pick.x, pick.y, pick.theta + math.pi)
    record = Action(station, rotated, place).record
    assert record.pick_angle_error_deg == pytest.approx(0.0, abs=1e-9)
    assert record.place_angle_error_deg == pytest.approx(180.0)
    # A half turn about the grasp moves the object's middle to the other side of the grasp.
    (grasp,) = station.scene.objects[OBJECT].grasps
    middle = station.objects[OBJECT].p_BMiddle
    arm = math.hypot(grasp.x - middle[0], grasp.y - middle[1])
    assert record.place_position_error_mm == pytest.approx(2e3 * arm)


def test_headings_are_compared_modulo_the_declared_symmetry(
    station: KittingStation, monkeypatch: pytest.MonkeyPatch
):
    objects = list(station.objects)
    objects[OBJECT] = dataclasses.replace(objects[OBJECT], symmetry=2)
    monkeypatch.setattr(station, "objects", tuple(objects))
    pick, place = right_action(station, OBJECT)
    rotated = PlanarPose(pick.x, pick.y, pick.theta + math.pi)
    record = Action(station, rotated, place).record
    assert record.place_angle_error_deg == pytest.approx(0.0, abs=1e-9)


def test_outcomes_follow_from_the_sequence_of_modes(station: KittingStation):
    action = right_action(station, OBJECT)
    held = (*GRASP, Mode.LIFT, Mode.CARRY, Mode.LOWER)
    for modes, outcome in (
        ((*GRASP, Mode.RETREAT), "missed"),
        ((*GRASP, Mode.LIFT, Mode.RETREAT), "dropped"),
        ((*GRASP, Mode.LIFT, Mode.CARRY, Mode.RETREAT), "dropped"),
        ((*held, Mode.RETREAT), "dropped"),
        ((*held, Mode.SEARCH, Mode.RETREAT), "dropped"),
        ((*held, Mode.RELEASE, Mode.RETREAT), "placed"),
        ((*held, Mode.SEARCH, Mode.LOWER, Mode.RELEASE, Mode.RETREAT), "placed"),
        ((*GRASP, Mode.LIFT), "unfinished"),
    ):
        assert Action(station, *action).go(*modes, Mode.OBSERVE).record.outcome == outcome


def test_the_end_of_an_episode_does_not_change_the_outcome(station: KittingStation):
    action = Action(station, *right_action(station, OBJECT)).go(*GRASP)
    action.log.observe(ModeChange(Mode.RELEASE, Mode.RELEASE, action.root, is_last=True))
    assert action.record.outcome == "unfinished"


def test_the_lifted_object_is_recorded(station: KittingStation):
    action = Action(station, *right_action(station, 0)).go(*GRASP, Mode.LIFT)
    action.put(2, flat(0.0, 0.0, 0.0, 0.05) @ station.scene.objects[2].X_WB)
    action.go(Mode.CARRY, Mode.LOWER, Mode.RELEASE)
    assert action.record.object == station.scene.objects[2].name
    assert action.record.outcome == "placed"
    # Errors refer to the initial pose and the goal of the object that was lifted.
    here, there = (station.scene.objects[index].X_WB.translation() for index in (0, 2))
    assert action.record.pick_position_error_mm > 1e3 * np.linalg.norm(there - here) / 2
    assert action.record.place_position_error_mm > 30.0


def test_place_errors_refer_to_the_nearest_suitable_cavity():
    twins = Kitting(tools=["flat_screwdriver", "flat_screwdriver"], random_order=False)
    station = build_station(Scenario(task=twins, cameras={}))
    (pick, _), (_, place) = right_action(station, 0), right_action(station, 1)
    record = Action(station, pick, place).record
    assert record.object == "flat_screwdriver"
    assert record.place_position_error_mm == pytest.approx(0.0, abs=1e-9)
    assert record.place_angle_error_deg == pytest.approx(0.0, abs=1e-9)


def test_an_object_without_grasp_or_goal_has_no_errors(
    station: KittingStation, monkeypatch: pytest.MonkeyPatch
):
    """A distractor may be picked."""
    items = list(station.scene.objects)
    items[OBJECT] = dataclasses.replace(items[OBJECT], grasps=())
    scene = dataclasses.replace(
        station.scene,
        objects=tuple(items),
        goals=tuple(
            dataclasses.replace(goal, reward=1 / 3)
            for goal in station.scene.goals
            if OBJECT not in goal.objects
        ),
    )
    action = right_action(station, OBJECT)
    monkeypatch.setattr(station, "scene", scene)
    record = Action(station, *action).record
    assert record.object == items[OBJECT].name
    assert record.pick_position_error_mm is record.pick_angle_error_deg is None
    assert record.place_position_error_mm is record.place_angle_error_deg is None


def test_nearest_object_measures_to_surfaces(station: KittingStation):
    poses = [item.X_WB for item in station.scene.objects]
    for index, item in enumerate(station.objects):
        end = item.p_BPoints[item.p_BPoints[:, 0].argmax()]
        x, y, _ = poses[index] @ end
        assert nearest_object(station, poses, PlanarPose(x, y)) == index
