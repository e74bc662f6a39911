"""The queue of the paper's experiments: collects, trains and evaluates, cell by cell.

Everything is done by the project's own commands, which take up what they left; so the queue itself
may be stopped and begun again at any time, and does nothing twice.
"""

from __future__ import annotations

import dataclasses
import json
import math
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from rich.console import Console

from kitting_drake.common.errors import DIVERGED, UserError
from kitting_drake.common.files import require_folder, write_atomically
from kitting_drake.common.paths import SCENARIOS
from kitting_drake.reproduction.paper.cells import (
    LEARNING_RATES,
    PRESET,
    TASKS,
    VALIDATE_EVERY,
    Cell,
    Task,
    Training,
    rates_key,
    reference,
)
from kitting_drake.reproduction.paper.learning_rates import (
    RATES,
    best_rate,
    read_rates,
    write_rates,
)

_THREADS = "OMP_NUM_THREADS"
_PATIENCE = 60.0
"""How long a command may take to end itself, in s."""
_FIRST_SEED, _FIRST_VALIDATION_SEED = 10000, 20000


@dataclass
class Failed(Exception):  # noqa: N818  A cell failed, not the queue.
    """One of the project's commands failed."""

    why: str


@dataclass
class Queue:
    """Collects, trains and evaluates in one folder, and puts results into another."""

    folder: Path
    results: Path
    console: Console
    workers: int = 1
    """Episodes side by side, beside the trainings."""
    trainings: int = 1
    """Trainings side by side."""
    _running: list[subprocess.Popen[str]] = field(default_factory=list, init=False)
    _wanted: dict[str, int] = field(default_factory=dict, init=False)
    """The most demonstrations of each task that a training of this run learns from."""
    _collected: set[Path] = field(default_factory=set, init=False)
    """The folders of demonstrations that were looked at."""
    _locks: dict[Path, threading.Lock] = field(default_factory=dict, init=False)
    """A lock for each folder that several trainings need and only one of them is to make."""
    _has_ended: bool = field(default=False, init=False)
    _guard: threading.Lock = field(default_factory=threading.Lock, init=False)
    """Guards the fields above."""

    def run(self, cells: Sequence[Cell]) -> dict[str, str]:
        """Fills cells, in their order as far as their networks are there.

        Trainings are begun in the order in which cells need them; evaluations are done one after
        another, beside them.

        Returns:
            For each cell that could not be filled, by its name, why.
        """
        pending = [cell for cell in cells if not self.is_done(cell)]
        self._say(f"{len(cells) - len(pending)} of {len(cells)} cells are done")
        failures: dict[str, str] = {}
        with ThreadPoolExecutor(max_workers=self.trainings) as trainer:
            needed = dict.fromkeys(
                training
                for cell in pending
                if isinstance(cell.policy, Training)
                for training in (*self._before(cell.policy), cell.policy)
            )
            for training in needed:
                most = max(training.demonstrations, self._wanted.get(training.task, 0))
                self._wanted[training.task] = most
            # What is trained already need not wait behind what is not.
            trained: dict[Any, Future[Path]] = {
                training: trainer.submit(self.train, training)
                for training in sorted(needed, key=lambda training: not self._is_trained(training))
            }
            try:
                while pending:
                    cell = self._next(pending, trained)
                    pending.remove(cell)
                    try:
                        weights = trained[cell.policy].result() if cell.policy in trained else None
                        self._evaluate(cell, weights)
                    except Failed as error:
                        failures[cell.name] = error.why
                        self._say(f"{cell.name}: {error.why}")
            except BaseException:
                # The trainings' own processes would otherwise be waited for.
                trainer.shutdown(wait=False, cancel_futures=True)
                with self._guard:
                    self._has_ended = True
                    running = list(self._running)
                for process in running:
                    _end(process)
                raise
        return failures

    def is_done(self, cell: Cell) -> bool:
        """Whether there is a result of a cell.

        Raises:
            UserError: there is one that is not this cell's.
        """
        path = self.results / f"{cell.name}.json"
        if not path.exists():
            return False
        try:
            departure = cell.departure(json.loads(path.read_text()), read_rates(self.results))
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise UserError(f"{path} is no summary of evaluate: delete it") from error
        if departure is not None:
            raise UserError(f"{path} is not that of its cell ({departure}): delete it")
        return True

    @staticmethod
    def _next(pending: Sequence[Cell], trained: Mapping[Any, Future[Path]]) -> Cell:
        """The first cell that need not wait; waits until there is one."""
        while True:
            for cell in pending:
                if cell.policy not in trained or trained[cell.policy].done():
                    return cell
            wait([trained[cell.policy] for cell in pending], return_when=FIRST_COMPLETED)

    def collect(self, task: Task, *, validation: bool) -> Path:
        """The file of a task's demonstrations, as many as this run needs, or of those to validate
        by."""
        count = task.validation if validation else self._wanted.get(task.name, task.demonstrations)
        folder = self.folder / "demonstrations" / f"{task.name}{'_validation' * validation}"
        with self._only_one_makes(folder):
            if folder not in self._collected:
                # Where all are there, it checks whether they are those of this task.
                self._command(
                    "collect",
                    SCENARIOS / task.file,
                    *("--scenario_name", task.demonstrated),
                    *("--scenario_text", "{policy: !Oracle {}}"),
                    *("--demos", count),
                    *("--seed", _FIRST_VALIDATION_SEED if validation else _FIRST_SEED),
                    *("--workers", 1),
                    folder=folder,
                )
                self._collected.add(folder)
        return folder / "demonstrations.h5"

    def _only_one_makes(self, path: Path) -> threading.Lock:
        with self._guard:
            return self._locks.setdefault(path, threading.Lock())

    def _before(self, training: Training) -> Iterator[Training]:
        """The trainings before a training: its base, and those of every learning rate.

        Each is begun by itself, as a training that waits for several would train them in turn.
        """
        if training.base is not None:
            yield from (*self._before(training.base), training.base)
        elif training.method != "so2" and training.learning_rate is None:
            chosen_by = reference(training)
            for rate in self._untried(chosen_by):
                yield dataclasses.replace(chosen_by, learning_rate=rate)

    def _is_trained(self, training: Training) -> bool:
        """Whether there are its networks, at its own learning rate."""
        if self._is_rate_chosen(training) and self._untried(reference(training)):
            return False
        return (self._folder(training, self._rate(training)) / "summary.json").exists()

    def _rate(self, training: Training) -> float:
        """The learning rate of a training, which for a baseline may have to be found first."""
        if self._is_rate_chosen(training):
            return self._best_rate(reference(training))
        return training.learning_rate or LEARNING_RATES[0]

    def _is_rate_chosen(self, training: Training) -> bool:
        """Whether its learning rate is the best one of `reference`."""
        return training.learning_rate is None and training.method != "so2"

    def _folder(self, training: Training, rate: float) -> Path:
        return self.folder / "trainings" / f"{training.name}_lr{rate:g}"

    def train(self, training: Training) -> Path:
        """The file of the weights of a training."""
        rate = self._rate(training)
        folder = self._folder(training, rate)
        with self._only_one_makes(folder):
            if not (folder / "summary.json").exists():
                self._train(training, rate, folder)
        self._check_training(training, folder)
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
            *("--preset", PRESET),
            *("--orientations", training.orientations),
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

    @staticmethod
    def _check_training(training: Training, folder: Path) -> None:
        """Raises Failed if what was trained in a folder, by an earlier version, is another."""
        summary = json.loads((folder / "summary.json").read_text())
        for key, wanted in (
            ("method", training.method),
            ("preset", PRESET),
            ("orientations", training.orientations),
            ("demonstrations", training.demonstrations),
            ("steps", training.steps),
            ("seed", training.seed),
            ("angle_only", training.angle_only),
        ):
            found = summary.get(key, False)
            if found != wanted:
                raise Failed(f"{folder}: its {key} is {found}, not {wanted}: delete it")

    def _best_rate(self, chosen_by: Training) -> float:
        """The learning rate at which a training of `reference` does best on validation scenes.

        What each comes to is written as soon as it is known, and not tried again.
        """
        for rate in self._untried(chosen_by):
            try:
                weights = self.train(dataclasses.replace(chosen_by, learning_rate=rate))
            except Failed as error:
                if DIVERGED not in error.why:
                    raise
                self._keep_rate(chosen_by, rate, math.inf)
                continue
            summary = json.loads(weights.with_name("summary.json").read_text())
            best = summary["best"]
            # The one of the two by which the checkpoint was chosen.
            self._keep_rate(chosen_by, rate, best.get("loss", best["cost_mm"]))
        return float(best_rate(read_rates(self.results)[rates_key(chosen_by)]))

    def _untried(self, chosen_by: Training) -> list[float]:
        """The learning rates of which it is not known what a training of `reference` comes to."""
        tried = read_rates(self.results).get(rates_key(chosen_by), {})
        return [rate for rate in LEARNING_RATES if f"{rate:g}" not in tried]

    def _keep_rate(self, chosen_by: Training, rate: float, cost: float) -> None:
        file = self.results / RATES
        with self._only_one_makes(file):
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
        # The results say nothing of where they were made.
        if weights is not None:
            name = str(weights.resolve().relative_to(self.folder.resolve()))
            text = text.replace(json.dumps(str(weights.resolve())), json.dumps(name))
        summary = json.loads(text)
        departure = cell.departure(summary, read_rates(self.results))
        if departure is not None:
            raise Failed(f"what was evaluated is not the cell: {departure}")
        write_atomically(self.results / f"{cell.name}.json", text)
        rate = 100 * summary["strict_success_rate"]
        self._say(f"{cell.name}: {rate:.1f} % strict, {100 * summary['success_rate']:.1f} %")

    def _command(self, verb: str, *arguments: Any, folder: Path) -> None:
        """Runs a command of the project with its output in a folder, and a log there.

        Raises:
            Failed: it failed.
        """
        command = [sys.executable, "-m", f"kitting_drake.{verb}", *map(str, arguments)]
        # Beside the folder: the command takes none that holds anything else.
        log_file = require_folder(folder.parent) / f"{folder.name}.log"
        with log_file.open("w") as log:
            with self._guard:
                if self._has_ended:
                    raise Failed("the queue was ended")
                process = subprocess.Popen(
                    [*command, "--output", str(folder), "--quiet"],
                    stdout=log,
                    stderr=subprocess.STDOUT,
                    text=True,
                    env={_THREADS: str(self._threads()), **os.environ},
                    # Ctrl-C is for the queue, which ends it.
                    start_new_session=True,
                )
                self._running.append(process)
            try:
                code = process.wait()
            finally:
                _end(process)
                self._running.remove(process)
        if code:
            last = log_file.read_text().strip().splitlines()[-1:]
            raise Failed(f"{verb} failed with exit code {code}: {' '.join(last)}")

    def _threads(self) -> int:
        """The threads of each command: its share of the cores."""
        return max(1, len(os.sched_getaffinity(0)) // (self.trainings + self.workers))

    def _say(self, text: str) -> None:
        self.console.print(text, highlight=False, markup=False)


def _end(process: subprocess.Popen[str]) -> None:
    """Ends a command: a training saves what it has before."""
    if process.poll() is None:
        process.terminate()
        try:
            process.wait(_PATIENCE)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def run_paper(queue: Queue, cells: Sequence[Cell]) -> dict[str, str]:
    """Fills cells, as `Queue.run` does, and ends what it began when it is ended itself.

    Returns:
        For each cell that could not be filled, by its name, why.

    Raises:
        UserError: a result is not that of its cell.
    """
    # What goes on would keep the next queue out.
    ended_by = (signal.SIGTERM, signal.SIGHUP)
    before = [signal.signal(number, lambda came, _: sys.exit(128 + came)) for number in ended_by]
    try:
        return queue.run(cells)
    finally:
        for number, handler in zip(ended_by, before, strict=True):
            signal.signal(number, handler)
