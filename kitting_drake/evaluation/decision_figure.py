"""Draws a learned policy's decision: the observation and the predicted maps."""

from __future__ import annotations

import io
import math
import textwrap
from typing import TYPE_CHECKING

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from numpy.typing import NDArray

from systems.signals import Observation, PickPlaceAction, PixelGrid

if TYPE_CHECKING:
    from kitting_drake.policies.learned_policy import Decision

_JAWS = 0.04
"""Half the opening of the jaws in the drawing, in metres."""
_PICK, _PLACE = "#e4572e", "#1b998b"
_UNSEEN, _STRIPE = (0.80, 0.72, 0.86), (0.68, 0.57, 0.78)
"""Colours of the stripes on pixels that a camera sees, but for which it measured no depth."""
_OUTSIDE = (0.90, 0.90, 0.90)
"""Colour of pixels outside all cameras' views or outside the region of interest."""
_STRIPES = 6
"""Width of a dark and a light stripe together, in pixels."""
_MOST_LETTERS = 150
"""Largest number of characters in a line of the title."""


def draw_decision(observation: Observation, decision: Decision, *, title: str = "") -> bytes:
    """Draws the observation with the gripper at pick and place, and the maps of pick, place and
    angle.

    If the policy stops, no gripper is drawn, and the maps are those of the rejected action.

    Args:
        observation: the observation on which the decision is based.
        decision: the decision of a learned policy.
        title: the title of the picture. If it is empty, the title is the kind of action, with its
            log-odds if the networks predict them.

    Returns:
        The picture as PNG.
    """
    figure = Figure(figsize=(12, 8), layout="constrained", dpi=110)
    axes = figure.subplot_mosaic(
        [["colour", "height"], ["pick", "place"], ["angle", "angle"]],
        height_ratios=[1, 1, 0.45],
    )
    _entitle(figure, title or _title(decision))
    colours = np.clip(observation.rgb.transpose(1, 2, 0), 0, 1)
    _draw_observation(axes["colour"], axes["height"], observation)
    if not decision.stop:
        for name in ("colour", "height"):
            _draw_grippers(axes[name], observation.grid, decision.action)
    _draw_maps(axes["pick"], axes["place"], decision, colours)
    _draw_angles(axes["angle"], decision)
    return _as_png(figure)


def draw_action(observation: Observation, action: PickPlaceAction, *, title: str = "") -> bytes:
    """Draws the observation with the gripper at pick and place, for a decision without maps.

    Args:
        observation: the observation on which the decision is based.
        action: the decision.
        title: the title of the picture. If it is empty, the title is the kind of action.

    Returns:
        The picture as PNG.
    """
    figure = Figure(figsize=(12, 3.5), layout="constrained", dpi=110)
    axes = figure.subplot_mosaic([["colour", "height"]])
    said = "press" if action.press else "pick and place"
    _entitle(figure, title or ("stop" if action.stop else said))
    _draw_observation(axes["colour"], axes["height"], observation)
    if not action.stop:
        for axis in axes.values():
            _draw_grippers(axis, observation.grid, action)
    return _as_png(figure)


def draw_maps(observation: Observation, decision: Decision, *, width: int) -> bytes:
    """Draws only the two maps of pick and place, side by side, for a frame of a video.

    Args:
        observation: the observation on which the decision is based.
        decision: a learned policy's decision.
        width: the width of the picture, in pixels; its height follows from the maps.

    Returns:
        The picture as PNG.
    """
    rows, cols = observation.height.shape
    dpi, gap, title = 100, 4, 20
    map_width = (width - gap) / 2
    height = map_width * rows / cols + title
    figure = Figure(figsize=(width / dpi, height / dpi), dpi=dpi)
    share = map_width / width, 1 - title / height
    pick = figure.add_axes((0.0, 0.0, *share))
    place = figure.add_axes((1 - share[0], 0.0, *share))
    _draw_maps(pick, place, decision, np.clip(observation.rgb.transpose(1, 2, 0), 0, 1))
    pick.set_title("stop" if decision.stop else "where to pick", loc="left", fontsize=9, pad=5)
    place.set_title("" if decision.stop else "where to place", loc="left", fontsize=9, pad=5)
    return _as_png(figure)


def _as_png(figure: Figure) -> bytes:
    buffer = io.BytesIO()
    with matplotlib.rc_context({"font.size": 9}):
        figure.savefig(buffer, format="png")
    return buffer.getvalue()


def _entitle(figure: Figure, title: str) -> None:
    if title:
        wrapped = textwrap.fill(title, _MOST_LETTERS)
        figure.suptitle(wrapped, x=0.01, horizontalalignment="left", fontsize=11)


def _draw_observation(colour: Axes, height: Axes, observation: Observation) -> None:
    _show(colour, "observation: colour")
    colour.imshow(np.clip(observation.rgb.transpose(1, 2, 0), 0, 1))
    _show(height, "observation: height")
    height.imshow(1e3 * observation.height, cmap="viridis")
    outside = ~observation.in_view & ~observation.valid
    unseen = ~observation.valid & ~outside
    rows, cols = np.indices(unseen.shape)
    striped = (rows + cols) % _STRIPES < _STRIPES // 2
    cover = np.zeros((*unseen.shape, 4))
    for where, tint in ((unseen, _UNSEEN), (unseen & striped, _STRIPE), (outside, _OUTSIDE)):
        cover[where] = (*tint, 1.0)
    for axes in (colour, height):
        axes.imshow(cover, interpolation="nearest")
    handles = []
    if unseen.any():
        handles.append(
            Patch(facecolor=_UNSEEN, edgecolor=_STRIPE, hatch="/////", lw=0, label="not seen")
        )
    if outside.any():
        handles.append(
            Patch(facecolor=_OUTSIDE, edgecolor="0.7", lw=0.5, label="out of view or region")
        )
    if handles:
        height.legend(
            handles=handles,
            loc="lower right",
            bbox_to_anchor=(1.0, 1.0),
            borderaxespad=0.2,
            ncols=2,
            frameon=False,
            fontsize=9,
        )


def _title(decision: Decision) -> str:
    """Returns a title with the kind of action, and the log-odds that there is something to pick.

    If the networks do not predict log-odds, the title is "stop" or empty.
    """
    said = "stop" if decision.stop else "pick and place"
    if decision.log_odds is None:
        return said if decision.stop else ""
    return f"{said}: log-odds that there is something to pick {decision.log_odds:+.1f}"


def _draw_maps(
    pick_axes: Axes, place_axes: Axes, decision: Decision, colours: NDArray[np.floating]
) -> None:
    grey = np.repeat(colours.mean(axis=2, keepdims=True), 3, axis=2)
    # Show probabilities down to a thousandth of the largest.
    log_pick = np.log10(np.maximum(decision.pick_map, 1e-12) / decision.pick_map.max())
    for axes, title, depth, cmap, pixel in (
        (
            pick_axes,
            "where to pick: p(u, v), over three decades",
            (log_pick + 3) / 3,
            "inferno",
            decision.pick_pixel,
        ),
        (
            place_axes,
            "where to place: best score over all rotations, down to 15 nats",
            (decision.place_map + 15) / 15,
            "viridis",
            decision.place_pixel,
        ),
    ):
        _show(axes, title)
        axes.imshow(grey)
        shown = np.clip(depth, 0, 1)
        axes.imshow(shown, cmap=cmap, alpha=np.sqrt(shown) * 0.9, vmin=0, vmax=1)
        axes.plot(pixel[1], pixel[0], "o", mfc="none", mec="white", ms=11, mew=1.4)


def _draw_angles(axes: Axes, decision: Decision) -> None:
    angles = 180 * np.arange(len(decision.angle_curve)) / len(decision.angle_curve)
    axes.fill_between(angles, decision.angle_curve, color=_PICK, alpha=0.25, step="mid")
    axes.step(angles, decision.angle_curve, where="mid", color=_PICK)
    if not decision.stop:
        axes.axvline(math.degrees(decision.action.pick.theta) % 180, color="0.3", lw=1, ls="--")
    axes.set(
        xlim=(0, 180),
        ylim=(0, None),
        xlabel="pick angle, degrees (modulo half a rotation)",
        ylabel="probability",
    )
    axes.set_xticks(range(0, 181, 15))
    axes.spines[["top", "right"]].set_visible(False)


def _show(axes: Axes, title: str) -> None:
    axes.set_title(title, loc="left", fontsize=9)
    axes.set_xticks([])
    axes.set_yticks([])
    axes.spines[:].set_visible(False)


def _draw_grippers(axes: Axes, grid: PixelGrid, action: PickPlaceAction) -> None:
    """Draws the gripper at pick and place, and an arrow between them."""
    reach = _JAWS / grid.resolution
    pick, place = (grid.to_pixel((pose.x, pose.y)) for pose in (action.pick, action.place))
    _draw_gripper(axes, pick, action.pick.theta, reach, _PICK)
    if action.press:
        return
    _draw_gripper(axes, place, action.place.theta, reach, _PLACE)
    axes.annotate(
        "",
        xy=tuple(place[::-1]),
        xytext=tuple(pick[::-1]),
        arrowprops={
            "arrowstyle": "->",
            "color": "white",
            "lw": 1.4,
            "shrinkA": 7,
            "shrinkB": 7,
        },
    )


def _draw_gripper(
    axes: Axes, pixel: NDArray[np.float64], theta: float, reach: float, colour: str
) -> None:
    """Draws the pads and a line between them; at theta zero the jaws close along the columns."""
    closing = np.array([-math.sin(theta), math.cos(theta)])
    pad = np.array([math.cos(theta), math.sin(theta)])
    ends = np.stack([pixel - reach * closing, pixel + reach * closing])
    axes.plot(ends[:, 1], ends[:, 0], color=colour, lw=1.2)
    for end in ends:
        line = np.stack([end - 0.3 * reach * pad, end + 0.3 * reach * pad])
        axes.plot(line[:, 1], line[:, 0], color=colour, lw=3, solid_capstyle="butt")
    axes.plot(pixel[1], pixel[0], "o", color=colour, ms=3.5)
