"""`python -m kitting_drake.collect SCENARIO.yaml`: collects demonstrations of the oracle."""

import contextlib
import dataclasses
import itertools
import json
import time
from collections import Counter
from collections.abc import Callable, Container, Iterable, Mapping, Sized
from pathlib import Path

from rich.console import Console

from kitting_drake.common.command_line import count_type, run_command, seed_type
from kitting_drake.common.errors import MachineError, UserError
from kitting_drake.common.files import (
    alone_in,
    claim_folder,
    files_digest,
    require_folder,
    write_json,
)
from kitting_drake.common.processes import (
    ProcessCrashed,
    Workers,
    counting_bar,
    side_by_side,
)
from kitting_drake.common.provenance import commit, versions
from kitting_drake.common.rendering import require_rendering
from kitting_drake.common.seeds import DEMONSTRATION_SEEDS, seeds_from
from kitting_drake.episode import EpisodeResult, ModeChange
from kitting_drake.episode.chosen import build_any_chosen, build_chosen, run_chosen
from kitting_drake.episode.episode_log import add_log_flag, log_of_many, log_of_seed
from kitting_drake.policies.data.demonstrations import (
    Demonstration,
    Origin,
    Rejection,
    merge_demonstrations,
    read_contents,
    write_demonstrations,
)
from kitting_drake.policies.data.lerobot_export import (
    export_lerobot,
    require_export,
    require_pyarrow,
)
from kitting_drake.policies.data.recorded import DemonstrationStep, FinalObservation
from kitting_drake.scenario.choosing import (
    ChosenScenario,
    choose_scenario,
    output_folder,
    scenario_parser,
)
from kitting_drake.scenario.policies import Oracle
from kitting_drake.scenario.workers import add_workers_flags, open_workers
from kitting_drake.station import KittingStation
from kitting_drake.station.hidden_table import hidden_table_note
from systems.signals import Observation, PickPlaceAction

LEAST_SCORE = 0.99
"""Demonstrations with a lower success rate are rejected."""

_MOST_REJECTED = 20
"""After this many rejected seeds in a row, collecting fails."""

Demonstrate = Callable[[int], Demonstration | Rejection | ProcessCrashed]
"""Makes the demonstration of a seed. Called in threads."""


def main() -> int:
    """Parses the command line and collects; returns the exit code."""
    parser = scenario_parser("collect", "Collect demonstrations of the oracle.")
    parser.add_argument(
        "--demos", type=count_type, default=100, help="number of demonstrations (100)"
    )
    add_workers_flags(parser)
    parser.add_argument(
        "--seed",
        type=seed_type,
        default=DEMONSTRATION_SEEDS.start,
        help=f"seed of the first episode ({DEMONSTRATION_SEEDS.start})",
    )
    parser.add_argument(
        "--export",
        choices=("lerobot",),
        help="also write them as a LeRobotDataset v3.0, to the folder lerobot in --output; if all "
        "demonstrations exist, only export",
    )
    add_log_flag(parser)
    arguments = parser.parse_args()
    log = log_of_many(arguments.log, arguments.ray)
    chosen = _by_oracle(choose_scenario(arguments))
    folder = require_folder(output_folder(arguments, f"{chosen.name}-demonstrations"))
    console = Console(quiet=arguments.quiet)
    if note := hidden_table_note(chosen.scenario):
        console.print(f"note: {note}", highlight=False, markup=False)
    start = time.perf_counter()
    with alone_in(folder):
        # Fail early, before claiming the folder.
        if not chosen.scenario.cameras:
            raise UserError(f"{chosen.path}: cameras is empty: collect needs at least one")
        require_rendering()
        build_any_chosen(chosen, seeds_from(arguments.seed))
        exported = folder / "lerobot" if arguments.export else None
        if exported:
            require_pyarrow()
        identity = {
            **chosen.described,
            "versions": versions(),
            # The user may import or annotate a tool again.
            "task_digest": files_digest(chosen.scenario.task.input_files(chosen.base)),
        }
        claim_folder(folder, "scenario.json", identity, of="scenario, tools or version")
        collection = Collection(folder, _origin(chosen, arguments.seed))
        if collection.assembled >= arguments.demos:
            nothing = "nothing to collect" if exported else "nothing to do"
            console.print(f"{nothing}: {collection.summary()}", highlight=False, soft_wrap=True)
        else:
            if exported:
                require_export(exported)
            with open_workers(arguments, chosen) as (workers, sent):
                collection.collect(
                    arguments.demos,
                    lambda seed: workers.run(_demonstrate, sent, seed, log),
                    workers=workers,
                    console=console,
                )
            seconds = time.perf_counter() - start
            told = f"{collection.summary()}; {seconds:.0f} s"
            console.print(told, highlight=False, markup=False, soft_wrap=True)
        if exported:
            with counting_bar(console, "exported") as progress:
                export_lerobot(collection.path, exported, track=progress.track)
            console.print(
                f"as a LeRobotDataset: {exported}/", highlight=False, markup=False, soft_wrap=True
            )
    return 0


class Collection:
    """A folder with the demonstrations of the first seeds that are not rejected.

    The result is independent of the number of workers and of interruptions. Unfinished collections
    keep a file per seed in `parts`; the end merges them into `demonstrations.h5`.
    """

    def __init__(self, folder: Path, origin: Origin) -> None:
        """Reads the files of earlier runs.

        Args:
            folder: the folder of the files.
            origin: the origin of the demonstrations.

        Raises:
            UserError: a file has another origin or is damaged.
        """
        self.path = folder / "demonstrations.h5"
        self._parts = folder / "parts"
        self._origin = origin
        self._accepted: dict[int, Path] = {}
        self._rejected: dict[int, Rejection] = {}
        self.assembled = 0
        """The number of demonstrations in `demonstrations.h5`."""
        for path in self._parts.glob(".*"):
            # Left by a killed process.
            path.unlink()
        for path in self._parts.glob("seed_*"):
            try:
                if path.suffix == ".h5":
                    self._accepted[int(path.stem.removeprefix("seed_"))] = path
                else:
                    rejection = Rejection(**json.loads(path.read_text()))
                    self._rejected[rejection.seed] = rejection
            except (OSError, ValueError, TypeError) as error:
                raise UserError(f"{path} is damaged: delete it") from error
        if self.path.exists():
            self._find_assembled()

    def _find_assembled(self) -> None:
        contents = read_contents(self.path)
        found = contents.origin
        if json.dumps(found.scenario) != json.dumps(self._origin.scenario):
            raise UserError(
                f"{self.path} belongs to another scenario: give another --output, or delete it"
            )
        if found.versions != self._origin.versions:
            raise UserError(
                f"{self.path} was written by {_listed(found.versions)}, but this is "
                f"{_listed(self._origin.versions)}: give another --output, or delete it"
            )
        if found.first_seed != self._origin.first_seed:
            raise UserError(
                f"{self.path} begins with seed {found.first_seed}: give --seed {found.first_seed} "
                "or another --output"
            )
        self.assembled = len(contents.seeds)
        self._accepted |= dict.fromkeys(contents.seeds, self.path)
        self._rejected |= {item.seed: item for item in contents.rejected}
        # A process killed after merging leaves its parts.
        self._remove_parts([*contents.seeds, *(item.seed for item in contents.rejected)])

    def collect(
        self, count: int, demonstrate: Demonstrate, *, workers: Workers, console: Console
    ) -> None:
        """Makes the missing demonstrations and merges all into `demonstrations.h5`.

        If a process dies, its seed is tried once more, as a process may be killed from outside.

        Args:
            count: the number of demonstrations wanted.
            demonstrate: makes a demonstration; called in threads.
            workers: determine the number of parallel calls.
            console: where to show the progress bar.

        Raises:
            UserError: no seeds are left, too many seeds in a row are rejected, or a process is
                killed twice.
        """
        seeds = seeds_from(self._origin.first_seed)
        working: set[int] = set()
        died: set[int] = set()

        def draw() -> int | None:
            seed = next_seed(seeds, count, self._accepted, self._rejected, working)
            if seed is not None:
                working.add(seed)
            return seed

        with counting_bar(console, "demonstrations") as progress:
            task = progress.add_task("", total=count, completed=min(count, len(self._accepted)))
            for seed, outcome in side_by_side(
                lambda seed: (seed, demonstrate(seed)), draw, workers=workers
            ):
                working.remove(seed)
                if not isinstance(outcome, ProcessCrashed):
                    self._keep(outcome)
                elif seed in died:
                    self._keep(_reject_dead(seed, outcome))
                died.add(seed)
                progress.update(task, completed=min(count, len(self._accepted)))
        done = (seed for seed in seeds if seed in self._accepted)
        self._assemble(list(itertools.islice(done, count)))

    def _keep(self, outcome: Demonstration | Rejection) -> None:
        path = self._parts / f"seed_{outcome.seed:08d}"
        if isinstance(outcome, Demonstration):
            path = path.with_suffix(".h5")
            write_demonstrations(path, self._origin, [outcome])
            self._accepted[outcome.seed] = path
        else:
            write_json(path.with_suffix(".json"), dataclasses.asdict(outcome))
            self._rejected[outcome.seed] = outcome

    def _assemble(self, seeds: list[int]) -> None:
        tried = range(self._origin.first_seed, seeds[-1])
        rejected = [item for seed, item in sorted(self._rejected.items()) if seed in tried]
        sources = [(self._accepted[seed], seed) for seed in seeds]
        merge_demonstrations(self.path, sources, self._origin, rejected)
        self._find_assembled()

    def _remove_parts(self, seeds: Iterable[int]) -> None:
        for seed in seeds:
            for ending in (".h5", ".json"):
                (self._parts / f"seed_{seed:08d}{ending}").unlink(missing_ok=True)
        with contextlib.suppress(OSError):
            # An earlier run may have asked for more demonstrations.
            self._parts.rmdir()

    def summary(self) -> str:
        """A sentence about the contents of `demonstrations.h5`."""
        contents = read_contents(self.path)
        megabytes = self.path.stat().st_size / 1e6
        several = ""
        if len(contents.commits) > 1:
            several = f"; made by several commits: {', '.join(c[:8] for c in contents.commits)}"
        return (
            f"{self.path} ({megabytes:.1f} MB) holds {_number(contents.seeds, 'demonstration')}, "
            f"{_number(contents.rejected, 'seed')} rejected{several}"
        )


def _listed(versions_: Mapping[str, str]) -> str:
    return ", ".join(f"{name} {version}" for name, version in versions_.items())


def _number(things: Sized, name: str) -> str:
    return f"{len(things)} {name}{'' if len(things) == 1 else 's'}"


def next_seed(
    seeds: range,
    count: int,
    accepted: Container[int],
    rejected: Container[int],
    working: Container[int],
) -> int | None:
    """The seed to try next.

    Demonstrations are wanted of the first `count` seeds that are not rejected.

    Args:
        seeds: the permitted seeds, in order.
        count: the number of demonstrations wanted.
        accepted: seeds with a demonstration.
        rejected: seeds without one.
        working: seeds in progress.

    Returns:
        The seed. None if there are already `count` seeds, accepted or in progress.

    Raises:
        UserError: no seed is left, or too many seeds in a row were rejected.
    """
    none_left = UserError(
        f"only seeds {seeds[0]} to {seeds[-1]} are available: give fewer --demos or another --seed"
    )
    if count > len(seeds):
        raise none_left
    hoped_for = in_a_row = 0
    for seed in seeds:
        if hoped_for == count:
            return None
        if seed in rejected:
            in_a_row += 1
            if in_a_row == _MOST_REJECTED:
                first = seed - _MOST_REJECTED + 1
                raise UserError(
                    f"the oracle failed on {_MOST_REJECTED} seeds in a row, {first} to {seed}: to "
                    f"find the cause, run python -m kitting_drake.run with --seed {seed}"
                )
        elif seed in accepted or seed in working:
            hoped_for += 1
            in_a_row = 0
        else:
            return seed
    if hoped_for < count:
        raise none_left
    return None


def _by_oracle(chosen: ChosenScenario) -> ChosenScenario:
    scenario = dataclasses.replace(chosen.scenario, policy=Oracle())
    return dataclasses.replace(chosen, scenario=scenario)


def _origin(chosen: ChosenScenario, first_seed: int) -> Origin:
    return Origin(
        scenario_name=chosen.name,
        scenario=chosen.described,
        grid=chosen.scenario.heightmap.grid(),
        learning=chosen.scenario.task.learning,
        first_seed=first_seed,
        versions=versions(),
    )


def _reject_dead(seed: int, dead: ProcessCrashed) -> Rejection:
    if dead.was_killed:
        raise dead.killed_twice(seed)
    return Rejection(seed, 0.0, f"its process ended with exit code {dead.exit_code}")


def _demonstrate(chosen: ChosenScenario, seed: int, log: Path | None) -> Demonstration | Rejection:
    # Without rendering, the station would have no cameras.
    require_rendering()
    try:
        diagram, station = build_chosen(chosen, seed=seed)
    except MachineError:
        raise
    except UserError as error:
        return Rejection(seed, 0.0, str(error))
    learning = chosen.scenario.task.learning
    recorder = DemonstrationRecorder(station, later_picks_possible=learning.later_picks_possible)
    file = None if log is None else log_of_seed(log, seed)
    result = run_chosen(chosen, diagram, station, observers=[recorder.observe], log=file)
    return recorder.demonstration(result)


class DemonstrationRecorder:
    """Records the observations and actions of an episode, as an `EpisodeObserver`."""

    def __init__(self, station: KittingStation, *, later_picks_possible: bool = False) -> None:
        """
        Args:
            station: a station with cameras and the oracle.
            later_picks_possible: see `Learning`. Episodes with two actions on one object are then
                rejected: the first action moves the object, so its later pick is a wrong label.
        """
        self._station = station
        self._later_picks_possible = later_picks_possible
        self._actions: list[tuple[Observation, PickPlaceAction]] = []
        self._final: FinalObservation | None = None

    def observe(self, event: ModeChange) -> None:
        """Records observation and action when an action begins, and the observation at the stop."""
        if event.is_last or not (event.is_action_start or event.is_stop):
            return
        observation = self._station.observation(event.root_context)
        if event.is_stop:
            self._final = FinalObservation.of(observation)
        else:
            action = self._station.proposed_action(event.root_context)
            self._actions.append((observation, action))

    def demonstration(self, result: EpisodeResult) -> Demonstration | Rejection:
        """The demonstration of a finished episode, without its failed actions, or a `Rejection`."""
        if result.failure or result.success_rate < LEAST_SCORE:
            reason = result.failure or f"the reward was {result.success_rate:.0%}"
            return Rejection(result.seed, result.success_rate, reason)
        taken = Counter(item.object for item in result.actions_taken)
        again = next((name for name, times in taken.items() if times > 1), None)
        if self._later_picks_possible and again is not None:
            return Rejection(result.seed, result.success_rate, f"{again} needed a second action")
        steps = tuple(
            DemonstrationStep.of(observation, action, name=item.object, category=item.category)
            for (observation, action), item in zip(self._actions, result.actions_taken, strict=True)
            if item.outcome == "placed"
        )
        if not steps:
            return Rejection(result.seed, result.success_rate, "no action was needed")
        # All goals are met, so the final observation shows a finished task.
        return Demonstration(result.seed, result.success_rate, steps, self._final, commit())


if __name__ == "__main__":
    run_command(main)
