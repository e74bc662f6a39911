"""Builds and runs the scenario chosen on a command line."""

import itertools
from collections.abc import Iterable, Sequence
from pathlib import Path

from pydrake.systems.framework import Context, Diagram

from kitting_drake.common.errors import MachineError, UserError
from kitting_drake.episode.episode import EpisodeResult, run_episode
from kitting_drake.episode.episode_log import EpisodeLog
from kitting_drake.episode.events import EpisodeObserver, Sampler
from kitting_drake.scenario.choosing import ChosenScenario
from kitting_drake.station import KittingStation, build_station, with_policy

_TRIED = 5
"""A scenario counts as invalid if no valid scene is found with this many seeds."""


def build_chosen(chosen: ChosenScenario, *, seed: int) -> tuple[Diagram, KittingStation]:
    """Builds a Diagram of the chosen scenario's station and policy; returns it and the station.

    Raises:
        UserError: station or policy cannot be made (see `build_station` and `make_policy`). The
            message names the scenario's file.
    """
    with chosen.named_in_errors():
        station = build_station(chosen.scenario, seed, chosen.base)
        return with_policy(station), station


def build_any_chosen(chosen: ChosenScenario, seeds: Iterable[int]) -> KittingStation:
    """Builds the station with the first of a few seeds that gives a valid scene.

    A random scene may be invalid for some seeds, which does not make the scenario invalid.

    Raises:
        MachineError: this machine cannot build the station.
        UserError: none of the seeds works. The error is that of the first seed.
    """
    errors = []
    for seed in itertools.islice(seeds, _TRIED):
        try:
            return build_chosen(chosen, seed=seed)[1]
        except MachineError:
            raise
        except UserError as error:
            errors.append(error)
    raise errors[0]


def run_chosen(
    chosen: ChosenScenario,
    diagram: Diagram,
    station: KittingStation,
    *,
    realtime_rate: float = 0.0,
    observers: Sequence[EpisodeObserver] = (),
    log: Path | None = None,
    sampler: Sampler | None = None,
) -> EpisodeResult:
    """Calls `run_episode` with a new Diagram from `build_chosen`. Writes a log to the file `log`,
    if given, and calls `sampler` after every step."""
    episode_log = None if log is None else EpisodeLog(station)
    both = [item for item in (episode_log, sampler) if item is not None]
    result = run_episode(
        diagram,
        station,
        scenario=chosen.name,
        policy=chosen.policy,
        realtime_rate=realtime_rate,
        observers=observers,
        log=_Samplers(both) if both else None,
    )
    if episode_log is not None and log is not None:
        episode_log.save(log)
    return result


class _Samplers:
    """Combines several samplers into one."""

    def __init__(self, samplers: Sequence[Sampler]) -> None:
        self._samplers = samplers

    def sample(self, root_context: Context) -> None:
        for sampler in self._samplers:
            sampler.sample(root_context)
