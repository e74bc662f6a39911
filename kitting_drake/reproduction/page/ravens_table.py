"""Writes the section on the five Ravens tasks: the paper's numbers (table I) and our runs."""

from collections import defaultdict
from collections.abc import Sequence

from kitting_drake.reproduction.page.markdown import markdown_table
from kitting_drake.reproduction.page.runs import LEARNED, METHODS, Run
from kitting_drake.tasks import RAVENS_TASKS

TASKS = tuple(task.title for task in RAVENS_TASKS)
"""The titles of the tasks, in the order of table I."""

PAPER: dict[tuple[str, int], tuple[tuple[float, float, float], ...]] = {
    ("SO(2)-equivariant (ours)", 36): (
        (100, 100, 100),
        (96.0, 100, 100),
        (97.8, 99.9, 100),
        (58.0, 100, 100),
        (51.8, 84.5, 97.5),
    ),
    ("SO(2)-equivariant (ours)", 180): (
        (95.0, 100, 100),
        (98.2, 100, 100),
        (96.2, 100, 100),
        (42.0, 95.0, 100),
        (56.0, 86.8, 99.0),
    ),
    ("Equivariant Transporter", 36): (
        (100, 100, 100),
        (95.6, 100, 100),
        (96.1, 100, 100),
        (64.0, 99.0, 100),
        (62.1, 85.6, 98.3),
    ),
    ("Transporter", 36): (
        (98.0, 100, 100),
        (82.3, 94.8, 100),
        (84.2, 99.6, 100),
        (45.0, 85.0, 99.0),
        (16.6, 63.3, 75.0),
    ),
}
"""Success rates in percent after 1, 10 and 100 demonstrations, by method and N, from table I."""


def in_ravens_table(run: Run) -> bool:
    """Whether a run belongs in the table. It must be of one of the five Ravens tasks, with default
    settings. Its policy must refine actions or have no networks."""
    if run.summary["task"] not in TASKS or run.departures:
        return False
    return run.method not in LEARNED or bool(run.detail("continuous"))


def ravens_section(runs: Sequence[Run]) -> list[str]:
    """Writes the section on the five Ravens tasks; it is empty without runs of them.

    Args:
        runs: all runs; those that are not `in_ravens_table` are ignored.
    """
    cells: dict[tuple[str, int | None, int | None], dict[str, list[str]]] = defaultdict(
        lambda: defaultdict(list)
    )
    for run in runs:
        if not in_ravens_table(run):
            continue
        low, high = (100 * value for value in run.summary["ci95"])
        key = (run.method, run.detail("orientations"), run.detail("demonstrations"))
        cells[key][run.summary["task"]].append(
            f"{100 * run.summary['success_rate']:.1f} ({low:.1f} to {high:.1f}), "
            f"{run.summary['episodes']}"
        )
    if not cells:
        return []
    rows = []
    for (method, orientations, count), found in sorted(cells.items(), key=str):
        name = METHODS.get(method, method)
        # List all runs, because a selection could flatter the policy.
        values = ["<br>".join(found[task]) if task in found else "-" for task in TASKS]
        rows.append([name, str(orientations or ""), str(count or ""), *values])
    headings = ["method", "N", "demonstrations", *TASKS]
    return [
        "### The five Ravens tasks, by default\n",
        "Actions are finer than a pixel and an angle bin. A cell has the mean reward in "
        "percent, its 95 %\ninterval and the number of episodes.\n",
        markdown_table(headings, rows),
    ]
