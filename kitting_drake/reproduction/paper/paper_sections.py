"""Writes the sections of the page of results that compare with the paper: figure 6 and table I.

They use only the results of `benchmark paper` and `benchmark networks`.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from typing import Any

from kitting_drake.reproduction.page.markdown import markdown_table, rate_text
from kitting_drake.reproduction.page.paired import STRICT, over_tools
from kitting_drake.reproduction.page.prose import prose
from kitting_drake.reproduction.page.protocol_page import PAPER
from kitting_drake.reproduction.page.ravens_table import PAPER as TABLE_1
from kitting_drake.reproduction.page.runs import LEARNED, METHODS
from kitting_drake.reproduction.paper.cell_results import Result, absent_text
from kitting_drake.reproduction.paper.cells import (
    ORIENTATIONS,
    PRESET,
    TASKS,
    Training,
)
from kitting_drake.reproduction.paper.departures import departures
from kitting_drake.reproduction.paper.efficiency import efficiency_section
from kitting_drake.reproduction.paper.paper_tables import (
    DEMONSTRATIONS,
    RAVENS_DEMONSTRATIONS,
    SHIPPED,
    flat_shapes,
    paper_cells,
)
from kitting_drake.reproduction.paper.parameter_table import parameters_section

_MEASURES = {
    "strict": "strict",
    "ravens": "Ravens: 10 mm, 15 degrees",
    "maniskill": "ManiSkill: 20 mm, 4 degrees, height 3 mm",
    "add_s": "ADD-S",
}
"""The headings of the measures of success on flat shapes."""
COLUMNS = tuple(sorted(ORIENTATIONS))
_HEADINGS = {"seen": "Seen toolset, figure 6(a)", "unseen": "Unseen toolsets, figure 6(b)"}
_TITLES = {"seen": "kitting-seen-toolset", "unseen": "kitting-unseen-toolsets"}

EARLIER_MARK = " e"
"""The mark of numbers of table I whose runs had other settings of the task (see
`Cell.is_earlier`)."""


def paper_sections(
    results: Sequence[Result],
    efficiency: Mapping[str, Any] | None = None,
    to_run_again: Collection[str] = (),
) -> list[str]:
    """Writes the sections that compare with the paper. Without results the list is empty.

    Args:
        results: the results from `cell_results`.
        efficiency: the result of `benchmark networks`; None without one.
        to_run_again: the names of the runs from trees with uncommitted changes. No table may use
            these runs; their cells must be run again.
    """
    if not results:
        return []
    by_name = {result.cell.name: result for result in results}
    state = _state_text(results, to_run_again).strip()
    sections = [prose("as_in_the_paper", preset=PRESET, state=state)]
    for task, heading in _HEADINGS.items():
        sections.append(f"### {heading}\n")
        if has_figure(task, results):
            sections.append(f"![Figure 6 of {task} tools](results_{task}.png)\n")
        sections.append(_figure_table(task, by_name, to_run_again))
    sections += _table_1(by_name, to_run_again)
    if efficiency is not None:
        sections.append(efficiency_section(efficiency))
        sections.append(parameters_section())
    sections.append(departures(by_name))
    return sections


def has_figure(task: str, results: Sequence[Result]) -> bool:
    """Whether figure 6 can be drawn for a task: both methods that it compares have results."""
    methods = {
        result.cell.policy.method
        for result in results
        if result.cell.task == task and isinstance(result.cell.policy, Training)
    }
    return set(LEARNED[:2]) <= methods


def has_table_1(results: Iterable[Result]) -> bool:
    """Whether there is a result for table I, which is on the Ravens tasks."""
    return any(TASKS[result.cell.task].table == "I" for result in results)


def _state_text(results: Sequence[Result], to_run_again: Collection[str]) -> str:
    """Says how many of the cells have been run, and how long that took."""
    cells = [cell for cell in paper_cells() if TASKS[cell.task].table != "shapes"]
    results = [result for result in results if TASKS[result.cell.task].table != "shapes"]
    count, again = len(cells), sum(cell.name in to_run_again for cell in cells)
    hours = f"{sum(result.summary['wall_seconds'] for result in results) / 3600:.0f}"
    if len(results) == count:
        return prose("cells_complete", all=count, hours=hours)
    missing = count - len(results) - again
    part = "cells_missing" if missing else "cells_to_run_again"
    return prose(part, done=len(results), all=count, hours=hours, again=again, missing=missing)


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
            rows.append(["*paper*, its own method", "100", *paper])
    oracle = [text(f"{task}_quantized_oracle_{n}") for n in COLUMNS]
    rows.append([METHODS["quantized_oracle"], "", *oracle])
    return markdown_table(["method", "demonstrations", *(f"N = {n}" for n in COLUMNS)], rows)


def _table_1(results: Mapping[str, Result], again: Collection[str]) -> list[str]:
    if not has_table_1(results.values()):
        return []
    tasks = [task.name for task in TASKS.values() if task.table == "I"]
    rows = []
    for method, n, papers in rows_of_table_1():
        for index, count in enumerate(RAVENS_DEMONSTRATIONS[::-1]):
            texts = [
                ravens_text(f"{task}_{method}_{n}_{count}", papers[task][index], results, again)
                for task in tasks
            ]
            rows.append([METHODS[method], str(n), str(count), *texts])
    headings = ["method", "N", "demonstrations"]
    return [
        "### The five Ravens tasks, table I\n",
        prose("ravens_tasks"),
        "![Table I as a figure](results_ravens.png)\n",
        markdown_table([*headings, *tasks], rows),
    ]


def rows_of_table_1() -> Iterator[tuple[str, int, dict[str, tuple[float, float, float]]]]:
    """Yields the rows of table I.

    A row has a method, its N, and the paper's figures by task. The figures are in the order of
    rising numbers of demonstrations.
    """
    tasks = [task.name for task in TASKS.values() if task.table == "I"]
    for (name, n), by_task in TABLE_1.items():
        method = next(key for key, label in METHODS.items() if label == name)
        yield method, n, dict(zip(tasks, by_task, strict=True))


def ravens_text(
    name: str, paper: float, results: Mapping[str, Result], again: Collection[str]
) -> str:
    """Returns the text of a cell of table I: our mean reward with its interval, and the paper's
    figure."""
    found = results.get(name)
    if found is None:
        return f"{absent_text(name, again)} / {paper:g}"
    mark = EARLIER_MARK if found.cell.is_earlier(found.summary) else ""
    rate = rate_text(found.summary["success_rate"], found.summary["ci95"])
    return f"{rate}{mark} / {paper:g}"


def fresh_tools(results: Sequence[Result], again: Collection[str] = ()) -> list[str]:
    """Writes the section on the ten fresh tools; it is empty without results on them.

    Args:
        results: the results from `cell_results`.
        again: `to_run_again` of `paper_sections`.
    """
    by_name = {result.cell.name: result for result in results}
    found = {label: by_name.get(f"fresh_{label}") for label in SHIPPED}
    if not any(found.values()):
        return []
    rows = [
        [
            label.replace("_", " ").replace("of 100", "trained on 100"),
            *(both_rates(result) if result else [absent_text(f"fresh_{label}", again), "-", "-"]),
        ]
        for label, result in found.items()
    ]
    return [
        "### Ten fresh tools\n",
        prose("fresh_tools"),
        markdown_table(
            ["policy", "strict success, %", "interval over tools", "paper's measure, %"], rows
        ),
    ]


def flat_shapes_table(results: Sequence[Result]) -> str:
    """Writes the table of `docs/robustness.md` on flat shapes: success by four measures, for each
    policy and number of demonstrations. Without results it is a sentence that says so.

    Args:
        results: the results from `cell_results`.
    """
    found = {result.cell.name: result.summary for result in results}
    rows, is_empty = [], True
    for policy, cells in flat_shapes().items():
        for cell in cells:
            texts = ["-"] * len(_MEASURES)
            if cell.name in found:
                rates, is_empty = found[cell.name]["measures"], False
                texts = [rate_text(rates[m]["success_rate"], rates[m]["ci95"]) for m in _MEASURES]
            count = cell.policy.demonstrations if isinstance(cell.policy, Training) else ""
            rows.append([policy, str(count), *texts])
    if is_empty:
        return "No runs yet.\n"
    return markdown_table(["policy", "demonstrations", *_MEASURES.values()], rows)


def both_rates(result: Result) -> list[str]:
    """Returns the strict rate, its interval over tools, and the rate by the paper's measure, as
    text."""
    summary = result.summary
    drawn = summary["resolved_scenario"]["task"]["_tag"] == "!ToolsetKitting"
    tools = over_tools(summary["outcomes"], STRICT) if drawn else None
    return [
        rate_text(summary["strict_success_rate"], summary["strict_ci95"]),
        "-" if tools is None else f"{100 * tools.low:.1f} to {100 * tools.high:.1f}",
        rate_text(summary["success_rate"], summary["ci95"]),
    ]
