"""Makes the table and the figure of `benchmark endurance`."""

import io
from collections import Counter
from collections.abc import Sequence
from typing import Any

import matplotlib
import numpy as np
from matplotlib.figure import Figure
from rich.table import Table

from kitting_drake.reproduction.benchmarks.shift.endurance import HOUR, ShiftScene

_COLOURS = ("#d55e00", "#cc79a7", "#e69f00", "#8c6d1f", "#56b4e9", "#009e73", "#0072b2")
_MARKERS = "ov^sDPX*"
_LINE = "#0072b2"
_SHOWN = 0.995
"""The histogram's axis ends just beyond this quantile of the cycle times. Its last bar counts all
longer cycles."""


def endurance_table(measured: dict[str, Any]) -> Table:
    """Makes a table of the measurements."""
    table = Table(
        title=f"{measured['scenario']} by {measured['policy']['name']}", title_justify="left"
    )
    table.add_column("")
    table.add_column("measured", justify="right")
    cycle, low_high = measured["cycle_seconds"], measured["minutes_between_assists_ci95"]
    between = measured["minutes_between_assists"]
    low, high = (_number(value) for value in low_high)
    rows = {
        "simulated": f"{measured['hours']:.2f} h, {measured['scenes']} scenes",
        "units": f"{measured['units']} of {measured['tools']} tools",
        "units an hour": f"{measured['units_per_hour']:.0f}",
        f"without {measured['exchange_seconds']:g} s an exchange": _number(
            measured["units_per_hour_without_exchange"], ".0f"
        ),
        "assists": str(measured["assists"]),
        "minutes between assists": f"{_number(between)} ({low} to {high})",
        "seconds a tool": f"median {_number(cycle['median'])}, p95 {_number(cycle['p95'])}",
        "causes": ", ".join(f"{name} {n}" for name, n in measured["causes"].items()) or "-",
    }
    for name, text in rows.items():
        table.add_row(name, text)
    return table


def _number(value: float | None, form: str = ".1f") -> str:
    return "-" if value is None else format(value, form)


def draw_endurance(measured: dict[str, Any], scenes: Sequence[ShiftScene]) -> bytes:
    """Draws the units over time, with each assist marked, and the histogram of cycles.

    Args:
        measured: the result of `summarise_shift`.
        scenes: the scenes of the shift.

    Returns:
        A PNG.
    """
    with matplotlib.rc_context({"font.size": 9, "legend.frameon": False}):
        figure = Figure(figsize=(10, 3.8), layout="constrained", dpi=130)
        units, cycles = figure.subplots(1, 2, width_ratios=[1.7, 1])
        _draw_units(units, measured, scenes)
        _draw_cycles(cycles, measured, [c for scene in scenes for c in scene.cycles()])
        for axes in (units, cycles):
            axes.spines[["top", "right"]].set_visible(False)
        buffer = io.BytesIO()
        figure.savefig(buffer, format="png")
    return buffer.getvalue()


def _draw_units(axes: Any, measured: dict[str, Any], scenes: Sequence[ShiftScene]) -> None:
    exchange, start, count = measured["exchange_seconds"], 0.0, 0
    times, counts = [0.0], [0]
    marks: dict[str, list[tuple[float, int]]] = {}
    for scene in scenes:
        for second in scene.unit_seconds:
            count += 1
            times.append(start + second)
            counts.append(count)
        for name, times_seen in Counter(scene.assists.values()).items():
            marks.setdefault(name, []).extend([(start + scene.sim_seconds, count)] * times_seen)
        start += scene.sim_seconds + exchange
    scale, unit = (HOUR, "hours") if start > HOUR else (60.0, "minutes")
    x = np.array([*times, start]) / scale
    axes.step(x, [*counts, count], where="post", color=_LINE, lw=1.4)
    for index, name in enumerate(measured["causes"]):
        points = np.array(marks[name], dtype=float)
        axes.scatter(
            points[:, 0] / scale,
            points[:, 1],
            s=34,
            color=_COLOURS[index % len(_COLOURS)],
            marker=_MARKERS[index % len(_MARKERS)],
            edgecolor="white",
            lw=0.5,
            zorder=3,
            label=f"{name}: {len(points)}",
        )
    if marks:
        axes.legend(title="assists", alignment="left", loc="upper left")
    axes.set(xlabel=f"simulated {unit}", ylabel="tools kitted strictly")
    axes.set_xlim(0.0, start / scale)
    axes.set_ylim(bottom=0)
    between = _number(measured["minutes_between_assists"])
    axes.set_title(
        f"{measured['units_per_hour']:.0f} units an hour, {between} min between assists",
        loc="left",
        weight="bold",
    )


def _draw_cycles(axes: Any, measured: dict[str, Any], cycles: Sequence[float]) -> None:
    cycle = measured["cycle_seconds"]
    axes.set(xlabel="seconds from one tool to the next", ylabel="tools")
    axes.set_title("Cycle times", loc="left", weight="bold")
    if not cycles:
        return
    width = cycle["bin_width"]
    bars = int(np.quantile(cycles, _SHOWN) / width) + 2
    clipped = np.minimum(cycles, (bars - 0.5) * width)
    axes.hist(clipped, bins=np.arange(bars + 1) * width, color=_LINE, alpha=0.8)
    for key, style in (("median", "-"), ("p95", "--")):
        label = f"{key}: {cycle[key]:.1f} s"
        axes.axvline(min(cycle[key], bars * width), color="black", lw=1, ls=style, label=label)
    axes.set_xlim(0.0, bars * width)
    axes.legend(loc="upper right")
