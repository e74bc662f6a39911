"""Intrinsics and poses of cameras from YAML: OpenCV's layout, ROS's CameraInfo, and our own."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from kitting_drake.common.errors import UserError
from kitting_drake.real_camera.calibrations.yaml_values import matrix, number, numbers, whole_number

Array = NDArray[np.float64]

_ORTHOGONAL = 1e-3
"""The largest difference of an entry of R^T R from the identity's."""
_MODELS = ("plumb_bob", "rational_polynomial", "radtan", "none", "")
_COEFFICIENTS = (0, 4, 5, 8)
_MATRICES = ("camera_matrix", "k", "K")
_WIDTHS, _HEIGHTS = ("width", "image_width"), ("height", "image_height")
_DISTORTIONS = ("distortion", "distortion_coefficients", "dist_coeffs", "d", "D")
_POSES = ("camera_to_base", "pose", "transform", "base_to_camera")
_POSITIONS = ("position", "translation")
_ROTATIONS = ("orientation", "quaternion_xyzw", "rotation", "rpy_deg", "rvec")
_MOST_ENVELOPES = 4
_ENVELOPE = ("header", "child_frame_id", "covariance")
"""The other keys of ROS messages that contain a pose."""

POSE_FIELDS = ("R_cam2base", "t_cam2base", *_POSES)
"""The fields of a camera's pose."""
OWN_INTRINSICS = (
    *("fx", "fy", "cx", "cy", "image_size", *_WIDTHS, *_HEIGHTS),
    *("distortion_model", *_DISTORTIONS),
)
"""The fields of intrinsics in our own layout; other fields of OpenCV and ROS are ignored."""


@dataclass(frozen=True)
class Intrinsics:
    """The intrinsics of a lens; image positions are whole numbers at pixel centres."""

    size: tuple[int, int]
    """(width, height), in pixels."""
    focal: tuple[float, float]
    """(fx, fy), in pixels."""
    centre: tuple[float, float]
    """(cx, cy), in pixels."""
    distortion: tuple[float, ...] = ()
    """k1, k2, p1, p2, k3, k4, k5, k6 in the order of OpenCV and ROS; fewer, or none."""


def has_intrinsics(node: dict[str, Any]) -> bool:
    """Whether a mapping holds intrinsics in some layout."""
    return any(key in node for key in ("fx", *_MATRICES))


def read_intrinsics(node: dict[str, Any], where: str) -> Intrinsics:
    """Reads the intrinsics in a mapping, in any of the three layouts.

    Raises:
        UserError: a field is missing or invalid; names the field.
    """
    if "fx" in node:
        fx, fy, cx, cy = (
            number(_get(node, key, where), f"{where}: {key}") for key in ("fx", "fy", "cx", "cy")
        )
    else:
        key = _first(node, *_MATRICES)
        if key is None:
            raise UserError(
                f"{where} has no intrinsics: give fx, fy, cx, cy, or camera_matrix, or k"
            )
        K = matrix(node[key], 3, 3, f"{where}: {key}")
        if K[1, 0] != 0 or not np.allclose(K[2], [0, 0, 1]):
            raise UserError(
                f"{where}: {key} must be fx 0 cx, 0 fy cy, 0 0 1: is it transposed, as MATLAB "
                "writes it?"
            )
        fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    if "image_size" in node:
        _refuse_two(node, ("image_size", *_WIDTHS, *_HEIGHTS), where)
        width, height = matrix(node["image_size"], 1, 2, f"{where}: image_size")[0].tolist()
    else:
        across, down = _first(node, *_WIDTHS), _first(node, *_HEIGHTS)
        if across is None or down is None:
            raise UserError(f"{where} has no image size: give width and height, in pixels")
        width, height = node[across], node[down]
    if fx <= 0 or fy <= 0:
        raise UserError(f"{where}: focal lengths must be positive, not {fx:g} and {fy:g}")
    size = whole_number(width, f"{where}: width"), whole_number(height, f"{where}: height")
    if not (0 <= cx <= size[0] and 0 <= cy <= size[1]):
        raise UserError(
            f"{where}: the principal point ({cx:g}, {cy:g}) is outside the image of "
            f"{size[0]}x{size[1]} pixels: are the intrinsics those of another resolution?"
        )
    return Intrinsics(size, (fx, fy), (cx, cy), _read_distortion(node, where))


def _read_distortion(node: dict[str, Any], where: str) -> tuple[float, ...]:
    model = node.get("distortion_model") or ""
    if model not in _MODELS:
        raise UserError(
            f"{where}: distortion_model {model} cannot be read: rectify the images, and give "
            "distortion: [] and no distortion_model"
        )
    key = _first(node, *_DISTORTIONS)
    if key is None:
        return ()
    values = tuple(numbers(node[key], f"{where}: {key}").tolist())
    if not any(values):
        return ()
    if len(values) not in _COEFFICIENTS:
        raise UserError(f"{where}: {key} must hold 0, 4, 5 or 8 numbers, not {len(values)}")
    return values


def read_pose(node: dict[str, Any], where: str) -> Array:
    """(4, 4): the pose of the camera's optical frame in the base frame, in any of the layouts.

    Raises:
        UserError: there is not exactly one pose, or its rotation is invalid; names the field.
    """
    given = [key for key in ("R_cam2base", *_POSES) if key in node]
    if "t_cam2base" in node and "R_cam2base" not in node:
        given.insert(0, "t_cam2base")
    if len(given) > 1:
        raise UserError(f"{where} has {' and '.join(given)}: give one pose")
    if "R_cam2base" in node or "t_cam2base" in node:
        X = np.eye(4)
        R = _get(node, "R_cam2base", where)
        X[:3, :3] = matrix(R, 3, 3, f"{where}: R_cam2base")
        t = matrix(_get(node, "t_cam2base", where), 3, 1, f"{where}: t_cam2base")
        X[:3, 3] = t[:, 0]
        return _checked(X, f"{where}: R_cam2base")
    if not given:
        raise UserError(
            f"{where} has no pose: give camera_to_base (4 x 4), or pose with position and "
            "quaternion_xyzw or rpy_deg"
        )
    key = given[0]
    value, label = node[key], f"{where}: {key}"
    if isinstance(value, dict) and "data" not in value:
        X = _pose_of_parts(value, label)
    else:
        X = matrix(value, 4, 4, label)
    X = _checked(X, label)
    return np.asarray(np.linalg.inv(X), dtype=float) if key == "base_to_camera" else X


def _pose_of_parts(value: dict[str, Any], where: str) -> Array:
    # geometry_msgs nests Pose in PoseStamped and PoseWithCovariance.
    for _ in range(_MOST_ENVELOPES):
        inner = _first(value, "pose", "transform")
        if inner is None:
            break
        _refuse_unknown(value, (inner, *_ENVELOPE), where)
        if not isinstance(value[inner], dict):
            raise UserError(f"{where}.{inner} must be a mapping")
        value = value[inner]
    _refuse_unknown(value, (*_POSITIONS, *_ROTATIONS), where)
    at = _refuse_two(value, _POSITIONS, where)
    if at is None:
        raise UserError(f"{where} has no position: three numbers in metres")
    X = np.eye(4)
    X[:3, 3] = matrix(value[at], 1, 3, f"{where}.{at}")[0]
    key = _refuse_two(value, _ROTATIONS, where)
    if key is None:
        raise UserError(f"{where} has no rotation: give quaternion_xyzw, rpy_deg, rotation or rvec")
    turn = numbers(value[key], f"{where}.{key}")
    if key in ("rpy_deg", "rvec"):
        turn = matrix(value[key], 1, 3, f"{where}.{key}")[0]
        # Roll, pitch and yaw about the fixed axes x, y and z, in this order, as in ROS.
        rotation = (
            Rotation.from_euler("xyz", turn, degrees=True)
            if key == "rpy_deg"
            else Rotation.from_rotvec(turn)
        )
        X[:3, :3] = rotation.as_matrix()
    elif turn.size == 9 and key == "rotation":
        X[:3, :3] = turn.reshape(3, 3)
    elif turn.size == 4:
        if abs(np.linalg.norm(turn) - 1) > _ORTHOGONAL:
            raise UserError(f"{where}.{key} must be a unit quaternion x, y, z, w")
        X[:3, :3] = Rotation.from_quat(turn).as_matrix()
    else:
        raise UserError(f"{where}.{key} must be a quaternion x, y, z, w, not {turn.size} numbers")
    return X


def _checked(X: Array, where: str) -> Array:
    R = X[:3, :3]
    if np.abs(R.T @ R - np.eye(3)).max() > _ORTHOGONAL or np.linalg.det(R) < 0:
        raise UserError(f"{where} is not a rigid pose: its rotation is not orthonormal")
    if not np.allclose(X[3], [0, 0, 0, 1]):
        raise UserError(f"{where}: the last row of a pose must be 0 0 0 1")
    if np.linalg.norm(X[:3, 3]) > 20:
        far = math.ceil(np.linalg.norm(X[:3, 3]))
        raise UserError(f"{where}: the camera is {far} m from the base: positions are in metres")
    return X


def _get(node: dict[str, Any], key: str, where: str) -> Any:
    if key not in node:
        raise UserError(f"{where} lacks '{key}'")
    return node[key]


def _first(node: dict[str, Any], *keys: str) -> str | None:
    return next((key for key in keys if key in node), None)


def _refuse_two(node: dict[str, Any], keys: tuple[str, ...], where: str) -> str | None:
    """The only given one of some fields, or None; raises UserError if there are several."""
    given = [key for key in keys if key in node]
    if len(given) > 1:
        raise UserError(f"{where} has {' and '.join(given)}: give one of them")
    return given[0] if given else None


def _refuse_unknown(node: dict[str, Any], keys: tuple[str, ...], where: str) -> None:
    """Raises UserError for a field that is not among the known ones."""
    for key in node:
        if key not in keys:
            raise UserError(f"{where} has the unknown field '{key}': remove it")
