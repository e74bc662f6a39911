"""Tests of whole episodes. Episodes of the oracle need no cameras."""

import dataclasses
import json
import sys
import types
from collections.abc import Sequence

import numpy as np
import pytest

from kitting_drake.episode import EpisodeObserver, EpisodeResult, ModeChange
from kitting_drake.scenario import Scenario
from kitting_drake.scenario.cameras import Pinhole
from kitting_drake.scenario.policies import PythonPolicy
from kitting_drake.tasks import ArrangedKitting
from kitting_drake.tasks.kitting.tool_poses import TablePose
from systems.pick_place_parameters import Mode, PickPlaceParameters
from systems.signals import Observation, PickPlaceAction, PlanarPose
from tests.kitting_drake.rig import Rig, build_rig

ONE_TOOL = ArrangedKitting(
    tools={"combination_wrench": TablePose(x=0.42, y=0.14)}, kit_pose=TablePose(x=0.5, y=-0.1)
)
BLIND = Scenario(task=ONE_TOOL, cameras={})


def build(scenario: Scenario = BLIND) -> Rig:
    return build_rig(scenario)


@dataclasses.dataclass(frozen=True)
class Seen:
    """A snapshot of an event."""

    previous: Mode
    mode: Mode
    is_action_start: bool
    is_stop: bool
    is_last: bool
    time: float
    counts: tuple[float, ...]
    asleep: bool


class Observer:
    """Records snapshots of events."""

    def __init__(self, rig: Rig) -> None:
        self._rig = rig
        self.seen: list[Seen] = []

    def observe(self, event: ModeChange) -> None:
        root = event.root_context
        body = self._rig.station.plant.get_body(self._rig.station.objects[0].body)
        self.seen.append(
            Seen(
                event.previous,
                event.mode,
                event.is_action_start,
                event.is_stop,
                event.is_last,
                root.get_time(),
                tuple(self._rig.port("counts", root)),
                body.is_locked(self._rig.station.plant.GetMyContextFromRoot(root)),
            )
        )


@pytest.fixture(scope="module")
def grasp_to_release() -> tuple[EpisodeResult, Sequence[Seen]]:
    """The oracle kits one tool, with real physics and without cameras."""
    rig = build()
    observer = Observer(rig)
    return rig.run(observer.observe, seconds=30.0), observer.seen


def test_the_oracle_kits_one_tool(grasp_to_release: tuple[EpisodeResult, Sequence[Seen]]):
    result, _ = grasp_to_release
    assert (result.failure, result.timed_out, result.interrupted) == (None, False, False)
    assert result.stop_reason in ("done", "actions spent")
    (item,) = result.objects
    assert (item.name, item.category) == ("combination_wrench", "wrench")
    assert (item.success, item.strict_success, item.cause) == (True, True, None)
    assert item.add_s_mm < 2.0
    assert (result.success_rate, result.strict_success_rate) == (1.0, 1.0)
    assert (result.actions, result.missed_grasps, result.dropped_objects) == (1, 0, 0)
    (action,) = result.actions_taken
    assert (action.object, action.category, action.outcome) == (item.name, "wrench", "placed")
    assert action.pick_position_error_mm == pytest.approx(0.0, abs=0.1)
    assert action.place_position_error_mm == pytest.approx(0.0, abs=0.1)
    assert result.point_contact_pairs == 0
    assert result.moving_at_end == []
    assert json.loads(json.dumps(result.as_dict()))["success_rate"] == 1.0


def test_observers_get_the_modes_in_order(grasp_to_release: tuple[EpisodeResult, Sequence[Seen]]):
    _, (*seen, last) = grasp_to_release
    motion = [Mode.APPROACH, Mode.DESCEND, Mode.CLOSE, Mode.CHECK, Mode.LIFT, Mode.CARRY]
    motion += [Mode.LOWER, Mode.RELEASE, Mode.RETREAT, Mode.OBSERVE]
    modes = [event.mode for event in seen if Mode.SEARCH not in (event.mode, event.previous)]
    assert modes == [*motion, Mode.DONE]
    # Each event continues from the previous one, at a later time.
    assert [event.previous for event in seen] == [Mode.OBSERVE, *(e.mode for e in seen[:-1])]
    assert sorted({event.time for event in seen}) == [event.time for event in seen]
    assert [event.is_action_start for event in seen] == [True] + [False] * (len(seen) - 1)
    assert [event.is_stop for event in seen] == [False] * (len(seen) - 1) + [True]
    # The last event marks the end. It is not a change of mode.
    assert not any(event.is_last for event in seen)
    assert (last.is_last, last.previous, last.mode) == (True, Mode.DONE, Mode.DONE)
    assert not last.is_action_start
    assert not last.is_stop
    # The first event already counts the action.
    assert [event.counts for event in seen] == [(1.0, 0.0, 0.0, 0.0)] * len(seen)


def test_a_tool_sleeps_until_the_hand_arrives(
    grasp_to_release: tuple[EpisodeResult, Sequence[Seen]],
):
    asleep = {event.mode: event.asleep for event in grasp_to_release[1]}
    held = [Mode.CHECK, Mode.LIFT, Mode.CARRY, Mode.LOWER, Mode.RELEASE]
    assert asleep[Mode.DESCEND]
    assert not any(asleep[mode] for mode in held)
    assert asleep[Mode.DONE]


def test_an_episode_that_times_out_has_no_reward():
    rig = build()
    observer = Observer(rig)
    result = rig.run(observer.observe, seconds=0.5)
    assert (result.timed_out, result.failure, result.stop_reason) == (True, None, "time")
    assert (result.success_rate, result.strict_success_rate) == (0.0, 0.0)
    assert result.sim_seconds == pytest.approx(0.5)
    assert (result.objects[0].success, result.objects[0].cause) == (False, "never picked")
    assert [action.outcome for action in result.actions_taken] == ["unfinished"]
    assert [event.mode for event in observer.seen] == [Mode.APPROACH, Mode.APPROACH]
    assert [event.is_last for event in observer.seen] == [False, True]


def test_initially_filled_goals_count_unless_the_episode_times_out():
    """The goal is already filled, so the expert stops at once."""
    rig = build()
    (X_WGoal,) = rig.scene.goals[0].poses
    rig.plant.SetDefaultFloatingBaseBodyPose(rig.plant.get_body(rig.objects[0].body), X_WGoal)
    observer = Observer(rig)
    result = rig.run(observer.observe, seconds=5.0)
    assert (result.success_rate, result.strict_success_rate, result.actions) == (1.0, 1.0, 0)
    assert result.objects[0].success
    assert [event.mode for event in observer.seen] == [Mode.DONE, Mode.DONE]
    assert observer.seen[0].is_stop
    # The episode ends as soon as the objects rest.
    assert result.sim_seconds < 1.0
    early = rig.run(seconds=0.1)
    assert early.objects[0].success
    assert (early.timed_out, early.success_rate, early.strict_success_rate) == (True, 0.0, 0.0)


@pytest.mark.parametrize("ends", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_end_at_success_ends_the_episode_without_another_action(ends: bool):
    """Two tries per tool would allow the planner to request another action."""
    task = dataclasses.replace(ONE_TOOL, tries=2)
    rig = build(dataclasses.replace(BLIND, task=task, end_at_success=ends))
    modes: list[Mode] = []
    result = rig.run(lambda event: modes.append(event.mode), seconds=30.0)
    assert (result.strict_success_rate, result.actions, result.timed_out) == (1.0, 1, False)
    assert result.stop_reason == "done"
    assert (Mode.DONE in modes) != ends


def raise_at(mode: Mode, error: BaseException) -> EpisodeObserver:
    def observe(event: ModeChange) -> None:
        if event.mode == mode and not event.is_last:
            raise error

    return observe


def test_a_failing_simulation_ends_the_episode_with_its_error():
    rig = build()
    told = Observer(rig)
    fails = raise_at(Mode.APPROACH, RuntimeError("the solver did\nnot converge"))
    result = rig.run(fails, told.observe, seconds=5.0)
    assert result.failure is not None
    assert "the solver did not converge" in result.failure
    assert result.stop_reason == "failure"
    assert (result.success_rate, result.strict_success_rate) == (0.0, 0.0)
    assert (result.interrupted, result.timed_out) == (False, False)
    assert result.sim_seconds < 1.0
    assert len(result.objects) == 1
    assert [event.is_last for event in told.seen] == [True]
    # JSON needs plain Python numbers.
    kinds = {type(value) for item in result.objects for value in vars(item).values()}
    assert kinds == {str, float, bool, dict}
    assert result.objects[0].measures == {}


def test_an_interrupted_episode_has_a_result():
    result = build().run(raise_at(Mode.APPROACH, KeyboardInterrupt()), seconds=5.0)
    assert result.interrupted
    assert (result.failure, result.stop_reason) == (None, "interrupted")
    assert result.sim_seconds < 1.0


# Policies that need a custom station.

SMALL = {
    name: dataclasses.replace(camera, width=160, height=120, focal_length=112.5)
    for name, camera in Scenario().cameras.items()
    if isinstance(camera, Pinhole)
}


class Stub:
    """A policy that picks at an empty spot, then stops."""

    def __init__(self) -> None:
        self.seen: list[Observation] = []

    def __call__(self, observation: Observation) -> PickPlaceAction:
        self.seen.append(observation)
        nothing = PlanarPose(0.3, 0.45, 0.0)
        return PickPlaceAction(nothing, nothing, stop=len(self.seen) == 2)


def install(policy: object, monkeypatch: pytest.MonkeyPatch) -> Scenario:
    """A scenario with a custom policy."""
    monkeypatch.setitem(sys.modules, "stub_policy", types.SimpleNamespace(policy=policy))
    return Scenario(
        task=ArrangedKitting(
            tools={"claw_hammer": TablePose(x=0.35, y=-0.3)}, kit_pose=TablePose(x=0.55, y=0.0)
        ),
        policy=PythonPolicy(function="stub_policy:policy"),
        planner=PickPlaceParameters(max_actions=5),
        cameras=SMALL,
    )


@pytest.mark.usefixtures("rendering")
def test_a_policy_is_called_only_after_the_planner_has_observed(monkeypatch: pytest.MonkeyPatch):
    stub = Stub()
    scenario = install(stub, monkeypatch)
    rig = build(scenario)
    asked: list[tuple[Mode, int]] = []
    result = rig.run(lambda event: asked.append((event.mode, len(stub.seen))), seconds=30.0)
    # The policy is called once before APPROACH, once before DONE, and at no other time.
    assert asked[0] == (Mode.APPROACH, 1)
    assert {count for mode, count in asked[:-2]} == {1}
    assert asked[-2:] == [(Mode.DONE, 2), (Mode.DONE, 2)]
    assert (result.actions, result.missed_grasps, result.failure) == (1, 1, None)
    assert [action.outcome for action in result.actions_taken] == ["missed"]
    assert result.objects[0].cause == "missed grasp"
    # The second observation shows the block, 50 mm high, where it stands, but not the hand.
    seen = stub.seen[1]
    row, col = np.round(seen.grid.to_pixel([0.45, 0.08])).astype(int)
    block = seen.height[row - 8 : row + 9, col - 8 : col + 9]
    assert np.count_nonzero(block) > 20  # The small camera images leave gaps in the height map.
    np.testing.assert_allclose(block[block > 0], 0.05, atol=0.004)
    assert seen.height.max() < 0.07


@pytest.mark.usefixtures("rendering")
@pytest.mark.parametrize("kind", [ValueError, RuntimeError])
def test_a_failing_policy_ends_the_episode_with_its_error(
    kind: type[Exception], monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
):
    def fail(_: Observation) -> PickPlaceAction:
        raise kind("weights of the wrong shape")

    scenario = install(fail, monkeypatch)
    result = build(scenario).run(seconds=1.0)
    assert result.failure == f"{kind.__name__}: weights of the wrong shape"
    # The log names the failing function.
    assert "in fail" in caplog.text
