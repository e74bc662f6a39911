"""An action that presses an object down, simulated in the station."""

import sys
import types
from pathlib import Path

import pytest
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context, EventStatus

from kitting_drake.scenario import Scenario
from kitting_drake.scenario.policies import PythonPolicy
from kitting_drake.tasks import ArrangedKitting
from kitting_drake.tasks.kitting.tool_poses import TablePose
from systems.pick_place_parameters import PickPlaceParameters
from systems.signals import PickPlaceAction, PlanarPose
from tests.kitting_drake.rig import build_rig


@pytest.mark.parametrize("force", [pytest.param(30.0, marks=pytest.mark.slow), 60.0])
@pytest.mark.usefixtures("rendering")
def test_a_press_stops_just_below_the_press_force(monkeypatch: pytest.MonkeyPatch, force: float):
    """The bounds allow for the impact at `touch_speed` and a delay of one planner period."""
    action = PickPlaceAction(pick=PlanarPose(0.42, 0.14), press=True)
    monkeypatch.setitem(sys.modules, "presser", types.SimpleNamespace(press=lambda _: action))
    scenario = Scenario(
        task=ArrangedKitting(tools={"claw_hammer": TablePose(x=0.42, y=0.14)}),
        policy=PythonPolicy(function="presser:press"),
        planner=PickPlaceParameters(press_force=force, max_actions=1),
        cameras={"front": Scenario().cameras["front"]},
    )
    rig = build_rig(scenario, seed=0, base=Path())
    peak = 0.0

    def watch(root: Context) -> EventStatus:
        nonlocal peak
        peak = max(peak, rig.port("wrist_force", root)[2])
        return EventStatus.DidNothing()

    simulator = Simulator(rig.diagram)
    simulator.set_monitor(watch)
    simulator.AdvanceTo(3.0)
    assert force - 5 < peak < force
