"""The cell and the episode of a scenario that a command line names."""

import itertools
from collections.abc import Iterable, Sequence
from pathlib import Path

from pydrake.geometry import Meshcat

from kitting_drake.common.errors import MachineError, UserError
from kitting_drake.episode.episode import EpisodeResult, run_episode
from kitting_drake.episode.events import EpisodeObserver
from kitting_drake.scenario.choosing import ChosenScenario
from kitting_drake.scenario.policies import DecisionObserver
from kitting_drake.station import Cell, build_cell

_TRIED = 5
"""How many seeds tell whether a scenario can be built at all."""


def build_chosen(
    chosen: ChosenScenario,
    *,
    seed: int,
    meshcat: Meshcat | None = None,
    picture: bool = False,
    video: Path | None = None,
    observer: DecisionObserver | None = None,
) -> Cell:
    """`build_cell` for a scenario of the command line.

    Raises:
        UserError: as `build_cell`, with the file's name.
    """
    try:
        return build_cell(
            chosen.scenario,
            seed=seed,
            base=chosen.base,
            meshcat=meshcat,
            picture=picture,
            video=video,
            observer=observer,
        )
    except UserError as error:
        raise type(error)(f"{chosen.path}: {error}") from error


def build_any_chosen(chosen: ChosenScenario, seeds: Iterable[int]) -> Cell:
    """The cell of the first of a few seeds with which it can be built: what a scene draws may not
    fit with some of them, and is then that seed's own failure.

    Raises:
        MachineError: it cannot be built on this machine.
        UserError: it can be built with none of the first seeds; that of the first of all.
    """
    errors = []
    for seed in itertools.islice(seeds, _TRIED):
        try:
            return build_chosen(chosen, seed=seed)
        except MachineError:
            raise
        except UserError as error:
            errors.append(error)
    raise errors[0]


def run_chosen(
    chosen: ChosenScenario,
    cell: Cell,
    *,
    seed: int,
    realtime_rate: float = 0.0,
    observers: Sequence[EpisodeObserver] = (),
) -> EpisodeResult:
    """`run_episode` for a scenario of the command line, in a cell fresh from `build_chosen`."""
    return run_episode(
        cell,
        task=chosen.scenario.task,
        scenario=chosen.name,
        policy=chosen.policy,
        seed=seed,
        time_limit=chosen.scenario.time_limit,
        end_at_success=chosen.scenario.end_at_success,
        realtime_rate=realtime_rate,
        observers=observers,
    )
