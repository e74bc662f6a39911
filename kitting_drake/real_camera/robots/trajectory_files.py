"""Writes joint trajectories as JSON with ROS's `trajectory_msgs/JointTrajectory`, and as CSV."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from kitting_drake.common.errors import UserError
from kitting_drake.common.files import write_atomically
from systems.arm_limits import JOINTS
from systems.arm_trajectory import ArmTrajectory, JawCommand, Segment

TRAJECTORY_FILES = ("trajectory.json", "trajectory.csv")
_DIGITS = 9
_KINDS = ("positions", "velocities", "accelerations")


def save_trajectory(
    folder: Path, trajectory: ArmTrajectory, joint_names: Sequence[str], robot: dict[str, Any]
) -> None:
    """Writes `trajectory.json` and `trajectory.csv`; docs/bench.md describes them.

    Args:
        folder: the folder for the files.
        trajectory: the trajectory to write.
        joint_names: the names of the seven joints.
        robot: a description of the arm, which is copied into the JSON.

    Raises:
        MachineError: a file cannot be written.
    """
    as_json, as_csv = (folder / name for name in TRAJECTORY_FILES)
    write_atomically(as_csv, _csv_text(trajectory, joint_names))
    write_atomically(as_json, _json_text(trajectory, joint_names, robot))


def _json_text(trajectory: ArmTrajectory, joint_names: Sequence[str], robot: dict[str, Any]) -> str:
    head = {
        "units": "metres, radians, seconds and newtons; docs/bench.md",
        "robot": robot,
        "rate": trajectory.rate,
        "duration": trajectory.duration,
        "limits_used": {name: round(share, 4) for name, share in trajectory.limits_used},
        "segments": [_segment_record(it, trajectory.rate) for it in trajectory.segments],
        "start_width": trajectory.start_width,
        "gripper": [_jaw_record(command) for command in trajectory.jaws],
    }
    arrays = [np.round(getattr(trajectory, kind), _DIGITS) for kind in _KINDS]
    points = [
        {kind: row[i].tolist() for kind, row in zip(_KINDS, arrays, strict=True)}
        | {"time_from_start": _ros_time(i / trajectory.rate)}
        for i in range(len(trajectory.positions))
    ]
    # Add the points after the other fields, each on a line of its own.
    text = json.dumps(head, indent=2).removesuffix("\n}")
    names = json.dumps(list(joint_names))
    lines = ",\n".join(f"      {json.dumps(point)}" for point in points)
    return (
        f'{text},\n  "joint_trajectory": {{\n    "joint_names": {names},\n    "points": [\n'
        f"{lines}\n    ]\n  }}\n}}\n"
    )


def _ros_time(seconds: float) -> dict[str, int]:
    nanoseconds = round(seconds * 1e9)
    return {"sec": nanoseconds // 10**9, "nanosec": nanoseconds % 10**9}


def _segment_record(segment: Segment, rate: float) -> dict[str, Any]:
    record: dict[str, Any] = {
        "name": segment.mode.lower(),
        "first_point": segment.first,
        "last_point": segment.last,
        "start": segment.first / rate,
        "end": segment.last / rate,
        "guarded": segment.stop_force is not None,
    }
    if segment.stop_force is not None:
        record["stop_force"] = segment.stop_force
    return record


def _jaw_record(command: JawCommand) -> dict[str, Any]:
    record: dict[str, Any] = {
        "time_from_start": command.time,
        "command": "grasp" if command.force else "move",
        "width": command.width,
        "speed": command.speed,
    }
    return record | ({"force": command.force} if command.force else {})


def _csv_text(trajectory: ArmTrajectory, joint_names: Sequence[str]) -> str:
    kinds = ("position", "velocity", "acceleration")
    head = ["time_from_start", *(f"{kind}_{name}" for kind in kinds for name in joint_names)]
    lines = [",".join([*head, "segment", "guarded"])]
    values = np.hstack([getattr(trajectory, kind) for kind in _KINDS])
    starts = np.array([segment.first for segment in trajectory.segments])
    for i, row in enumerate(values):
        segment = trajectory.segments[int(np.searchsorted(starts, i, side="right")) - 1]
        numbers = ",".join(f"{value:.{_DIGITS}f}" for value in (i / trajectory.rate, *row))
        guarded = int(segment.stop_force is not None)
        lines.append(f"{numbers},{segment.mode.lower()},{guarded}")
    return "\n".join(lines) + "\n"


def load_trajectory(path: Path) -> ArmTrajectory:
    """Reads a `trajectory.json`.

    Raises:
        UserError: the file is not a trajectory of `decide --robot`.
    """
    try:
        content = json.loads(path.read_text())
        points = content["joint_trajectory"]["points"]
        arrays = [np.array([point[kind] for point in points], dtype=float) for kind in _KINDS]
        if any(it.shape != (len(points), JOINTS) or not np.isfinite(it).all() for it in arrays):
            raise ValueError(
                "each point must have seven finite positions, velocities and accelerations"
            )
        if len(points) < 2:
            raise ValueError("it has fewer than two points")
        q, v, a = arrays
        return ArmTrajectory(
            float(content["rate"]),
            q,
            v,
            a,
            segments=tuple(
                Segment(
                    it["name"].upper(), it["first_point"], it["last_point"], it.get("stop_force")
                )
                for it in content["segments"]
            ),
            jaws=tuple(
                JawCommand(it["time_from_start"], it["width"], it["speed"], it.get("force", 0.0))
                for it in content["gripper"]
            ),
            start_width=float(content["start_width"]),
            limits_used=tuple(content["limits_used"].items()),
        )
    except OSError as error:
        raise UserError(f"cannot read {path}: {error.strerror}") from error
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        reason = str(error) if isinstance(error, ValueError) else "a field is missing or invalid"
        raise UserError(f"{path} is not a trajectory of `decide --robot`: {reason}") from error
