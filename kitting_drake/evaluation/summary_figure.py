"""Draws the figure beside `summary.json`, with placement errors and causes of failure."""

import io
import itertools
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from kitting_drake.common.files import write_atomically
from kitting_drake.evaluation.summary import Entry, Episode, counted_actions, counted_objects

_COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#8c6d1f")
"""Seven colours that are distinguishable with colour blindness (after Okabe and Ito)."""
_LINES = ("-", "-.", ":")
_HATCHES = ("", "////", "....")
"""Hatches that distinguish categories when the colours are used up."""

_STYLE = {
    "font.size": 9.5,
    "axes.edgecolor": "0.5",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.titlelocation": "left",
    "axes.titlesize": 11,
    "axes.titleweight": "bold",
    "grid.color": "0.9",
    "hatch.linewidth": 0.6,
    "legend.frameon": False,
}

_LENGTHS = (0.1, 300.0)
_ANGLES = (0.02, 180.0)
"""Ranges of the axes: `_LENGTHS` in mm, `_ANGLES` in degrees. Values outside a range are drawn at
its end."""


@dataclass(frozen=True)
class _Look:
    """The style in which a category is drawn."""

    colour: str
    line: str
    hatch: str


@dataclass(frozen=True)
class _Panel:
    """A panel of the figure: the distribution of one error."""

    title: str
    unit: str
    object_key: str
    action_key: str | None
    limits: tuple[float, float]


_PANELS = (
    _Panel("ADD-S", "mm", "add_s_mm", None, _LENGTHS),
    _Panel("Position", "mm", "position_error_mm", "place_position_error_mm", _LENGTHS),
    _Panel("Angle", "degrees", "angle_error_deg", "place_angle_error_deg", _ANGLES),
)


def draw_summary(summary: dict[str, Any], episodes: Sequence[Episode], path: Path) -> None:
    """Draws the distributions behind a summary.

    Three panels show, for each category, the share of objects with an error of at most x. The
    errors are ADD-S (with the task's threshold, if any), position and angle. The panels of position
    and angle also show the errors of the policy's actions; these do not include slip in the jaws.
    Objects of failed or timed-out episodes count as infinite errors. The fourth panel counts the
    causes of failure.

    Args:
        summary: the result of `summarise`.
        episodes: all episodes of the summary.
        path: path of the .png file.

    Raises:
        MachineError: writing fails.
    """
    # Import matplotlib lazily.
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    objects = list(itertools.chain.from_iterable(counted_objects(episodes)))
    actions = counted_actions(episodes)
    looks = dict(zip(summary["categories"], _looks(), strict=False))
    image = io.BytesIO()
    with plt.rc_context(_STYLE):
        figure, axes = plt.subplots(2, 2, figsize=(10.5, 7.0), layout="constrained")
        figure.suptitle(_title(summary), x=0.01, horizontalalignment="left", fontsize=12)
        for axis, panel in zip(axes.flat, _PANELS, strict=False):
            _draw_panel(axis, panel, summary, looks, objects, actions)
        threshold = summary["success_threshold_mm"]
        if threshold is not None:
            axes[0, 0].axvline(threshold, color="black", linewidth=0.8)
            axes[0, 0].text(threshold, 1.035, f"{threshold:g} mm", horizontalalignment="center")
        _draw_causes(axes[1, 1], summary, looks)
        handles, labels = axes[0, 1].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=min(len(labels), 5))
        figure.savefig(image, format="png", dpi=150)
        plt.close(figure)
    write_atomically(path, image.getvalue())


def _looks() -> Iterable[_Look]:
    """Yields distinct styles for 21 categories, then the same styles again."""
    return itertools.cycle(
        _Look(colour, line, hatch)
        for line, hatch in zip(_LINES, _HATCHES, strict=True)
        for colour in _COLOURS
    )


def _title(summary: dict[str, Any]) -> str:
    low, high = summary["strict_ci95"]
    return (
        f"{summary['scenario']} by {summary['policy']}: "
        f"{summary['strict_success_rate']:.1%} strict success "
        f"(95 %: {low:.1%} to {high:.1%}) in {summary['episodes']} episodes\n"
        f"{summary['success_description']}: {summary['success_rate']:.1%}"
    )


def _draw_panel(
    axis: Any,
    panel: _Panel,
    summary: dict[str, Any],
    looks: dict[str, _Look],
    objects: list[Entry],
    actions: list[Entry],
) -> None:
    for name, category in summary["categories"].items():
        errors = [item[panel.object_key] for item in objects if item["category"] == name]
        label = f"{name}, {category['strict_success_rate']:.1%} strict"
        _draw_shares(axis, errors, panel.limits, looks[name], label)
    if panel.action_key is not None:
        errors = [item[panel.action_key] for item in actions]
        _draw_shares(axis, errors, panel.limits, _Look("black", "--", ""), "all, by the actions")
    axis.set_title(panel.title)
    axis.set_xlabel(f"error of at most, {panel.unit}")
    axis.set_ylabel("share of the objects")


def _draw_shares(
    axis: Any,
    errors: list[float | None],
    limits: tuple[float, float],
    look: _Look,
    label: str,
) -> None:
    """Draws the cumulative distribution of the errors' magnitudes. None counts as infinite."""
    known = [error for error in errors if error is not None]
    ordered = np.sort(np.clip(np.abs(known), *limits))
    shares = np.arange(len(known) + 1) / max(len(errors), 1)
    axis.step(
        [limits[0], *ordered, limits[1]],
        [*shares, shares[-1]],
        where="post",
        color=look.colour,
        linestyle=look.line,
        linewidth=1.6,
        label=label,
    )
    axis.set_xscale("log")
    axis.set_xlim(*limits)
    axis.set_ylim(0.0, 1.02)
    axis.xaxis.set_major_formatter("{x:g}")
    axis.yaxis.set_major_formatter(lambda share, _: f"{share:.0%}")
    axis.grid(True)


def _draw_causes(axis: Any, summary: dict[str, Any], looks: dict[str, _Look]) -> None:
    """Draws a bar for each cause, divided by category."""
    causes = list(summary["causes"])
    ends = np.zeros(len(causes))
    for name, category in summary["categories"].items():
        counts = [category["causes"].get(cause, 0) for cause in causes]
        look = looks[name]
        axis.barh(
            causes,
            counts,
            left=ends,
            color=look.colour,
            hatch=look.hatch,
            edgecolor="white",
            linewidth=0,
            height=0.65,
        )
        ends += counts
    for row, count in enumerate(ends):
        axis.annotate(f" {count:.0f}", (count, row), verticalalignment="center")
    axis.set_title("No success, and why")
    axis.set_xlabel("objects")
    axis.set_xlim(0.0, 1.08 * max(*ends, 1.0))
    axis.invert_yaxis()
    axis.tick_params(left=False)
    axis.spines["left"].set_visible(False)
    axis.xaxis.get_major_locator().set_params(integer=True)
