"""The table of what each perturbation costs each policy: a part of `docs/robustness.md`."""

from collections import defaultdict
from collections.abc import Sequence
from typing import Any

from kitting_drake.common.errors import UserError
from kitting_drake.common.paths import SCENARIOS
from kitting_drake.reporting.markdown import markdown_table
from kitting_drake.reporting.paired import STRICT, paired_difference, points_text
from kitting_drake.reporting.runs import Run, described, scenario_differences
from kitting_drake.scenario.loader import load_scenario
from kitting_drake.scenario.perturbations import LEVELS, NAMES

_BEGIN, _END = "<!-- figures -->\n", "<!-- end of figures -->\n"
_AS_IT_IS = "as it is"
_COLUMNS = {
    "so2": "of 100 demonstrations",
    "generalist": "generalist",
    "shape_matching": "shape matching",
}
_COMPARED = ("generalist, minus as it is", "generalist, minus shape matching")
"""In points, on the seeds that both ran."""
_TRIES = 2
_FRAMES = 5
"""So many images are averaged in further rows."""


def robustness_table(runs: Sequence[Run]) -> str:
    """Strict success on unseen toolsets, with two tries a tool and policies that recover.

    Args:
        runs: all; those that are none of these are left out. More than one of a cell are told one
            below the other, in the order of their seeds.
    """
    expected = _expected()
    cells: dict[tuple[str, str], list[str]] = defaultdict(list)
    outcomes: dict[tuple[str, str], list[Any]] = defaultdict(list)
    seeds: set[str] = set()
    for run in sorted(runs, key=lambda run: min(run.summary["seeds"])):
        if run.method not in _COLUMNS or not run.detail("recover"):
            continue
        found = run.summary["resolved_scenario"]
        label = next((k for k, v in expected.items() if not scenario_differences(found, v)), None)
        if label is None:
            continue
        low, high = (100 * value for value in run.summary["strict_ci95"])
        share = 100 * run.summary["strict_success_rate"]
        cells[label, run.method].append(f"{share:.1f} ({low:.0f} to {high:.0f})")
        # Older summaries tell of no episode.
        outcomes[label, run.method] += run.summary.get("outcomes", ())
        seeds.add(f"{run.summary['episodes']} episodes from seed {min(run.summary['seeds'])}")
    if not cells:
        return "No runs yet.\n"

    def difference(first: tuple[str, str], second: tuple[str, str]) -> str:
        if first == second:
            return "-"
        found = paired_difference(
            {"outcomes": outcomes[first]}, {"outcomes": outcomes[second]}, STRICT
        )
        return "-" if found is None else points_text(found)

    # Runs that differ in nothing but their seeds are all told: choosing would be flattering.
    rows = [
        [
            label,
            *("<br>".join(cells[label, method]) or "-" for method in _COLUMNS),
            difference((label, "generalist"), (_AS_IT_IS, "generalist")),
            difference((label, "generalist"), (label, "shape_matching")),
        ]
        for label in expected
        if any((label, method) in cells for method in _COLUMNS)
    ]
    table = markdown_table(["perturbation", *_COLUMNS.values(), *_COMPARED], rows)
    return f"{table}\n{'; '.join(sorted(seeds))}.\n"


def with_figures(page: str, figures: str) -> str:
    """A page with the text between its two marks replaced.

    Raises:
        UserError: it lacks the marks.
    """
    head, begin, rest = page.partition(_BEGIN)
    _, end, tail = rest.partition(_END)
    if not begin or not end:
        raise UserError(f"the page on robustness lacks {_BEGIN.strip()} and {_END.strip()}")
    return f"{head}{begin}{figures}{end}{tail}"


def _expected() -> dict[str, dict[str, Any]]:
    """The scenario of each row, as JSON holds it."""
    path, task = SCENARIOS / "kitting_unseen.yaml", f"task: {{tries: {_TRIES}}}"
    one, more = f"{{{task}}}", f"{{{task}, sensor_noise: {{frames: {_FRAMES}}}}}"
    rows: dict[str, tuple[str, str | None]] = {_AS_IT_IS: (one, None)}
    for level in LEVELS:
        rows |= {f"`{name}:{level}`": (one, f"{name}:{level}") for name in NAMES}
    for name in ("depth_noise", "all"):
        rows[f"`{name}:moderate`, {_FRAMES} frames"] = (more, f"{name}:moderate")
    return {
        label: described(load_scenario(path, text=text, perturb=perturb))
        for label, (text, perturb) in rows.items()
    }
