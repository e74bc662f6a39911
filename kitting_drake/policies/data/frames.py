"""Episodes as frames at a fixed rate, with camera images, joints and commands, for imitation
learning.

The names are those of LeRobot datasets, and of the environments in `kitting_drake.gym` that take
joint targets.
"""

from __future__ import annotations

import io
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from kitting_drake.common.errors import UserError
from kitting_drake.common.files import write_atomically

STATE = "observation.state"
ACTION = "action"
GRIPPER = "gripper"
"""The name of the last entry of states and actions. In a state it is the opening between the pads,
in m. In an action it is the opening towards which the fingers' springs pull, in m. This opening is
smaller than a held object, or negative for a firmer grip."""
RATES = range(10, 31)
"""The permitted numbers of frames per second."""
DEFAULT_RATE = 16
"""The default number of frames per second. It divides the 128 simulation steps of a second, so that
frames are equally far apart."""
DEFAULT_WIDTH = 160


def image_key(camera: str) -> str:
    """Returns the name of a camera's images in LeRobot datasets and environments."""
    return f"observation.images.{camera}"


@dataclass(frozen=True)
class FrameSettings:
    """Settings of the recording of episodes as frames."""

    fps: int = DEFAULT_RATE
    """Frames per simulated second, one of `RATES`."""
    width: int = DEFAULT_WIDTH
    """Largest width of the images, in pixels."""
    cameras: tuple[str, ...] = ()
    """Names of the cameras to record; empty for all cameras of the scenario."""

    def __post_init__(self) -> None:
        """Raises UserError if the rate or the width cannot be used."""
        if self.fps not in RATES:
            raise UserError(f"fps is {self.fps}: use {RATES[0]} to {RATES[-1]}")
        if self.width < 16:
            raise UserError(f"image_width is {self.width} pixels: use at least 16")

    def size(self, width: int, height: int) -> tuple[int, int]:
        """Returns the width and height of the recorded images of a camera, in pixels. They have the
        camera's aspect ratio.

        Args:
            width: the width of the camera's own images, in pixels. Recorded images are not larger.
            height: the height of the camera's own images, in pixels.
        """
        scale = min(1.0, self.width / width)
        return max(1, round(scale * width)), max(1, round(scale * height))


def reduce_image(image: NDArray[np.uint8], recording: FrameSettings) -> NDArray[np.uint8]:
    """Reduces an image (height, width, 3) to the recorded size. Each pixel is the mean of the area
    that it covers."""
    height, width = image.shape[:2]
    size = recording.size(width, height)
    if size == (width, height):
        return image
    return np.asarray(Image.fromarray(image).resize(size, Image.Resampling.BOX))


def encode_png(image: NDArray[np.uint8]) -> bytes:
    """Encodes an image (height, width, 3) as PNG."""
    content = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(image)).save(content, "PNG")
    return content.getvalue()


@dataclass
class EpisodeFrames:
    """The n frames of an episode."""

    seed: int
    fps: int
    names: tuple[str, ...]
    """Names of the entries of states and actions: the joints that move the hand, then `GRIPPER`."""
    state: NDArray[np.float32]
    """(n, entries) measured positions, in m and rad."""
    action: NDArray[np.float32]
    """(n, entries) commanded positions, in m and rad, at the time of the next frame."""
    reward: NDArray[np.float32]
    """(n) the increase of the task's reward from each frame to the next."""
    success: NDArray[np.bool_]
    """(n) for each frame, whether every goal is filled at the next frame."""
    images: dict[str, list[bytes]] = field(default_factory=dict)
    """For each camera, the PNG of each frame."""

    def __len__(self) -> int:
        return len(self.state)

    def save(self, path: Path) -> None:
        """Writes a `.npz` file atomically.

        Raises:
            MachineError: writing fails.
        """
        arrays = {
            "seed": np.array(self.seed),
            "fps": np.array(self.fps),
            "names": np.array(self.names),
            "cameras": np.array(list(self.images), dtype=np.str_),
            "state": self.state,
            "action": self.action,
            "reward": self.reward,
            "success": self.success,
        }
        for camera, pictures in self.images.items():
            arrays[f"sizes {camera}"] = np.array([len(item) for item in pictures])
            arrays[f"images {camera}"] = np.frombuffer(b"".join(pictures), np.uint8)
        buffer = io.BytesIO()
        np.savez(buffer, allow_pickle=False, **arrays)
        write_atomically(path, buffer.getvalue())


def read_frames(path: Path) -> EpisodeFrames:
    """Reads a file that `EpisodeFrames.save` wrote.

    Raises:
        UserError: the file is unusable.
    """
    try:
        with np.load(path) as file:
            images = {}
            for camera in file["cameras"].tolist():
                ends = np.cumsum(file[f"sizes {camera}"]).tolist()
                content = file[f"images {camera}"].tobytes()
                starts = [0, *ends[:-1]]
                images[camera] = [content[a:b] for a, b in zip(starts, ends, strict=True)]
            return EpisodeFrames(
                seed=int(file["seed"]),
                fps=int(file["fps"]),
                names=tuple(file["names"].tolist()),
                state=file["state"],
                action=file["action"],
                reward=file["reward"],
                success=file["success"],
                images=images,
            )
    except FileNotFoundError as error:
        raise UserError(f"there is no file {path}") from error
    except (OSError, ValueError, KeyError) as error:
        raise UserError(f"{path} is damaged: delete it, and collect again") from error
