"""Draws the figure of `benchmark networks`: figure 6(c) of the paper, and related measurements."""

from __future__ import annotations

import io
from collections.abc import Callable
from pathlib import Path
from typing import Any

from kitting_drake.common.files import write_atomically
from kitting_drake.evaluation.quantities import count_text, seconds_text
from kitting_drake.reproduction.network_speed.speed_tables import (
    MEASURE_NAMES,
    METHOD_NAMES,
    RUNG_NAMES,
)

_METHODS = {"so2": "#009e73", "equivariant_transporter": "#e69f00", "transporter": "#56646f"}
"""Colours that the colour-blind can distinguish; the first two are the paper's green and orange."""
_MARKERS = {"so2": "o", "equivariant_transporter": "s", "transporter": "^"}
_RUNGS = {
    "escnn_float32": "#c9c9c9",
    "escnn_bfloat16": "#9a9a9a",
    "ours_float32": "#7fcdb4",
    "ours_bfloat16": "#009e73",
}
_BARRED = ("training_step", "decision")
"""The measures that are drawn as bars; the tables have all measures."""
_COLUMNS = 6
"""The number of columns in the grid of panels; each preset takes an equal number of them."""
_STYLE = {
    "font.size": 12.0,
    "axes.edgecolor": "0.5",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.titlelocation": "left",
    "axes.titlesize": 13.0,
    "axes.titleweight": "bold",
    "axes.axisbelow": True,
    "grid.color": "0.9",
    "legend.frameon": False,
}


def draw_networks(measured: dict[str, Any], path: Path) -> None:
    """Draws the figure of a benchmark.

    Args:
        measured: the result of `benchmark_networks`.
        path: a .png file to write.

    Raises:
        MachineError: the file cannot be written.
    """
    # Import matplotlib lazily.
    import matplotlib
    from matplotlib.figure import Figure

    angle, decision = measured["pick_angle"], measured["decision"]
    presets = list(dict.fromkeys(row["preset"] for row in angle))
    rows = [
        [f"{kind} {preset}" for preset in presets for _ in range(_COLUMNS // len(presets))]
        for kind in ("time", "parameters")
    ]
    last = ["decision"] * (_COLUMNS // 2) + ["folding"] * (_COLUMNS // 2)
    image = io.BytesIO()
    with matplotlib.rc_context(_STYLE):
        figure = Figure(figsize=(11.0, 12.0), layout="constrained")
        figure.get_layout_engine().set(w_pad=0.12, h_pad=0.12)
        axes = figure.subplot_mosaic([*rows, last], height_ratios=(1.0, 0.85, 1.3))
        for preset in presets:
            chosen = [row for row in angle if row["preset"] == preset]
            _draw_lines(axes[f"time {preset}"], chosen, "seconds", seconds_text)
            axes[f"time {preset}"].set_title(f"Pick angle: time ({preset})")
            own = [row for row in chosen if row["method"] != "transporter"]
            _draw_lines(axes[f"parameters {preset}"], own, "parameters", count_text)
            axes[f"parameters {preset}"].set_title(f"Pick angle: parameters ({preset})")
        _draw_lines(axes["decision"], decision, "seconds", seconds_text)
        axes["decision"].set_title(f"A whole decision: time ({measured['preset']})")
        _draw_folding(axes["folding"], measured)
        handles, names = axes[f"time {presets[0]}"].get_legend_handles_labels()
        figure.legend(handles, names, loc="outside upper left", ncols=len(names))
        figure.supxlabel(_conditions(measured), x=0.01, horizontalalignment="left", fontsize=11)
        figure.savefig(image, format="png", dpi=130)
    write_atomically(path, image.getvalue())


def _conditions(measured: dict[str, Any]) -> str:
    """Describes the machine and the type of the numbers in words."""
    machine = measured["machine"]
    place = machine["cpu"] if machine["device"] == "cpu" else machine["device"]
    threads = f"{machine['threads']} thread{'s' if machine['threads'] > 1 else ''}"
    return (
        f"{place}, {threads}, {measured['inference_type']} unless stated otherwise. "
        "In brackets: the preset.\n"
        "The Transporter has no network of the angle: its time is that of all its picking."
    )


def _draw_lines(
    axis: Any, rows: list[dict[str, Any]], quantity: str, text: Callable[[float], str]
) -> None:
    """Draws a line over N for each method, with the values at both of its ends."""
    from matplotlib.ticker import LogLocator, NullLocator

    counts = sorted({row["orientations"] for row in rows})
    measured = [row for row in rows if row[quantity]]
    axis.set_yscale("log")
    for method, colour in _METHODS.items():
        chosen = sorted(
            (row for row in measured if row["method"] == method),
            key=lambda row: row["orientations"],
        )
        axis.plot(
            [counts.index(row["orientations"]) for row in chosen],
            [row[quantity] for row in chosen],
            marker=_MARKERS[method],
            color=colour,
            markersize=7,
            linewidth=2.2,
            label=METHOD_NAMES[method],
        )
        for row in {id(row): row for row in chosen[:1] + chosen[-1:]}.values():
            _label(axis, row, measured, counts, quantity, text)
    low, high = axis.get_ylim()
    # Make room for the labels: extend each end by a quarter of the range, or by half a decade if
    # that is more.
    spread = max(high / low, 100.0) ** 0.25
    axis.set_ylim(low / spread, high * spread)
    axis.yaxis.set_major_locator(LogLocator(numticks=6))
    axis.yaxis.set_minor_locator(NullLocator())
    axis.yaxis.set_major_formatter(lambda value, _: text(value))
    axis.set_xticks(range(len(counts)), [str(n) for n in counts])
    axis.set_xlim(-0.5, len(counts) - 0.5)
    axis.set_xlabel("orientations N")
    axis.grid(True, axis="y")


def _label(
    axis: Any,
    row: dict[str, Any],
    rows: list[dict[str, Any]],
    counts: list[int],
    quantity: str,
    text: Callable[[float], str],
) -> None:
    """Writes a point's value below the point if it is the lowest of several at one N, else above
    the point."""
    there = [other[quantity] for other in rows if other["orientations"] == row["orientations"]]
    below = len(there) > 1 and row[quantity] == min(there)
    axis.annotate(
        text(row[quantity]),
        (counts.index(row["orientations"]), row[quantity]),
        xytext=(0, -8 if below else 8),
        textcoords="offset points",
        horizontalalignment="center",
        verticalalignment="top" if below else "bottom",
        fontsize=11,
    )


def _draw_folding(axis: Any, measured: dict[str, Any]) -> None:
    """Draws the speed-ups over plain escnn as bars, grouped by measure."""
    folding = measured["folding"]
    rungs = list(folding["rungs"])
    ticks, names = [], []
    most = max(folding["speed_up"][rung][measure] for rung in rungs for measure in _BARRED)
    for group, measure in enumerate(_BARRED):
        first = group * (len(rungs) + 1.2)
        axis.text(0.0, first - 0.6, MEASURE_NAMES[measure], verticalalignment="bottom")
        for index, rung in enumerate(rungs):
            value = folding["speed_up"][rung][measure]
            taken = seconds_text(folding["rungs"][rung][measure]["seconds"])
            axis.barh(first + index, value, 0.85, color=_RUNGS[rung])
            axis.text(
                value + 0.03 * most,
                first + index,
                f"{value:.2f}x, {taken}",
                verticalalignment="center",
                fontsize=11,
            )
            ticks.append(first + index)
            names.append(RUNG_NAMES[rung].replace(" autocast", "\nautocast"))
    axis.set_xlim(0.0, 1.5 * most)
    axis.set_ylim(max(ticks) + 0.6, -1.3)
    axis.set_yticks(ticks, names, fontsize=11)
    axis.tick_params(axis="y", length=0)
    axis.grid(True, axis="x")
    axis.set_xlabel("times faster than plain escnn in float32")
    axis.set_title(f"Plain escnn and folded ({measured['preset']})")
