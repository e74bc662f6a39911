"""Writes the part of the protocol on the cells of the paper's tables.

It says how each cell was trained and tested, and how cells differ.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from statistics import mean, stdev
from typing import Any

from kitting_drake.common.provenance import short_commits
from kitting_drake.reproduction.page.markdown import markdown_table
from kitting_drake.reproduction.page.paired import OWN, STRICT
from kitting_drake.reproduction.page.prose import prose
from kitting_drake.reproduction.page.runs import LEARNED, METHODS
from kitting_drake.reproduction.paper.cell_results import Result, absent_text
from kitting_drake.reproduction.paper.cells import LEARNING_RATES, TASKS, Training, rates_key
from kitting_drake.reproduction.paper.differences import differences
from kitting_drake.reproduction.paper.failed_grasps import (
    changeable,
    failed_grasps,
    is_as_in_the_paper,
)
from kitting_drake.reproduction.paper.learning_rates import Rates, best_rate
from kitting_drake.reproduction.paper.paper_sections import (
    both_rates,
    ravens_text,
    rows_of_table_1,
)
from kitting_drake.reproduction.paper.paper_tables import (
    BEYOND_OF_TABLE_1,
    FIGURE_6,
    HEADLINE_SEEDS,
    PATIENCE,
    PATIENT,
    RAVENS_DEMONSTRATIONS,
    headline,
)

_VARIANTS = {
    "as in the paper": "",
    "with all extensions": "_ours",
    "with recovery, in two tries per tool": "_ours_recovering",
    "without the search by the hand": "_minus_search",
    "without outline fitting": "_minus_outlines",
    "without any refinement": "_minus_refinement",
    "without labels of later picks": "_minus_all_targets",
    "without curvature and reflection": "_minus_curvature",
}
"""For each row's label, the ending of the names of its cells."""

_TOLD = ("trained_orientations", "steps", "learning_rate", "training_seed", "compute_type")
"""The details of a policy that are columns of the table "Every cell"."""


def protocol_sections(
    results: Sequence[Result], rates: Rates, to_run_again: Collection[str] = ()
) -> list[str]:
    """Writes the sections on the cells of the paper's tables. Without results the list is empty.

    Args:
        results: the results from `cell_results`.
        rates: the cost of each learning rate of each baseline on validation scenes.
        to_run_again: the names of the runs from trees with uncommitted changes. No table may use
            these runs; their cells must be run again.
    """
    if not results:
        return []
    by_name = {result.cell.name: result for result in results}
    sections = [prose("cells", rates=_rates_text(rates).strip())]
    sections += _trainings(by_name, to_run_again)
    sections += _beyond_the_paper(by_name, to_run_again)
    sections += _palletizing(by_name)
    sections += _pyramid(by_name, to_run_again)
    sections += differences(by_name)
    sections += failed_grasps(results)
    sections += ["### Every cell\n", _every_cell(results)]
    return sections


def _rates_text(rates: Rates) -> str:
    if not rates:
        return f"Our method learns with the rate {LEARNING_RATES[0]:g}.\n"
    parts = []
    for training in _baselines():
        costs = rates.get(rates_key(training))
        who = f"the {METHODS[training.method]}, {training.task}"
        if costs is None:
            parts.append(
                f'- {who}: not chosen yet; `learning rate` of "Every cell" says what was used\n'
            )
            continue
        unit = "mm" if TASKS[training.task].table == "6" else "nats"
        tried = ", ".join(
            f"{rate} ({f'{cost:.2f} {unit}' if math.isfinite(cost) else 'diverged'})"
            for rate, cost in costs.items()
        )
        parts.append(f"- {who}: {best_rate(costs)}, chosen from {tried}\n")
    return prose("learning_rates", ours=f"{LEARNING_RATES[0]:g}") + "\n" + "".join(parts)


def _baselines() -> list[Training]:
    """Returns the trainings that choose the learning rates: each baseline on each task of
    `rates_from`."""
    tasks = dict.fromkeys(task.rates_from for task in TASKS.values())
    return [Training(task, method, 36, 100) for method in LEARNED[1:] for task in tasks]


def _trainings(results: Mapping[str, Result], again: Collection[str]) -> list[str]:
    """Writes the section on the variation between trainings; it is empty if no cell was trained
    twice."""
    rows = []
    for task in FIGURE_6:
        for method in LEARNED[:2]:
            names = [headline(task, method, seed).name for seed in HEADLINE_SEEDS]
            there = [results[name] for name in names if name in results]
            if len(there) > 1:
                cells = [
                    _mean_rates([results[name]]) if name in results else absent_text(name, again)
                    for name in names
                ]
                rows.append([METHODS[method], task, *cells, _mean_rates(there)])
    if not rows:
        return []
    headings = ["method", "toolsets", *(f"training seed {seed}" for seed in HEADLINE_SEEDS), "mean"]
    return [
        "### Variation between trainings\n",
        prose("trainings"),
        markdown_table(headings, rows, left_columns=2),
    ]


def _mean_rates(results: Sequence[Result]) -> str:
    """Returns the mean strict rate and the mean rate by the paper's measure, in percent, as text
    such as "95.1 / 96.3".

    With more than one result, each mean is followed by its results' standard deviation.
    """
    texts = []
    for rate in (STRICT, OWN):
        percents = [100 * result.summary[rate] for result in results]
        spread = f" ± {stdev(percents):.1f}" if len(percents) > 1 else ""
        texts.append(f"{mean(percents):.1f}{spread}")
    return " / ".join(texts)


def _beyond_the_paper(results: Mapping[str, Result], again: Collection[str]) -> list[str]:
    names = {label: f"so2_180_100{ending}" for label, ending in _VARIANTS.items()}
    beyond = list(names.values())[1:]
    if not any(f"{task}_{name}" in results for task in FIGURE_6 for name in beyond):
        return []

    def text(name: str) -> str:
        return results[name].text if name in results else absent_text(name, again)

    steps = TASKS["unseen"].steps
    rows = [
        # The ablations (`_minus_...`) were run on the unseen toolsets only.
        [label, text(f"unseen_{name}"), "" if "minus" in name else text(f"seen_{name}")]
        for label, name in names.items()
    ]
    return [
        "### Beyond the paper, and an ablation\n",
        prose("beyond_the_paper", steps=steps, more=steps + TASKS["unseen"].more_steps),
        markdown_table(["ours, N = 180, 100 demonstrations", "unseen", "seen"], rows),
    ]


def _palletizing(results: Mapping[str, Result]) -> list[str]:
    if not any(name.startswith("palletizing_boxes") for name in results):
        return []
    return [prose("palletizing"), *_toppled_boxes(results)]


def _pyramid(results: Mapping[str, Result], again: Collection[str]) -> list[str]:
    """Writes the section on the tasks of `BEYOND_OF_TABLE_1`, run with our extensions."""
    if not any(
        f"{task}_so2" in name and name.endswith("_ours")
        for name in results
        for task in BEYOND_OF_TABLE_1
    ):
        return []
    rows = []
    for method, n, papers in rows_of_table_1():
        if method != "so2":
            continue
        for index, count in enumerate(RAVENS_DEMONSTRATIONS[::-1]):
            endings = {str(count): "ours"}
            if count == RAVENS_DEMONSTRATIONS[0]:
                endings[f"{count}, {PATIENCE} times the steps"] = f"{PATIENT}_ours"
            for label, ending in endings.items():
                texts = [
                    ravens_text(
                        f"{task}_so2_{n}_{count}_{ending}", papers[task][index], results, again
                    )
                    for task in BEYOND_OF_TABLE_1
                ]
                rows.append([METHODS[method], str(n), label, *texts])
    headings = ["method", "N", "demonstrations", *BEYOND_OF_TABLE_1]
    return [prose("pyramid"), markdown_table(headings, rows)]


def _toppled_boxes(results: Mapping[str, Result]) -> list[str]:
    """Writes the failures on palletizing after one demonstration, for the cells that were run."""
    rows = []
    for method, n, _ in rows_of_table_1():
        result = results.get(f"palletizing_boxes_{method}_{n}_1")
        if result is not None:
            summary = result.summary
            boxes = sum(row["objects"] for row in summary["categories"].values())
            missed = f"{summary['missed_grasps']} of {summary['actions']}"
            toppled = f"{summary['causes'].get('toppled', 0)} of {boxes}"
            rows.append([METHODS[method], str(n), missed, toppled])
    if not rows:
        return []
    headings = ["method", "N", "actions that grasp nothing", "boxes that topple"]
    return [prose("palletizing_once"), markdown_table(headings, rows)]


def _every_cell(results: Sequence[Result]) -> str:
    def detail(result: Result, key: str) -> str:
        value = result.summary["policy_details"].get(key)
        return "" if value is None else str(value)

    rows = []
    for result in results:
        summary = result.summary
        rows.append(
            [
                result.cell.name,
                *(detail(result, key) for key in _TOLD),
                str(summary["episodes"]),
                f"{min(summary['seeds'])} to {max(summary['seeds'])}",
                *both_rates(result),
                _causes(summary),
                (summary["policy_digest"] or "-").removeprefix("sha256 ")[:8],
                summary["versions"]["drake"],
                short_commits(summary["commit"]),
                changeable(summary).text if is_as_in_the_paper(result) else "",
            ]
        )
    headings = [
        "cell",
        "trained at N",
        "steps",
        "learning rate",
        "training seed",
        "type",
        "episodes",
    ]
    headings += ["seeds", "strict success, %", "over tools", "paper's measure, %", "causes"]
    headings += ["weights", "Drake", "commit", "after a failed grasp"]
    return prose("every_cell") + "\n" + markdown_table(headings, rows)


def _causes(summary: Mapping[str, Any]) -> str:
    """Returns the causes of failures, and of successes that are not strict, with their counts."""
    counts = {**summary["causes"], **summary["ambiguous"]}
    return ", ".join(f"{name} {count}" for name, count in counts.items() if count) or "-"
