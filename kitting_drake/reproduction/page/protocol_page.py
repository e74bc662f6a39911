"""Writes the protocol, docs/protocol.md: every run behind the figures of docs/results.md."""

from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

from kitting_drake.common.provenance import short_commits
from kitting_drake.evaluation.summary import ACTION_ERRORS, AMBIGUITIES, ERRORS
from kitting_drake.evaluation.terminal import number
from kitting_drake.reproduction.page.markdown import markdown_table, rate_text
from kitting_drake.reproduction.page.prose import prose
from kitting_drake.reproduction.page.ravens_table import in_ravens_table, ravens_section
from kitting_drake.reproduction.page.runs import LEARNED, METHODS, Run
from kitting_drake.tasks import PAPER_TASKS

_ORIENTATIONS = (36, 72, 120, 180)
"""The values of N in section V-C.1 of the paper."""


@dataclass(frozen=True)
class _Paper:
    """Numbers that the paper's text (section V-D.1) gives for a task."""

    heading: str
    ours: float
    """The success rate of the SO(2) method at N = 180 with 100 demonstrations, in percent."""
    transporter_gain: float
    """The mean of the Equivariant Transporter's rate minus that of the SO(2) method, in percentage
    points."""


PAPER = {
    "kitting-seen-toolset": _Paper("Seen toolset", 96.5, 0.63),
    "kitting-unseen-toolsets": _Paper("Unseen toolsets", 87.25, 2.16),
}


def protocol_page(
    runs: Sequence[Run],
    link: str,
    cells: Sequence[str] = (),
    set_aside: Sequence[Run] = (),
) -> str:
    """Writes the whole page, in Markdown.

    Args:
        runs: the runs from `read_runs`; there may be none.
        link: the path from the page's folder to that of the table of runs.
        cells: the sections from
            `kitting_drake.reproduction.paper.protocol_sections.protocol_sections`.
        set_aside: the runs that nobody can repeat. They are listed in a table of their own.
    """
    sections = [prose("protocol", link=link), *cells]
    if runs:
        sections.append(prose("by_default"))
    for task in PAPER_TASKS:
        if of_task := [run for run in runs if run.paper_task == task]:
            sections += _task_sections(task, of_task)
    sections += ravens_section(runs)
    others = [run for run in runs if run.paper_task is None and not in_ravens_table(run)]
    if others:
        sections += ["## Other runs\n", _others_table(others)]
    if set_aside:
        sections += [prose("not_reproducible", count=len(set_aside)), _aside_table(set_aside)]
    if runs or set_aside:
        sections.append(_mishaps([*runs, *set_aside], link))
    sections.append("## Runs\n")
    sections.append(_runs_table(runs) if runs else "There are none yet.\n")
    return "\n".join(sections)


def _task_sections(task: str, runs: list[Run]) -> list[str]:
    paper = PAPER[task]
    return [
        f"### {paper.heading} (`{task}`)\n",
        _success_table(runs, paper),
        f"In the paper the Equivariant Transporter is {paper.transporter_gain} points better "
        "than the SO(2)-equivariant\nmethod, on average over N and demonstrations.\n",
        *_most_tested_run(runs),
        *_causes(runs),
    ]


def _success_table(runs: list[Run], paper: _Paper) -> str:
    cells: dict[tuple[Any, ...], list[Run]] = defaultdict(list)
    for run in runs:
        keys = ("preset", "demonstrations", "orientations")
        cells[run.method, *(run.detail(key) for key in keys)].append(run)
    orientations = _with_others(_ORIENTATIONS, (n for *_, n in cells))

    def row(method: str, preset: str | None = None, count: int | None = None) -> list[str]:
        named = [METHODS.get(method, method), preset or "", str(count or "")]
        # Methods without N, such as the exact oracle, have the same figure for all N.
        any_n = cells.get((method, preset, count, None), [])
        return named + [
            _cell(cells.get((method, preset, count, n), []) + any_n) for n in orientations
        ]

    rows = []
    for method in LEARNED:
        mine = [(preset, count) for name, preset, count, _ in cells if name == method]
        rows += [row(method, *found) for found in sorted(set(mine), key=str)]
        if method == "so2":
            given = [f"- / {paper.ours:g}" if n == 180 else "" for n in orientations]
            rows.append(["*paper*, its own method", "", "100", *given])
    others = {key[:3] for key in cells if key[0] not in (*LEARNED, "quantized_oracle", "oracle")}
    rows += [row(*key) for key in sorted(others, key=str)]
    present = {method for method, *_ in cells}
    rows += [row(oracle) for oracle in ("quantized_oracle", "oracle") if oracle in present]
    headings = ["method", "preset", "demonstrations", *(f"N = {n}" for n in orientations)]
    return markdown_table(headings, rows, left_columns=2)


def _with_others(usual: Iterable[int], found: Iterable[int | None]) -> list[int]:
    return sorted({*usual, *(value for value in found if value is not None)})


def _cell(runs: list[Run]) -> str:
    # List all runs that differ only in their training, because a selection could flatter the
    # policy.
    return (
        "<br>".join(
            f"{_strict(run.summary)} / {_own(run.summary)}, {run.summary['episodes']}{_marks(run)}"
            for run in runs
        )
        or "-"
    )


def _marks(run: Run) -> str:
    trained = run.detail("trained_orientations")
    marks = ["\\*" * (1 + bool(run.detail("fit_outlines")))] if run.detail("continuous") else []
    if trained is not None and trained != run.detail("orientations"):
        marks.append("†")
    return "".join(f" {mark}" for mark in marks)


def _strict(summary: dict[str, Any]) -> str:
    return rate_text(summary["strict_success_rate"], summary["strict_ci95"])


def _own(summary: dict[str, Any]) -> str:
    return rate_text(summary["success_rate"], summary["ci95"])


def _most_tested_run(runs: list[Run]) -> list[str]:
    """Writes tables by category for the run with the most episodes. If there are runs of networks,
    only these are considered."""
    learned = [run for run in runs if run.method in LEARNED]
    # Do not take the best run, which may be the luckiest of those with few episodes.
    most = max(learned or runs, key=lambda run: (run.summary["episodes"], run.name))
    rows = [*most.summary["categories"].items(), ("all", most.summary)]

    def errors(of: dict[str, Any]) -> str:
        return f"{number(of['median'])}, {number(of['p95'])}"

    placed = [
        [name, _strict(row), _own(row), *(errors(row[key]) for key in ERRORS)] for name, row in rows
    ]
    acted = [
        [name, *(errors(row["action_errors"][key]) for key in ACTION_ERRORS)] for name, row in rows
    ]
    return [
        f"#### By category: {most.label}\n",
        "Errors of the objects at the end of an episode: median and 95th percentile.\n",
        markdown_table(
            [
                "category",
                "strict success, %",
                "paper's measure, %",
                "ADD-S, mm",
                "position, mm",
                "angle, deg",
                "height, mm",
            ],
            placed,
        ),
        "Errors of the policy's actions relative to the annotated grasp and the goal: median and "
        "95th percentile.\n",
        markdown_table(["category", "pick, mm", "pick, deg", "place, mm", "place, deg"], acted),
    ]


def _causes(runs: list[Run]) -> list[str]:
    """Writes a table of the causes of failure, with a row for each run, best first."""
    causes = list(dict.fromkeys(cause for run in runs for cause in run.summary["causes"]))
    rows = []
    for run in sorted(runs, key=lambda run: -run.summary["strict_success_rate"]):
        summary = run.summary
        objects = sum(row["objects"] for row in summary["categories"].values())
        rows.append(
            [run.label, run.seeds, str(objects)]
            + [str(summary["causes"].get(cause, 0)) for cause in causes]
            + [str(summary["ambiguous"].get(name, 0)) for name in AMBIGUITIES]
        )
    ambiguous = [f"success, but {name}" for name in AMBIGUITIES]
    return [
        "#### Causes of failure\n",
        markdown_table(["run", "seeds", "objects", *causes, *ambiguous], rows, left_columns=2),
    ]


def _others_table(runs: list[Run]) -> str:
    rows = [
        [
            run.name,
            run.summary["task"],
            run.label,
            run.departures_text,
            run.summary["success_description"],
            _strict(run.summary),
            _own(run.summary),
            str(run.summary["episodes"]),
            run.seeds,
        ]
        for run in runs
    ]
    headings = ["name", "task", "run", "what differs", "criterion of success"]
    headings += ["strict success, %", "success, %", "episodes", "seeds"]
    return markdown_table(headings, rows, left_columns=5)


def _mishaps(runs: Sequence[Run], link: str) -> str:
    failed, timed_out, episodes = (
        sum(run.summary[key] for run in runs)
        for key in ("failed_episodes", "timed_out_episodes", "episodes")
    )
    return prose("mishaps", link=link, failed=failed, timed_out=timed_out, episodes=episodes)


def _aside_table(runs: Sequence[Run]) -> str:
    rows = [
        [run.name, _strict(run.summary), _own(run.summary), _weights(run), *_commits(run)]
        for run in runs
    ]
    return markdown_table(["name", "strict success, %", "success, %", "weights", "commit"], rows)


def _commits(run: Run) -> list[str]:
    return ["<br>".join((run.summary["commit"] or "-").split(", "))]


def _weights(run: Run) -> str:
    """Returns the first digits of the digest of a run's weights."""
    return (run.summary.get("policy_digest") or "-").removeprefix("sha256 ")[:8]


def _runs_table(runs: Sequence[Run]) -> str:
    rows = [
        [
            run.name,
            run.summary["task"],
            run.label,
            str(run.detail("steps") or ""),
            str(run.summary["episodes"]),
            run.seeds,
            f"{run.summary['wall_seconds'] / 3600:.1f}",
            _weights(run),
            short_commits(run.summary["commit"]),
        ]
        for run in runs
    ]
    headings = ["name", "task", "run", "training steps", "episodes", "seeds", "core hours"]
    headings += ["weights", "commit"]
    return markdown_table(headings, rows, left_columns=3)
