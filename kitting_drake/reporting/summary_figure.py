"""The picture beside `summary.json`: how well tools were placed, and why some were not."""

import io
from pathlib import Path
from typing import Any

import numpy as np

from kitting_drake.common.files import write_whole
from kitting_drake.reporting.summary import Episode

_COLOURS = {
    "hammer": "#0072b2",
    "pliers": "#d55e00",
    "wrench": "#009e73",
    "screwdriver": "#cc79a7",
}
"""Of the categories: four that all eyes tell apart (Okabe and Ito)."""

_STYLE = {
    "font.size": 9.5,
    "axes.edgecolor": "0.5",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.titlelocation": "left",
    "axes.titlesize": 11,
    "axes.titleweight": "bold",
    "grid.color": "0.9",
    "legend.frameon": False,
}

_LENGTHS = (0.1, 300.0)
_ANGLES = (0.02, 180.0)
"""What the axes show, in mm and degrees; what is beyond is drawn at their ends."""


def draw_summary(summary: dict[str, Any], episodes: list[Episode], path: Path) -> None:
    """Draws the distributions behind a summary.

    Three panels show, for each category, the share of its objects that ended within x of their
    goals: by ADD-S, where the curve meets the threshold at the success rate; by position and by
    angle, beside where the policy's answers would have brought them had nothing slipped. Objects of
    failed episodes are within no x. The fourth panel counts the causes.

    Args:
        summary: what `summarise` made of the episodes.
        episodes: all of them.
        path: a .png file.

    Raises:
        UserError: the file cannot be written.
    """
    # Imported here: the other verbs should not wait for it.
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    whole = [episode for episode in episodes if not episode["failure"]]
    objects = [item for episode in whole for item in episode["objects"]]
    actions = [item for episode in whole for item in episode["actions_taken"]]
    low, high = summary["ci95"]
    image = io.BytesIO()
    with plt.rc_context(_STYLE):
        figure, axes = plt.subplots(2, 2, figsize=(10.5, 7.0), layout="constrained")
        figure.suptitle(
            f"{summary['scenario']} by {summary['policy']}: {summary['success_rate']:.1%} kitted "
            f"(95 %: {low:.1%} to {high:.1%}) in {summary['episodes']} episodes",
            x=0.01,
            horizontalalignment="left",
            fontsize=13,
        )
        panels = (
            (axes[0, 0], "ADD-S", "mm", "add_s_mm", None, _LENGTHS),
            (
                axes[0, 1],
                "Position",
                "mm",
                "position_error_mm",
                "place_position_error_mm",
                _LENGTHS,
            ),
            (axes[1, 0], "Angle", "degrees", "angle_error_deg", "place_angle_error_deg", _ANGLES),
        )
        for axis, title, unit, key, answer, limits in panels:
            for name, category in summary["categories"].items():
                values = [item[key] for item in objects if item["category"] == name]
                label = f"{name}, {category['success_rate']:.1%} kitted"
                _draw_shares(axis, values, category["objects"], limits, _COLOURS[name], label)
            if answer is not None:
                answers = [item[answer] for item in actions]
                _draw_shares(axis, answers, len(answers), limits, "black", "all, as answered", "--")
            axis.set_title(title)
            axis.set_xlabel(f"error of at most, {unit}")
            axis.set_ylabel("share of the tools")
        threshold = summary["success_threshold_mm"]
        axes[0, 0].axvline(threshold, color="black", linewidth=0.8)
        axes[0, 0].text(threshold, 1.035, f"{threshold:g} mm", horizontalalignment="center")
        _draw_causes(axes[1, 1], summary)
        handles, labels = axes[0, 1].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=len(labels))
        figure.savefig(image, format="png", dpi=150)
        plt.close(figure)
    write_whole(path, image.getvalue())


def _draw_shares(
    axis: Any,
    values: list[float],
    total: int,
    limits: tuple[float, float],
    colour: str,
    label: str,
    line: str = "-",
) -> None:
    """Draws which share of `total` things has a magnitude of at most x."""
    ordered = np.sort(np.clip(np.abs(values), *limits))
    shares = np.arange(len(values) + 1) / max(total, 1)
    axis.step(
        [limits[0], *ordered, limits[1]],
        [*shares, shares[-1]],
        where="post",
        color=colour,
        linestyle=line,
        linewidth=1.6,
        label=label,
    )
    axis.set_xscale("log")
    axis.set_xlim(*limits)
    axis.set_ylim(0.0, 1.02)
    axis.xaxis.set_major_formatter("{x:g}")
    axis.yaxis.set_major_formatter(lambda share, _: f"{share:.0%}")
    axis.grid(True)


def _draw_causes(axis: Any, summary: dict[str, Any]) -> None:
    """Draws a bar for each cause, of pieces for the categories."""
    causes = list(summary["causes"])
    ends = np.zeros(len(causes))
    for name, category in summary["categories"].items():
        counts = [category["causes"][cause] for cause in causes]
        axis.barh(causes, counts, left=ends, color=_COLOURS[name], height=0.65)
        ends += counts
    for row, count in enumerate(ends):
        axis.annotate(f" {count:.0f}", (count, row), verticalalignment="center")
    axis.set_title("Not kitted, and why")
    axis.set_xlabel("tools")
    axis.set_xlim(0.0, 1.08 * max(*ends, 1.0))
    axis.invert_yaxis()
    axis.tick_params(left=False)
    axis.spines["left"].set_visible(False)
    axis.xaxis.get_major_locator().set_params(integer=True)
