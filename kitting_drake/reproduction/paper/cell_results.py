"""The runs that fill the cells of the paper's tables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from kitting_drake.common.errors import UserError
from kitting_drake.reproduction.page.markdown import rate_text
from kitting_drake.reproduction.page.run_table import Summary
from kitting_drake.reproduction.page.runs import Run
from kitting_drake.reproduction.paper.cells import Cell
from kitting_drake.reproduction.paper.learning_rates import Rates
from kitting_drake.reproduction.paper.paper_tables import paper_cells


@dataclass(frozen=True)
class Result:
    """A cell, and its summary."""

    cell: Cell
    summary: Mapping[str, Any]

    @cached_property
    def text(self) -> str:
        """The strict rate with its interval, and the rate by the paper's measure, in percent."""
        strict = rate_text(self.summary["strict_success_rate"], self.summary["strict_ci95"])
        return f"{strict} / {100 * self.summary['success_rate']:.1f}"


def cell_results(runs: Sequence[Run], rates: Rates) -> tuple[list[Result], list[Run]]:
    """Divides runs into those of cells and others: a run that is named as a cell must be it.

    Args:
        runs: of `read_runs`.
        rates: of `read_rates`.

    Returns:
        The results in the order of the cells, and the other runs in theirs.

    Raises:
        UserError: a run is not what its name says.
    """
    found = {run.name: run.summary for run in runs}
    cells = {cell.name: cell for cell in paper_cells() if cell.name in found}
    for name, cell in cells.items():
        check_cell(cell, found[name], rates)
    results = [Result(cell, found[name]) for name, cell in cells.items()]
    return results, [run for run in runs if run.name not in cells]


def check_cell(cell: Cell, summary: Summary, rates: Rates) -> None:
    """Checks that a summary is that of a cell.

    Raises:
        UserError: it is not; says why.
    """
    try:
        departure = cell.departure(summary, rates)
        if departure is None and not isinstance(summary["outcomes"], list):
            departure = "its outcomes are no list"
    except (KeyError, TypeError, AttributeError) as error:
        raise UserError(f"run '{cell.name}' is no summary of evaluate: {error!r}") from error
    if departure is not None:
        raise UserError(
            f"run '{cell.name}' is not that of the cell of this name ({departure}): give it "
            "another name, or remove it (results --remove)"
        )
