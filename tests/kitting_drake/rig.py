"""Stations for tests, each connected to its scenario's policy."""

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.framework import Context, Diagram

from kitting_drake.episode import EpisodeObserver, EpisodeResult, run_episode
from kitting_drake.scenario import Scenario
from kitting_drake.scenario.policies import DecisionObserver
from kitting_drake.station import KittingStation, build_station, with_policy
from kitting_drake.tasks.task import Scene
from systems.placement import PlacedObject


@dataclass(frozen=True)
class Rig:
    diagram: Diagram
    """The diagram of the station and the policy."""
    station: KittingStation

    @property
    def plant(self) -> MultibodyPlant:
        return self.station.plant

    @property
    def scene(self) -> Scene:
        return self.station.scene

    @property
    def objects(self) -> tuple[PlacedObject, ...]:
        return self.station.objects

    def port(self, name: str, root: Context | None = None) -> Any:
        """The value of the station's input port `action`, or of its output port `name`.

        Without `root`, the default context is used.
        """
        root = self.diagram.CreateDefaultContext() if root is None else root
        context = self.station.GetMyContextFromRoot(root)
        if name == "action":
            return self.station.GetInputPort(name).Eval(context)
        return self.station.GetOutputPort(name).Eval(context)

    def run(
        self, *observers: EpisodeObserver, seconds: float | None = None, name: str = "test"
    ) -> EpisodeResult:
        """Runs an episode of at most `seconds` of simulated time, or the scenario's time limit."""
        if seconds is not None:
            scenario = dataclasses.replace(self.station.scenario, time_limit=seconds)
            self.station.scenario = scenario
        return run_episode(
            self.diagram, self.station, scenario=name, policy=name, observers=observers
        )


def build_rig(
    scenario: Scenario,
    *,
    seed: int = 0,
    base: Path = Path(),
    observer: DecisionObserver | None = None,
) -> Rig:
    station = build_station(scenario, seed, base)
    return Rig(with_policy(station, observer), station)
