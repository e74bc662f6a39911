"""`python -m kitting_drake.results`: docs/results.md, from the summaries under docs/results/.

Each file there is a copy of a `summary.json` of `evaluate`, under any name. Nothing in the tables
comes from anywhere else, but the paper's own figures.
"""

import argparse
import json
import os
from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.console import Console

from kitting_drake.common.command_line import run_verb
from kitting_drake.common.errors import UserError
from kitting_drake.common.files import write_whole
from kitting_drake.episode.action_log import CAUSES
from kitting_drake.reporting.summary import (
    ANSWER_ERRORS,
    DOUBTS,
    ERRORS,
    FAILED,
    SEEN_TASK,
    UNSEEN_TASK,
    number,
)

_METHODS = {
    "so2": "SO(2)-equivariant (ours)",
    "equivariant_transporter": "Equivariant Transporter",
    "transporter": "Transporter",
    "quantised_oracle": "oracle, rounded",
    "oracle": "oracle, exact",
}
_LEARNED = ("so2", "equivariant_transporter", "transporter")

_ORIENTATIONS = (36, 72, 120, 180)
_DEMONSTRATIONS = (10, 100)
"""What the paper varies (sections V-B.1 and V-C.1)."""


@dataclass(frozen=True)
class _Paper:
    """What the text of the paper (section V-D.1) says of a task."""

    title: str
    ours: float
    """Success rate at N = 180 with 100 demonstrations, in percent."""
    transporter_gain: float
    """How much better the Equivariant Transporter is on average, in points."""


_TASKS = {
    SEEN_TASK: _Paper("Seen toolset", 96.5, 0.63),
    UNSEEN_TASK: _Paper("Unseen toolsets", 87.25, 2.16),
}

_INTRODUCTION = """\
# Results

Written by `python -m kitting_drake.results` from files alone, each the `summary.json` of one
`evaluate`; they are listed at the end. Do not edit.

A cell of the first tables is the success rate in percent (section IV-C of the paper: the share of
the tools that ended with ADD-S below the threshold; failed episodes count 0), its 95 % interval
(Wilson's, as if every tool of every episode were drawn anew: for *these* tools; of tools in
general the twenty of the test set tell less), and how many episodes were run. `-`: not run. A
star: answered between pixels and bins, which the paper does not; else on them. A dagger: asked for
another N than it was trained at.

ADD-S forgives a flat tool that stands proud of its cavity, or lies the wrong way round: "proud"
counts the kitted tools that stand more than 2 mm too high, "turned" those more than 20 degrees
round (which is nothing where both ends are alike, as of an offset screwdriver). `?`: not counted.

The unseen test tools are those of the dataset's test split. What these policies and the hand do was
improved while looking at episodes of the seeds 0 to 99, with these tools: seeds from 100 on are
the ones to trust.

The oracle knows the truth. Rounded, it says it in pixels and N orientations: no policy of that N
can be expected to do better. Exact, it has no N, and its one figure stands in every column.

The paper gives two of these cells as numbers, over 100 episodes each and with the best of its
checkpoints (section V-C.2). The others are bars of its figure 6, and left out.
"""


@dataclass(frozen=True)
class _Run:
    """One summary, and what its policy is."""

    file: str
    summary: dict[str, Any]

    def detail(self, key: str) -> Any:
        """Of the policy; None if not given."""
        return (self.summary["policy_details"] or {}).get(key)

    @property
    def seeds(self) -> str:
        """Its first and last."""
        seeds = self.summary["seeds"]
        first, last = min(seeds), max(seeds)
        return f"{first} to {last}" if last - first + 1 == len(seeds) else f"{first} .. {last}"

    @property
    def label(self) -> str:
        """What tells it from the other runs of its task, for a person."""
        parts = [_METHODS.get(self.detail("method"), self.summary["policy"])]
        for key, text in (
            ("orientations", "N = {}"),
            ("demonstrations", "{} demonstrations"),
            ("preset", "preset {}"),
        ):
            if self.detail(key) is not None:
                parts.append(text.format(self.detail(key)))
        return ", ".join(parts)


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
    summaries = read_summaries(arguments.results)
    link = os.path.relpath(arguments.results, arguments.output.parent)
    write_whole(arguments.output, results_page(summaries, link))
    Console(quiet=arguments.quiet).print(
        f"{len(summaries)} summaries: {arguments.output}", highlight=False
    )
    return 0


def read_summaries(folder: Path) -> dict[str, dict[str, Any]]:
    """The summaries of a folder by the names of their files, in order.

    Raises:
        UserError: there are none, or one is not what `evaluate` writes.
    """
    paths = sorted(folder.glob("*.json"))
    if not paths:
        raise UserError(f"there are no .json files in {folder}: copy summary.json files there")
    return {path.name: _read_summary(path) for path in paths}


def _read_summary(path: Path) -> dict[str, Any]:
    try:
        summary = json.loads(path.read_text())
    except (OSError, ValueError) as error:
        raise UserError(f"{path} cannot be read: {error}") from error
    required = ("task", "policy", "policy_details", "seeds", "episodes", "success_rate", "ci95")
    for key in (*required, *ERRORS, "answers", "causes", "categories", "wall_seconds"):
        if not isinstance(summary, dict) or key not in summary:
            raise UserError(f"{path} lacks '{key}': it must be a summary.json of evaluate")
    if not summary["seeds"] or len(summary["ci95"] or ()) != 2:
        raise UserError(f"{path} has no seeds or no ci95: it must be a summary.json of evaluate")
    _check_details(summary["policy_details"], f"{path}: policy_details")
    return summary


def _check_details(details: Any, where: str) -> None:
    if details is None:
        return
    method = details.get("method") if isinstance(details, dict) else None
    if method not in _METHODS:
        raise UserError(f"{where}.method must be one of {', '.join(_METHODS)}, not '{method}'")
    needed = [] if method == "oracle" else ["orientations"]
    if method in _LEARNED:
        needed.append("demonstrations")
    for key in needed:
        if not isinstance(details.get(key), int):
            raise UserError(f"{where}.{key} must be a whole number for the method {method}")


def results_page(summaries: dict[str, dict[str, Any]], link: str) -> str:
    """The whole page, in Markdown.

    Args:
        summaries: by the names of their files.
        link: the folder of the files, from the page's own.
    """
    runs = [_Run(file, summary) for file, summary in summaries.items()]
    sections = [_INTRODUCTION]
    for task, paper in _TASKS.items():
        mine = [run for run in runs if run.summary["task"] == task and run.detail("method")]
        sections.append(f"## {paper.title} (`{task}`)\n")
        sections.append(_success_table(mine, paper))
        sections.append(
            f"In the paper the Equivariant Transporter is {paper.transporter_gain} points better "
            "than the SO(2)-equivariant\nmethod, on average over N and demonstrations.\n"
        )
        if mine:
            sections += [*_most_tested_run(mine), *_causes(mine)]
    sections += ["## Files\n", _files_table(runs, link)]
    return "\n".join(sections)


def _success_table(runs: list[_Run], paper: _Paper) -> str:
    cells: dict[tuple[Any, ...], list[_Run]] = defaultdict(list)
    for run in runs:
        keys = ("method", "preset", "demonstrations", "orientations")
        cells[tuple(run.detail(key) for key in keys)].append(run)
    orientations = _with_others(_ORIENTATIONS, (n for *_, n in cells))

    def row(method: str, preset: str | None = None, count: int | None = None) -> list[str]:
        named = [_METHODS[method], preset or "", str(count or "")]
        # The exact oracle has no N.
        shown = [None] * len(orientations) if method == "oracle" else orientations
        return named + [_cell(cells[method, preset, count, n]) for n in shown]

    rows = []
    for method in _LEARNED:
        mine = [(preset, count) for name, preset, count, _ in cells if name == method]
        presets = sorted({preset for preset, _ in mine}, key=str) or [None]
        counts = _with_others(_DEMONSTRATIONS, (count for _, count in mine))
        rows += [row(method, preset, count) for preset in presets for count in counts]
        if method == "so2":
            given = [f"{paper.ours:g}" if n == 180 else "" for n in orientations]
            rows.append(["*paper*, ours", "", "100", *given])
    rows += [row("quantised_oracle"), row("oracle")]
    headings = ["method", "preset", "demonstrations", *(f"N = {n}" for n in orientations)]
    return _table(headings, rows, left=2)


def _with_others(usual: Sequence[int], found: Iterable[int | None]) -> list[int]:
    return sorted({*usual, *(value for value in found if value is not None)})


def _cell(runs: list[_Run]) -> str:
    # Runs that differ in nothing but their training are all told: choosing would be flattering.
    return (
        "<br>".join(f"{_rate(run.summary)}, {run.summary['episodes']}{_marks(run)}" for run in runs)
        or "-"
    )


def _marks(run: _Run) -> str:
    trained = run.detail("trained_orientations")
    marks = ["\\*"] if run.detail("continuous") else []
    if trained is not None and trained != run.detail("orientations"):
        marks.append("†")
    return "".join(f" {mark}" for mark in marks)


def _rate(summary: dict[str, Any]) -> str:
    low, high = summary["ci95"]
    return f"{100 * summary['success_rate']:.1f} ({100 * low:.1f} to {100 * high:.1f})"


def _most_tested_run(runs: list[_Run]) -> list[str]:
    """Tables by category of the network that was tested most; if there is none, of an oracle."""
    learned = [run for run in runs if run.detail("method") in _LEARNED]
    # Not the best: of few episodes, that is the luckiest.
    most = max(learned or runs, key=lambda run: (run.summary["episodes"], run.file))
    rows = [*most.summary["categories"].items(), ("all", most.summary)]
    placed = [
        [name, _rate(row)]
        + [f"{number(row[key]['median'])}, {number(row[key]['p95'])}" for key in ERRORS]
        for name, row in rows
    ]
    answered = [
        [name]
        + [
            f"{number(row['answers'][key]['median'])}, {number(row['answers'][key]['p95'])}"
            for key in ANSWER_ERRORS
        ]
        for name, row in rows
    ]
    return [
        f"### By category: {most.label}\n",
        "How far from their goals the tools ended: median and 95th percentile.\n",
        _table(
            ["category", "kitted, %", "ADD-S, mm", "position, mm", "angle, deg", "height, mm"],
            placed,
        ),
        "How far the policy's answers were from the annotated grasp, and from where the tool "
        "belongs.\n",
        _table(["category", "pick, mm", "pick, deg", "place, mm", "place, deg"], answered),
    ]


def _causes(runs: list[_Run]) -> list[str]:
    rows = []
    for run in sorted(runs, key=lambda run: -run.summary["success_rate"]):
        causes = run.summary["causes"]
        tools = sum(row["objects"] for row in run.summary["categories"].values())
        doubts = run.summary.get("doubts", {})
        rows.append(
            [run.label, run.seeds, str(tools)]
            + [str(causes.get(name, "?")) for name in (*CAUSES, FAILED)]
            + [str(doubts.get(name, "?")) for name in DOUBTS]
        )
    headings = ["run", "seeds", "tools", *CAUSES, FAILED, *(f"kitted, but {x}" for x in DOUBTS)]
    return ["### Why tools were not kitted\n", _table(headings, rows, left=2)]


def _files_table(runs: list[_Run], link: str) -> str:
    rows = [
        [
            f"[{run.file}]({link}/{run.file})",
            run.summary["task"],
            run.label,
            str(run.detail("steps") or ""),
            str(run.summary["episodes"]),
            run.seeds,
            f"{run.summary['wall_seconds'] / 3600:.1f}",
        ]
        for run in runs
    ]
    headings = ["file", "task", "run", "training steps", "episodes", "seeds", "hours, summed"]
    return _table(headings, rows, left=3)


def _table(headings: list[str], rows: list[list[str]], left: int = 1) -> str:
    """A Markdown table whose source is as readable as what it becomes.

    Args:
        headings: of the columns.
        rows: cells.
        left: how many columns, from the first, stand left; the others stand right.
    """
    widths = [max(map(len, column)) for column in zip(headings, *rows, strict=True)]
    rule = [
        "-" * width if index < left else "-" * (width - 1) + ":"
        for index, width in enumerate(widths)
    ]
    lines = [
        [
            cell.ljust(width) if index < left else cell.rjust(width)
            for index, (cell, width) in enumerate(zip(line, widths, strict=True))
        ]
        for line in (headings, rule, *rows)
    ]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


if __name__ == "__main__":
    run_verb(main)
