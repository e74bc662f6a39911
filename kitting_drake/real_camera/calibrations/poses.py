"""Reads the pose of a camera in the robot's base frame, from the fields of the camera's entry."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kitting_drake.common.errors import UserError
from kitting_drake.real_camera.calibrations.frame_names import (
    BASE,
    CAMERA,
    HAND,
    FoundPose,
    FrameNames,
    directed,
    is_body,
)
from kitting_drake.real_camera.calibrations.layouts import get
from kitting_drake.real_camera.calibrations.pose_files import read_pose_file
from kitting_drake.real_camera.calibrations.pose_values import assembled, pose_of_value, rigid
from kitting_drake.real_camera.calibrations.yaml_values import matrix

Array = NDArray[np.float64]

_OPENCV = {"R_cam2base": "t_cam2base", "R_cam2gripper": "t_cam2gripper"}
"""The rotations that cv2.calibrateHandEye returns, and their translations."""
_STATED = ("camera_to_base", "base_to_camera", "camera_to_hand")
"""The fields whose names state which pose they hold."""
_POSES = ("camera_to_base", "pose", "transform", "base_to_camera", "camera_to_hand")
POSE_FIELDS = (
    *(*_OPENCV, *_OPENCV.values(), *_POSES),
    *("hand_to_base", "optical_to_link", "base_frame", "camera_frame"),
)
"""All fields of a camera's pose."""


def has_pose(node: dict[str, Any]) -> bool:
    """Whether a camera's entry has a pose."""
    return any(key in node for key in (*_OPENCV, *_OPENCV.values(), *_POSES))


def read_pose(node: dict[str, Any], where: str, folder: Path) -> Array:
    """Returns the pose (4, 4) of the camera's optical frame in the base frame.

    `docs/bench.md` describes the layouts of poses.

    Args:
        node: the camera's entry.
        where: the beginning of error messages.
        folder: the folder of the files that the entry names.

    Raises:
        UserError: there is not exactly one pose, its rotation is invalid, or the camera is on the
            hand and the hand's pose is missing. The message names the field.
    """
    found = _given_pose(node, where, folder)
    if "optical_to_link" in node:
        label = f"{where}: optical_to_link"
        link = _one_pose(node["optical_to_link"], label, folder)
        if link.child and link.parent and is_body(link.child) and not is_body(link.parent):
            link = link.inverse
        X, body = found.X @ link.X, ""
    else:
        X, body = found.X, found.child if is_body(found.child) else ""
    if body:
        raise UserError(
            f"{found.where} is the pose of {body}, the camera's body: also give optical_to_link "
            f"beside it; the command `tf2_echo {body} ..._optical_frame` prints it"
        )
    if not found.in_hand:
        if "hand_to_base" in node:
            raise UserError(
                f"{where} has hand_to_base, but {found.where} is the pose of a fixed camera: "
                "remove hand_to_base, or call the pose camera_to_hand"
            )
        return X
    if "hand_to_base" not in node:
        raise UserError(
            f"{found.where} is the pose of a camera on the hand (eye in hand): give hand_to_base, "
            "the hand's pose in the base when the frame was taken"
        )
    return _hand_pose(node, found, where, folder) @ X


def _given_pose(node: dict[str, Any], where: str, folder: Path) -> FoundPose:
    """Returns the pose in a camera's entry. Raises UserError unless there is exactly one pose."""
    given = [key for key in (*_OPENCV, *_POSES) if key in node]
    for turn, position in _OPENCV.items():
        if position in node and turn not in node:
            given.insert(0, position)
    if len(given) > 1:
        raise UserError(f"{where} has {' and '.join(given)}: give only one pose")
    if not given:
        raise UserError(
            f"{where} has no pose: give camera_to_base (4 x 4), or pose with position and "
            "quaternion_xyzw or rpy_deg, or a file with a pose"
        )
    key = given[0]
    for turn, position in _OPENCV.items():
        if key in (turn, position):
            R = matrix(get(node, turn, where), 3, 3, f"{where}: {turn}")
            t = matrix(get(node, position, where), 3, 1, f"{where}: {position}")
            X = rigid(assembled(R, t[:, 0]), f"{where}: {turn}")
            return FoundPose(X, f"{where}: {turn}", in_hand=turn == "R_cam2gripper")
    names = FrameNames.of(node)
    return _as_stated(key, _read_value(node[key], f"{where}: {key}", folder, names), names)


def _as_stated(key: str, found: FoundPose, names: FrameNames) -> FoundPose:
    """Returns the camera's pose: interprets `found` by the names of its field and its frames."""
    turned = directed(found, names)
    if key not in _STATED:
        return turned
    if not turned.parent:
        turned = found.inverse if key == "base_to_camera" else found
        return FoundPose(turned.X, found.where, in_hand=key == "camera_to_hand")
    # If the names require an inversion, the file has the pose of the base in the camera.
    is_inverse = turned.parent != found.parent
    if bool(turned.in_hand) != (key == "camera_to_hand") or is_inverse != (key == "base_to_camera"):
        raise UserError(
            f"{found.where} is the pose of {found.child} in {found.parent}, which contradicts the "
            f"field's name {key}: rename the field to pose"
        )
    return turned


def _read_value(value: Any, where: str, folder: Path, names: FrameNames) -> FoundPose:
    if not isinstance(value, str):
        return pose_of_value(value, where)
    poses = read_pose_file(folder / value)
    if len(poses) == 1:
        return poses[0]
    # Of several static transforms, use that of the camera.
    ends = [
        pose
        for pose in poses
        if sorted(map(names.kind, (pose.parent, pose.child))) in ([BASE, CAMERA], [CAMERA, HAND])
    ]
    if len(ends) != 1:
        pairs = ", ".join(f"{pose.parent} to {pose.child}" for pose in poses)
        raise UserError(
            f"{folder / value} has {len(poses)} transforms ({pairs}), and {len(ends)} of them are "
            "of a camera in the base or the hand: keep only one"
        )
    return ends[0]


def _one_pose(value: Any, where: str, folder: Path) -> FoundPose:
    return _read_value(value, where, folder, FrameNames())


def _hand_pose(node: dict[str, Any], camera: FoundPose, where: str, folder: Path) -> Array:
    """Returns the pose (4, 4) of the hand in the base."""
    hand = _one_pose(node["hand_to_base"], f"{where}: hand_to_base", folder)
    if not hand.parent or not hand.child:
        return hand.X
    names = FrameNames.of(node)
    kinds = [
        HAND if name.strip("/") == camera.parent.strip("/") else names.kind(name)
        for name in (hand.parent, hand.child)
    ]
    if kinds == [HAND, BASE]:
        return hand.inverse.X
    if kinds != [BASE, HAND]:
        raise UserError(
            f"{hand.where} is the pose of {hand.child} in {hand.parent}: give the pose of the "
            f"hand {camera.parent} in the base"
        )
    if camera.parent and camera.parent.strip("/") not in (
        hand.parent.strip("/"),
        hand.child.strip("/"),
    ):
        raise UserError(
            f"{hand.where} is the pose of {hand.child}, but the camera's pose is in "
            f"{camera.parent}: give the pose of {camera.parent}"
        )
    return hand.X
