"""Draws an episode as a strip: the observation o_t before each action, and the action's outcome."""

import io
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from kitting_drake.episode import ModeChange
from kitting_drake.station import KittingStation
from systems.signals import Observation, PlanarPose

_MOST_FRAMES = 10
_COLUMNS = 5
_MARK = {"markeredgecolor": "white", "markeredgewidth": 1.2, "markersize": 10}
_PICK = {"color": "#e69f00", "marker": "o", **_MARK}
_PLACE = {"color": "#009e73", "marker": "s", **_MARK}
"""The style of the mark at the place. Colour-blind people can distinguish it from the mark at the
pick."""


@dataclass(frozen=True)
class StripFrame:
    """One observation and the action that follows it."""

    colours: NDArray[np.float32]
    """(rows, cols, 3) picture of the observation, in [0, 1]."""
    pick: NDArray[np.float64] | None
    """(row, col) of the action's pick; None if no action follows."""
    place: NDArray[np.float64] | None
    """(row, col) of the action's place; None if no action follows."""


class ActionStrip:
    """Records the observation o_t before each action and at the end. Pass its method `observe` as
    an `EpisodeObserver`."""

    def __init__(self, station: KittingStation) -> None:
        """
        Args:
            station: the station of the episode, with cameras.
        """
        self._station = station
        self.frames: list[StripFrame] = []

    def observe(self, event: ModeChange) -> None:
        """Records a frame when an action begins and when the episode ends."""
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
    """Draws several strips, one below the other. A long strip continues on another line.

    Args:
        rows: the title of each strip, its frames and the outcome of each action.

    Returns:
        The picture as PNG.
    """
    columns = min(_COLUMNS, max(len(frames) for _, frames, _ in rows))
    lines = [-(-min(len(frames), _MOST_FRAMES) // columns) for _, frames, _ in rows]
    with rc_context({"font.size": 14}):
        figure = Figure(figsize=(2.9 * columns, 1.9 * sum(lines) + 0.4), layout="constrained")
        parts = figure.subfigures(len(rows), 1, squeeze=False, height_ratios=lines)[:, 0]
        for part, count, (title, frames, outcomes) in zip(parts, lines, rows, strict=True):
            part.suptitle(title, x=0.005, horizontalalignment="left", fontweight="bold")
            grid = list(part.subplots(count, columns, squeeze=False).flat)
            for axes in grid:
                axes.set_axis_off()
            for number, (axes, frame) in enumerate(zip(grid, frames, strict=False)):
                _draw(axes, frame, outcomes[number] if number < len(outcomes) else "done")
        keys = [Line2D([], [], linestyle="", **look) for look in (_PICK, _PLACE)]
        names = ["pick", "place"]
        figure.legend(keys, names, loc="upper right", ncols=2, frameon=False, borderpad=0)
        buffer = io.BytesIO()
        figure.savefig(buffer, format="png", dpi=110)
    return buffer.getvalue()


def _draw(axes: Axes, frame: StripFrame, title: str) -> None:
    axes.imshow(frame.colours)
    axes.set_title(title, loc="left", fontsize=14)
    if frame.pick is None or frame.place is None:
        return
    ends = np.stack([frame.pick, frame.place])
    axes.plot(ends[:, 1], ends[:, 0], color="white", lw=1.6)
    for pixel, look in ((frame.pick, _PICK), (frame.place, _PLACE)):
        axes.plot(pixel[1], pixel[0], **look)
    rows, cols = frame.colours.shape[:2]
    axes.set(xlim=(-0.5, cols - 0.5), ylim=(rows - 0.5, -0.5))
