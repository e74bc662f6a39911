"""Demonstrations from outside: folders of frames and actions, as one file that `train` takes."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from kitting_drake.common.errors import UserError
from kitting_drake.common.provenance import versions
from kitting_drake.common.seeds import VALIDATION_SEEDS
from kitting_drake.policies.data.demonstrations import (
    Demonstration,
    Origin,
    read_demonstrations,
    write_demonstrations,
)
from kitting_drake.policies.data.learning import Learning
from kitting_drake.policies.data.recorded import DemonstrationStep, FinalObservation
from kitting_drake.real_camera.calibrations.calibration import (
    Calibration,
    calibration_digest,
    calibration_record,
)
from kitting_drake.real_camera.frames import Frame, read_frames
from kitting_drake.real_camera.step_actions import StepAction, read_action
from kitting_drake.real_camera.views import observe
from systems.signals import Observation

TASK = "bench"
"""The task of demonstrations from outside, where those of the simulation have their own."""
_FIRST_SEED = VALIDATION_SEEDS.stop
"""No episode of the simulation has a seed from here on."""


@dataclass(frozen=True)
class StepFolder:
    """The frames of one observation, and perhaps an `action.json`."""

    path: Path
    is_last: bool
    """Whether nothing comes after it in its demonstration."""

    @property
    def name(self) -> str:
        """The names of the demonstration and of the step."""
        return f"{self.path.parent.name}/{self.path.name}"


@dataclass(frozen=True)
class Summary:
    """The numbers of what was written."""

    demonstrations: int
    steps: int
    finals: int
    """Demonstrations that end by an observation in which nothing is left to do."""


def find_demonstrations(folder: Path) -> list[list[StepFolder]]:
    """The steps of each demonstration, by their names, in which numbers count as numbers.

    Args:
        folder: holds a folder for each demonstration, and that one for each step.

    Raises:
        UserError: there is no demonstration, or one without steps.
    """
    if not folder.is_dir():
        raise UserError(f"there is no folder {folder}")
    found = []
    for demonstration in _subfolders(folder):
        steps = _subfolders(demonstration)
        if not steps:
            raise UserError(
                f"{demonstration} holds no steps: a demonstration is a folder that holds a folder "
                "of frames for each step"
            )
        found.append([StepFolder(path, path is steps[-1]) for path in steps])
    if not found:
        raise UserError(f"{folder} holds no demonstrations: each is a folder in it")
    return found


def _subfolders(folder: Path) -> list[Path]:
    def key(path: Path) -> list[tuple[int, str]]:
        # Numbers, which stand at odd places, come in the order of their values.
        parts = re.split(r"(\d+)", path.name)
        return [(int(part) if i % 2 else 0, part) for i, part in enumerate(parts)]

    try:
        inside = [path for path in folder.iterdir() if not path.name.startswith(".")]
        return sorted((path for path in inside if path.is_dir()), key=key)
    except OSError as error:
        raise UserError(f"cannot read {folder}: {error.strerror}") from error


def read_observation(step: Path, calibration: Calibration) -> Observation:
    """o_t of a step, as `decide` sees it.

    Raises:
        UserError: its frames cannot be used; names the step.
    """
    return _observe(step, calibration)[1]


def _observe(step: Path, calibration: Calibration) -> tuple[dict[str, Frame], Observation]:
    try:
        frames = read_frames([step], calibration)
        return frames, observe(frames, calibration)
    except UserError as error:
        raise UserError(f"step {step.parent.name}/{step.name}: {error}") from error


def check_action(step: StepFolder, action: StepAction, calibration: Calibration) -> None:
    """Checks that an action fits its step.

    Raises:
        UserError: it says stop where something comes after it, or was clicked by another
            calibration, by which the same point of the table has other coordinates.
    """
    if action.action.stop and not step.is_last:
        raise UserError(
            f"{step.name} says that nothing is left to do, but steps come after it: only the last "
            "step of a demonstration can"
        )
    if action.calibration not in (None, calibration_digest(calibration)):
        raise UserError(
            f"{step.name} was clicked by another calibration: give that by --camera, or click it "
            "again"
        )


def check_replaceable(path: Path, folder: Path) -> None:
    """Checks that a file, if there is one, holds earlier demonstrations of a folder of that name.

    Raises:
        UserError: it holds something else.
    """
    if not path.exists():
        return
    try:
        origin = read_demonstrations(path).origin
    except UserError as error:
        raise UserError(f"{path} exists, and is no file of demonstrations: delete it") from error
    if (origin.scenario_name, origin.scenario.get("task")) != (folder.resolve().name, TASK):
        raise UserError(f"{path} holds demonstrations of {origin.scenario_name}: delete it")


def convert(folder: Path, calibration: Calibration, learning: Learning, path: Path) -> Summary:
    """Writes a folder's demonstrations to a file, atomically.

    Args:
        folder: see `find_demonstrations`.
        calibration: of the cameras, one for all demonstrations.
        learning: what training may assume of them.
        path: the file.

    Raises:
        UserError: a step has no action, or one that cannot be; frames cannot be used; two
            demonstrations are the same; or the file cannot be written. It names the step.
    """
    labelled = [_labelled(steps, calibration) for steps in find_demonstrations(folder)]
    actions = [[action.as_dict() for _, action in steps] for steps in labelled]
    origin = Origin(
        scenario_name=folder.resolve().name,
        scenario={
            "task": TASK,
            "calibration": calibration_record(calibration),
            # With the frames, which the seeds stand for, these determine what is learned.
            "actions": hashlib.sha256(json.dumps(actions).encode()).hexdigest(),
        },
        grid=calibration.grid,
        first_seed=_FIRST_SEED,
        versions=versions(),
        learning=learning,
    )
    write_demonstrations(path, origin, _demonstrations(labelled, calibration))
    stops = sum(steps[-1][1].action.stop for steps in labelled)
    return Summary(len(labelled), sum(map(len, labelled)) - stops, stops)


def _labelled(
    steps: Sequence[StepFolder], calibration: Calibration
) -> list[tuple[StepFolder, StepAction]]:
    labelled = []
    for step in steps:
        action = read_action(step.path, calibration.grid)
        check_action(step, action, calibration)
        labelled.append((step, action))
    if labelled[0][1].action.stop:
        raise UserError(
            f"{steps[0].path.parent} holds no steps but the last, in which nothing is left to do: "
            "there is nothing to learn from it"
        )
    return labelled


def _demonstrations(
    labelled: Sequence[Sequence[tuple[StepFolder, StepAction]]], calibration: Calibration
) -> Iterator[Demonstration]:
    """The demonstrations, one in memory at a time."""
    names: dict[int, str] = {}
    for steps in labelled:
        digest = hashlib.sha256()
        recorded, final = [], None
        for step, action in steps:
            frames, observation = _observe(step.path, calibration)
            _update(digest, frames)
            if action.action.stop:
                final = FinalObservation.of(observation)
            else:
                recorded.append(
                    DemonstrationStep.of(
                        observation, action.action, name=action.object, category=action.category
                    )
                )
        seed = _seed(digest.digest())
        name = steps[0][0].path.parent.name
        if seed in names:
            raise UserError(f"{names[seed]} and {name} hold the same frames: remove one of them")
        names[seed] = name
        yield Demonstration(seed, 1.0, tuple(recorded), final)


def _update(digest: hashlib._Hash, frames: dict[str, Frame]) -> None:
    for name in sorted(frames):
        digest.update(name.encode())
        digest.update(np.ascontiguousarray(frames[name].color).tobytes())
        digest.update(frames[name].depth.tobytes())


def _seed(digest: bytes) -> int:
    """A number for the frames of a demonstration, which have no seed: by it `train` notices that
    the same demonstration is learned from and validated by."""
    return _FIRST_SEED + int.from_bytes(digest[:8], "big") % (2**32 - _FIRST_SEED)
