"""Logs joints, commands, forces, observations and actions of an episode, as NumPy's `.npz` or as
MCAP for Foxglove and rerun."""

from __future__ import annotations

import argparse
import io
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydrake.systems.framework import Context

from kitting_drake.common.errors import UserError
from kitting_drake.common.extras import import_extra
from kitting_drake.common.files import write_atomically
from kitting_drake.episode.mcap_messages import definition, mcap_messages
from kitting_drake.station import KittingStation
from kitting_drake.station.robot import joint_names
from systems.pick_place_parameters import Mode

ENDINGS = (".npz", ".mcap")
_SAMPLED = ("time", "state", "hand", "torque", "wrist", "commanded", "opening", "mode")

Arrays = dict[str, NDArray[Any]]


def add_log_flag(parser: argparse.ArgumentParser) -> None:
    """Adds the flag `--log` to a parser."""
    parser.add_argument(
        "--log",
        type=Path,
        metavar="FILE.npz",
        help="also log joints, forces, heightmaps, actions (.npz, or .mcap for Foxglove, rerun)",
    )


def check_log(path: Path) -> None:
    """Checks, before the episode, that a log can be written to a file.

    Raises:
        UserError: the file's suffix is not supported, or the path is a folder.
        MachineError: a required package is not installed.
    """
    if path.suffix not in ENDINGS:
        raise UserError(f"--log writes {' and '.join(ENDINGS)} files, not '{path}'")
    if path.is_dir():
        raise UserError(f"--log: {path} is a folder: name a file")
    if path.suffix == ".mcap":
        _mcap_package()


def log_of_many(path: Path | None, cluster: str | None) -> Path | None:
    """Checks and returns the file of `--log` for a command that runs many episodes.

    Args:
        path: the path of `--log`, if given; see `log_of_seed`.
        cluster: the cluster of `--ray`, if given.

    Raises:
        UserError: the file cannot be used (see `check_log`), or `--ray` is given as well.
        MachineError: a required package is not installed.
    """
    if path is None:
        return None
    check_log(path)
    if cluster is not None:
        raise UserError("--log cannot write files from other machines: leave out --ray")
    return path.resolve()


def log_of_seed(path: Path, seed: int) -> Path:
    """The log file of one of many episodes. For seed 7, `runs/log.npz` becomes
    `runs/log_00000007.npz`."""
    return path.with_name(f"{path.stem}_{seed:08d}{path.suffix}")


class EpisodeLog:
    """Logs an episode, with one sample per step of the plant."""

    def __init__(self, station: KittingStation) -> None:
        """
        Args:
            station: the station of the episode.
        """
        self._station = station
        self._samples: dict[str, list[NDArray[np.float64]]] = {name: [] for name in _SAMPLED}
        self._poses: list[NDArray[np.float64]] = []
        self._actions: list[tuple[float, NDArray[np.float64], NDArray[np.float64], bool]] = []
        self._heights: list[NDArray[np.float32]] = []
        self._seen: NDArray[np.float32] | None = None

    def sample(self, root_context: Context) -> None:
        """Appends a sample. Call it after each step, in order."""
        station = self._station
        context = station.GetMyContextFromRoot(root_context)

        def port(name: str) -> Any:
            return station.GetOutputPort(name).Eval(context)

        for key, value in (
            ("time", np.array(root_context.get_time())),
            ("state", port("robot_state")),
            ("hand", port("hand_state")[:4]),
            ("torque", port("actuation")),
            ("wrist", port("wrist_force")),
            ("commanded", port("commanded")),
            ("opening", port("commanded_opening")),
            ("mode", port("mode")[0]),
        ):
            self._samples[key].append(np.array(value))
        self._poses.append(
            np.array([X_WB.GetAsMatrix34() for X_WB in station.object_poses(root_context)])
        )
        if int(port("counts")[0]) > len(self._actions):
            action = port("accepted_action")
            poses = (action.pick.as_array(), action.place.as_array())
            self._actions.append((root_context.get_time(), *poses, action.press))
            if self._seen is not None:
                self._heights.append(self._seen)
        if station.has_cameras and port("asks")[0]:
            # This is the policy's observation: Drake's cache avoids a second rendering.
            self._seen = port("observation_heights").height.astype(np.float32)

    def arrays(self) -> Arrays:
        """Returns the log of n samples and k actions, in SI units, radians and the world frame.

        Returns:
            For each step:

            - `time` (n); `mode` (n), a `Mode`;
            - `joint_position`, `joint_velocity`, `joint_torque` (n, j), of the robot's joints: x,
              y, z and yaw of the floating hand, or the seven of an arm;
            - `hand_pose` (n, 4), x, y, z and yaw of the hand;
            - `finger_position`, `finger_force` (n, 2), the force of the actuators;
            - `wrist_force` (n, 6), contact forces along x, y, z, the moment about z, and the force
              on each finger;
            - `commanded_position`, `commanded_velocity`, `commanded_acceleration` (n, j);
            - `commanded_opening` (n, 2), the opening between the pads and its rate;
            - `object_poses` (n, objects, 3, 4), X_WB.

            For each action:

            - `action_time` (k), its start;
            - `pick`, `place` (k, 3), x, y and theta; `press` (k), whether the action presses;
            - `observation_height` (k, rows, cols), the heights that the policy observed; missing
              without cameras.

            Names: `joint_names`, `mode_names`, `object_names`.
        """
        found = {key: np.array(values) for key, values in self._samples.items()}
        names = joint_names(self._station.scenario.robot)
        j = len(names)
        state, torque, commanded = found["state"], found["torque"], found["commanded"]
        times = np.array([action[0] for action in self._actions])
        picks = np.array([action[1] for action in self._actions]).reshape(-1, 3)
        places = np.array([action[2] for action in self._actions]).reshape(-1, 3)
        arrays: Arrays = {
            "time": found["time"],
            "joint_position": state[:, :j],
            "joint_velocity": state[:, j + 2 : 2 * j + 2],
            "joint_torque": torque[:, :j],
            "finger_position": state[:, j : j + 2],
            "finger_force": torque[:, j:],
            "hand_pose": found["hand"],
            "wrist_force": found["wrist"],
            "commanded_position": commanded[:, :j],
            "commanded_velocity": commanded[:, j : 2 * j],
            "commanded_acceleration": commanded[:, 2 * j :],
            "commanded_opening": found["opening"],
            "mode": found["mode"].astype(np.int8),
            "object_poses": np.array(self._poses),
            "action_time": times,
            "pick": picks,
            "place": places,
            "press": np.array([action[3] for action in self._actions], bool),
            "joint_names": np.array(names),
            "mode_names": np.array([mode.name for mode in Mode]),
            "object_names": np.array([item.name for item in self._station.objects]),
        }
        if len(self._heights) == len(times) > 0:
            arrays["observation_height"] = np.array(self._heights)
        return arrays

    def save(self, path: Path) -> None:
        """Writes the log to a `.npz` or `.mcap` file, atomically.

        Raises:
            MachineError: writing fails, or a required package is not installed.
        """
        buffer = io.BytesIO()
        if path.suffix == ".npz":
            np.savez_compressed(buffer, allow_pickle=False, **self.arrays())
        else:
            _write_mcap(buffer, self.arrays())
        write_atomically(path, buffer.getvalue())


def _write_mcap(buffer: io.BytesIO, arrays: Arrays) -> None:
    writer = _mcap_package().writer.Writer(buffer)
    schemas = {}
    for message in mcap_messages(arrays):
        if message.kind not in schemas:
            schemas[message.kind] = writer.register_msgdef(message.kind, definition(message.kind))
        writer.write_message(
            message.topic,
            schemas[message.kind],
            message.content,
            log_time=round(1e9 * message.time),
        )
    writer.finish()


def _mcap_package() -> ModuleType:
    return import_extra("mcap_ros2", "writer", purpose="--log FILE.mcap", extra="log")
