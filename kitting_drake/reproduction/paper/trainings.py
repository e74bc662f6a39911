"""The section of the protocol on the variation between trainings."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from statistics import mean, stdev

from kitting_drake.reproduction.page.markdown import markdown_table
from kitting_drake.reproduction.page.paired import OWN, STRICT
from kitting_drake.reproduction.page.prose import prose
from kitting_drake.reproduction.page.runs import LEARNED, METHODS
from kitting_drake.reproduction.paper.cell_results import Result, absent_text
from kitting_drake.reproduction.paper.paper_tables import FIGURE_6, HEADLINE_SEEDS, headline


def trainings(results: Mapping[str, Result], to_run_again: Collection[str] = ()) -> list[str]:
    """The section; empty where nothing has been trained from a second seed.

    Args:
        results: by the names of their cells.
        to_run_again: the names of the cells whose runs are set aside.
    """
    rows = []
    for task in FIGURE_6:
        for method in LEARNED[:2]:
            names = [headline(task, method, seed).name for seed in HEADLINE_SEEDS]
            there = [results[name] for name in names if name in results]
            if len(there) > 1:
                cells = [
                    _rates([results[name]]) if name in results else absent_text(name, to_run_again)
                    for name in names
                ]
                rows.append([METHODS[method], task, *cells, _rates(there)])
    if not rows:
        return []
    headings = ["method", "toolsets", *(f"seed {seed}" for seed in HEADLINE_SEEDS), "mean"]
    return [
        "### Variation between trainings\n",
        prose("trainings"),
        markdown_table(headings, rows, left_columns=2),
    ]


def _rates(results: Sequence[Result]) -> str:
    """The mean of both rates, and its standard deviation where there are several."""
    texts = []
    for rate in (STRICT, OWN):
        percents = [100 * result.summary[rate] for result in results]
        spread = f" ± {stdev(percents):.1f}" if len(percents) > 1 else ""
        texts.append(f"{mean(percents):.1f}{spread}")
    return " / ".join(texts)
