"""Finds the results of the cells of the paper's tables."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

from kitting_drake.common.errors import UserError
from kitting_drake.common.provenance import is_reproducible
from kitting_drake.reproduction.page.markdown import rate_text
from kitting_drake.reproduction.page.run_table import Summary
from kitting_drake.reproduction.page.runs import LEARNED, Run
from kitting_drake.reproduction.paper.cells import Cell
from kitting_drake.reproduction.paper.learning_rates import Rates
from kitting_drake.reproduction.paper.paper_tables import paper_cells

MISSING, TO_RUN_AGAIN = "-", "- ‡"
"""The texts of a cell that was not run, and of a cell whose run is not reproducible."""


@dataclass(frozen=True)
class Result:
    """A cell with the summary of its run."""

    cell: Cell
    summary: Mapping[str, Any]

    @cached_property
    def text(self) -> str:
        """The strict success rate with its interval, and the success rate by the paper's measure,
        in percent."""
        strict = rate_text(self.summary["strict_success_rate"], self.summary["strict_ci95"])
        return f"{strict} / {100 * self.summary['success_rate']:.1f}"


class Divided(NamedTuple):
    """The three groups into which `cell_results` divides runs."""

    results: list[Result]
    """The results of cells, in the order of the cells."""
    others: list[Run]
    """The other runs, in their given order."""
    set_aside: list[Run]
    """All runs from trees with uncommitted changes, even if they belong to cells. No table may use
    them."""

    @property
    def to_run_again(self) -> frozenset[str]:
        """The names of the runs that are set aside."""
        return frozenset(run.name for run in self.set_aside)


def cell_results(runs: Sequence[Run], rates: Rates) -> Divided:
    """Divides runs into those of cells and others. A run with the name of a cell must fit the cell.

    Args:
        runs: the runs from `read_runs`.
        rates: the learning rates from `read_rates`.

    Raises:
        UserError: a run does not fit the cell of its name.
    """
    found = {run.name: run.summary for run in runs}
    cells = {cell.name: cell for cell in paper_cells() if cell.name in found}
    for name, cell in cells.items():
        check_cell(cell, found[name], rates)
    set_aside = [run for run in runs if not is_reproducible(run.summary["commit"])]
    away = {run.name for run in set_aside}
    results = [Result(cell, found[name]) for name, cell in cells.items() if name not in away]
    others = [run for run in runs if run.name not in cells.keys() | away]
    return Divided(results, others, set_aside)


def absent_text(name: str, to_run_again: Collection[str]) -> str:
    """Returns the text for a cell without a result."""
    return TO_RUN_AGAIN if name in to_run_again else MISSING


def check_cell(cell: Cell, summary: Summary, rates: Rates) -> None:
    """Checks that a summary fits a cell.

    Raises:
        UserError: it does not fit. The message says why.
    """
    try:
        departure = cell.departure(summary, rates)
        if departure is None and not isinstance(summary["outcomes"], list):
            departure = "its outcomes are not a list"
    except (KeyError, TypeError, AttributeError) as error:
        raise UserError(
            f"run '{cell.name}' is not a summary of evaluate: a field is missing or of another type"
        ) from error
    if departure is not None:
        raise UserError(
            f"run '{cell.name}' does not fit the cell of this name ({departure}): give the run "
            "another name, or remove it (results --remove)"
        )


def check_new_cell(cell: Cell, summary: Summary, rates: Rates) -> None:
    """Checks that a new summary may fill a cell.

    Raises:
        UserError: the summary does not fit the cell, or its run cannot be repeated.
    """
    check_cell(cell, summary, rates)
    commits = summary["commit"]
    if not is_reproducible(commits):
        made = f"commit {commits}, with uncommitted changes" if commits else "an unknown commit"
        raise UserError(
            f"run '{cell.name}' cannot fill the cell of this name: its episodes are from {made}; "
            "commit the changes and evaluate into a fresh folder"
        )
    if summary["policy_details"].get("method") in LEARNED and not summary["policy_digest"]:
        raise UserError(
            f"run '{cell.name}' lacks policy_digest, the digest of its weights: evaluate it again"
        )
