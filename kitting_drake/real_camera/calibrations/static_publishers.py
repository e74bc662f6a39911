"""Reads poses in calls of ROS's static_transform_publisher, which MoveIt's hand-eye calibration
writes, for example."""

from __future__ import annotations

import ast
import math
import re
import shlex
from collections.abc import Iterator, Sequence
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from kitting_drake.common.errors import UserError
from kitting_drake.real_camera.calibrations.frame_names import FoundPose
from kitting_drake.real_camera.calibrations.pose_values import (
    assembled,
    rigid,
    rotation_of_quaternion,
    rotation_of_rpy,
)
from kitting_drake.real_camera.calibrations.yaml_values import number

PUBLISHER = "static_transform_publisher"
_FLAGS = ("x", "y", "z", "qx", "qy", "qz", "qw", "roll", "pitch", "yaw")
_EXECUTABLES = ("executable", "node_executable")


def published_poses(text: str, path: Path) -> list[FoundPose]:
    """Returns the poses that a file publishes: a launch file in XML or Python, or shell commands.

    Raises:
        UserError: the file is damaged, or the arguments of a publisher are not numbers and frames.
    """
    if text.lstrip().startswith("<"):
        calls = _calls_in_xml(text, path)
    elif re.search(r"^\s*(from|import) ", text, re.MULTILINE):
        calls = _calls_in_python(text, path)
    else:
        calls = _calls_in_lines(text, path)
    poses = [_pose(words, f"{path}: {PUBLISHER}") for words in calls]
    if not poses:
        raise UserError(f"{path} has no complete call of {PUBLISHER}")
    return poses


def _calls_in_xml(text: str, path: Path) -> Iterator[list[str]]:
    try:
        root = ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        raise UserError(f"{path} is not complete XML: {error}") from error
    for node in root.iter("node"):
        if PUBLISHER in (node.get("type"), node.get("exec")):
            yield _split(node.get("args", ""), path)


def _calls_in_python(text: str, path: Path) -> Iterator[list[str]]:
    try:
        tree = ast.parse(text)
    except (SyntaxError, ValueError) as error:
        raise UserError(f"{path} is not complete Python: {error}") from error
    for call in ast.walk(tree):
        if not isinstance(call, ast.Call):
            continue
        given = {item.arg: item.value for item in call.keywords}
        called = [given[key] for key in _EXECUTABLES if key in given]
        if not any(isinstance(item, ast.Constant) and item.value == PUBLISHER for item in called):
            continue
        try:
            words = ast.literal_eval(given["arguments"])
        except (KeyError, ValueError) as error:
            raise UserError(
                f"{path}: the arguments of {PUBLISHER} must be written out, without variables"
            ) from error
        yield [str(word) for word in words]


def _calls_in_lines(text: str, path: Path) -> Iterator[list[str]]:
    joined = text.replace("\\\n", " ")
    for line in joined.splitlines():
        if PUBLISHER in line or "--frame-id" in line:
            words = _split(line.rpartition(PUBLISHER)[2], path)
            if words:
                yield words


def _split(text: str, path: Path) -> list[str]:
    try:
        return shlex.split(text, comments=True)
    except ValueError as error:
        raise UserError(f"{path}: {PUBLISHER}: {error}") from error


def _pose(words: Sequence[str], where: str) -> FoundPose:
    if "--ros-args" in words:
        words = words[: words.index("--ros-args")]
    words = [word for word in words if ":=" not in word]
    if any(word.startswith("--") for word in words):
        return _pose_of_flags(words, where)
    # Without flags, the arguments are x y z yaw pitch roll, or x y z qx qy qz qw; then the
    # parent and the child frame, and in ROS 1 a period.
    values: list[float] = []
    while len(values) < len(words) and _is_number(words[len(values)]):
        values.append(float(words[len(values)]))
    rest = list(words[len(values) :])
    if len(rest) == 3 and _is_number(rest[2]):
        rest.pop()
    if len(values) not in (6, 7) or len(rest) != 2:
        raise UserError(
            f"{where} must have x y z yaw pitch roll, or x y z qx qy qz qw, and two frames, not "
            f"'{' '.join(words)}'"
        )
    if len(values) == 6:
        yaw, pitch, roll = values[3:]
        R = rotation_of_rpy(np.degrees([roll, pitch, yaw])).as_matrix()
    else:
        R = rotation_of_quaternion(np.array(values[3:]), where)
    X = assembled(np.asarray(R, dtype=float), np.array(values[:3]))
    return FoundPose(rigid(X, where), where, rest[0], rest[1])


def _pose_of_flags(words: Sequence[str], where: str) -> FoundPose:
    flat = [part for word in words for part in (word.split("=", 1) if word[:2] == "--" else [word])]
    given: dict[str, str] = {}
    for key, value in zip(flat[::2], flat[1::2], strict=False):
        if key in given:
            raise UserError(f"{where} has {key} twice")
        given[key] = value
    known = {f"--{flag}" for flag in _FLAGS} | {"--frame-id", "--child-frame-id"}
    wrong = next((key for key in given if key not in known), None)
    if wrong is not None or len(flat) % 2:
        raise UserError(f"{where} has the unknown argument '{wrong or flat[-1]}'")
    if "--frame-id" not in given or "--child-frame-id" not in given:
        raise UserError(f"{where} lacks --frame-id or --child-frame-id")
    values = {flag: number(given.get(f"--{flag}", 0.0), f"{where}: --{flag}") for flag in _FLAGS}
    quaternion = [values[key] for key in ("qx", "qy", "qz", "qw")]
    angles = [values[key] for key in ("roll", "pitch", "yaw")]
    if any(f"--q{axis}" in given for axis in "xyzw"):
        if any(angles):
            raise UserError(f"{where} has both a quaternion and roll, pitch, yaw: give one of them")
        R = rotation_of_quaternion(np.array(quaternion), f"{where}: --qx --qy --qz --qw")
    else:
        R = np.asarray(rotation_of_rpy(np.degrees(angles)).as_matrix(), dtype=float)
    X = assembled(R, np.array([values["x"], values["y"], values["z"]]))
    return FoundPose(rigid(X, where), where, given["--frame-id"], given["--child-frame-id"])


def _is_number(word: str) -> bool:
    try:
        return math.isfinite(float(word))
    except ValueError:
        return False
