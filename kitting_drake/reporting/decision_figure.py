"""A picture of a learned policy's decision: what it saw, and the maps that it decided from."""

from __future__ import annotations

import io
import math
from typing import TYPE_CHECKING

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from systems.signals import Observation

if TYPE_CHECKING:
    from kitting_drake.policies.learned_policy import Decision

_JAWS = 0.04
"""Half the opening of the jaws in the drawing, in metres."""
_PICK, _PLACE = "#e4572e", "#1b998b"


def draw_decision(observation: Observation, decision: Decision) -> bytes:
    """The observation with both gripper poses, the three maps, and nothing else.

    Returns:
        A PNG.
    """
    figure = Figure(figsize=(12, 8), layout="constrained", dpi=110)
    axes = figure.subplot_mosaic(
        [["colour", "height"], ["pick", "place"], ["angle", "angle"]],
        height_ratios=[1, 1, 0.45],
    )
    colours = np.clip(observation.rgb.transpose(1, 2, 0), 0, 1)
    _show(axes["colour"], "observation: colour", observation)
    axes["colour"].imshow(colours)
    _show(axes["height"], "observation: height", observation)
    axes["height"].imshow(1e3 * observation.height, cmap="viridis")
    grey = np.repeat(colours.mean(axis=2, keepdims=True), 3, axis=2)

    # A probability of a thousandth of the largest still shows.
    log_pick = np.log10(np.maximum(decision.pick_map, 1e-12) / decision.pick_map.max())
    for name, title, depth, cmap in (
        ("pick", "where to pick: p(u, v), over three decades", (log_pick + 3) / 3, "inferno"),
        (
            "place",
            "where to place: best score over all turns, down to 15 nats",
            (decision.place_map + 15) / 15,
            "viridis",
        ),
    ):
        _show(axes[name], title, observation)
        axes[name].imshow(grey)
        shown = np.clip(depth, 0, 1)
        axes[name].imshow(shown, cmap=cmap, alpha=np.sqrt(shown) * 0.9, vmin=0, vmax=1)

    action = decision.action
    for name in ("colour", "height"):
        _gripper(axes[name], decision.pick_pixel, action.pick.theta, observation, _PICK)
        _gripper(axes[name], decision.place_pixel, action.place.theta, observation, _PLACE)
        axes[name].annotate(
            "",
            xy=tuple(decision.place_pixel[::-1]),
            xytext=tuple(decision.pick_pixel[::-1]),
            arrowprops={
                "arrowstyle": "->",
                "color": "white",
                "lw": 1.4,
                "shrinkA": 7,
                "shrinkB": 7,
            },
        )
    for name, pixel in (("pick", decision.pick_pixel), ("place", decision.place_pixel)):
        axes[name].plot(pixel[1], pixel[0], "o", mfc="none", mec="white", ms=11, mew=1.4)

    curve = axes["angle"]
    angles = 180 * np.arange(len(decision.angle_curve)) / len(decision.angle_curve)
    curve.fill_between(angles, decision.angle_curve, color=_PICK, alpha=0.25, step="mid")
    curve.step(angles, decision.angle_curve, where="mid", color=_PICK)
    curve.axvline(math.degrees(action.pick.theta) % 180, color="0.3", lw=1, ls="--")
    curve.set(
        xlim=(0, 180),
        ylim=(0, None),
        xlabel="pick angle, degrees (a half turn is none)",
        ylabel="probability",
    )
    curve.set_xticks(range(0, 181, 15))
    curve.spines[["top", "right"]].set_visible(False)
    buffer = io.BytesIO()
    with matplotlib.rc_context({"font.size": 9}):
        figure.savefig(buffer, format="png")
    return buffer.getvalue()


def _show(axes: Axes, title: str, observation: Observation) -> None:
    axes.set_title(title, loc="left", fontsize=9)
    axes.set_xticks([])
    axes.set_yticks([])
    axes.spines[:].set_visible(False)


def _gripper(
    axes: Axes, pixel: np.ndarray, theta: float, observation: Observation, colour: str
) -> None:
    """A line between the jaws and the two pads; at theta zero they close along the cols."""
    closing = np.array([-math.sin(theta), math.cos(theta)])
    pad = np.array([math.cos(theta), math.sin(theta)])
    reach = _JAWS / observation.grid.resolution
    ends = np.stack([pixel - reach * closing, pixel + reach * closing])
    axes.plot(ends[:, 1], ends[:, 0], color=colour, lw=1.2)
    for end in ends:
        line = np.stack([end - 0.3 * reach * pad, end + 0.3 * reach * pad])
        axes.plot(line[:, 1], line[:, 0], color=colour, lw=3, solid_capstyle="butt")
    axes.plot(pixel[1], pixel[0], "o", color=colour, ms=3.5)
