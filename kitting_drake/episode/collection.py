"""A resumable collection of demonstrations."""

import contextlib
import dataclasses
import itertools
import json
from collections.abc import Callable, Container, Iterable, Mapping, Sized
from pathlib import Path

from rich.console import Console

from kitting_drake.common.errors import UserError
from kitting_drake.common.files import write_json
from kitting_drake.common.processes import (
    ProcessCrashed,
    Workers,
    counting_bar,
    side_by_side,
)
from kitting_drake.common.seeds import seeds_from
from kitting_drake.policies.data.demonstrations import (
    Demonstration,
    Origin,
    Rejection,
    merge_demonstrations,
    read_contents,
    write_demonstrations,
)

_MOST_REJECTED = 20
"""If this many seeds in a row are rejected, the collection fails."""

Demonstrate = Callable[[int], Demonstration | Rejection | ProcessCrashed]
"""A function that makes the demonstration of a seed. It is called in threads."""


class Collection:
    """A folder with the demonstrations of the first seeds that are not rejected.

    The result does not depend on the number of workers or on interruptions. An unfinished
    collection has one file for each seed in `parts`. These files are merged into
    `demonstrations.h5` at the end.
    """

    def __init__(self, folder: Path, origin: Origin) -> None:
        """Reads the files of earlier runs.

        Args:
            folder: the folder of the files.
            origin: the scenario and the versions that make the demonstrations.

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
            # This file is left over from a killed process.
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
                f"{self.path} belongs to another scenario: delete it, or give another --output"
            )
        if found.versions != self._origin.versions:
            raise UserError(
                f"{self.path} was written by {_listed(found.versions)}, but this is "
                f"{_listed(self._origin.versions)}: delete the file, or give another --output"
            )
        if found.first_seed != self._origin.first_seed:
            raise UserError(
                f"{self.path} begins with seed {found.first_seed}: give --seed {found.first_seed} "
                "or another --output"
            )
        self.assembled = len(contents.seeds)
        self._accepted |= dict.fromkeys(contents.seeds, self.path)
        self._rejected |= {item.seed: item for item in contents.rejected}
        # Parts remain if an earlier process was killed after merging them.
        self._remove_parts([*contents.seeds, *(item.seed for item in contents.rejected)])

    def collect(
        self, count: int, demonstrate: Demonstrate, *, workers: Workers, console: Console
    ) -> None:
        """Makes the missing demonstrations and merges all into `demonstrations.h5`.

        If a process dies, its seed is tried once more, because the process may have been killed
        from outside.

        Args:
            count: the number of demonstrations wanted.
            demonstrate: makes a demonstration; it is called in threads.
            workers: the workers, whose capacity determines the number of parallel calls.
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
            # Parts may remain from an earlier run that asked for more demonstrations.
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
    """Chooses the seed to try next.

    The collection should hold demonstrations of the first `count` seeds that are not rejected.

    Args:
        seeds: the permitted seeds, in order.
        count: the number of demonstrations wanted.
        accepted: seeds that have a demonstration.
        rejected: seeds whose demonstration was rejected.
        working: seeds in progress.

    Returns:
        The seed; None if `count` seeds are already accepted or in progress.

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


def _reject_dead(seed: int, dead: ProcessCrashed) -> Rejection:
    if dead.was_killed:
        raise dead.killed_twice(seed)
    return Rejection(seed, 0.0, f"its process ended with exit code {dead.exit_code}")
