"""Figures 6(a) and 6(b) of the paper, from the results of `benchmark paper`."""

from __future__ import annotations

import io
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from kitting_drake.paper.cells import DEMONSTRATIONS
from kitting_drake.paper.page import COLUMNS, Result
from kitting_drake.reporting.runs import METHODS

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_COLOURS = {10: "#009e73", 100: "#d55e00"}
"""Green and orange, as in the paper."""
_MARKERS = {"so2": "o", "equivariant_transporter": "s", "transporter": "^"}
_STEP = 0.12
"""Between the markers of one N."""


def draw_figure_6(task: str, results: Mapping[str, Result]) -> bytes:
    """A PNG: success over N, after 10 and after 100 demonstrations.

    A filled marker is the strict success rate with its 95 % interval, a hollow one above it the
    rate by the paper's measure, which the paper draws. A black line is the strict rate of the
    rounded oracle. What was not run is not there.

    Args:
        task: `seen` or `unseen`.
        results: by the names of their cells.
    """
    # Imported here: the other commands should not wait for it.
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    series = [(method, count) for count in sorted(DEMONSTRATIONS) for method in _MARKERS]
    image = io.BytesIO()
    style = {"font.size": 10, "axes.spines.top": False, "axes.spines.right": False}
    with plt.rc_context(style):
        figure, axis = plt.subplots(figsize=(7.0, 3.8), layout="constrained")
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
                axis.hlines(rate, *ends, color="black", linewidth=1.0, label="oracle, quantized")
        axis.set_xticks(range(len(COLUMNS)), [f"N = {n}" for n in COLUMNS])
        axis.set_xlim(-0.55, len(COLUMNS) - 0.45)
        axis.set_ylim(top=101)
        axis.set_ylabel("success, %")
        axis.grid(axis="y", color="0.9", zorder=0)
        axis.set_axisbelow(True)
        axis.plot([], [], "o", color="0.4", label="filled: strict success")
        hollow = {"color": "0.4", "markerfacecolor": "white"}
        axis.plot([], [], "o", label="hollow: by the paper's measure", **hollow)
        handles, labels = axis.get_legend_handles_labels()
        once = dict(zip(labels, handles, strict=True))
        figure.legend(
            once.values(),
            once.keys(),
            loc="outside lower center",
            ncols=2,
            frameon=False,
            fontsize=9,
        )
        figure.savefig(image, format="png", dpi=130)
        plt.close(figure)
    return image.getvalue()


def _draw_marker(
    axis: Axes, where: float, summary: Mapping[str, Any], method: str, count: int
) -> None:
    """Both rates of a cell."""
    rate, (low, high) = summary["strict_success_rate"], summary["strict_ci95"]
    look = {"color": _COLOURS[count], "marker": _MARKERS[method], "markersize": 6, "linestyle": ""}
    axis.errorbar(
        where,
        100 * rate,
        yerr=[[100 * (rate - low)], [100 * (high - rate)]],
        elinewidth=1.2,
        label=f"{METHODS[method]}, {count} demonstrations",
        zorder=3,
        **look,
    )
    axis.plot(where, 100 * summary["success_rate"], markerfacecolor="white", zorder=2, **look)
