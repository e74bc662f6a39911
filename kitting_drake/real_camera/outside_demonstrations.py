"""Demonstrations from real cameras: folders of frames and actions, converted for `train`."""

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
from kitting_drake.real_camera.checking.table_check import check_table
from kitting_drake.real_camera.checking.views import check_frames, check_views, observe
from kitting_drake.real_camera.frames import Frame, read_frames
from kitting_drake.real_camera.step_actions import StepAction, read_action
from systems.signals import Observation

TASK = "bench"
"""The task name in files of demonstrations from real cameras. No simulated task has this name."""
_FIRST_SEED = VALIDATION_SEEDS.stop
"""The first seed above those of all simulated episodes."""


@dataclass(frozen=True)
class StepFolder:
    """The folder of one observation's frames, and possibly an `action.json`."""

    path: Path
    is_last: bool
    """Whether this is the last step of its demonstration."""

    @property
    def name(self) -> str:
        """The names of the demonstration's and the step's folders, as `demonstration/step`."""
        return f"{self.path.parent.name}/{self.path.name}"


@dataclass(frozen=True)
class Summary:
    """The numbers of demonstrations and observations that `convert` wrote."""

    demonstrations: int
    steps: int
    finals: int
    """The number of final observations, in which nothing is left to do."""


def find_demonstrations(folder: Path) -> list[list[StepFolder]]:
    """Returns the steps of each demonstration, in the order of their names, with 2 before 10.

    Args:
        folder: it holds a folder for each demonstration, which in turn holds a folder for each
            step.

    Raises:
        UserError: there is no demonstration, or one has no steps.
    """
    if not folder.is_dir():
        raise UserError(f"there is no folder {folder}")
    found = []
    for demonstration in _subfolders(folder):
        steps = _subfolders(demonstration)
        if not steps:
            raise UserError(
                f"{demonstration} has no steps: a demonstration is a folder with a folder of "
                "frames for each step"
            )
        found.append([StepFolder(path, path is steps[-1]) for path in steps])
    if not found:
        raise UserError(f"{folder} has no demonstrations: each must be a folder in it")
    return found


def _subfolders(folder: Path) -> list[Path]:
    def key(path: Path) -> list[tuple[int, str]]:
        # Numbers are at odd positions, and are compared by value.
        parts = re.split(r"(\d+)", path.name)
        return [(int(part) if i % 2 else 0, part) for i, part in enumerate(parts)]

    try:
        inside = [path for path in folder.iterdir() if not path.name.startswith(".")]
        return sorted((path for path in inside if path.is_dir()), key=key)
    except OSError as error:
        raise UserError(f"cannot read {folder}: {error.strerror}") from error


def read_observation(step: Path, calibration: Calibration) -> Observation:
    """Returns the observation o_t of a step, as in `decide`.

    Raises:
        UserError: the step's frames are unusable. The message names the step.
    """
    return _observe(step, calibration)[1]


def _observe(step: Path, calibration: Calibration) -> tuple[dict[str, Frame], Observation]:
    try:
        frames = read_frames([step], calibration)
        checked = check_frames(frames, calibration)
        check_views(checked, calibration)
        check_table(checked, calibration)
        return frames, observe(checked, calibration)
    except UserError as error:
        raise UserError(f"step {step.parent.name}/{step.name}: {error}") from error


def check_action(step: StepFolder, action: StepAction, calibration: Calibration) -> None:
    """Checks that an action fits its step.

    Raises:
        UserError: the action stops before the last step; or it was clicked with another
            calibration, so its coordinates do not hold in this one.
    """
    if action.action.stop and not step.is_last:
        raise UserError(
            f"{step.name} says that nothing is left to do, but steps come after it: only the last "
            "step of a demonstration may say so"
        )
    if action.calibration not in (None, calibration_digest(calibration)):
        raise UserError(
            f"{step.name} was clicked with another calibration: give that calibration with "
            "--camera, or click the step again"
        )


def check_replaceable(path: Path, folder: Path) -> None:
    """Checks that a file may be replaced by the demonstrations of a folder.

    It may if it does not exist, or if it holds demonstrations from a folder of the same name.

    Raises:
        UserError: the file holds something else.
    """
    if not path.exists():
        return
    try:
        origin = read_demonstrations(path).origin
    except UserError as error:
        raise UserError(f"{path} exists and is not a file of demonstrations: delete it") from error
    if (origin.scenario_name, origin.scenario.get("task")) != (folder.resolve().name, TASK):
        raise UserError(
            f"{path} holds demonstrations of {origin.scenario_name}, not of "
            f"{folder.resolve().name}: delete the file"
        )


def convert(folder: Path, calibration: Calibration, learning: Learning, path: Path) -> Summary:
    """Writes a folder's demonstrations to a file, atomically.

    Args:
        folder: the demonstrations; see `find_demonstrations`.
        calibration: the cameras' calibration, the same for all demonstrations.
        learning: the assumptions about the task that training may make.
        path: the file to write.

    Raises:
        UserError: a step has no action or an invalid action, frames are unusable, two
            demonstrations are the same, or the file cannot be written. The message names the step,
            the demonstrations or the file.
    """
    labelled = [_labelled(steps, calibration) for steps in find_demonstrations(folder)]
    actions = [[action.as_dict() for _, action in steps] for steps in labelled]
    origin = Origin(
        scenario_name=folder.resolve().name,
        scenario={
            "task": TASK,
            "calibration": calibration_record(calibration),
            # The seeds identify the frames, and this digest identifies the actions.
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
            f"{steps[0].path.parent} has only a last step, in which nothing is left to do: remove "
            "this demonstration, from which there is nothing to learn"
        )
    return labelled


def _demonstrations(
    labelled: Sequence[Sequence[tuple[StepFolder, StepAction]]], calibration: Calibration
) -> Iterator[Demonstration]:
    """Yields the demonstrations one at a time, to save memory."""
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
    """Returns a seed derived from a demonstration's frames.

    `train` compares seeds to find demonstrations that training and validation share.
    """
    return _FIRST_SEED + int.from_bytes(digest[:8], "big") % (2**32 - _FIRST_SEED)
