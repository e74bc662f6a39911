"""Makes the tables and the diagram of `benchmark reliability`."""

from __future__ import annotations

import io
from typing import Any

import matplotlib
from matplotlib.figure import Figure
from rich.table import Table

_NAMES = {"networks": "generalist", "shape_matching": "shape matching"}
_ERRORS = ("wrong above", "right below")
"""Headings: the wrong share of the decisions above the threshold, and the share of the right
decisions that is below it."""
_OTHER_KEYS = {"threshold", "limits"}
"""The keys of a policy's measures that are no number of cameras."""
_COLOURS = {"networks": "#e4572e", "shape_matching": "#1b998b"}


def reliability_table(measured: dict[str, Any]) -> Table:
    """Makes a table with a row for each policy and number of cameras."""
    table = Table(title="confidence of decisions", title_justify="left")
    table.add_column("policy", min_width=10)
    table.add_column("cameras")
    for heading in ("decisions", "right", "error", *_ERRORS):
        table.add_column(heading, justify="right")
    for policy, name in _NAMES.items():
        for cameras, found in measured[policy].items():
            if cameras in _OTHER_KEYS:
                continue
            table.add_row(
                name,
                cameras,
                str(found["decisions"]),
                f"{100 * found['right']:.1f} %",
                f"{found['calibration_error']:.3f}",
                f"{100 * found['wrong_answers']:.1f} %",
                f"{100 * found['refused']:.1f} %",
            )
    return table


def limits_table(measured: dict[str, Any]) -> Table:
    """Makes a table with a row for each policy and least confidence."""
    table = Table(title="least confidence to act", title_justify="left")
    table.add_column("policy")
    for heading in ("least confidence", *_ERRORS):
        table.add_column(heading, justify="right")
    for policy, name in _NAMES.items():
        for found in measured[policy]["limits"]:
            table.add_row(
                name,
                f"{found['least_confidence']:g}",
                f"{100 * found['wrong_answers']:.1f} %",
                f"{100 * found['refused']:.1f} %",
            )
    return table


def draw_reliability(measured: dict[str, Any]) -> bytes:
    """Draws the share of right decisions against the confidence. Each point shows its number of
    decisions."""
    figure = Figure(figsize=(8, 4.4), layout="constrained", dpi=130)
    for axes, (policy, name) in zip(
        figure.subplots(1, 2, sharey=True), _NAMES.items(), strict=True
    ):
        found = measured[policy]["all"]
        confidence, right, counts = zip(*found["bins"], strict=True)
        axes.plot([0, 1], [0, 1], color="0.75", lw=1, zorder=0)
        sizes = [12 + 0.9 * count for count in counts]
        axes.scatter(confidence, right, s=sizes, color=_COLOURS[policy], alpha=0.85, lw=0)
        for x, y, count in zip(confidence, right, counts, strict=True):
            axes.annotate(
                str(count), (x, y), xytext=(7, -11), textcoords="offset points", fontsize=7
            )
        axes.axvline(measured[policy]["threshold"], color="0.4", lw=1, ls="--")
        axes.set(xlim=(-0.03, 1.03), ylim=(-0.05, 1.08), xlabel="confidence")
        axes.set_title(
            f"{name}: {found['decisions']} decisions, error {found['calibration_error']:.3f}",
            loc="left",
            fontsize=9,
        )
        axes.spines[["top", "right"]].set_visible(False)
    figure.axes[0].set_ylabel("share of right decisions")
    buffer = io.BytesIO()
    with matplotlib.rc_context({"font.size": 9}):
        figure.savefig(buffer, format="png")
    return buffer.getvalue()
