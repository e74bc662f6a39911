"""Reads camera images, joint positions and joint targets off a station, for policies that command
joints."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydrake.systems.framework import Context

from kitting_drake.common.errors import UserError
from kitting_drake.policies.data.frames import GRIPPER, FrameSettings, image_key, reduce_image
from kitting_drake.station import KittingStation
from kitting_drake.station.robot import joint_names
from systems.trajectory_controller import FINGERS


def chosen_cameras(recording: FrameSettings, cameras: dict[str, Any]) -> tuple[str, ...]:
    """The names of the cameras to record: those that `recording` names or, if there are none, all
    cameras of the scenario.

    Raises:
        UserError: a name is unknown.
    """
    for name in recording.cameras:
        if name not in cameras:
            raise UserError(f"there is no camera '{name}': the scenario has {', '.join(cameras)}")
    return recording.cameras or tuple(cameras)


class JointView:
    """Reads a station's joints, joint targets and camera images."""

    def __init__(self, station: KittingStation, recording: FrameSettings) -> None:
        """
        Args:
            station: the station, with cameras.
            recording: the settings, which name cameras and image size.

        Raises:
            UserError: the settings name an unknown camera.
        """
        self._station, self._recording = station, recording
        self.cameras = chosen_cameras(recording, station.scenario.cameras)
        joints = joint_names(station.scenario.robot)
        self.names = (*joints, GRIPPER)
        """The names of the entries of `state` and `command`."""
        self._joints = len(joints)
        self._stiffness = station.scenario.controller.finger_stiffness

    def state(self, root_context: Context) -> NDArray[np.float32]:
        """(entries) the joints' positions and the opening between the pads, in rad and m."""
        state, j = self._port(root_context, "robot_state"), self._joints
        return np.array([*state[:j], sum(state[j : j + FINGERS])], np.float32)

    def command(self, root_context: Context) -> NDArray[np.float32]:
        """(entries) the planner's present targets, in rad and m. A closing force that the planner
        commands is converted to a smaller target opening with the same effect."""
        joints = self._port(root_context, "commanded")[: self._joints]
        opening = self._port(root_context, "commanded_opening")[0]
        force = self._port(root_context, "commanded_closing_force")[0]
        # See `FingerLaw`: a closing force f acts like an opening that is smaller by 2 f / k_w.
        return np.array([*joints, opening - 2 * force / self._stiffness], np.float32)

    def images(self, root_context: Context) -> dict[str, NDArray[np.uint8]]:
        """The cameras' images (height, width, 3), with the scenario's noise, by their
        `image_key`."""
        found = {}
        for camera in self.cameras:
            image = self._port(root_context, f"color_image_{camera}").data[:, :, :3]
            found[image_key(camera)] = reduce_image(np.ascontiguousarray(image), self._recording)
        return found

    def _port(self, root_context: Context, name: str) -> Any:
        station = self._station
        return station.GetOutputPort(name).Eval(station.GetMyContextFromRoot(root_context))
