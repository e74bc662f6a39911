"""Reads poses from mappings: matrices, positions with rotations, and ROS's messages."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from kitting_drake.common.errors import UserError
from kitting_drake.real_camera.calibrations.frame_names import FoundPose
from kitting_drake.real_camera.calibrations.layouts import refuse_two, refuse_unknown
from kitting_drake.real_camera.calibrations.yaml_values import matrix, numbers

Array = NDArray[np.float64]

_ORTHOGONAL = 1e-3
"""The largest accepted difference between an entry of R^T R and that of the identity."""
_FARTHEST = 20.0
"""If a camera is farther than this from the base, in metres, its position is probably not in
metres."""
_POSITIONS = ("position", "translation")
_ROTATIONS = ("orientation", "quaternion_xyzw", "rotation", "rpy_deg", "rvec")
_MOST_ENVELOPES = 4
_ENVELOPE = ("header", "child_frame_id", "covariance")
"""The other keys of a ROS message in which a pose is nested."""


def pose_of_value(value: Any, where: str) -> FoundPose:
    """Reads a pose from 4 x 4 numbers, or from a mapping with a position and a rotation.

    Raises:
        UserError: the value is not a rigid pose in metres. The message names the field.
    """
    if isinstance(value, dict) and "data" not in value:
        return _pose_of_parts(value, where)
    return FoundPose(rigid(matrix(value, 4, 4, where), where), where)


def _pose_of_parts(value: dict[str, Any], where: str) -> FoundPose:
    parent, child = "", ""
    # A message of geometry_msgs nests Pose in PoseStamped and PoseWithCovariance.
    for _ in range(_MOST_ENVELOPES):
        inner = next((key for key in ("pose", "transform") if key in value), None)
        if inner is None:
            break
        refuse_unknown(value, (inner, *_ENVELOPE), where)
        if not isinstance(value[inner], dict):
            raise UserError(f"{where}.{inner} must be a mapping")
        header = value.get("header")
        if isinstance(header, dict) and "child_frame_id" in value:
            parent = str(header.get("frame_id") or "")
            child = str(value["child_frame_id"] or "")
        value = value[inner]
    refuse_unknown(value, (*_POSITIONS, *_ROTATIONS), where)
    at = refuse_two(value, _POSITIONS, where)
    if at is None:
        raise UserError(f"{where} has no position: give three numbers in metres")
    position = matrix(value[at], 1, 3, f"{where}.{at}")[0]
    key = refuse_two(value, _ROTATIONS, where)
    if key is None:
        raise UserError(f"{where} has no rotation: give quaternion_xyzw, rpy_deg, rotation or rvec")
    R = _rotation(key, value[key], f"{where}.{key}")
    return FoundPose(rigid(assembled(R, position), where), where, parent, child)


def _rotation(key: str, value: Any, where: str) -> Array:
    turn = numbers(value, where)
    if key in ("rpy_deg", "rvec"):
        turn = matrix(value, 1, 3, where)[0]
        rotation = rotation_of_rpy(turn) if key == "rpy_deg" else Rotation.from_rotvec(turn)
        return np.asarray(rotation.as_matrix(), dtype=float)
    if turn.size == 9 and key == "rotation":
        return turn.reshape(3, 3)
    if turn.size == 4:
        return rotation_of_quaternion(turn, where)
    raise UserError(f"{where} must be a quaternion x, y, z, w, not {turn.size} numbers")


def rotation_of_rpy(degrees: Array) -> Rotation:
    """Returns the rotation by roll, pitch and yaw about the fixed axes x, y and z, in this
    order."""
    return Rotation.from_euler("xyz", degrees, degrees=True)


def rotation_of_quaternion(xyzw: Array, where: str, tolerance: float = _ORTHOGONAL) -> Array:
    """Returns the rotation matrix (3, 3) of a unit quaternion.

    Raises:
        UserError: the length of the quaternion is not 1.
    """
    if abs(np.linalg.norm(xyzw) - 1) > tolerance:
        length = np.linalg.norm(xyzw)
        raise UserError(
            f"{where} must be a unit quaternion x, y, z, w, but its length is {length:.4g}"
        )
    return np.asarray(Rotation.from_quat(xyzw).as_matrix(), dtype=float)


def assembled(R: Array, position: Array) -> Array:
    """Returns the pose (4, 4) with a rotation (3, 3) and a position (3,)."""
    X = np.eye(4)
    X[:3, :3], X[:3, 3] = R, position
    return X


def rigid(X: Array, where: str) -> Array:
    """Checks a pose (4, 4) and returns it.

    Raises:
        UserError: the rotation is not orthonormal, or the position is not in metres.
    """
    R = X[:3, :3]
    if np.abs(R.T @ R - np.eye(3)).max() > _ORTHOGONAL or np.linalg.det(R) < 0:
        raise UserError(f"{where} is not a rigid pose: its rotation is not orthonormal")
    if not np.allclose(X[3], [0, 0, 0, 1]):
        transposed = np.allclose(X[:3, 3], 0)
        hint = ": it is transposed" if transposed else ""
        raise UserError(f"{where}: the last row of a pose must be 0 0 0 1{hint}")
    if np.linalg.norm(X[:3, 3]) > _FARTHEST:
        far = math.ceil(np.linalg.norm(X[:3, 3]))
        raise UserError(f"{where}: the camera is {far} m from the base: give positions in metres")
    return X
