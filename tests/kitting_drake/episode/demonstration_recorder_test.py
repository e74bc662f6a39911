"""Tests of `DemonstrationRecorder`."""

import dataclasses
import itertools
import sys
import types

import numpy as np
import pytest
from pydrake.systems.framework import Context

from kitting_drake.episode import EpisodeObserver, EpisodeResult, ModeChange
from kitting_drake.episode.demonstration_recorder import DemonstrationRecorder
from kitting_drake.policies.data.demonstrations import Demonstration, Rejection
from kitting_drake.policies.data.recorded import DemonstrationStep
from kitting_drake.scenario import Scenario
from kitting_drake.scenario.cameras import Pinhole
from kitting_drake.scenario.policies import PythonPolicy
from kitting_drake.tasks import ArrangedKitting
from kitting_drake.tasks.kitting.tool_poses import TablePose
from kitting_drake.tasks.task import ActionRecord
from systems.pick_place_parameters import Mode, PickPlaceParameters
from systems.signals import Observation, PickPlaceAction, PlanarPose
from tests.kitting_drake.rig import Rig, build_rig

pytestmark = pytest.mark.usefixtures("rendering")

SMALL = {
    name: dataclasses.replace(camera, width=160, height=120, focal_length=112.5)
    for name, camera in Scenario().cameras.items()
    if isinstance(camera, Pinhole)
}
# After so short a wait the tools are still settling, so observations differ between steps.
HASTY = PickPlaceParameters(observe_settle=0.02)


def rig_of(*tools: str, **more: object) -> Rig:
    poses = [TablePose(x=0.42, y=0.14), TablePose(x=0.60, y=0.3, yaw_deg=20.0)]
    task = ArrangedKitting(tools=dict(zip(tools, poses, strict=False)))
    scenario = Scenario(task=task, cameras=SMALL, **more)  # type: ignore[arg-type]
    return build_rig(scenario, seed=3)


def run(rig: Rig, seconds: float, *observers: EpisodeObserver) -> EpisodeResult:
    return rig.run(*observers, seconds=seconds)


def assert_shows(step: DemonstrationStep, observation: Observation) -> None:
    expected = DemonstrationStep.of(observation, PickPlaceAction(), name="")
    np.testing.assert_array_equal(step.image, expected.image)


def test_records_observations_actions_and_the_final_observation():
    rig = rig_of("combination_wrench", planner=HASTY)
    recorder = DemonstrationRecorder(rig.station)
    latched: list[tuple[PlanarPose, PlanarPose]] = []

    def latch(event: ModeChange) -> None:
        action = rig.station.accepted_action(event.root_context)
        latched.append((action.pick, action.place))

    result = run(rig, 30.0, recorder.observe, latch)
    made = recorder.demonstration(result)
    assert isinstance(made, Demonstration)
    assert (made.seed, made.score) == (3, 1.0)
    (step,) = made.steps
    assert (step.object, step.category) == ("combination_wrench", "wrench")
    assert (step.pick, step.place) == latched[0]
    # The wrench is at the pick in the first observation, but not in the final one.
    assert made.final is not None
    row, col = np.round(Scenario().heightmap.grid().to_pixel([step.pick.x, step.pick.y]))
    here = np.s_[int(row) - 3 : int(row) + 4, int(col) - 3 : int(col) + 4]
    assert step.height[here].max() > 0.005
    assert made.final.height[here].max() < 0.003


def test_records_the_policys_observation(monkeypatch: pytest.MonkeyPatch):
    action = PickPlaceAction(PlanarPose(0.35, 0.3, 0.1), PlanarPose(0.5, 0.0, 0.2))
    seen: list[Observation] = []

    def look(observation: Observation) -> PickPlaceAction:
        seen.append(observation)
        return action

    monkeypatch.setitem(sys.modules, "looking", types.SimpleNamespace(look=look))
    rig = rig_of("claw_hammer", planner=HASTY, policy=PythonPolicy(function="looking:look"))
    recorder = DemonstrationRecorder(rig.station)
    result = run(rig, 0.1, recorder.observe)
    made = recorder.demonstration(as_success(result, "placed"))
    assert isinstance(made, Demonstration)
    (step,) = made.steps
    assert_shows(step, seen[0])
    assert step.height.max() > 0.04
    assert (step.pick, step.place) == (action.pick, action.place)
    assert made.final is None  # This recorder did not see the end of the episode.


def as_success(result: EpisodeResult, *outcomes: str) -> EpisodeResult:
    """A successful episode with the given actions."""
    actions = [
        ActionRecord(
            f"object_{number}", "any", outcome, PlanarPose(), PlanarPose(), None, None, None, None
        )
        for number, outcome in enumerate(outcomes)
    ]
    return dataclasses.replace(result, success_rate=1.0, failure=None, actions_taken=actions)


def test_failed_actions_are_omitted():
    """Of four simulated actions the first two fail; the demonstration has the other two only."""
    rig = rig_of("claw_hammer", "flat_screwdriver")
    recorder = DemonstrationRecorder(rig.station)
    root: Context = rig.diagram.CreateDefaultContext()
    context = rig.plant.GetMyMutableContextFromRoot(root)
    seen: list[Observation] = []

    def tell(previous: Mode, mode: Mode, *, is_last: bool = False) -> None:
        recorder.observe(ModeChange(previous, mode, root, is_last))

    def act() -> None:
        seen.append(rig.port("observation", root))
        modes = [Mode.OBSERVE, Mode.APPROACH, Mode.DESCEND, Mode.RETREAT, Mode.OBSERVE]
        for previous, mode in itertools.pairwise(modes):
            tell(previous, mode)

    def put_at_goal(index: int) -> None:
        (X_WGoal,) = rig.scene.goals[index].poses
        body = rig.plant.get_body(rig.objects[index].body)
        rig.plant.SetFreeBodyPose(context, body, X_WGoal)

    act()
    act()
    act()
    put_at_goal(0)
    act()
    put_at_goal(1)
    left = rig.port("observation", root)
    tell(Mode.OBSERVE, Mode.DONE)
    tell(Mode.DONE, Mode.DONE, is_last=True)
    nothing = run(rig, 0.01)
    result = as_success(nothing, "missed", "dropped", "placed", "placed")
    made = recorder.demonstration(result)
    assert isinstance(made, Demonstration)
    assert [step.object for step in made.steps] == ["object_2", "object_3"]
    for step, observation in zip(made.steps, seen[2:], strict=True):
        assert_shows(step, observation)
    assert (made.steps[0].image != made.steps[1].image).any()
    assert made.final is not None
    np.testing.assert_array_equal(made.final.height, left.height)
    # Failures and episodes without full success are rejected.
    less = dataclasses.replace(result, success_rate=0.5)
    assert recorder.demonstration(less) == Rejection(3, 0.5, "the reward was 50%")
    failed = dataclasses.replace(result, success_rate=0.0, failure="the solver", actions_taken=[])
    assert recorder.demonstration(failed) == Rejection(3, 0.0, "the solver")
    # With `later_picks_possible`, a demonstration with two actions on one object is rejected.
    first, *others, last = result.actions_taken
    twice = [first, *others, dataclasses.replace(last, object=first.object)]
    again = dataclasses.replace(result, actions_taken=twice)
    assert isinstance(recorder.demonstration(again), Demonstration)
    labelling = DemonstrationRecorder(rig.station, later_picks_possible=True)
    assert labelling.demonstration(again) == Rejection(3, 1.0, "object_0 needed a second action")
    aside = as_success(nothing, "missed", "missed", "missed", "missed")
    assert recorder.demonstration(aside) == Rejection(3, 1.0, "no action was needed")
