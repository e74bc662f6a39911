"""Converts a log to ROS 2 messages, which Foxglove, rerun and PlotJuggler read."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RotationMatrix

_PERIOD = 1 / 32
"""Period of poses, in s. Joints and forces are written at every step."""

_RULE = "=" * 80
_PARTS = {
    "builtin_interfaces/Time": "int32 sec\nuint32 nanosec",
    "std_msgs/Header": "builtin_interfaces/Time stamp\nstring frame_id",
    "geometry_msgs/Vector3": "float64 x\nfloat64 y\nfloat64 z",
    "geometry_msgs/Point": "float64 x\nfloat64 y\nfloat64 z",
    "geometry_msgs/Quaternion": "float64 x\nfloat64 y\nfloat64 z\nfloat64 w",
    "geometry_msgs/Wrench": "geometry_msgs/Vector3 force\ngeometry_msgs/Vector3 torque",
    "geometry_msgs/Pose": "geometry_msgs/Point position\ngeometry_msgs/Quaternion orientation",
    "geometry_msgs/Transform": (
        "geometry_msgs/Vector3 translation\ngeometry_msgs/Quaternion rotation"
    ),
    "geometry_msgs/TransformStamped": (
        "std_msgs/Header header\nstring child_frame_id\ngeometry_msgs/Transform transform"
    ),
}
"""Definitions of the message types that are parts of other types."""

_DEFINITIONS = {
    "sensor_msgs/msg/JointState": (
        "std_msgs/Header header\nstring[] name\nfloat64[] position\nfloat64[] velocity\n"
        "float64[] effort"
    ),
    "geometry_msgs/msg/WrenchStamped": "std_msgs/Header header\ngeometry_msgs/Wrench wrench",
    "geometry_msgs/msg/PoseStamped": "std_msgs/Header header\ngeometry_msgs/Pose pose",
    "tf2_msgs/msg/TFMessage": "geometry_msgs/TransformStamped[] transforms",
    "sensor_msgs/msg/Image": (
        "std_msgs/Header header\nuint32 height\nuint32 width\nstring encoding\n"
        "uint8 is_bigendian\nuint32 step\nuint8[] data"
    ),
    "std_msgs/msg/String": "string data",
}


@dataclass(frozen=True)
class Message:
    """A ROS 2 message with its topic and time."""

    topic: str
    kind: str
    """The message's type, a key of `_DEFINITIONS`."""
    time: float
    """Time of the message in the episode, in s."""
    content: dict[str, Any]


def definition(kind: str) -> str:
    """The schema text of a message type, including the types that it uses."""
    texts, pending = [_DEFINITIONS[kind]], [_DEFINITIONS[kind]]
    used: list[str] = []
    while pending:
        text = pending.pop()
        for line in text.splitlines():
            name = line.split()[0].removesuffix("[]")
            if name in _PARTS and name not in used:
                used.append(name)
                pending.append(_PARTS[name])
                texts.append(f"{_RULE}\nMSG: {name}\n{_PARTS[name]}")
    return "\n".join(texts)


def mcap_messages(arrays: Mapping[str, NDArray[Any]]) -> Iterator[Message]:
    """The messages of a log, ordered by time.

    - `/joint_states`, `/joint_commands`: `JointState` of the robot's joints. `/gripper`:
      `JointState` of the fingers.
    - `/wrist_wrench`: `WrenchStamped`, the contact forces on the hand.
    - `/mode`: `String`, the planner's mode when it changes.
    - `/tf`: `TFMessage`, hand and objects in the frame `world`, 32 times a second.
    - `/pick`, `/place`: `PoseStamped` at the start of each action.
    - `/observation_height`: `Image` of 32-bit floats, the heights that the policy observed, in
      metres.

    Args:
        arrays: the arrays of `EpisodeLog.arrays`.
    """
    shown, before, begun = -np.inf, None, 0
    for index, time in enumerate(arrays["time"].tolist()):
        while begun < len(arrays["action_time"]) and arrays["action_time"][begun] <= time:
            yield from _action(arrays, begun, time)
            begun += 1
        yield from _joints(arrays, index, time)
        mode = str(arrays["mode_names"][arrays["mode"][index]])
        if mode != before:
            before = mode
            yield Message("/mode", "std_msgs/msg/String", time, {"data": mode})
        if time - shown >= _PERIOD - 1e-9:
            shown = time
            transforms = {"transforms": list(_transforms(arrays, index, time))}
            yield Message("/tf", "tf2_msgs/msg/TFMessage", time, transforms)


def _joints(arrays: Mapping[str, NDArray[Any]], index: int, time: float) -> Iterator[Message]:
    names = arrays["joint_names"].tolist()
    for topic, joints, keys in (
        ("/joint_states", names, ("joint_position", "joint_velocity", "joint_torque")),
        ("/joint_commands", names, ("commanded_position", "commanded_velocity", None)),
        ("/gripper", ["left_finger", "right_finger"], ("finger_position", None, "finger_force")),
    ):
        values = [[] if key is None else arrays[key][index].tolist() for key in keys]
        content = dict(zip(("position", "velocity", "effort"), values, strict=True))
        content |= {"header": _header(time), "name": joints}
        yield Message(topic, "sensor_msgs/msg/JointState", time, content)
    x, y, z, about_z, *_ = arrays["wrist_force"][index].tolist()
    wrench = {"force": _vector((x, y, z)), "torque": _vector((0.0, 0.0, about_z))}
    content = {"header": _header(time), "wrench": wrench}
    yield Message("/wrist_wrench", "geometry_msgs/msg/WrenchStamped", time, content)


def _action(arrays: Mapping[str, NDArray[Any]], index: int, time: float) -> Iterator[Message]:
    for name in ("pick", "place"):
        x, y, theta = arrays[name][index].tolist()
        pose = {"position": _vector((x, y, 0.0)), "orientation": _yaw(theta)}
        content = {"header": _header(time), "pose": pose}
        yield Message(f"/{name}", "geometry_msgs/msg/PoseStamped", time, content)
    if "observation_height" not in arrays:
        return
    height = np.ascontiguousarray(arrays["observation_height"][index], "<f4")
    image = {
        "header": _header(time),
        "height": height.shape[0],
        "width": height.shape[1],
        "encoding": "32FC1",
        "is_bigendian": 0,
        "step": 4 * height.shape[1],
        "data": height.tobytes(),
    }
    yield Message("/observation_height", "sensor_msgs/msg/Image", time, image)


def _transforms(
    arrays: Mapping[str, NDArray[Any]], index: int, time: float
) -> Iterator[dict[str, Any]]:
    x, y, z, yaw = arrays["hand_pose"][index].tolist()
    frames = [("hand", (x, y, z), _yaw(yaw))]
    for name, X_WB in zip(
        arrays["object_names"].tolist(), arrays["object_poses"][index], strict=True
    ):
        R_WB = RotationMatrix.ProjectToRotationMatrix(X_WB[:, :3]).ToQuaternion()
        rotation = {axis: getattr(R_WB, axis)() for axis in "xyzw"}
        frames.append((name, tuple(X_WB[:, 3].tolist()), rotation))
    for name, p_W, rotation in frames:
        yield {
            "header": _header(time),
            "child_frame_id": name,
            "transform": {"translation": _vector(p_W), "rotation": rotation},
        }


def _vector(values: tuple[float, ...]) -> dict[str, float]:
    return dict(zip("xyz", values, strict=True))


def _yaw(angle: float) -> dict[str, float]:
    return {"x": 0.0, "y": 0.0, "z": float(np.sin(angle / 2)), "w": float(np.cos(angle / 2))}


def _header(time: float) -> dict[str, Any]:
    seconds, nanoseconds = divmod(round(1e9 * time), 1_000_000_000)
    return {"stamp": {"sec": seconds, "nanosec": nanoseconds}, "frame_id": "world"}
