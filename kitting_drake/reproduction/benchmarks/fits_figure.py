"""Draws the figure of `benchmark fits`."""

from __future__ import annotations

import io
from typing import Any

import matplotlib
from matplotlib.figure import Figure

_COLOURS = {"perfect": "#1b998b", "moderate": "#e4572e"}


def draw_fits(measured: dict[str, Any]) -> bytes:
    """Draws strict success, with 95 % intervals, and peak force against the clearance.

    Returns:
        A PNG.
    """
    figure = Figure(figsize=(9, 4), layout="constrained", dpi=130)
    success, force = figure.subplots(1, 2)
    groups = {(item["sensing"], item["search"]) for item in measured["fits"]}
    for number, (sensing, search) in enumerate(sorted(groups, reverse=True)):
        found = [
            item
            for item in measured["fits"]
            if (item["sensing"], item["search"]) == (sensing, search)
        ]
        # Shift the markers sideways, so that intervals do not hide each other.
        x = [item["clearance_mm"] * 1.03 ** (number - 1.5) for item in found]
        y = [100 * item["strict"] / item["tools"] for item in found]
        ends = [[100 * end for end in item["interval"]] for item in found]
        look = {
            "color": _COLOURS[sensing],
            "ls": "-" if search else "--",
            "marker": "o" if search else "s",
            "ms": 4,
            "lw": 1.3,
        }
        errors = [
            [middle - low for middle, (low, _) in zip(y, ends, strict=True)],
            [high - middle for middle, (_, high) in zip(y, ends, strict=True)],
        ]
        label = f"{sensing} sensing, {'with' if search else 'without'} search"
        success.errorbar(x, y, yerr=errors, elinewidth=0.8, capsize=2, label=label, **look)
        peaks = [item["peak_force_n"]["max"] for item in found]
        force.plot(x, [float("nan") if peak is None else peak for peak in peaks], **look)
    ticks = sorted({item["clearance_mm"] for item in measured["fits"]})
    for axes in (success, force):
        axes.set_xscale("log")
        axes.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
        axes.minorticks_off()
        axes.invert_xaxis()
        axes.set_xlabel("clearance a side, mm")
        axes.spines[["top", "right"]].set_visible(False)
    success.set(ylim=(-3, 103), ylabel="strict success, %")
    force.set(ylabel="largest peak force of an action, N")
    force.set_ylim(bottom=0)
    success.legend(fontsize=8, loc="lower left", frameon=False)
    buffer = io.BytesIO()
    with matplotlib.rc_context({"font.size": 9}):
        figure.savefig(buffer, format="png")
    return buffer.getvalue()
