"""The results of `benchmark paper`: cells, and their summaries."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from kitting_drake.common.errors import UserError
from kitting_drake.reproduction.page.markdown import rate_text
from kitting_drake.reproduction.page.runs import check_summary
from kitting_drake.reproduction.paper.cells import Cell
from kitting_drake.reproduction.paper.efficiency import EFFICIENCY
from kitting_drake.reproduction.paper.learning_rates import RATES, read_rates
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


def read_results(folder: Path) -> list[Result]:
    """The results of `benchmark paper`, in the order of the cells; there may be none.

    Raises:
        UserError: a file there is of no cell, or not what its cell says.
    """
    if not folder.is_dir():
        return []
    cells = {cell.name: cell for cell in paper_cells()}
    rates = read_rates(folder)
    found = {}
    for path in sorted(folder.glob("*.json")):
        if path.name in (RATES, EFFICIENCY):
            continue
        cell = cells.get(path.stem)
        if cell is None:
            raise UserError(f"{path} is of no cell of the paper's tables: delete it")
        try:
            summary = json.loads(path.read_text())
            check_summary(summary, path)
            departure = cell.departure(summary, rates)
            kinds = (type(summary["outcomes"]), type(summary["versions"]))
            if kinds != (list, dict):
                raise TypeError("outcomes must be a list, and versions a mapping")
        except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
            raise UserError(f"{path} is no summary of evaluate: {error!r}") from error
        if departure is not None:
            raise UserError(f"{path} is not that of its cell: {departure}")
        found[cell.name] = Result(cell, summary)
    return [found[name] for name in cells if name in found]
