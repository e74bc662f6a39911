"""Draws figures 6(a) and 6(b) of the paper, and its table I as a figure, from `benchmark paper`."""

from __future__ import annotations

import io
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from kitting_drake.reproduction.page.ravens_table import PAPER as TABLE_1
from kitting_drake.reproduction.page.runs import METHODS
from kitting_drake.reproduction.paper.cell_results import Result
from kitting_drake.reproduction.paper.cells import TASKS
from kitting_drake.reproduction.paper.paper_sections import COLUMNS
from kitting_drake.reproduction.paper.paper_tables import DEMONSTRATIONS, RAVENS_DEMONSTRATIONS

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_COLOURS = {10: "#009e73", 100: "#d55e00"}
"""Green and orange as in the paper, in shades that the colour-blind can distinguish."""
_MARKERS = {"so2": "o", "equivariant_transporter": "s", "transporter": "^"}
_STEP = 0.12
"""The distance along x between neighbouring markers with the same N. Successive N are 1 apart."""
_ROWS = {
    ("so2", 36): ("#e69f00", "o"),
    ("so2", 180): ("#d55e00", "D"),
    ("equivariant_transporter", 36): ("#0072b2", "s"),
    ("transporter", 36): ("#56646f", "^"),
}
"""The rows of table I (method and N), with markers and with colours that the colour-blind can
distinguish."""
_ROW_STEP = 0.19
"""At each number of demonstrations, the markers of `_ROWS` stand side by side, this far apart along
x. Successive numbers of demonstrations are 1 apart."""
_STYLE = {
    "font.size": 13,
    "axes.edgecolor": "0.5",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.titlesize": 13,
    "lines.markersize": 8,
}
"""A style that is readable at half the size of the picture."""
_TOP = 102.5
"""The upper end of an axis in percent. It is above 100, so that markers at 100 are not cut off."""


def draw_figure_6(task: str, results: Mapping[str, Result]) -> bytes:
    """Draws success over N after 10 and 100 demonstrations, as a PNG.

    A filled marker is the strict success rate with its 95 % interval. A hollow marker is the rate
    by the paper's measure, as in the paper's figure. A black line is the strict rate of the
    quantized oracle. Missing results are left out.

    Args:
        task: `seen` or `unseen`.
        results: the results by cell name.
    """
    # Import matplotlib lazily.
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    series = [(method, count) for count in sorted(DEMONSTRATIONS) for method in _MARKERS]
    with plt.rc_context(_STYLE):
        figure, axis = plt.subplots(figsize=(9.6, 5.6), layout="constrained")
        for index, (method, count) in enumerate(series):
            for place, n in enumerate(COLUMNS):
                result = results.get(f"{task}_{method}_{n}_{count}")
                if result is None:
                    continue
                where = place + _STEP * (index - (len(series) - 1) / 2)
                _draw_marker(axis, where, result.summary, method, count)
        for place, n in enumerate(COLUMNS):
            oracle = results.get(f"{task}_quantized_oracle_{n}")
            if oracle is not None:
                rate = 100 * oracle.summary["strict_success_rate"]
                ends = (place - 0.42, place + 0.42)
                axis.hlines(rate, *ends, color="black", linewidth=1.5, label="oracle, quantized")
        axis.set_xticks(range(len(COLUMNS)), [f"N = {n}" for n in COLUMNS])
        axis.set_xlim(-0.55, len(COLUMNS) - 0.45)
        axis.set_ylim(top=_TOP)
        axis.set_ylabel("success, %")
        axis.grid(axis="y", color="0.9", zorder=0)
        axis.set_axisbelow(True)
        _explain(axis, "strict success", "by the paper's measure")
        return _finish(figure)


def _draw_marker(
    axis: Axes, where: float, summary: Mapping[str, Any], method: str, count: int
) -> None:
    """Draws the strict rate of a cell, and its rate by the paper's measure."""
    rate, (low, high) = summary["strict_success_rate"], summary["strict_ci95"]
    look = {"color": _COLOURS[count], "marker": _MARKERS[method], "linestyle": ""}
    axis.errorbar(
        where,
        100 * rate,
        yerr=[[100 * (rate - low)], [100 * (high - rate)]],
        elinewidth=1.8,
        label=f"{METHODS[method]}, {count} demonstrations",
        zorder=3,
        **look,
    )
    axis.plot(where, 100 * summary["success_rate"], markerfacecolor="white", zorder=2, **look)


def draw_table_1(results: Mapping[str, Result]) -> bytes:
    """Draws the mean reward of each Ravens task over the number of demonstrations, as a PNG.

    A filled marker is our result with its 95 % interval. A star is our result with extensions. A
    hollow marker is the paper's result for the same cell. A cell without a run is left out,
    and so is the paper's result for it. A task without a run has no panel.

    Args:
        results: the results by cell name.
    """
    # Import matplotlib lazily.
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    names = [task.name for task in TASKS.values() if task.table == "I"]
    drawn = {
        column: task
        for column, task in enumerate(names)
        if any(name.startswith(f"{task}_") for name in results)
    }
    columns = drawn or dict(enumerate(names))
    counts = sorted(RAVENS_DEMONSTRATIONS)
    with plt.rc_context(_STYLE):
        figure, axes = plt.subplots(
            1,
            len(columns),
            figsize=(10.5, 5.0),
            sharey=True,
            squeeze=False,
            layout="constrained",
        )
        axes = axes[0]
        for (column, task), axis in zip(columns.items(), axes, strict=True):
            _draw_task(axis, task, column, results)
            # Break the titles into two lines, because five tasks stand side by side.
            axis.set_title("\n".join(task.replace("_", " ").rsplit(" ", 1)))
            axis.set_xticks(range(len(counts)), [str(count) for count in counts])
            axis.set_xlim(-0.5, len(counts) - 0.5)
            axis.grid(axis="y", color="0.9", zorder=0)
            axis.set_axisbelow(True)
        axes[0].set_ylim(top=_TOP)
        axes[0].set_ylabel("mean reward, %")
        axes[len(axes) // 2].set_xlabel("demonstrations")
        _explain(axes[0], "measured here", "the paper's")
        return _finish(figure)


def _draw_task(axis: Axes, task: str, column: int, results: Mapping[str, Result]) -> None:
    """Draws the panel of a task. It shows a result of the paper only where we have a result
    without extensions."""
    for index, ((method, n), (colour, marker)) in enumerate(_ROWS.items()):
        for place, count in enumerate(sorted(RAVENS_DEMONSTRATIONS)):
            where = place + _ROW_STEP * (index - (len(_ROWS) - 1) / 2)
            name, row = f"{task}_{method}_{n}_{count}", f"{METHODS[method]}, N = {n}"
            if name in results:
                look = {"color": colour, "marker": marker, "linestyle": ""}
                paper = TABLE_1[METHODS[method], n][column][place]
                axis.plot(where, paper, markerfacecolor="white", zorder=2, **look)
                _draw_reward(axis, where, results[name].summary, row, look)
            if f"{name}_ours" in results:
                look = {"color": colour, "marker": "*", "linestyle": ""}
                summary = results[f"{name}_ours"].summary
                _draw_reward(axis, where, summary, f"{row}, with extensions", look)


def _draw_reward(
    axis: Axes, where: float, summary: Mapping[str, Any], label: str, look: Mapping[str, str]
) -> None:
    rate, (low, high) = summary["success_rate"], summary["ci95"]
    axis.errorbar(
        where,
        100 * rate,
        yerr=[[100 * (rate - low)], [100 * (high - rate)]],
        elinewidth=1.8,
        label=label,
        zorder=3,
        **look,
    )


def _explain(axis: Axes, filled: str, hollow: str) -> None:
    """Adds the meaning of filled and hollow markers to the legend."""
    axis.plot([], [], "o", color="0.4", label=f"filled: {filled}")
    axis.plot([], [], "o", color="0.4", markerfacecolor="white", label=f"hollow: {hollow}")


def _finish(figure: Figure) -> bytes:
    """Adds a legend without duplicates, closes the figure and returns it as a PNG."""
    import matplotlib.pyplot as plt

    pairs = [axis.get_legend_handles_labels() for axis in figure.axes]
    once = {label: handle for pair in pairs for handle, label in zip(*pair, strict=True)}
    figure.legend(
        once.values(),
        once.keys(),
        loc="outside lower center",
        ncols=2,
        frameon=False,
        fontsize=12,
    )
    image = io.BytesIO()
    figure.savefig(image, format="png", dpi=130)
    plt.close(figure)
    return image.getvalue()
