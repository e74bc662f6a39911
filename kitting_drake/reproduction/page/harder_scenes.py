"""Writes the tables of `docs/robustness.md` about scenes that are harder than the tidy table."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from kitting_drake.reproduction.page.markdown import markdown_table, rate_text
from kitting_drake.reproduction.page.runs import Run

FIRST_SEEDS = (
    *(73000, 82000, 85000, 86000, 92000, 94000, 96000),
    *(100000, 102000, 104000, 106000, 108000, 117000),
)
"""The first seeds of the runs in these tables."""
_POLICIES = {"generalist": "generalist", "shape_matching": "shape matching", "oracle": "oracle"}


@dataclass(frozen=True)
class _Row:
    """A row of the table."""

    label: str
    scenario: str
    """The scenario's file and name, as in a summary."""
    perturbed: bool = False
    """Whether all perturbations are applied, at the level `moderate`."""
    height_error: float = 0.0
    """The error of the cameras' calibrated height, in m."""
    own_shapes: bool = True
    """Whether the shapes of `!AssemblingKits` are those of this project."""


_ROWS = (
    _Row("unseen toolsets", "kitting_unseen:KittingUnseenToolsets"),
    _Row(
        "unseen toolsets, `--perturb all:moderate`",
        "kitting_unseen:KittingUnseenToolsets",
        perturbed=True,
    ),
    _Row(
        "unseen toolsets, cameras calibrated 5 mm too high",
        "kitting_unseen:KittingUnseenToolsets",
        height_error=0.005,
    ),
    _Row(
        "unseen toolsets, cameras calibrated 5 mm too low",
        "kitting_unseen:KittingUnseenToolsets",
        height_error=-0.005,
    ),
    _Row("pairs of tools that touch", "heaps:touching"),
    _Row("pairs of tools, one across the other", "heaps:crossed"),
    _Row("half of the tools lean on the kit", "heaps:leaning"),
    _Row("a heap of four tools", "heaps:heap"),
    _Row("parts of 15 to 60 mm", "small_parts:SmallParts"),
    _Row("rings, plates, discs, boards and cylinders", "small_parts:RingsPlatesCylinders"),
    _Row("tools of 250 to 330 mm", "large_tools:LargeTools"),
    _Row("tools of 1 to 2 kg", "large_tools:HeavyTools"),
    _Row("meshes of nine real tools", "own_tools:OwnToolsets"),
    _Row("two kits", "raised_kits:TwoKits"),
    _Row("a kit on a riser, tilted by 3 degrees", "raised_kits:TiltedKit"),
    _Row("five flat shapes of ours in a kit", "assembling_kits:Test"),
    _Row("five of Ravens' fourteen shapes in a kit", "assembling_kits:Test", own_shapes=False),
)


def harder_scenes_table(runs: Sequence[Run]) -> str:
    """Writes the table: the strict success of each policy, and for the generalist also the largest
    forces and the number of right reasons to stop. Without runs it is a sentence that says so.

    Args:
        runs: all runs. Of several runs of a policy in a row, the one with the highest seeds counts.
    """
    rows = []
    for row, found in _rows(runs):
        shown = found.get("generalist")
        rows.append(
            [
                row.label,
                *(
                    rate_text(found[key]["strict_success_rate"], found[key]["strict_ci95"])
                    if key in found
                    else "-"
                    for key in _POLICIES
                ),
                _forces(shown) if shown else "-",
                _reasons(shown) if shown else "-",
            ]
        )
    if not rows:
        return "No runs yet.\n"
    headings = ["scene", *_POLICIES.values(), "force, N", "right reasons to stop"]
    return markdown_table(headings, rows)


def stop_reasons_table(runs: Sequence[Run]) -> str:
    """Writes the table of the reasons for which the generalist's episodes in these scenes ended,
    right ones and wrong ones. Without runs it is a sentence that says so.

    Args:
        runs: all runs, as for `harder_scenes_table`.
    """
    right, wrong = Counter[str](), Counter[str]()
    for _, found in _rows(runs):
        for reason, count in found.get("generalist", {}).get("stop_reasons", {}).items():
            right[reason] += count["right"]
            wrong[reason] += count["wrong"]
    if not right + wrong:
        return "No runs yet.\n"
    rows = [[f"`{it}`", str(right[it]), str(wrong[it])] for it, _ in (right + wrong).most_common()]
    return markdown_table(["reason", "right", "wrong"], rows)


def _rows(runs: Sequence[Run]) -> list[tuple[_Row, dict[str, dict[str, Any]]]]:
    """Returns each row that has runs, with the summaries of its runs by method."""
    chosen = [run for it in FIRST_SEEDS for run in runs if run.summary["seeds"][0] == it]
    found = [
        (row, {run.method: run.summary for run in chosen if _is_of(run, row)}) for row in _ROWS
    ]
    return [(row, summaries) for row, summaries in found if summaries]


def _is_of(run: Run, row: _Row) -> bool:
    scenario: dict[str, Any] = run.summary["resolved_scenario"]
    noise = scenario["sensor_noise"]
    return (
        run.summary["scenario"] == row.scenario
        and bool(noise["depth_std"]) == row.perturbed
        and noise.get("rig_height_error", 0.0) == row.height_error
        and (not scenario["task"].get("shapes")) == row.own_shapes
    )


def _forces(summary: dict[str, Any]) -> str:
    forces = summary["peak_force_n"]
    return f"{forces['p95']:.0f}, {forces['max']:.0f}"


def _reasons(summary: dict[str, Any]) -> str:
    counts = summary["stop_reasons"].values()
    right = sum(count["right"] for count in counts)
    return f"{right} of {right + sum(count['wrong'] for count in counts)}"
