"""Reads poses that tf2_echo, hand-eye calibrations, MoveIt or Open3D wrote, and plain matrices."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kitting_drake.common.errors import UserError
from kitting_drake.real_camera.calibrations.frame_names import FoundPose
from kitting_drake.real_camera.calibrations.layouts import get
from kitting_drake.real_camera.calibrations.pose_values import (
    assembled,
    pose_of_value,
    rigid,
    rotation_of_quaternion,
)
from kitting_drake.real_camera.calibrations.static_publishers import PUBLISHER, published_poses
from kitting_drake.real_camera.calibrations.yaml_values import (
    matrix,
    number,
    parse_yaml,
    read_text,
)

Array = NDArray[np.float64]

_ROUNDED = 2e-3
"""The tolerance for the length of a quaternion that tf2_echo printed with three decimals."""
_STILL = 2e-3
"""tf2_echo prints a frame's pose repeatedly. The poses may differ by at most this, in metres and in
the numbers of the quaternion. Otherwise the frame was not at rest."""
_NUMBERS = r"\[\s*([^\]]*?)\s*\]"
_ECHO = re.compile(rf"Translation:\s*{_NUMBERS}.*?in Quaternion(?:\s*\(xyzw\))?\s*{_NUMBERS}", re.S)
_ECHO_CALL = re.compile(r"\btf2?_echo[ \t]+([\w/.-]+)[ \t]+([\w/.-]+)")
_EYE_IN_HAND = {"eye_in_hand": True, "eye_on_hand": True, "eye_on_base": False}
_KNOWN = (
    "tf2_echo's text, a static_transform_publisher, an easy_handeye calibration, a geometry_msgs "
    "message, Open3D's PinholeCameraParameters, or 4 x 4 numbers"
)


def read_pose_file(path: Path) -> list[FoundPose]:
    """Reads the poses in a file. Only files of static publishers and /tf_static can hold several.

    Raises:
        UserError: the file is unreadable, incomplete, or of an unknown layout.
    """
    if path.suffix == ".npy":
        return [FoundPose(rigid(_load_matrix(path), str(path)), str(path))]
    text = read_text(path)
    if "Translation:" in text and "Rotation:" in text:
        return [_pose_of_echo(text, path)]
    if PUBLISHER in text or "--frame-id" in text:
        return published_poses(text, path)
    numbers = _plain_numbers(text)
    if numbers is not None:
        return [FoundPose(rigid(matrix(numbers, 4, 4, str(path)), str(path)), str(path))]
    try:
        content = parse_yaml(text, path)
    except UserError as error:
        raise UserError(f"{path} holds no pose that can be read: give {_KNOWN}") from error
    return _poses_of_mapping(content, str(path))


def _load_matrix(path: Path) -> Array:
    try:
        X = np.load(path, allow_pickle=False)
    except (OSError, ValueError, EOFError, SyntaxError) as error:
        raise UserError(f"cannot read {path}: it is not a complete .npy file") from error
    if not isinstance(X, np.ndarray) or X.shape != (4, 4) or X.dtype.kind not in "iuf":
        raise UserError(f"{path} must hold 4 x 4 numbers")
    return X.astype(float)


def _plain_numbers(text: str) -> list[str] | None:
    """Returns the numbers in a text, as np.savetxt writes them; None if the text has other
    words."""
    words = re.sub(r"#[^\n]*", "", text).replace(",", " ").replace(";", " ").split()
    try:
        return words if [float(word) for word in words] else None
    except ValueError:
        return None


def _pose_of_echo(text: str, path: Path) -> FoundPose:
    """Returns the last pose that tf2_echo, or tf_echo of ROS 1, printed."""
    found = _ECHO.findall(text)
    if not found:
        raise UserError(
            f"{path} is not complete: tf2_echo prints both a Translation and a Quaternion"
        )
    values = [
        [number(word, str(path)) for word in re.split(r"[\s,]+", " ".join(pair).strip())]
        for pair in found
    ]
    if any(len(row) != 7 for row in values):
        raise UserError(
            f"{path} must have three numbers after Translation and four after Quaternion"
        )
    table = np.array(values)
    # Give all quaternions the sign of the last one: q and -q are the same rotation.
    table[:, 3:] *= np.where(table[:, 3:] @ table[-1, 3:] < 0, -1, 1)[:, None]
    if np.ptp(table, axis=0).max() > _STILL:
        raise UserError(
            f"{path} has {len(table)} poses of the same frame, which differ: give only one pose"
        )
    calls = set(_ECHO_CALL.findall(text))
    if len(calls) > 1:
        raise UserError(f"{path} has poses of several pairs of frames: give only one pair")
    parent, child = calls.pop() if calls else ("", "")
    R = rotation_of_quaternion(table[-1, 3:], f"{path}: Quaternion", _ROUNDED)
    X = rigid(assembled(R, table[-1, :3]), str(path))
    # `tf2_echo A B` prints the pose of B in A.
    return FoundPose(X, str(path), parent, child)


def _poses_of_mapping(content: dict[str, Any], where: str) -> list[FoundPose]:
    parameters = content.get("parameters")
    if content.get("class_name") == "PinholeCameraTrajectory":
        if not isinstance(parameters, list) or len(parameters) != 1:
            raise UserError(f"{where} must have exactly one pose: save the parameters of one view")
        content = parameters[0] if isinstance(parameters[0], dict) else {}
    if "extrinsic" in content:
        return [FoundPose(open3d_pose(content, where), where)]
    if "transformation" in content:
        return [_easy_handeye(content, where)]
    if isinstance(parameters, dict) and "transform" in content:
        return [_easy_handeye2(content, parameters, where)]
    if isinstance(content.get("transforms"), list):
        entries = content["transforms"]
        return [pose_of_value(item, f"{where}: transforms[{i}]") for i, item in enumerate(entries)]
    if set(content) & {"position", "translation", "pose", "transform"}:
        return [pose_of_value(content, where)]
    raise UserError(f"{where} holds no pose that can be read: give {_KNOWN}")


def open3d_pose(content: dict[str, Any], where: str) -> Array:
    """Returns the pose (4, 4) of the camera from Open3D's `extrinsic`.

    The field maps from the world to the camera, and is stored column by column.
    """
    value = content["extrinsic"]
    if isinstance(value, list) and any(isinstance(item, list) for item in value):
        raise UserError(
            f"{where}: extrinsic must be a flat list of 16 numbers, column by column, as Open3D "
            "writes it; for rows of numbers give base_to_camera"
        )
    X = rigid(matrix(value, 4, 4, f"{where}: extrinsic").T, f"{where}: extrinsic")
    return np.asarray(np.linalg.inv(X), dtype=float)


def _easy_handeye(content: dict[str, Any], where: str) -> FoundPose:
    """Reads the pose in a file of easy_handeye for ROS 1. Files of its older versions have no
    field `parameters`."""
    inner = content.get("parameters", content)
    if not isinstance(inner, dict) or not isinstance(inner.get("eye_on_hand"), bool):
        raise UserError(f"{where} lacks eye_on_hand: give true or false")
    turn, keys = content["transformation"], ("x", "y", "z", "qx", "qy", "qz", "qw")
    if not isinstance(turn, dict):
        raise UserError(f"{where}: transformation must have {', '.join(keys)}")
    values = [
        number(get(turn, key, f"{where}: transformation"), f"{where}: transformation.{key}")
        for key in keys
    ]
    R = rotation_of_quaternion(np.array(values[3:]), f"{where}: transformation")
    X = rigid(assembled(R, np.array(values[:3])), f"{where}: transformation")
    return _of_hand_eye(X, inner, inner["eye_on_hand"], where)


def _easy_handeye2(content: dict[str, Any], parameters: dict[str, Any], where: str) -> FoundPose:
    kind = parameters.get("calibration_type")
    if kind not in _EYE_IN_HAND:
        raise UserError(
            f"{where}: calibration_type must be eye_in_hand or eye_on_base, not {kind!r}"
        )
    X = pose_of_value(content["transform"], f"{where}: transform").X
    return _of_hand_eye(X, parameters, _EYE_IN_HAND[kind], where)


def _of_hand_eye(X: Array, parameters: dict[str, Any], in_hand: bool, where: str) -> FoundPose:
    parent = parameters.get("robot_effector_frame" if in_hand else "robot_base_frame")
    child = parameters.get("tracking_base_frame")
    return FoundPose(X, where, str(parent or ""), str(child or ""), in_hand)
