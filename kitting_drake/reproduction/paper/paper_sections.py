"""The part of the page of results that answers the paper: figure 6 and table I, from the results of
`benchmark paper` alone."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import Any

from kitting_drake.common.provenance import short_commits
from kitting_drake.reproduction.page.markdown import markdown_table, rate_text
from kitting_drake.reproduction.page.paired import STRICT, over_tools
from kitting_drake.reproduction.page.prose import prose
from kitting_drake.reproduction.page.ravens_table import PAPER as TABLE_1
from kitting_drake.reproduction.page.results_page import PAPER
from kitting_drake.reproduction.page.runs import LEARNED, METHODS
from kitting_drake.reproduction.paper.cell_results import Result, absent_text
from kitting_drake.reproduction.paper.cells import (
    LEARNING_RATES,
    ORIENTATIONS,
    PRESET,
    TASKS,
    Training,
    rates_key,
)
from kitting_drake.reproduction.paper.departures import departures
from kitting_drake.reproduction.paper.differences import differences
from kitting_drake.reproduction.paper.efficiency import efficiency_section
from kitting_drake.reproduction.paper.failed_grasps import (
    changeable,
    failed_grasps,
    is_as_in_the_paper,
)
from kitting_drake.reproduction.paper.learning_rates import Rates, best_rate
from kitting_drake.reproduction.paper.paper_tables import (
    BEYOND_OF_TABLE_1,
    DEMONSTRATIONS,
    PATIENCE,
    PATIENT,
    RAVENS_DEMONSTRATIONS,
    SHIPPED,
    paper_cells,
)
from kitting_drake.reproduction.paper.parameter_table import parameters_section
from kitting_drake.reproduction.paper.trainings import trainings

COLUMNS = tuple(sorted(ORIENTATIONS))
_HEADINGS = {"seen": "Seen toolset, figure 6(a)", "unseen": "Unseen toolsets, figure 6(b)"}
_TITLES = {"seen": "kitting-seen-toolset", "unseen": "kitting-unseen-toolsets"}

_VARIANTS = {
    "as in the paper": "",
    "with all extensions": "_ours",
    "with recovery, in two tries a tool": "_ours_recovering",
    "without the search by the hand": "_minus_search",
    "without outline fitting": "_minus_outlines",
    "without any refinement": "_minus_refinement",
    "without labels of later picks": "_minus_all_targets",
    "without curvature and reflection": "_minus_curvature",
}
"""Endings of the names of cells, by what their rows are called."""

EARLIER_MARK = " e"
"""Behind a figure of table I: run on an earlier version of the task."""

_TOLD = ("trained_orientations", "steps", "learning_rate", "training_seed", "compute_type")
"""The details of a policy that are columns of "Every cell"."""


def paper_sections(
    results: Sequence[Result],
    rates: Rates,
    efficiency: Mapping[str, Any] | None = None,
    to_run_again: Collection[str] = (),
) -> list[str]:
    """The sections of the page; none without results.

    Args:
        results: of `cell_results`.
        rates: what each learning rate of each baseline came to on validation scenes.
        efficiency: what `benchmark networks` measured, if it was.
        to_run_again: the names of the cells whose runs are set aside.
    """
    if not results:
        return []
    by_name = {result.cell.name: result for result in results}
    sections = [
        prose(
            "as_in_the_paper",
            preset=PRESET,
            rates=_rates_text(rates).strip(),
            state=_state_text(results, to_run_again).strip(),
        ),
        departures(by_name),
    ]
    for task, heading in _HEADINGS.items():
        sections.append(f"### {heading}\n")
        if has_figure(task, results):
            sections.append(f"![Figure 6 of {task} tools](results_{task}.png)\n")
        sections.append(_figure_table(task, by_name, to_run_again))
    sections += trainings(by_name, to_run_again)
    if efficiency is not None:
        sections.append(efficiency_section(efficiency))
        sections.append(parameters_section())
    sections += _beyond_the_paper(by_name, to_run_again)
    sections += _table_1(by_name, to_run_again)
    sections += _fresh_tools(by_name, to_run_again)
    sections += differences(by_name)
    sections += failed_grasps(results)
    sections += ["### Every cell\n", _every_cell(results)]
    return sections


def has_figure(task: str, results: Sequence[Result]) -> bool:
    """Whether there is something to draw: cells of both methods of a task's figure 6."""
    methods = {
        result.cell.policy.method
        for result in results
        if result.cell.task == task and isinstance(result.cell.policy, Training)
    }
    return set(LEARNED[:2]) <= methods


def has_table_1(results: Iterable[Result]) -> bool:
    """Whether there is a cell of the Ravens tasks."""
    return any(TASKS[result.cell.task].table == "I" for result in results)


def _state_text(results: Sequence[Result], to_run_again: Collection[str]) -> str:
    """How many of the cells have been run, and what that took."""
    cells = paper_cells()
    count, again = len(cells), sum(cell.name in to_run_again for cell in cells)
    hours = f"{sum(result.summary['wall_seconds'] for result in results) / 3600:.0f}"
    if len(results) == count:
        return prose("cells_complete", all=count, hours=hours)
    missing = count - len(results) - again
    part = "cells_missing" if missing else "cells_to_run_again"
    return prose(part, done=len(results), all=count, hours=hours, again=again, missing=missing)


def _rates_text(rates: Rates) -> str:
    if not rates:
        return f"The learning rate of ours is {LEARNING_RATES[0]:g}.\n"
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
        parts.append(f"- {who}: {best_rate(costs)} of {tried}\n")
    return prose("learning_rates", ours=f"{LEARNING_RATES[0]:g}") + "\n" + "".join(parts)


def _baselines() -> list[Training]:
    """The trainings of `reference`: of each baseline on each task that chooses its rate."""
    tasks = dict.fromkeys(task.rates_from for task in TASKS.values())
    return [Training(task, method, 36, 100) for method in LEARNED[1:] for task in tasks]


def _figure_table(task: str, results: Mapping[str, Result], again: Collection[str]) -> str:
    def text(name: str) -> str:
        return results[name].text if name in results else absent_text(name, again)

    rows = []
    for method in LEARNED:
        for count in reversed(DEMONSTRATIONS):
            given = [
                # The paper has the Transporter at N = 36 only.
                "" if method == "transporter" and n != 36 else text(f"{task}_{method}_{n}_{count}")
                for n in COLUMNS
            ]
            rows.append([METHODS[method], str(count), *given])
        if method == "so2":
            paper = [f"- / {PAPER[_TITLES[task]].ours:g}" if n == 180 else "" for n in COLUMNS]
            rows.append(["*paper*, ours", "100", *paper])
    oracle = [text(f"{task}_quantized_oracle_{n}") for n in COLUMNS]
    rows.append([METHODS["quantized_oracle"], "", *oracle])
    return markdown_table(["method", "demonstrations", *(f"N = {n}" for n in COLUMNS)], rows)


def _beyond_the_paper(results: Mapping[str, Result], again: Collection[str]) -> list[str]:
    names = {label: f"so2_180_100{ending}" for label, ending in _VARIANTS.items()}
    beyond = list(names.values())[1:]
    if not any(f"{task}_{name}" in results for task in _HEADINGS for name in beyond):
        return []

    def text(name: str) -> str:
        return results[name].text if name in results else absent_text(name, again)

    steps = TASKS["unseen"].steps
    rows = [
        # Without one thing at a time, only the unseen toolsets tell a difference.
        [label, text(f"unseen_{name}"), "" if "minus" in name else text(f"seen_{name}")]
        for label, name in names.items()
    ]
    return [
        "### Beyond the paper, and an ablation\n",
        prose("beyond_the_paper", steps=steps, more=steps + TASKS["unseen"].more_steps),
        markdown_table(["ours, N = 180, 100 demonstrations", "unseen", "seen"], rows),
    ]


def _table_1(results: Mapping[str, Result], again: Collection[str]) -> list[str]:
    if not has_table_1(results.values()):
        return []
    tasks = [task.name for task in TASKS.values() if task.table == "I"]

    def text(name: str, paper: float) -> str:
        found = results.get(name)
        if found is None:
            return f"{absent_text(name, again)} / {paper:g}"
        mark = EARLIER_MARK if found.cell.is_earlier(found.summary) else ""
        rate = rate_text(found.summary["success_rate"], found.summary["ci95"])
        return f"{rate}{mark} / {paper:g}"

    rows, beyond = [], []
    for (name, n), by_task in TABLE_1.items():
        method = next(key for key, label in METHODS.items() if label == name)
        papers = dict(zip(tasks, by_task, strict=True))
        for index, count in enumerate(RAVENS_DEMONSTRATIONS[::-1]):
            cells = {task: f"{task}_{method}_{n}_{count}" for task in tasks}
            paper = {task: papers[task][index] for task in tasks}
            rows.append([name, str(n), str(count), *(text(cells[t], paper[t]) for t in tasks)])
            if method == "so2":
                ours = [text(f"{cells[t]}_ours", paper[t]) for t in BEYOND_OF_TABLE_1]
                beyond.append([name, str(n), str(count), *ours])
            if method == "so2" and count == RAVENS_DEMONSTRATIONS[0]:
                ours = [text(f"{cells[t]}_{PATIENT}_ours", paper[t]) for t in BEYOND_OF_TABLE_1]
                beyond.append([name, str(n), f"{count}, {PATIENCE} times the steps", *ours])
    headings = ["method", "N", "demonstrations"]
    sections = [
        "### The five Ravens tasks, table I\n",
        prose("ravens_tasks"),
        "![Table I as a figure](results_ravens.png)\n",
        markdown_table([*headings, *tasks], rows),
    ]
    if any(name.startswith("palletizing_boxes") for name in results):
        sections.append(prose("palletizing"))
    sections += _toppled_boxes(results)
    if any(
        f"{task}_so2" in name and name.endswith("_ours")
        for name in results
        for task in BEYOND_OF_TABLE_1
    ):
        table = markdown_table([*headings, *BEYOND_OF_TABLE_1], beyond)
        sections += [prose("pyramid"), table]
    return sections


def _toppled_boxes(results: Mapping[str, Result]) -> list[str]:
    """What went wrong on palletizing after one demonstration, of the cells that are there."""
    rows = []
    for name, n in TABLE_1:
        method = next(key for key, label in METHODS.items() if label == name)
        result = results.get(f"palletizing_boxes_{method}_{n}_1")
        if result is not None:
            summary = result.summary
            boxes = sum(row["objects"] for row in summary["categories"].values())
            missed = f"{summary['missed_grasps']} of {summary['actions']}"
            toppled = f"{summary['causes'].get('toppled', 0)} of {boxes}"
            rows.append([name, str(n), missed, toppled])
    if not rows:
        return []
    headings = ["method", "N", "actions that grasp nothing", "boxes that topple"]
    return [prose("palletizing_once"), markdown_table(headings, rows)]


def _fresh_tools(results: Mapping[str, Result], again: Collection[str]) -> list[str]:
    found = {label: results.get(f"fresh_{label}") for label in SHIPPED}
    if not any(found.values()):
        return []
    rows = [
        [
            label.replace("_", " "),
            *(_both(result) if result else [absent_text(f"fresh_{label}", again), "-", "-"]),
        ]
        for label, result in found.items()
    ]
    return [
        "### Ten fresh tools\n",
        prose("fresh_tools"),
        markdown_table(["policy", "strict, %", "over tools", "paper's, %"], rows),
    ]


def _both(result: Result) -> list[str]:
    """Both rates, and between them the strict one's interval over tools."""
    summary = result.summary
    drawn = summary["resolved_scenario"]["task"]["_tag"] == "!ToolsetKitting"
    tools = over_tools(summary["outcomes"], STRICT) if drawn else None
    return [
        rate_text(summary["strict_success_rate"], summary["strict_ci95"]),
        "-" if tools is None else f"{100 * tools.low:.1f} to {100 * tools.high:.1f}",
        rate_text(summary["success_rate"], summary["ci95"]),
    ]


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
                *_both(result),
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
    headings += ["seeds", "strict, %", "over tools", "paper's, %", "causes"]
    headings += ["weights", "Drake", "commit", "after a failed grasp"]
    return prose("every_cell") + "\n" + markdown_table(headings, rows)


def _causes(summary: Mapping[str, Any]) -> str:
    """Why objects were no success, or no strict one, and how many."""
    counts = {**summary["causes"], **summary["ambiguous"]}
    return ", ".join(f"{name} {count}" for name, count in counts.items() if count) or "-"
