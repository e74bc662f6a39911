"""Figures 6(a) and 6(b) of the paper, from the results of `benchmark paper`."""

import io
from collections.abc import Mapping

from kitting_drake.paper.cells import DEMONSTRATIONS
from kitting_drake.paper.page import COLUMNS, Result
from kitting_drake.reporting.runs import METHODS

_COLOURS = {10: "#009e73", 100: "#d55e00"}
"""Green and orange, as in the paper."""
_WIDE, _SLIM = 0.34, 0.13
_METHODS = {"equivariant_transporter": (_WIDE, 0.35), "so2": (_SLIM, 1.0)}
"""Width and opacity of a method's bars: ours slim and dark, over the other, wide and light."""


def draw_figure_6(task: str, results: Mapping[str, Result]) -> bytes:
    """A PNG: success by the paper's measure over N, after 10 and after 100 demonstrations.

    Ours are the dark, slim bars over the light, wide ones of the Equivariant Transporter, as in the
    paper; a white line across a bar is the strict success rate. The rounded oracle is a black line.
    What was not run is not there.

    Args:
        task: `seen` or `unseen`.
        results: by the names of their cells.
    """
    # Imported here: the other commands should not wait for it.
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    image = io.BytesIO()
    style = {"font.size": 10, "axes.spines.top": False, "axes.spines.right": False}
    with plt.rc_context(style):
        figure, axis = plt.subplots(figsize=(7.0, 3.6), layout="constrained")
        for method, (width, opacity) in _METHODS.items():
            for side, count in zip((-0.19, 0.19), reversed(DEMONSTRATIONS), strict=True):
                label = f"{METHODS[method]}, {count} demonstrations"
                for place, n in enumerate(COLUMNS):
                    result = results.get(f"{task}_{method}_{n}_{count}")
                    if result is None:
                        continue
                    where, summary = place + side, result.summary
                    axis.bar(
                        where,
                        100 * summary["success_rate"],
                        width,
                        color=_COLOURS[count],
                        alpha=opacity,
                        label=label,
                        zorder=2,
                    )
                    strict = 100 * summary["strict_success_rate"]
                    ends = (where - width / 2, where + width / 2)
                    axis.hlines(strict, *ends, color="white", linewidth=1.2, zorder=3)
                    label = ""
        for place, n in enumerate(COLUMNS):
            oracle = results.get(f"{task}_quantized_oracle_{n}")
            if oracle is not None:
                rate = 100 * oracle.summary["success_rate"]
                axis.hlines(rate, place - 0.42, place + 0.42, color="black", linewidth=1.0)
        axis.set_xticks(range(len(COLUMNS)), [f"N = {n}" for n in COLUMNS])
        axis.set_xlim(-0.55, len(COLUMNS) - 0.45)
        axis.set_ylim(0, 101)
        axis.set_ylabel("success, %")
        axis.grid(axis="y", color="0.9", zorder=0)
        axis.set_axisbelow(True)
        if axis.get_legend_handles_labels()[0]:
            figure.legend(loc="outside lower center", ncols=2, frameon=False, fontsize=9)
        figure.savefig(image, format="png", dpi=130)
        plt.close(figure)
    return image.getvalue()
