"""A training run: its settings, steps, and the files from which it resumes."""

import dataclasses
import io
import json
import pickle
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from torch.utils.tensorboard import SummaryWriter

from kitting_drake.common.command_line import interrupts_wait
from kitting_drake.common.errors import DIVERGED, UserError
from kitting_drake.common.files import (
    append_line,
    read_lines,
    write_atomically,
    write_json,
)
from kitting_drake.policies.data.images import LabelledImage
from kitting_drake.policies.data.training_data import TrainingData, evenly_chosen
from kitting_drake.policies.learned_policy import LearnedPolicy
from kitting_drake.policies.networks.architecture import NetworkConfig
from kitting_drake.policies.networks.device import preferred_type
from kitting_drake.policies.networks.factored import Networks
from kitting_drake.policies.networks.methods import make_networks
from kitting_drake.policies.networks.weights import load_trainable, save_weights
from kitting_drake.policies.training.normalisation import normalisation
from kitting_drake.policies.training.training_step import Trainer
from kitting_drake.policies.training.validation import mean_loss, validate

WEIGHTS = "policy.safetensors"
"""The file of the best weights, in the folder of a training run."""
_CHECKPOINT_EVERY = 100
"""The number of steps between checkpoints, and between points of the logged curves."""
_MOST_VALIDATED = 64
"""The largest number of scenes, and of final observations, in a validation."""
_MOST_NORMALISED = 512
"""The largest number of scenes from which the normalisation is computed."""
_DAMAGED = (
    OSError,
    EOFError,
    RuntimeError,
    KeyError,
    TypeError,
    ValueError,
    pickle.UnpicklingError,
)
"""The exceptions that reading a damaged checkpoint may raise."""


@dataclass(frozen=True)
class Settings:
    """The settings that distinguish one training run from another."""

    scenario: str
    demonstrations: int
    """The number of demonstrations or static scenes for training."""
    demonstration_seeds: tuple[int, ...]
    validation_seeds: tuple[int, ...]
    method: str
    preset: str
    orientations: int
    rotations: int | None
    """The number of crop rotations in a training step, see `Networks.rotations`."""
    steps: int
    batch: int
    learning_rate: float
    decay: bool
    taken_only: bool
    """Whether observations are labelled only with the action that the expert took, and not with
    later picks."""
    rigid: bool
    """Whether curvature augmentation is off."""
    reflection: bool
    """Whether half of the samples are reflected."""
    colour: bool
    """Whether the networks see colours."""
    stop: bool
    """Whether the networks learn to stop from final observations."""
    validate_every: int
    seed: int
    angle_only: bool
    """Whether only the pick-angle network is trained, from untrained weights."""
    start: str | None
    """A digest of the weights from which training starts; None for untrained weights."""
    start_seeds: tuple[int, ...]
    """All demonstration seeds of the starting weights (see `card_seeds`)."""
    start_learned: dict[str, list[int]]
    """For each scenario, the seeds on which the starting weights were trained (see
    `learned_seeds`)."""
    device: str
    compute_type: str


def _initial_networks(settings: Settings, learned: TrainingData, start: Path | None) -> Networks:
    """Makes the networks with which the training begins. They have the weights of the file `start`;
    if `start` is None, they are untrained."""
    torch.manual_seed(settings.seed)
    try:
        if start is not None:
            if settings.angle_only:
                return load_trainable(start, settings.orientations, settings.preset)
            return load_trainable(start)
        config = NetworkConfig(
            method=settings.method,
            preset=settings.preset,
            orientations=settings.orientations,
            colour=settings.colour,
            stop=settings.stop,
            **normalisation(learned.scenes(_MOST_NORMALISED)),  # type: ignore[arg-type]
        )
        networks = make_networks(config)
        networks.check_orientations(settings.orientations)
    except ValueError as error:
        raise UserError(f"--orientations {settings.orientations}: {error}") from error
    return networks


class TrainingRun:
    """A training run and its files."""

    def __init__(
        self,
        settings: Settings,
        learned: TrainingData,
        held_out: TrainingData,
        folder: Path,
        console: Console,
        start: Path | None = None,
    ) -> None:
        """
        Args:
            settings: the settings of the run.
            learned: the training data.
            held_out: the validation data, by which the best weights are chosen.
            folder: the folder of the run's files.
            console: where to show progress.
            start: the file of the weights from which to start; None for untrained weights.

        Raises:
            UserError: the settings do not fit the networks, or the weights are unusable.
        """
        self.settings, self.folder, self.console = settings, folder, console
        self._log = folder / "log.jsonl"
        self.grid = learned.grid
        self.samples = learned.samples(taken_only=settings.taken_only, colour=settings.colour)
        self.finals = learned.finals(colour=settings.colour)
        self.validation_scenes = held_out.scenes(_MOST_VALIDATED)
        self.validation_finals = held_out.finals(_MOST_VALIDATED)
        self._judged: Sequence[LabelledImage] = ()
        if held_out.learning.many_answers:
            samples = held_out.samples(taken_only=True, colour=settings.colour)
            chosen = evenly_chosen(list(range(len(samples))), _MOST_VALIDATED)
            self._judged = [samples[index] for index in chosen]
        networks = _initial_networks(settings, learned, start)
        networks.to(settings.device)
        networks.compute_type = preferred_type()
        networks.rotations = settings.rotations
        self.trainer = Trainer(
            networks,
            seed=settings.seed,
            steps=settings.steps,
            batch=settings.batch,
            learning_rate=settings.learning_rate,
            decay=settings.decay,
            curvature=not settings.rigid,
            reflection=settings.reflection,
            only="pick_angle" if settings.angle_only else None,
        )
        self.best: dict[str, Any] | None = None
        self.seconds = 0.0
        self.recent: list[dict[str, float]] = []
        """The losses of each step since the last point of the logged curves."""
        self.card = {
            **dataclasses.asdict(settings),
            "samples": len(self.samples),
            "final_observations": len(self.finals),
            "resolution": self.grid.resolution,
            "torch": torch.__version__,
        }

    def train(self) -> None:
        """Trains to the last step, resuming from a checkpoint if there is one."""
        self._resume()
        trainer, settings = self.trainer, self.settings
        if trainer.step_count >= settings.steps:
            self._summarise()
            self.console.print("all steps are done")
            return
        self._introduce()
        progress = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("{task.fields[speed]}"),
            TimeRemainingColumn(),
            console=self.console,
            transient=True,
            disable=not self.console.is_terminal,
        )
        start, begun = time.perf_counter() - self.seconds, trainer.step_count
        clock = time.perf_counter()
        writer = SummaryWriter(str(self.folder / "tensorboard"), purge_step=begun + 1)
        with writer, progress, interrupts_wait() as interrupted:
            task = progress.add_task("steps", total=settings.steps, completed=begun, speed="")
            while trainer.step_count < settings.steps:
                self._step()
                step = trainer.step_count
                last = step == settings.steps
                speed = (step - begun) / (time.perf_counter() - clock)
                progress.update(task, completed=step, speed=f"{speed:.2f} steps/s")
                if step % settings.validate_every == 0 or last:
                    report = self._validate(writer)
                    progress.print(_report_line(step, report), highlight=False)
                if step % _CHECKPOINT_EVERY == 0 or last:
                    self._log_losses(writer)
                if interrupted() or step % _CHECKPOINT_EVERY == 0 or last:
                    self.seconds = time.perf_counter() - start
                    self._save()
                if interrupted() and not last:
                    progress.print(f"stopped after step {step}: run the same command to resume")
                    raise KeyboardInterrupt
        self._summarise()

    def _introduce(self) -> None:
        size = sum(weight.numel() for weight in self.trainer.networks.parameters())
        finals = f" and {len(self.finals)} final observations" if self.settings.stop else ""
        self.console.print(
            f"{self.settings.method}, {self.settings.preset}: {size:,} parameters; "
            f"{len(self.samples)} samples{finals} of {self.settings.demonstrations} "
            f"demonstrations; {len(self.validation_scenes)} scenes for validation",
            highlight=False,
        )

    def _step(self) -> None:
        losses = self.trainer.step(self.samples, self.finals)
        self.recent.append(losses)
        if not all(np.isfinite(list(losses.values()))):
            raise UserError(f"{DIVERGED} at step {self.trainer.step_count}: lower --learning-rate")

    def _log_losses(self, writer: SummaryWriter) -> None:
        """Logs the mean of each loss since the last point of the curves."""
        step = self.trainer.step_count
        names = {name: None for losses in self.recent for name in losses}
        means = {
            name: float(np.mean([losses[name] for losses in self.recent if name in losses]))
            for name in names
        }
        self.recent.clear()
        for name, value in means.items():
            writer.add_scalar(f"loss/{name}", value, step)
        append_line(self._log, {"step": step, **means})

    def _summarise(self) -> None:
        summary = {**self.card, "best": self.best, "wall_seconds": self.seconds}
        write_json(self.folder / "summary.json", summary)

    def _validate(self, writer: SummaryWriter) -> dict[str, float]:
        networks, step = self.trainer.networks.eval(), self.trainer.step_count
        policy = LearnedPolicy(networks, orientations=self.settings.orientations)
        report = validate(policy, self.validation_scenes, self.validation_finals)
        if self._judged:
            report["loss"] = mean_loss(networks, self._judged)
        chosen = {"step": step, **report}
        criterion = "loss" if self._judged else "cost_mm"
        if self.best is None or report[criterion] < self.best[criterion]:
            self.best = chosen
            threshold = report.get("stop_threshold")
            card = {**self.card, "validation": chosen, "stop_threshold": threshold}
            save_weights(self.folder / WEIGHTS, networks, card)
        append_line(self._log, chosen)
        for name, value in report.items():
            writer.add_scalar(f"validation/{name}", value, step)
        return report

    def _resume(self) -> None:
        path = self.folder / "checkpoint.pt"
        if not path.exists():
            self._log.unlink(missing_ok=True)
            return
        try:
            state = torch.load(path, map_location=self.trainer.networks.device, weights_only=True)
            self.trainer.load_state_dict(state["trainer"])
            self.best, self.seconds, self.recent = (
                state[key] for key in ("best", "seconds", "recent")
            )
        except _DAMAGED as error:
            raise UserError(
                f"cannot resume from {path}, which is damaged: delete {self.folder} to start afresh"
            ) from error
        kept = [line for line in read_lines(self._log) if line["step"] <= self.trainer.step_count]
        write_atomically(self._log, "".join(json.dumps(line) + "\n" for line in kept))

    def _save(self) -> None:
        buffer = io.BytesIO()
        state = {
            "trainer": self.trainer.state_dict(),
            "best": self.best,
            "seconds": self.seconds,
            "recent": self.recent,
        }
        torch.save(state, buffer)
        write_atomically(self.folder / "checkpoint.pt", buffer.getvalue())


def _report_line(step: int, report: dict[str, float]) -> str:
    stops = ""
    if "stop_threshold" in report:
        stops = f"; {report['false_stops']:.0f} false and {report['missed_stops']:.0f} missed stops"
    loss = f"; loss {report['loss']:.2f}" if "loss" in report else ""
    return (
        f"step {step}: median errors of the pick {report['median_pick_mm']:.1f} mm, "
        f"{report['median_pick_deg']:.2f} deg, of the place {report['median_place_mm']:.1f} mm, "
        f"{report['median_rotation_deg']:.2f} deg; "
        f"mean displacement {report['displacement_mm']:.2f} mm{stops}{loss}"
    )
