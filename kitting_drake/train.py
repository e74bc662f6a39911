"""`python -m kitting_drake.train --demos FILE`: trains networks from demonstrations; no Drake."""

import argparse
import dataclasses
import hashlib
import io
import json
import pickle
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from torch.utils.tensorboard import SummaryWriter

from kitting_drake.common.command_line import count_type, interrupts_wait, run_command, seed_type
from kitting_drake.common.errors import UserError
from kitting_drake.common.files import (
    alone_in,
    append_line,
    claim_folder,
    read_lines,
    require_folder,
    write_atomically,
    write_json,
)
from kitting_drake.policies.config import METHODS, PRESETS, NetworkConfig
from kitting_drake.policies.learned_policy import LearnedPolicy
from kitting_drake.policies.methods import make_networks
from kitting_drake.policies.networks import Networks
from kitting_drake.policies.samples import normalisation
from kitting_drake.policies.training import Trainer
from kitting_drake.policies.training_data import TrainingData, read_training_data
from kitting_drake.policies.validation import validate
from kitting_drake.policies.weights import (
    load_trainable,
    preferred_device,
    preferred_type,
    read_weights_file,
    save_weights,
)

WEIGHTS = "policy.safetensors"
"""The best weights, in the folder of a training run."""
_CHECKPOINT_EVERY = 100
"""Steps between checkpoints, and between points of the curves."""
_MOST_VALIDATED = 64
"""The most scenes, and the most final observations, that a validation uses."""
_MOST_NORMALISED = 512
"""The most scenes whose images tell by what inputs are normalised."""
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
    """The number of demonstrations, or of static scenes, that are learned from."""
    demonstration_seeds: tuple[int, ...]
    validation_seeds: tuple[int, ...]
    method: str
    preset: str
    orientations: int
    steps: int
    learning_rate: float
    decay: bool
    taken_only: bool
    """Whether later picks of a demonstration are no labels of its earlier observations."""
    rigid: bool
    """Whether there is no curvature augmentation."""
    reflection: bool
    """Whether half of the samples are mirror images."""
    colour: bool
    """Whether the networks see colours."""
    stop: bool
    """Whether the networks learn from final observations that there is nothing left to pick."""
    validate_every: int
    seed: int
    start: str | None
    """A digest of the weights that training begins with; None: fresh ones."""
    device: str
    compute_type: str


def main() -> int:
    """Parses the command line and trains; returns the exit code."""
    arguments = _parse()
    console = Console(quiet=arguments.quiet)
    if arguments.demos is None:
        _export(arguments, arguments.weights or arguments.output / WEIGHTS, console)
        return 0
    learned, held_out = _split(arguments.demos, arguments.demonstrations, arguments.validation)
    settings = _settings(arguments, learned, held_out)
    folder = require_folder(
        arguments.output or Path("output") / f"{learned.scenario}-training".replace(" ", "_")
    )
    run = _Run(settings, learned, held_out, folder, console, arguments.start)
    with alone_in(folder):
        # Scenarios of one name may differ, and with them what the same seeds give.
        origins = [item.origin for item in (learned, held_out)]
        described = {**dataclasses.asdict(settings), "origins": origins}
        claim_folder(folder, "settings.json", described, of="training run")
        run.train()
    if arguments.export:
        _export(arguments, folder / WEIGHTS, console)
    console.print(f"files: {folder}/", highlight=False)
    return 0


def _export(arguments: argparse.Namespace, weights: Path, console: Console) -> None:
    """Writes weights in another format, to the folder `onnx` beside them, or in --output."""
    # Who exports nothing does not wait for it.
    from kitting_drake.policies.onnx_export import export_onnx

    folder = (arguments.output or weights.parent) / "onnx"
    with console.status(f"exporting {weights.name}"):
        export_onnx(weights, folder)
    console.print(f"networks as ONNX: {folder}/", highlight=False)


def _settings(
    arguments: argparse.Namespace, learned: TrainingData, held_out: TrainingData
) -> Settings:
    assumed = learned.learning
    begun = None if arguments.start is None else _checked_start(arguments, learned)
    return Settings(
        scenario=learned.scenario,
        demonstrations=learned.count,
        demonstration_seeds=learned.seeds,
        validation_seeds=held_out.seeds,
        method=arguments.method,
        preset=arguments.preset,
        orientations=arguments.orientations,
        steps=arguments.steps,
        learning_rate=arguments.learning_rate,
        decay=arguments.decay,
        taken_only=arguments.taken_only or not assumed.later_picks_possible,
        # The Transporter rotates whole images: it has no crop in which an object can be bent.
        rigid=arguments.rigid or not assumed.curvature or arguments.method == "transporter",
        reflection=assumed.reflection and not arguments.rigid,
        colour=learned.colour if begun is None else begun.colour,
        stop=bool(learned.finals(1)) if begun is None else begun.stop,
        validate_every=arguments.validate_every,
        seed=arguments.seed,
        start=None if begun is None else _digest(arguments.start),
        device=preferred_device().type,
        compute_type=str(preferred_type()).removeprefix("torch."),
    )


def _checked_start(arguments: argparse.Namespace, learned: TrainingData) -> NetworkConfig:
    """The config of the weights to begin with, which must be those that the flags ask for."""
    config = read_weights_file(arguments.start).config
    for flag in ("method", "preset", "orientations"):
        given, found = getattr(arguments, flag), getattr(config, flag)
        if given != found:
            raise UserError(f"{arguments.start} has {flag} {found}: give --{flag} {found}")
    if config.colour and not learned.colour:
        raise UserError(f"{arguments.start} looks at colours, and {arguments.demos} has none")
    return config


def _digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def _parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="python -m kitting_drake.train",
        description="Train a policy's networks from demonstrations. Run again, it resumes.",
    )
    parser.add_argument(
        "--demos",
        type=Path,
        metavar="FILE.h5",
        help="what to learn from: what collect or draw_scenes wrote",
    )
    parser.add_argument(
        "--demonstrations",
        type=count_type,
        metavar="N",
        help="learn from the first N (all, but for those to validate by)",
    )
    parser.add_argument(
        "--validation",
        type=Path,
        metavar="FILE.h5",
        help="demonstrations to choose a checkpoint by (default: those of --demos that come after "
        "the ones learned from, a tenth as many)",
    )
    parser.add_argument(
        "--from",
        dest="start",
        type=Path,
        metavar="FILE.safetensors",
        help="weights to begin with, such as models/policies/generalist.safetensors (default: "
        "fresh ones)",
    )
    parser.add_argument("--method", choices=METHODS, default="so2")
    parser.add_argument("--preset", choices=PRESETS, default="small", help="size of the networks")
    parser.add_argument("--orientations", type=count_type, default=180, metavar="N")
    parser.add_argument("--steps", type=count_type, default=10_000, help="(10000)")
    parser.add_argument("--learning-rate", type=_rate_type, default=1e-4, help="Adam's (1e-4)")
    parser.add_argument(
        "--decay", action="store_true", help="let the learning rate fall to zero over the steps"
    )
    parser.add_argument(
        "--taken-only",
        action="store_true",
        help="as in the paper: label each observation with what was picked then, not also with "
        "what was picked later (always so where the task does not allow it)",
    )
    parser.add_argument(
        "--rigid",
        action="store_true",
        help="as in the paper: augment by motions of the whole scene only, not by curvature (never "
        "with transporter) and reflection (neither where the task does not allow it)",
    )
    parser.add_argument(
        "--validate-every", type=count_type, default=500, metavar="STEPS", help="(500)"
    )
    parser.add_argument("--seed", type=seed_type, default=0, help="of weights and draws (0)")
    parser.add_argument("--output", type=Path, metavar="DIR", help="where all files go")
    parser.add_argument(
        "--export",
        choices=("onnx",),
        help="also write the networks for other programs, to the folder onnx in --output; without "
        "--demos those trained in --output before, or of --weights, without training",
    )
    parser.add_argument(
        "--weights", type=Path, metavar="FILE", help="what to export, without --demos"
    )
    parser.add_argument("--quiet", action="store_true", help="print nothing but errors")
    arguments = parser.parse_args()
    if arguments.demos is None and not arguments.export:
        parser.error("--demos says what to learn from")
    if arguments.demos is None and not (arguments.weights or arguments.output):
        parser.error("--export needs --demos to train first, or --output or --weights to export")
    if arguments.weights and (arguments.demos or not arguments.export):
        parser.error("--weights is for --export without --demos")
    return arguments


def _rate_type(text: str) -> float:
    try:
        rate = float(text)
    except ValueError:
        rate = -1.0
    if not 0 < rate < 1:
        raise argparse.ArgumentTypeError(f"'{text}' is not a number between 0 and 1")
    return rate


def _split(
    path: Path, count: int | None, validation: Path | None
) -> tuple[TrainingData, TrainingData]:
    """The data to learn from, and those to validate by."""
    everything = read_training_data(path)
    total = everything.count
    if count is None:
        count = total if validation else total - max(1, total // 11)
    if total < count:
        raise UserError(f"{path} holds {total} demonstrations, not {count}: collect more")
    learned = everything.part(0, count)
    if validation is None:
        kept = everything.part(count, count + max(1, count // 10))
        if not kept.count or not count:
            raise UserError(
                f"of {total} in {path}, {count} to learn from leave none to validate by: "
                "collect more, or give --validation"
            )
        return learned, kept
    held_out = read_training_data(validation)
    shared = learned.shares_scenes(held_out)
    if shared is not None:
        raise UserError(
            f"{validation} and {path} share the seed {shared}: validation needs other ones"
        )
    if held_out.grid != everything.grid:
        raise UserError(f"{validation} and {path} have different pixel grids")
    return learned, held_out


def _fresh(settings: Settings, learned: TrainingData) -> Networks:
    """Networks with fresh weights."""
    try:
        config = NetworkConfig(
            method=settings.method,
            preset=settings.preset,
            orientations=settings.orientations,
            colour=settings.colour,
            stop=settings.stop,
            **normalisation(learned.scenes(_MOST_NORMALISED)),  # type: ignore[arg-type]
        )
        torch.manual_seed(settings.seed)
        networks = make_networks(config)
        networks.check_orientations(settings.orientations)
    except ValueError as error:
        raise UserError(f"--orientations {settings.orientations}: {error}") from error
    return networks


class _Run:
    """A training run and its files."""

    def __init__(
        self,
        settings: Settings,
        learned: TrainingData,
        held_out: TrainingData,
        folder: Path,
        console: Console,
        start: Path | None,
    ) -> None:
        self.settings, self.folder, self.console = settings, folder, console
        self._log = folder / "log.jsonl"
        self.grid = learned.grid
        self.samples = learned.samples(taken_only=settings.taken_only)
        self.finals = learned.finals()
        self.validation_scenes = held_out.scenes(_MOST_VALIDATED)
        self.validation_finals = held_out.finals(_MOST_VALIDATED)
        networks = _fresh(settings, learned) if start is None else load_trainable(start)
        networks.to(settings.device)
        networks.compute_type = preferred_type()
        self.trainer = Trainer(
            networks,
            seed=settings.seed,
            steps=settings.steps,
            learning_rate=settings.learning_rate,
            decay=settings.decay,
            curvature=not settings.rigid,
            reflection=settings.reflection,
        )
        self.best: dict[str, Any] | None = None
        self.seconds = 0.0
        self.recent: list[dict[str, float]] = []
        """The losses since the last point of the curves."""
        self.card = {
            **dataclasses.asdict(settings),
            "samples": len(self.samples),
            "final_observations": len(self.finals),
            "resolution": self.grid.resolution,
            "torch": torch.__version__,
        }

    def train(self) -> None:
        """Trains to the last step, from the checkpoint if there is one."""
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
                progress.update(task, completed=step, speed=f"{speed:.2f} a second")
                if step % settings.validate_every == 0 or last:
                    report = self._validate(writer)
                    progress.print(_report_line(step, report), highlight=False)
                if step % _CHECKPOINT_EVERY == 0 or last:
                    self._log_losses(writer)
                if interrupted() or step % _CHECKPOINT_EVERY == 0 or last:
                    self.seconds = time.perf_counter() - start
                    self._save()
                if interrupted() and not last:
                    progress.print(f"stopped after step {step}: the same command goes on there")
                    raise KeyboardInterrupt
        self._summarise()

    def _introduce(self) -> None:
        size = sum(weight.numel() for weight in self.trainer.networks.parameters())
        finals = f" and {len(self.finals)} final observations" if self.settings.stop else ""
        self.console.print(
            f"{self.settings.method}, {self.settings.preset}: {size:,} parameters; "
            f"{len(self.samples)} samples{finals} of {self.settings.demonstrations} "
            f"demonstrations; {len(self.validation_scenes)} scenes to validate by",
            highlight=False,
        )

    def _step(self) -> None:
        losses = self.trainer.step(self.samples, self.finals)
        self.recent.append(losses)
        if not all(np.isfinite(list(losses.values()))):
            raise UserError(
                f"a loss is no longer a number at step {self.trainer.step_count}: "
                "lower --learning-rate"
            )

    def _log_losses(self, writer: SummaryWriter) -> None:
        """The mean of each loss since the last point of the curves, over the steps that have it."""
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
        chosen = {"step": step, **report}
        if self.best is None or report["cost_mm"] < self.best["cost_mm"]:
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
            raise UserError(f"{path} cannot be taken up again: delete {self.folder}") from error
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
    return (
        f"step {step}: median errors of the pick {report['median_pick_mm']:.1f} mm, "
        f"{report['median_pick_deg']:.2f} deg, of the place {report['median_place_mm']:.1f} mm, "
        f"{report['median_rotation_deg']:.2f} deg; "
        f"mean displacement {report['displacement_mm']:.2f} mm{stops}"
    )


if __name__ == "__main__":
    run_command(main)
