from pathlib import Path

import numpy as np
import pytest
from pydrake.common.value import Value
from rich.console import Console

from kitting_drake.common.errors import UserError
from kitting_drake.common.rendering import can_render
from kitting_drake.reproduction.benchmarks import recovery_benchmark as recovery
from kitting_drake.reproduction.benchmarks.recovery_benchmark import (
    ActionOffset,
    Disturbance,
    benchmark_recovery,
    recovery_table,
)
from kitting_drake.scenario.choosing import ChosenScenario
from kitting_drake.scenario.policies import Oracle, PythonPolicy, ShapeMatching
from kitting_drake.scenario.schema import Scenario
from kitting_drake.tasks import Kitting
from systems.signals import Observation, PickPlaceAction, PlanarPose


def test_an_offset_shifts_an_action_until_it_is_stopped():
    system = ActionOffset(np.array([0.01, 0.02, -0.03, 0.04]))
    context = system.CreateDefaultContext()
    action = PickPlaceAction(pick=PlanarPose(0.1, 0.2, 0.3), place=PlanarPose(0.4, 0.5, 0.6))
    system.GetInputPort("action").FixValue(context, Value(action))
    shifted = system.GetOutputPort("action").Eval(context)
    assert shifted.pick == PlanarPose(pytest.approx(0.11), pytest.approx(0.22), 0.3)
    assert shifted.place == PlanarPose(pytest.approx(0.37), pytest.approx(0.54), 0.6)
    system.stop(context)
    assert system.GetOutputPort("action").Eval(context) == action


def chosen(scenario: Scenario) -> ChosenScenario:
    return ChosenScenario(scenario, Path("mine.yaml"), "mine", text=None)


def test_a_scenario_without_cameras_is_rejected():
    with pytest.raises(UserError, match=r"mine\.yaml: cameras is empty"):
        benchmark_recovery(chosen(Scenario(cameras={})), 1, 0, Console(quiet=True))


@pytest.mark.skipif(not can_render(), reason="images cannot be rendered here")
def test_failed_and_timed_out_episodes_are_counted_without_kitted_objects():
    task = Kitting(tools=["combination_wrench"])
    broken = PythonPolicy(function=f"{__name__}:raise_always")
    for policy, limit, key in [(broken, 30.0, "failed"), (Oracle(), 1.0, "timed_out")]:
        scenario = Scenario(task=task, policy=policy, time_limit=limit)
        count = recovery._Count()
        assert recovery._run(chosen(scenario), Disturbance.NONE, 0, count) is None
        assert (getattr(count, key), count.kitted, count.objects) == (1, 0, 1)


def raise_always(observation: Observation) -> PickPlaceAction:
    raise ValueError("no idea")


@pytest.mark.slow
@pytest.mark.skipif(not can_render(), reason="images cannot be rendered here")
def test_a_recovering_policy_recovers_and_leaves_kitted_objects_alone():
    scenario = Scenario(
        task=Kitting(tools=["claw_hammer", "combination_wrench"], tries=3),
        policy=ShapeMatching(recover=True),
    )
    measured, strips = benchmark_recovery(chosen(scenario), 2, 0, Console(quiet=True))
    assert strips.startswith(b"\x89PNG")
    for name, count in measured["disturbances"].items():
        assert count["touched"] == 0, name
        assert count["recovered"] == count["disturbed"], name
        assert count["disturbed"] == (0 if name == "nothing" else 2)
        assert count["failed"] == count["timed_out"] == 0
    # A missed grasp costs another action.
    actions = {name: count["actions"] for name, count in measured["disturbances"].items()}
    assert actions["grasp off by 40 mm"] > actions["nothing"] == 4
    assert recovery_table(measured).row_count == 4
