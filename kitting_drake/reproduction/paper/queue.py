"""The queue of the paper's experiments: collects, trains and evaluates, cell by cell.

It runs the project's own commands one at a time. These resume unfinished work, so the queue can be
stopped and restarted at any time without repeating anything.
"""

from __future__ import annotations

import dataclasses
import json
import math
import signal
import subprocess
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from rich.console import Console

from kitting_drake.common.errors import DIVERGED, UserError
from kitting_drake.common.files import require_folder
from kitting_drake.common.paths import SCENARIOS
from kitting_drake.common.provenance import is_reproducible, uncommitted_note
from kitting_drake.reproduction.page.run_table import add_run, read_summaries, remove_runs
from kitting_drake.reproduction.paper.cell_results import check_cell, check_new_cell
from kitting_drake.reproduction.paper.cells import (
    LEARNING_RATES,
    TASKS,
    VALIDATE_EVERY,
    Cell,
    Task,
    Training,
    rates_key,
    reference,
)
from kitting_drake.reproduction.paper.learning_rates import best_rate, read_rates, write_rates

_PATIENCE = 60.0
"""The time that a terminated command has to exit, in s."""
_FIRST_SEED, _FIRST_VALIDATION_SEED = 10000, 20000
_BEFORE = {"angle_only": False}
"""The values of fields that the summaries of older trainings lack."""


class Failed(Exception):  # noqa: N818  A cell failed, not the queue.
    """Raised if a command of the project failed."""


@dataclass
class Queue:
    """Collects, trains and evaluates in one folder, and adds results to the table in another
    folder."""

    folder: Path
    results: Path
    """The folder with the table of runs (`run_table`) and the learning rates."""
    console: Console
    workers: int = 1
    """The number of episodes that run in parallel."""
    _wanted: dict[str, int] = field(default_factory=dict, init=False)
    """By task, the largest number of training demonstrations that a cell of this run needs."""
    _collected: set[Path] = field(default_factory=set, init=False)
    """The folders of demonstrations that have been checked."""
    _failed: dict[Path, str] = field(default_factory=dict, init=False)
    """The errors of commands that failed in this run, by folder. These commands are not tried
    again."""

    def run(self, cells: Sequence[Cell]) -> dict[str, str]:
        """Trains and evaluates cells in order, and adds their results to the table of runs.

        Returns:
            The reason for each cell that could not be filled, by name.

        Raises:
            UserError: a result does not fit its cell.
        """
        if note := uncommitted_note():
            self._say(f"note: {note}")
        pending = self.pending(cells)
        self._say(f"{len(cells) - len(pending)} of {len(cells)} cells are done")
        for cell in pending:
            for training in self._needed(cell.policy):
                most = max(training.demonstrations, self._wanted.get(training.task, 0))
                self._wanted[training.task] = most
        failures: dict[str, str] = {}
        for cell in pending:
            try:
                weights = self.train(cell.policy) if isinstance(cell.policy, Training) else None
                self._evaluate(cell, weights)
            except Failed as error:
                failures[cell.name] = str(error)
                self._say(f"{cell.name}: {error}")
        return failures

    def pending(self, cells: Sequence[Cell]) -> list[Cell]:
        """Returns the cells to run: those without a run in the table, and those whose run used code
        that cannot be checked out again.

        Raises:
            UserError: the table is damaged, or a run does not fit its cell.
        """
        done, rates = read_summaries(self.results), read_rates(self.results)
        for cell in cells:
            if cell.name in done:
                check_cell(cell, done[cell.name], rates)
        kept = {name for name, run in done.items() if is_reproducible(run.get("commit"))}
        return [cell for cell in cells if cell.name not in kept]

    def collect(self, task: Task, *, validation: bool) -> Path:
        """Collects the missing demonstrations of a task, for training or validation; returns their
        file."""
        count = task.validation if validation else self._wanted.get(task.name, task.demonstrations)
        folder = self.folder / "demonstrations" / f"{task.name}{'_validation' * validation}"
        if folder not in self._collected:
            # If all demonstrations exist, the command checks that they belong to this task.
            self._command(
                "collect",
                SCENARIOS / task.file,
                *("--scenario_name", task.demonstrated),
                *("--scenario_text", "{policy: !Oracle {}}"),
                *("--demos", count),
                *("--seed", _FIRST_VALIDATION_SEED if validation else _FIRST_SEED),
                *("--workers", self.workers),
                folder=folder,
            )
            self._collected.add(folder)
        return folder / "demonstrations.h5"

    def _needed(self, policy: Training | str) -> Iterator[Training]:
        """Yields the trainings that a policy needs: its own, that of its base, and the one that
        decides its learning rate."""
        if isinstance(policy, str):
            return
        yield policy
        if policy.base is not None:
            yield from self._needed(policy.base)
        if _is_rate_chosen(policy) and self._untried(reference(policy)):
            yield reference(policy)

    def train(self, training: Training) -> Path:
        """Trains, unless this was done before; returns the weights file."""
        rate = training.learning_rate or LEARNING_RATES[0]
        if _is_rate_chosen(training):
            rate = self._best_rate(reference(training))
        folder = self.folder / "trainings" / f"{training.name}_lr{rate:g}"
        if not (folder / "summary.json").exists():
            self._train(training, rate, folder)
        _check_training(training, folder)
        return folder / "policy.safetensors"

    def _train(self, training: Training, rate: float, folder: Path) -> None:
        task = TASKS[training.task]
        base = training.base
        start = () if base is None else ("--angle-only", "--from", self.train(base))
        self._command(
            "train",
            *("--demos", self.collect(task, validation=False)),
            *("--validation", self.collect(task, validation=True)),
            *("--demonstrations", training.demonstrations),
            *("--method", training.method),
            *("--preset", training.preset),
            *("--orientations", training.orientations),
            *(() if training.rotations is None else ("--rotations", training.rotations)),
            *("--steps", training.steps),
            *("--learning-rate", rate),
            "--decay",
            *(("--taken-only",) if training.taken_only else ()),
            *(("--rigid",) if training.rigid else ()),
            *("--validate-every", VALIDATE_EVERY),
            *start,
            *("--seed", training.seed),
            folder=folder,
        )

    def _best_rate(self, chosen_by: Training) -> float:
        """Returns the learning rate with the best validation result.

        `chosen_by` is a training that `reference` returned. It runs once with each learning rate.
        The result of each run is saved at once, so that no run is repeated.
        """
        for rate in self._untried(chosen_by):
            try:
                weights = self.train(dataclasses.replace(chosen_by, learning_rate=rate))
            except Failed as error:
                if DIVERGED not in str(error):
                    raise
                self._keep_rate(chosen_by, rate, math.inf)
                continue
            summary = json.loads(weights.with_name("summary.json").read_text())
            best = summary["best"]
            # Use the criterion by which the checkpoint was chosen.
            self._keep_rate(chosen_by, rate, best.get("loss", best["cost_mm"]))
        return float(best_rate(read_rates(self.results)[rates_key(chosen_by)]))

    def _untried(self, chosen_by: Training) -> list[float]:
        """Returns the learning rates with which `chosen_by` has not been trained yet."""
        tried = read_rates(self.results).get(rates_key(chosen_by), {})
        return [rate for rate in LEARNING_RATES if f"{rate:g}" not in tried]

    def _keep_rate(self, chosen_by: Training, rate: float, cost: float) -> None:
        known = read_rates(self.results)
        key = rates_key(chosen_by)
        write_rates(self.results, known | {key: known.get(key, {}) | {f"{rate:g}": cost}})

    def _evaluate(self, cell: Cell, weights: Path | None) -> None:
        task = TASKS[cell.task]
        folder = self.folder / "evaluations" / cell.name
        self._command(
            "evaluate",
            SCENARIOS / task.file,
            *("--scenario_name", task.tested),
            *("--scenario_text", cell.scenario_text(str(weights.resolve()) if weights else "")),
            *("--seed", cell.seeds[0]),
            *("--episodes", len(cell.seeds)),
            *("--workers", self.workers),
            folder=folder,
        )
        text = (folder / "summary.json").read_text()
        # Make the path of the weights relative, because results must not hold absolute paths.
        if weights is not None:
            name = str(weights.resolve().relative_to(self.folder.resolve()))
            text = text.replace(json.dumps(str(weights.resolve())), json.dumps(name))
        summary = json.loads(text)
        try:
            check_new_cell(cell, summary, read_rates(self.results))
        except UserError as error:
            raise Failed(f"{error} ({folder})") from error
        earlier = read_summaries(self.results).get(cell.name)
        if earlier is not None and not is_reproducible(earlier.get("commit")):
            remove_runs(self.results, [cell.name])
        add_run(self.results, cell.name, summary)
        rate = 100 * summary["strict_success_rate"]
        self._say(f"{cell.name}: {rate:.1f} % strict, {100 * summary['success_rate']:.1f} %")

    def _command(self, verb: str, *arguments: Any, folder: Path) -> None:
        """Runs a command of the project, with its output in a folder and a log beside the folder.

        Raises:
            Failed: the command failed, now or earlier in this run.
        """
        if folder in self._failed:
            raise Failed(self._failed[folder])
        command = [sys.executable, "-m", f"kitting_drake.{verb}", *map(str, arguments)]
        # Write the log beside the folder, because commands reject folders with other files.
        log_file = require_folder(folder.parent) / f"{folder.name}.log"
        with log_file.open("w") as log:
            process = subprocess.Popen(
                [*command, "--output", str(folder), "--quiet"],
                stdout=log,
                stderr=subprocess.STDOUT,
                text=True,
                # Ctrl-C must reach only the queue, which then terminates the command.
                start_new_session=True,
            )
            try:
                code = process.wait()
            finally:
                _end(process)
        if code:
            last = log_file.read_text().strip().splitlines()[-1:]
            self._failed[folder] = f"{verb} failed with exit code {code}: {' '.join(last)}"
            raise Failed(self._failed[folder])

    def _say(self, text: str) -> None:
        self.console.print(text, highlight=False, markup=False)


def _is_rate_chosen(training: Training) -> bool:
    """Whether a training uses the learning rate that is best for its `reference`."""
    return training.learning_rate is None and training.method != "so2"


def _check_training(training: Training, folder: Path) -> None:
    """Raises Failed if a folder holds another training, from an earlier version."""
    summary = json.loads((folder / "summary.json").read_text())
    for key, wanted in (
        ("method", training.method),
        ("preset", training.preset),
        ("orientations", training.orientations),
        ("rotations", training.rotations),
        ("demonstrations", training.demonstrations),
        ("steps", training.steps),
        ("seed", training.seed),
        ("angle_only", training.angle_only),
    ):
        found = summary.get(key, _BEFORE.get(key))
        if found != wanted:
            raise Failed(
                f"{folder} holds another training ({key} is {found}, not {wanted}): delete it"
            )


def _end(process: subprocess.Popen[str]) -> None:
    """Terminates a command, after giving it time to save its state."""
    if process.poll() is None:
        process.terminate()
        try:
            process.wait(_PATIENCE)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def run_paper(queue: Queue, cells: Sequence[Cell]) -> dict[str, str]:
    """Fills cells with `Queue.run`. If a signal stops the queue, the running command ends too.

    Returns:
        The reason for each cell that could not be filled, by name.

    Raises:
        UserError: a result does not fit its cell.
    """
    # Exit on these signals. The exit also ends the running command, which would otherwise keep its
    # folder locked against the next queue.
    ended_by = (signal.SIGTERM, signal.SIGHUP)
    before = [signal.signal(number, lambda came, _: sys.exit(128 + came)) for number in ended_by]
    try:
        return queue.run(cells)
    except (KeyboardInterrupt, SystemExit):
        queue.console.print(
            f"stopped: unfinished work is in {queue.folder}, finished cells are in "
            f"{queue.results}; run the same command again to continue",
            highlight=False,
            markup=False,
        )
        raise
    finally:
        for number, handler in zip(ended_by, before, strict=True):
            signal.signal(number, handler)
