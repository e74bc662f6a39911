"""Infers from ROS's frame names which of two frames is the base, the hand or the camera."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kitting_drake.common.errors import UserError

Array = NDArray[np.float64]

BASE, HAND, CAMERA = "base", "hand", "camera"
_WORDS = {
    CAMERA: r"cam|optical|rgb|depth|colou?r|realsense|kinect|zed|oak|eye|sensor|infra|d4\d\d",
    HAND: r"hand|tool|flange|gripper|tcp|effector|wrist|(^|[_/-])ee([_/-]|$)|link_?[5-8]$|axis",
    BASE: r"base|world|map|robot|table|link_?0$",
}
"""Patterns in the names of frames. The first pattern that matches decides, so `camera_base` is a
camera."""
_BODY = r"(link|base|base[_-]frame|screw[_-]frame|camera[_-]frame)$"
"""The pattern of names of a camera's body frame (x forward), as ROS's drivers name it."""


@dataclass(frozen=True)
class FoundPose:
    """A pose in a file: that of the frame `child` in the frame `parent`, as in ROS."""

    X: Array
    """A transform (4, 4) that maps points from `child` to `parent`."""
    where: str
    """The file or field, for error messages."""
    parent: str = ""
    """The name of the frame `parent`; empty if the file does not give it."""
    child: str = ""
    """The name of the frame `child`; empty if the file does not give it."""
    in_hand: bool | None = None
    """Whether the camera is on the hand; None if the file does not say it."""

    @property
    def inverse(self) -> FoundPose:
        """Returns the pose of `parent` in `child`."""
        X = np.asarray(np.linalg.inv(self.X), dtype=float)
        return FoundPose(X, self.where, self.child, self.parent, self.in_hand)


@dataclass(frozen=True)
class FrameNames:
    """The names of the base's and the camera's frames, which a user gives if a file is ambiguous;
    otherwise empty."""

    base: str = ""
    camera: str = ""

    @staticmethod
    def of(node: dict[str, Any]) -> FrameNames:
        """Reads the fields `base_frame` and `camera_frame` of a camera's entry."""
        return FrameNames(str(node.get("base_frame", "")), str(node.get("camera_frame", "")))

    def kind(self, name: str) -> str:
        """Returns BASE, HAND or CAMERA for a frame's name, or "" if the name does not show its
        kind."""
        plain = name.strip("/")
        if plain and plain == self.base.strip("/"):
            return BASE
        if plain and plain == self.camera.strip("/"):
            return CAMERA
        for kind, words in _WORDS.items():
            if re.search(words, plain.lower()):
                return kind
        return ""


def directed(found: FoundPose, names: FrameNames) -> FoundPose:
    """Returns the pose of the camera in the base or the hand, inverted if the frame names require
    it.

    A pose without frame names is returned unchanged. The pose of a hand-eye calibration is also
    returned unchanged, because its file states which pose it is.

    Raises:
        UserError: the names are ambiguous, or neither frame is a camera.
    """
    if not found.parent or not found.child or found.in_hand is not None:
        return found
    kinds = names.kind(found.parent), names.kind(found.child)
    if kinds[0] == CAMERA and kinds[1] in (BASE, HAND):
        found, kinds = found.inverse, (kinds[1], CAMERA)
    if kinds[1] != CAMERA or kinds[0] not in (BASE, HAND):
        raise UserError(
            f"{found.where} is the pose of {found.child} in {found.parent}, and it is not clear "
            "which of these frames is the robot's base and which is the camera: give base_frame "
            "and camera_frame beside it"
        )
    return FoundPose(found.X, found.where, found.parent, found.child, kinds[0] == HAND)


def is_body(name: str) -> bool:
    """Whether a name is that of a camera's body frame instead of its optical frame."""
    plain = name.lower()
    return "optical" not in plain and re.search(_BODY, plain) is not None
