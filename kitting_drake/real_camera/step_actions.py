"""Reads and writes `action.json`: a person's or robot's action for the frames in the same
folder."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from kitting_drake.common.errors import UserError
from kitting_drake.common.files import write_json
from kitting_drake.real_camera.calibrations.yaml_values import number
from systems.signals import PickPlaceAction, PixelGrid, PlanarPose, wrap_to_pi

NAME = "action.json"
UNNAMED = "object"
"""The default name of an object."""


@dataclass(frozen=True)
class StepAction:
    """An action and its labels."""

    action: PickPlaceAction
    """The pick and place in the base frame, or a stop."""
    object: str = UNNAMED
    """The name of the picked object."""
    category: str = ""
    """The object's category, or empty if objects have no categories."""
    calibration: str | None = None
    """The digest of the calibration with which the action was clicked; None if it was not
    clicked."""

    def as_dict(self) -> dict[str, Any]:
        """Returns the content of `action.json`, in the layout of `decide`, in metres and
        radians."""
        result: dict[str, Any] = {
            "units": "metres and radians, in the base frame; docs/bench.md",
            "stop": self.action.stop,
        }
        if self.calibration is not None:
            result["calibration"] = self.calibration
        if self.action.stop:
            return result
        if self.object != UNNAMED:
            result["object"] = self.object
        if self.category:
            result["category"] = self.category
        for name, pose in (("pick", self.action.pick), ("place", self.action.place)):
            result[name] = {"x": pose.x, "y": pose.y, "yaw": wrap_to_pi(pose.theta)}
        return result


def parse_action(record: Any, grid: PixelGrid, where: str) -> StepAction:
    """Reads an action from the content of an `action.json`; ignores fields that it does not need.

    Args:
        record: the content.
        grid: the workspace, in which pick and place must lie.
        where: the beginning of error messages.

    Raises:
        UserError: a field is missing or invalid, or pick or place is outside the workspace.
    """
    if not isinstance(record, dict):
        raise UserError(f"{where} must be a mapping with pick and place, or with stop: true")
    for flag in ("stop", "press"):
        if not isinstance(record.get(flag, False), bool):
            raise UserError(f"{where}: {flag} must be true or false, not {record[flag]!r}")
    texts = {key: record.get(key) for key in ("object", "category", "calibration")}
    for key, text in texts.items():
        if text is not None and not isinstance(text, str):
            raise UserError(f"{where}: {key} must be a string, not {text!r}")
        if text and not text.isprintable():
            raise UserError(f"{where}: {key} must have only printable characters, not {text!r}")
    known = {key: text for key, text in texts.items() if text}
    if record.get("stop", False):
        return StepAction(PickPlaceAction(stop=True), **known)
    if record.get("press", False):
        raise UserError(f"{where} presses down instead of picking and placing: leave this step out")
    pick, place = (_pose(record.get(name), grid, f"{where}: {name}") for name in ("pick", "place"))
    return StepAction(PickPlaceAction(pick, place), **known)


def _pose(node: Any, grid: PixelGrid, where: str) -> PlanarPose:
    if not isinstance(node, dict) or not {"x", "y", "yaw"} <= set(node):
        raise UserError(f"{where} must have x, y and yaw (or give stop: true)")
    x, y, yaw = (number(node[key], f"{where}.{key}") for key in ("x", "y", "yaw"))
    if not grid.contains((x, y)):
        raise UserError(
            f"{where} at ({x:g}, {y:g}) m is outside the workspace "
            f"({grid.x_min:g} to {grid.x_max:g}, {grid.y_min:g} to {grid.y_max:g} m)"
        )
    if abs(yaw) > math.tau:
        raise UserError(f"{where}.yaw is {yaw:g}, more than a full turn: give it in radians")
    return PlanarPose(x, y, yaw)


def read_action(step: Path, grid: PixelGrid) -> StepAction:
    """Reads the action of a step.

    Args:
        step: the folder of the step's frames.
        grid: the workspace, in which pick and place must lie.

    Raises:
        UserError: the file is missing or invalid. The message names it.
    """
    path = step / NAME
    if not path.is_file():
        raise UserError(f"{step} has no {NAME}: write this file, or click the action with --click")
    try:
        record = json.loads(path.read_text())
    except OSError as error:
        raise UserError(f"cannot read {path}: {error.strerror}") from error
    except (ValueError, RecursionError) as error:
        raise UserError(f"{path} is not JSON: {error}") from error
    return parse_action(record, grid, str(path))


def write_action(step: Path, action: StepAction) -> None:
    """Writes the action of a step atomically. An existing file is replaced.

    Raises:
        MachineError: the file cannot be written.
    """
    write_json(step / NAME, action.as_dict())
