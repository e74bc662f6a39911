"""The station and the episode of a scenario that a command line names."""

import itertools
from collections.abc import Iterable, Sequence
from pathlib import Path

from pydrake.systems.framework import Diagram

from kitting_drake.common.errors import MachineError, UserError
from kitting_drake.episode.episode import EpisodeResult, run_episode
from kitting_drake.episode.episode_log import EpisodeLog
from kitting_drake.episode.events import EpisodeObserver
from kitting_drake.scenario.choosing import ChosenScenario
from kitting_drake.station import KittingStation, build_station, with_policy

_TRIED = 5
"""How many seeds tell whether a scenario can be built at all."""


def build_chosen(chosen: ChosenScenario, *, seed: int) -> tuple[Diagram, KittingStation]:
    """The station of a scenario of the command line, and the Diagram of it and its policy.

    Raises:
        UserError: as `build_station` and `make_policy`, with the file's name.
    """
    with chosen.named_in_errors():
        station = build_station(chosen.scenario, seed, chosen.base)
        return with_policy(station), station


def build_any_chosen(chosen: ChosenScenario, seeds: Iterable[int]) -> KittingStation:
    """The station of the first of a few seeds with which it can be built.

    What a scene draws may not fit with some seeds: that is then the failure of that seed alone.

    Raises:
        MachineError: it cannot be built on this machine.
        UserError: it can be built with none of the first seeds; that of the first of all.
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
) -> EpisodeResult:
    """`run_episode` for a scenario of the command line, in a Diagram fresh from `build_chosen`; a
    log goes to a file, if one is named."""
    episode_log = None if log is None else EpisodeLog(station)
    result = run_episode(
        diagram,
        station,
        scenario=chosen.name,
        policy=chosen.policy,
        realtime_rate=realtime_rate,
        observers=observers,
        log=episode_log,
    )
    if episode_log is not None and log is not None:
        episode_log.save(log)
    return result
