"""Records an episode as frames at a fixed rate."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from pydrake.systems.framework import Context

from kitting_drake.episode.joint_view import JointView
from kitting_drake.policies.data.frames import EpisodeFrames, FrameSettings, encode_png, image_key
from kitting_drake.station import KittingStation
from systems.placement import ALL


class FrameRecorder:
    """A `Sampler` of `run_episode` that takes frames from a station.

    A frame is taken at the step nearest to each multiple of the period.
    """

    def __init__(self, station: KittingStation, recording: FrameSettings) -> None:
        """
        Args:
            station: the station of the episode, with cameras.
            recording: rate, image size and cameras.

        Raises:
            UserError: a camera is unknown.
        """
        self._station, self._recording = station, recording
        self._view = JointView(station, recording)
        self._half_step = station.plant.time_step() / 2
        self._states: list[NDArray[np.float32]] = []
        self._commands: list[NDArray[np.float32]] = []
        self._rewards: list[float] = []
        self._images: dict[str, list[bytes]] = {camera: [] for camera in self._view.cameras}

    def sample(self, root_context: Context) -> None:
        """Takes a frame if one is due. Call it after each step, in order."""
        due = len(self._states) / self._recording.fps
        if root_context.get_time() < due - self._half_step:
            return
        self._states.append(self._view.state(root_context))
        self._commands.append(self._view.command(root_context))
        self._rewards.append(self._station.reward(root_context))
        images = self._view.images(root_context)
        for camera, pictures in self._images.items():
            pictures.append(encode_png(images[image_key(camera)]))

    def frames(self) -> EpisodeFrames:
        """Returns all frames so far. The action of the last frame is the present command."""
        commands = np.array(self._commands)
        rewards = np.array([*self._rewards, self._rewards[-1]])
        return EpisodeFrames(
            seed=self._station.seed,
            fps=self._recording.fps,
            names=self._view.names,
            state=np.array(self._states),
            action=np.concatenate([commands[1:], commands[-1:]]),
            reward=np.diff(rewards).astype(np.float32),
            success=rewards[1:] > ALL,
            images=self._images,
        )
