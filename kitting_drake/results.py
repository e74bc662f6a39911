"""`python -m kitting_drake.results`: writes the pages of results from the runs in docs/results/.

The pages are docs/results.md with its figures, docs/protocol.md, and the tables in
docs/robustness.md. `--add` adds a run of `evaluate` to the runs, and `--remove` removes one. A cell
of a table shows the run that has the cell's name (see `benchmark paper`). Such a run is refused if
it was made with uncommitted changes.

docs/results/ also has `learning_rates.json` from `benchmark paper`, and a copy of `networks.json`
from `benchmark networks`. All numbers come from this folder, except those of the paper.
"""

import argparse
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rich.console import Console

from kitting_drake.common.command_line import run_command
from kitting_drake.common.files import write_atomically
from kitting_drake.reproduction.page.harder_scenes import harder_scenes_table, stop_reasons_table
from kitting_drake.reproduction.page.protocol_page import protocol_page
from kitting_drake.reproduction.page.results_page import results_page
from kitting_drake.reproduction.page.robustness import robustness_table, with_figures
from kitting_drake.reproduction.page.run_table import add_run, remove_runs
from kitting_drake.reproduction.page.runs import read_evaluation, read_runs
from kitting_drake.reproduction.paper.cell_results import Result, cell_results, check_new_cell
from kitting_drake.reproduction.paper.efficiency import read_efficiency
from kitting_drake.reproduction.paper.learning_rates import read_rates
from kitting_drake.reproduction.paper.paper_figures import draw_figure_6, draw_table_1
from kitting_drake.reproduction.paper.paper_sections import (
    flat_shapes_table,
    fresh_tools,
    has_figure,
    has_table_1,
    paper_sections,
)
from kitting_drake.reproduction.paper.paper_tables import paper_cells
from kitting_drake.reproduction.paper.protocol_sections import protocol_sections


def main() -> int:
    """Parses the command line and writes the files; returns the exit code."""
    arguments = _parser().parse_args()
    folder, output = arguments.results, arguments.output
    rates = read_rates(folder)
    if arguments.remove:
        remove_runs(folder, arguments.remove)
    for name, path in arguments.add:
        summary = read_evaluation(Path(path))
        for cell in paper_cells():
            if cell.name == name:
                check_new_cell(cell, summary, rates)
        add_run(folder, name, summary)
    runs = read_runs(folder)
    divided = cell_results(runs, rates)
    answers, others = divided.results, divided.others
    efficiency = read_efficiency(folder)
    link = os.path.relpath(folder, output.parent)
    again = divided.to_run_again
    page = results_page(
        others, link, fresh_tools(answers, again), paper_sections(answers, efficiency, again)
    )
    write_atomically(output, page)
    cells = protocol_sections(answers, rates, again)
    page = protocol_page(others, link, cells, divided.set_aside)
    write_atomically(output.with_name("protocol.md"), page)
    _draw(answers, efficiency, output.parent)
    robustness = output.with_name("robustness.md")
    if robustness.exists():
        page = with_figures(robustness.read_text(), robustness_table(others))
        page = with_figures(page, harder_scenes_table(others), "harder scenes")
        page = with_figures(page, stop_reasons_table(others), "stop reasons")
        page = with_figures(page, flat_shapes_table(answers), "flat shapes")
        write_atomically(robustness, page)
    Console(quiet=arguments.quiet).print(
        f"{len(runs)} runs: {output}", highlight=False, markup=False
    )
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m kitting_drake.results",
        description="Write the pages of results from the table of runs.",
    )
    parser.add_argument(
        "--results",
        type=Path,
        metavar="DIR",
        default=Path("docs/results"),
        help="folder of runs.csv and episodes.jsonl.xz (docs/results)",
    )
    parser.add_argument(
        "--output",
        type=Path,
        metavar="FILE.md",
        default=Path("docs/results.md"),
        help="the page to write; protocol.md is written to the same folder (docs/results.md)",
    )
    parser.add_argument(
        "--add",
        nargs=2,
        action="append",
        default=[],
        metavar=("NAME", "DIR"),
        help="first add a run: its name, and the output folder of `evaluate`",
    )
    parser.add_argument(
        "--remove", action="append", metavar="NAME", help="first remove the run of this name"
    )
    parser.add_argument("--quiet", action="store_true", help="print nothing but errors")
    return parser


def _draw(answers: Sequence[Result], efficiency: dict[str, Any] | None, folder: Path) -> None:
    """Draws the paper's figure 6 and table I, and the networks' run times, as far as there are
    results for them."""
    by_name = {answer.cell.name: answer for answer in answers}
    for task in ("seen", "unseen"):
        if has_figure(task, answers):
            path = folder / f"results_{task}.png"
            write_atomically(path, draw_figure_6(task, by_name))
    if answers and efficiency is not None:
        # Import torch lazily.
        from kitting_drake.reproduction.network_speed.speed_figure import draw_networks

        draw_networks(efficiency, folder / "networks.png")
    if has_table_1(answers):
        write_atomically(folder / "results_ravens.png", draw_table_1(by_name))


if __name__ == "__main__":
    run_command(main)
