"""`python -m kitting_drake.results`: docs/results.md, from the summaries in docs/results/, and the
table of docs/robustness.md.

Each file there is a copy of a `summary.json` of `evaluate`, under any name; in docs/results/paper/
are those of `benchmark paper`, each under the name of its cell, and `networks.json`, a copy of the
file of `benchmark networks`. Nothing in the tables comes from anywhere else, but the paper's own
figures.
"""

import argparse
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rich.console import Console

from kitting_drake.common.command_line import run_command
from kitting_drake.common.files import write_atomically
from kitting_drake.reproduction.page.results_page import results_page
from kitting_drake.reproduction.page.robustness import robustness_table, with_figures
from kitting_drake.reproduction.page.runs import read_runs
from kitting_drake.reproduction.paper.cell_results import Result, read_results
from kitting_drake.reproduction.paper.efficiency import read_efficiency
from kitting_drake.reproduction.paper.learning_rates import read_rates
from kitting_drake.reproduction.paper.paper_figures import draw_figure_6, draw_table_1
from kitting_drake.reproduction.paper.paper_sections import has_figure, has_table_1, paper_sections


def main() -> int:
    """Parses the command line and writes the file; returns the exit code."""
    parser = argparse.ArgumentParser(
        prog="python -m kitting_drake.results", description="Tables of results, from files only."
    )
    parser.add_argument(
        "--results",
        type=Path,
        metavar="DIR",
        default=Path("docs/results"),
        help="where the summaries are (docs/results)",
    )
    parser.add_argument(
        "--output",
        type=Path,
        metavar="FILE.md",
        default=Path("docs/results.md"),
        help="what to write (docs/results.md)",
    )
    parser.add_argument("--quiet", action="store_true", help="print nothing but errors")
    arguments = parser.parse_args()
    runs = read_runs(arguments.results)
    link = os.path.relpath(arguments.results, arguments.output.parent)
    answers = read_results(arguments.results / "paper")
    rates = read_rates(arguments.results / "paper")
    efficiency = read_efficiency(arguments.results / "paper")
    page = results_page(runs, link, paper_sections(answers, rates, link, efficiency))
    write_atomically(arguments.output, page)
    _draw(answers, efficiency, arguments.output.parent)
    robustness = arguments.output.with_name("robustness.md")
    if robustness.exists():
        page = with_figures(robustness.read_text(), robustness_table(runs))
        write_atomically(robustness, page)
    Console(quiet=arguments.quiet).print(
        f"{len(runs) + len(answers)} summaries: {arguments.output}", highlight=False, markup=False
    )
    return 0


def _draw(answers: Sequence[Result], efficiency: dict[str, Any] | None, folder: Path) -> None:
    """Draws figure 6 of the tasks that it compares methods on, what networks cost, and table I."""
    by_name = {answer.cell.name: answer for answer in answers}
    for task in ("seen", "unseen"):
        if has_figure(task, answers):
            path = folder / f"results_{task}.png"
            write_atomically(path, draw_figure_6(task, by_name))
    if answers and efficiency is not None:
        # Only who has something to draw waits for torch.
        from kitting_drake.reproduction.network_speed.speed_figure import draw_networks

        draw_networks(efficiency, folder / "networks.png")
    if has_table_1(answers):
        write_atomically(folder / "results_ravens.png", draw_table_1(by_name))


if __name__ == "__main__":
    run_command(main)
