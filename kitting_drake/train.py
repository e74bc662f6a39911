"""`python -m kitting_drake.train --demos FILE`: trains networks, without Drake."""

import argparse
import dataclasses
import hashlib
import math
import re
from pathlib import Path

from rich.console import Console

from kitting_drake.common.command_line import count_type, run_command, seed_type
from kitting_drake.common.errors import UserError
from kitting_drake.common.files import (
    alone_in,
    claim_folder,
    require_folder,
)
from kitting_drake.policies.data.training_data import TrainingData, read_training_data
from kitting_drake.policies.networks.architecture import METHODS, PRESETS, NetworkConfig
from kitting_drake.policies.networks.device import preferred_device, preferred_type
from kitting_drake.policies.networks.weights import card_seeds, learned_seeds, read_weights_file
from kitting_drake.policies.training.training_run import WEIGHTS, Settings, TrainingRun


def main() -> int:
    """Parses the command line and trains; returns the exit code."""
    arguments = _parse()
    console = Console(quiet=arguments.quiet)
    if arguments.demos is None:
        _export(arguments, arguments.weights or arguments.output / WEIGHTS, console)
        return 0
    learned, held_out = _split(arguments.demos, arguments.demonstrations, arguments.validation)
    _require_picks(learned, arguments.demos, "for training")
    settings = _settings(arguments, learned, held_out)
    _check_validation(settings, held_out, arguments.validation or arguments.demos)
    if arguments.export:
        # Fail before the training starts if the packages for the export are missing.
        from kitting_drake.policies.training.onnx_export import require_onnx

        require_onnx()
    folder = require_folder(
        arguments.output or Path("output") / re.sub(r"[ /]", "_", f"{learned.scenario}-training")
    )
    run = TrainingRun(settings, learned, held_out, folder, console, arguments.start)
    with alone_in(folder):
        # Compare the contents, because the same seeds give other data in a changed scenario of the
        # same name.
        origins = [item.origin for item in (learned, held_out)]
        made_by = [item.made_by for item in (learned, held_out)]
        described = {**dataclasses.asdict(settings), "origins": origins, "made_by": made_by}
        claim_folder(folder, "settings.json", described, of="training run")
        run.train()
    if arguments.export:
        _export(arguments, folder / WEIGHTS, console)
    console.print(f"files: {folder}/", highlight=False, markup=False)
    return 0


def _export(arguments: argparse.Namespace, weights: Path, console: Console) -> None:
    """Writes weights as ONNX to the folder `onnx` in --output, or by default beside the weights."""
    # Import ONNX lazily.
    from kitting_drake.policies.training.onnx_export import export_onnx

    folder = (arguments.output or weights.parent) / "onnx"
    with console.status(f"exporting {weights.name}"):
        export_onnx(weights, folder)
    console.print(f"networks as ONNX: {folder}/", highlight=False, markup=False)


def _settings(
    arguments: argparse.Namespace, learned: TrainingData, held_out: TrainingData
) -> Settings:
    assumed = learned.learning
    if arguments.taken_only and not learned.has_taken:
        raise UserError(
            f"--taken-only needs demonstrations, but {arguments.demos} has static scenes, in "
            "which no object was picked"
        )
    begun: NetworkConfig | None = None
    seeds: tuple[int, ...] = ()
    before: dict[str, list[int]] = {}
    if arguments.start is not None:
        begun, seeds, before = _checked_start(arguments, learned, held_out)
    return Settings(
        scenario=learned.scenario,
        demonstrations=learned.count,
        demonstration_seeds=learned.seeds,
        validation_seeds=held_out.seeds,
        method=arguments.method,
        preset=arguments.preset,
        orientations=arguments.orientations,
        rotations=arguments.rotations,
        steps=arguments.steps,
        batch=arguments.batch,
        learning_rate=arguments.learning_rate,
        decay=arguments.decay,
        taken_only=arguments.taken_only or not assumed.later_picks_possible,
        # Curvature augmentation bends crops, so it does not suit the Transporter, which rotates
        # whole images.
        rigid=arguments.rigid or not assumed.curvature or arguments.method == "transporter",
        reflection=assumed.reflection and not arguments.rigid,
        colour=learned.colour if begun is None else begun.colour,
        stop=bool(learned.finals(1)) if begun is None else begun.stop,
        validate_every=arguments.validate_every,
        seed=arguments.seed,
        angle_only=arguments.angle_only,
        start=None if begun is None else _digest(arguments.start),
        start_seeds=seeds,
        start_learned=before,
        device=preferred_device().type,
        compute_type=str(preferred_type()).removeprefix("torch."),
    )


def _checked_start(
    arguments: argparse.Namespace, learned: TrainingData, held_out: TrainingData
) -> tuple[NetworkConfig, tuple[int, ...], dict[str, list[int]]]:
    """Checks the weights of --from against the flags and the data.

    Returns:
        The weights' network configuration, the seeds of their training and validation data, and the
        seeds of their training data by scenario.

    Raises:
        UserError: the weights do not match, or were trained on a seed of the validation data.
    """
    file = read_weights_file(arguments.start)
    config = file.config
    before = learned_seeds(file.card)
    shared = set(before.get(held_out.scenario, ())) & set(held_out.seeds)
    if shared:
        raise UserError(
            f"{arguments.start} was trained on seed {min(shared)}, which is in the validation "
            "data: give other validation data with --validation"
        )
    fixed = ["method", "preset", "orientations"]
    if arguments.angle_only:
        # --angle-only trains a new pick-angle network, whose N and size may differ from those of
        # --from.
        fixed = ["method"] if config.has_unets_of(arguments.preset) else ["method", "preset"]
    for flag in fixed:
        given, found = getattr(arguments, flag), getattr(config, flag)
        if given != found:
            raise UserError(f"{arguments.start} has {flag} {found}: give --{flag} {found}")
    if config.colour and not learned.colour:
        raise UserError(f"{arguments.start} needs colours, but {arguments.demos} has none")
    resolution, found = learned.grid.resolution, file.card.get("resolution")
    if found is not None and not math.isclose(found, resolution, rel_tol=1e-6):
        raise UserError(
            f"{arguments.start} was trained with pixels of {found:g} m, but {arguments.demos} has "
            f"pixels of {resolution:g} m"
        )
    return config, tuple(sorted(card_seeds(file.card))), before


def _check_validation(settings: Settings, held_out: TrainingData, path: Path) -> None:
    """Raises UserError if the validation data cannot select a checkpoint or the stopping
    threshold."""
    if settings.colour and not held_out.colour:
        raise UserError(
            f"{path} has no colours, but the networks need them: give other validation data with "
            "--validation"
        )
    _require_picks(held_out, path, "for validation")
    if settings.stop and not held_out.finals(1):
        raise UserError(
            f"all {held_out.count} {held_out.kind} for validation in {path} end with objects left "
            "to pick, so the policy cannot learn when to stop: "
            f"{held_out.verb} more, or give other validation data with --validation"
        )


def _require_picks(data: TrainingData, path: Path, purpose: str) -> None:
    """Raises UserError if no observation has an object to pick."""
    if not data.scenes(1):
        raise UserError(
            f"none of the {data.count} {data.kind} in {path} {purpose} has an object to pick: "
            f"{data.verb} more"
        )


def _digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def _parse() -> argparse.Namespace:
    parser = _parser()
    arguments = parser.parse_args()
    if arguments.demos is None and not arguments.export:
        parser.error("--demos is required, unless --export is given")
    if arguments.demos is None and not (arguments.weights or arguments.output):
        parser.error("--export needs --demos, --weights or --output")
    if arguments.demos and arguments.export and arguments.method == "transporter":
        parser.error("--export onnx: a transporter cannot be exported")
    if arguments.angle_only and not arguments.start:
        parser.error("--angle-only needs --from, which gives the weights of the other networks")
    if arguments.angle_only and arguments.method == "transporter":
        parser.error("--angle-only: a transporter has no separate angle network")
    if arguments.rotations and arguments.method != "transporter":
        parser.error(
            "--rotations is only for --method transporter: the other methods do not rotate images"
        )
    if arguments.weights and (arguments.demos or not arguments.export):
        parser.error("--weights can only be given with --export, and without --demos")
    for flag, given in (
        ("--from", arguments.start),
        ("--validation", arguments.validation),
        ("--demonstrations", arguments.demonstrations),
    ):
        if arguments.demos is None and given is not None:
            parser.error(f"{flag} needs --demos")
    return arguments


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m kitting_drake.train",
        description="Train a policy's networks. Run the same command again to resume.",
    )
    parser.add_argument(
        "--demos",
        type=Path,
        metavar="FILE.h5",
        help="training data: a file of collect, draw_scenes or demonstrate",
    )
    parser.add_argument(
        "--demonstrations",
        type=count_type,
        metavar="N",
        help="train on the first N demonstrations or scenes (default: all but the validation data)",
    )
    parser.add_argument(
        "--validation",
        type=Path,
        metavar="FILE.h5",
        help="validation data, which select the checkpoint (default: the data after the training "
        "data in --demos, up to a tenth as many; static scenes then have other tools)",
    )
    parser.add_argument(
        "--from",
        dest="start",
        type=Path,
        metavar="FILE.safetensors",
        help="initial weights, such as models/policies/generalist.safetensors (default: random)",
    )
    _add_settings(parser)
    parser.add_argument("--output", type=Path, metavar="DIR", help="the folder for all files")
    parser.add_argument(
        "--export",
        choices=("onnx",),
        help="also write the networks to the folder onnx in --output. Without --demos: only "
        "export, either the networks trained in --output or those of --weights",
    )
    parser.add_argument(
        "--weights", type=Path, metavar="FILE", help="the weights to export, without --demos"
    )
    parser.add_argument("--quiet", action="store_true", help="print nothing but errors")
    return parser


def _add_settings(parser: argparse.ArgumentParser) -> None:
    """Adds the flags of the training settings."""
    parser.add_argument(
        "--angle-only",
        action="store_true",
        help="train only the pick-angle network, from random weights. The others come from "
        "--from, which may have another N, or another preset with the same U-nets",
    )
    parser.add_argument("--method", choices=METHODS, default="so2")
    parser.add_argument("--preset", choices=PRESETS, default="small", help="size of the networks")
    parser.add_argument(
        "--orientations", type=count_type, default=180, metavar="N", help="number of angles (180)"
    )
    parser.add_argument(
        "--rotations",
        type=count_type,
        metavar="N",
        help="for the transporter: the number of rotations of the crop in a training step, twice "
        "that of the scene (default: as few as possible: those of the label and four others)",
    )
    parser.add_argument(
        "--steps", type=count_type, default=10_000, help="number of training steps (10000)"
    )
    parser.add_argument(
        "--batch", type=count_type, default=1, metavar="N", help="number of samples in a step (1)"
    )
    parser.add_argument(
        "--learning-rate", type=_rate_type, default=1e-4, help="learning rate of Adam (1e-4)"
    )
    parser.add_argument(
        "--decay", action="store_true", help="decay the learning rate to zero over the steps"
    )
    parser.add_argument(
        "--taken-only",
        action="store_true",
        help="as in the paper: label each observation only with the next pick, and not with "
        "later picks (always on if the task does not permit later picks)",
    )
    parser.add_argument(
        "--rigid",
        action="store_true",
        help="as in the paper: augment only by rigid motions, not by bending and mirroring (each "
        "is always off if the task does not permit it; the transporter never bends)",
    )
    parser.add_argument(
        "--validate-every",
        type=count_type,
        default=500,
        metavar="STEPS",
        help="number of steps between validations (500)",
    )
    parser.add_argument(
        "--seed", type=seed_type, default=0, help="seed of the initial weights and of all draws (0)"
    )


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
    """Returns the training and the validation data."""
    everything = read_training_data(path)
    total = everything.count
    # If `count` is given, validate on a tenth as many, else on all data after the training data.
    most_kept = total if count is None else max(1, count // 10)
    if count is None:
        count = total if validation else _most_unrelated(everything, total - max(1, total // 11))
    if total < count:
        raise UserError(
            f"{path} holds {total} {everything.kind}, not {count}: {everything.verb} more"
        )
    learned = everything.part(0, count)
    if validation is None:
        first = min(end for end in everything.unrelated if end >= count)
        kept = everything.part(first, first + most_kept)
        if not kept.count or not count:
            raise UserError(
                f"{path} holds {total} {everything.kind}: {count} for training leave none for "
                "validation"
                f"{'' if everything.has_taken else ' with other tools'}: "
                f"{everything.verb} more, or give --validation"
            )
        return learned, kept
    held_out = read_training_data(validation)
    shared = learned.shares_scenes(held_out)
    if shared is not None:
        raise UserError(
            f"{validation} and {path} share seed {shared}: validation needs other seeds"
        )
    if held_out.grid != everything.grid:
        raise UserError(
            f"{validation} and {path} have different pixel grids: give data with the same grid"
        )
    return learned, held_out


def _most_unrelated(data: TrainingData, wanted: int) -> int:
    """Returns the number n of demonstrations or scenes to train on: the first n of the data.

    It is the largest number, up to `wanted`, after which the data can be split into unrelated parts
    (see `TrainingData.unrelated`). If there is no such number, it is `wanted`.
    """
    return max((end for end in data.unrelated if end <= wanted), default=wanted)


if __name__ == "__main__":
    run_command(main)
