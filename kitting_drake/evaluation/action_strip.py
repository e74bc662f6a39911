"""Draws a strip of frames: o_t before each action of an episode, and the action's outcome."""

import io
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from kitting_drake.episode import ModeChange
from kitting_drake.station import KittingStation
from systems.signals import Observation, PlanarPose

_MOST_FRAMES = 7
_PICK, _PLACE = "#e4572e", "#1b998b"


@dataclass(frozen=True)
class StripFrame:
    """One observation and the action that follows it."""

    colours: NDArray[np.float32]
    """(rows, cols, 3), in [0, 1]."""
    pick: NDArray[np.float64] | None
    """(row, col); None if no action follows."""
    place: NDArray[np.float64] | None
    """(row, col); None if no action follows."""


class ActionStrip:
    """Records o_t before each action and at the end. Its `observe` is an `EpisodeObserver`."""

    def __init__(self, station: KittingStation) -> None:
        """
        Args:
            station: the episode's, with cameras.
        """
        self._station = station
        self.frames: list[StripFrame] = []

    def observe(self, event: ModeChange) -> None:
        """Records a frame if the event needs one."""
        if not (event.is_action_start or event.is_stop):
            return
        seen = self._station.observation(event.root_context)
        colours = np.clip(seen.rgb.transpose(1, 2, 0), 0, 1)
        if event.is_stop:
            self.frames.append(StripFrame(colours, None, None))
            return
        action = self._station.accepted_action(event.root_context)
        pick, place = (_pixel(seen, pose) for pose in (action.pick, action.place))
        self.frames.append(StripFrame(colours, pick, place))


def _pixel(observation: Observation, pose: PlanarPose) -> NDArray[np.float64]:
    return observation.grid.to_pixel((pose.x, pose.y))


def draw_strips(rows: Sequence[tuple[str, Sequence[StripFrame], Sequence[str]]]) -> bytes:
    """Draws several strips, one below the other.

    Args:
        rows: for each strip its title, its frames and the outcome of each action.

    Returns:
        A PNG.
    """
    columns = min(_MOST_FRAMES, max(len(frames) for _, frames, _ in rows))
    figure = Figure(figsize=(3.1 * columns, 1.95 * len(rows)), layout="constrained", dpi=110)
    grid = figure.subplots(len(rows), columns, squeeze=False)
    for line, (title, frames, outcomes) in zip(grid, rows, strict=True):
        for axes in line:
            axes.set_axis_off()
        for number, (axes, frame) in enumerate(zip(line, frames, strict=False)):
            outcome = outcomes[number] if number < len(outcomes) else "done"
            _draw(axes, frame, f"{title}: {outcome}" if number == 0 else outcome)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png")
    return buffer.getvalue()


def _draw(axes: Axes, frame: StripFrame, title: str) -> None:
    axes.imshow(frame.colours)
    axes.set_title(title, loc="left", fontsize=9)
    if frame.pick is None or frame.place is None:
        return
    ends = np.stack([frame.pick, frame.place])
    axes.plot(ends[:, 1], ends[:, 0], color="white", lw=1.0)
    for pixel, colour in ((frame.pick, _PICK), (frame.place, _PLACE)):
        axes.plot(pixel[1], pixel[0], "o", color=colour, mec="white", mew=0.8, ms=6)
    rows, cols = frame.colours.shape[:2]
    axes.set(xlim=(-0.5, cols - 0.5), ylim=(rows - 0.5, -0.5))
