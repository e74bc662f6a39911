"""Writes the tables of `docs/robustness.md`: the effect of each perturbation on each policy."""

from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from kitting_drake.common.errors import UserError
from kitting_drake.common.paths import SCENARIOS
from kitting_drake.evaluation.intervals import proportion_interval
from kitting_drake.reproduction.page.markdown import markdown_table
from kitting_drake.reproduction.page.paired import STRICT, paired_difference, points_text
from kitting_drake.reproduction.page.runs import Run, described, scenario_differences
from kitting_drake.scenario.loader import load_scenario
from kitting_drake.scenario.perturbations import LEVELS, NAMES
from kitting_drake.scenario.policies import Learned

_UNSEEN = SCENARIOS / "paper/kitting_unseen.yaml"
_UNPERTURBED = "unperturbed"
_COLUMNS = {
    "so2": "from 100 demonstrations",
    "generalist": "generalist",
    "shape_matching": "shape matching",
}
_COMPARED = (
    "generalist: perturbed minus unperturbed, common seeds",
    "generalist minus shape matching, common seeds",
)
"""The paired differences, in percentage points, on the seeds that both runs have."""
_TRIES = 2
_FRAMES = 5
"""The number of images per observation in the rows with several frames."""
_SEEDS = range(2870, 2895)
"""The seeds of every cell of the first table. They were not used before these runs."""
_FEWEST = 12
"""Runs at the levels mild and severe use at least this many seeds: the first ones of `_SEEDS`."""

Key = tuple[str, str]
"""The label of a row of the table, and a method."""


def robustness_table(runs: Sequence[Run]) -> str:
    """Writes the tables of strict success on unseen toolsets.

    Policies have two tries per tool and may recover. All runs of the first table use the same
    seeds. The second table has the levels mild and severe, on at least the first 12 of these seeds.
    The last table has the cells that ran on more seeds. It uses all their seeds, because leaving
    some out could flatter the policy.

    Args:
        runs: all runs. Runs of other scenarios, and runs with other weights than the shipped ones,
            are ignored.

    Raises:
        UserError: two runs of one cell share seeds.
    """
    expected, shipped = _expected(), _shipped()
    found: dict[Key, list[Run]] = defaultdict(list)
    for run in runs:
        if run.method not in _COLUMNS or not run.detail("recover"):
            continue
        if run.method in shipped and run.summary.get("policy_digest") != shipped[run.method]:
            continue
        scenario = run.summary["resolved_scenario"]
        for label, wanted in expected.items():
            if not scenario_differences(scenario, wanted):
                found[label, run.method].append(run)
                break
    _check_seeds(found)
    common = {
        key: chosen
        for key, every in found.items()
        if (chosen := [run for run in every if _common(run, key[0])])
    }
    further = {key[0] for key, every in found.items() if len(common.get(key, ())) < len(every)}
    parts = []
    if common:
        parts.append(
            f"Each cell of the first table has {len(_SEEDS)} episodes from seed {_SEEDS[0]} on:\n\n"
            + _table(common, [label for label in expected if not _is_other_level(label)])
        )
    if any(_is_other_level(label) for label, _ in common):
        parts.append(
            f"Levels `mild` and `severe` were run on at least the first {_FEWEST} of these seeds. "
            "Each cell ends with the number of objects:\n\n"
            + _table(common, [label for label in expected if _is_other_level(label)], counted=True)
        )
    needless = _needless_table(common, list(expected))
    if needless:
        parts.append(
            "Some actions were on objects that have no cavity, such as boxes. The next table has "
            "the number of these\nactions, out of all actions in these runs. Success rates do not "
            "include these objects:\n\n" + needless
        )
    if further:
        parts.append(
            "The last table has the perturbations that were also run on other seeds. It pools all "
            "seeds.\nEach cell ends with the number of objects:\n\n"
            + _table(found, [label for label in expected if label in further], counted=True)
        )
    return "\n".join(parts) or "No runs yet.\n"


def _table(found: Mapping[Key, Sequence[Run]], labels: Sequence[str], counted: bool = False) -> str:
    """Writes a table with one row for each perturbation that was run.

    Args:
        found: the runs by row and method.
        labels: the labels of the rows.
        counted: whether cells show the number of objects.
    """

    def share(key: Key) -> str:
        if key not in found:
            return "-"
        good, objects = np.sum([_strict(run) for run in found[key]], axis=0)
        low, high = (100 * value for value in proportion_interval(int(good), int(objects)))
        text = f"{100 * good / objects:.1f} ({low:.0f} to {high:.0f})"
        return f"{text}, {objects}" if counted else text

    def outcomes(key: Key) -> dict[str, Any]:
        # Leave out summaries of older versions, which have no outcomes.
        return {
            "outcomes": [
                item for run in found.get(key, ()) for item in run.summary.get("outcomes", ())
            ]
        }

    def difference(first: Key, second: Key) -> str:
        if first == second:
            return "-"
        points = paired_difference(outcomes(first), outcomes(second), STRICT)
        return "-" if points is None else points_text(points)

    rows = [
        [
            label,
            *(share((label, method)) for method in _COLUMNS),
            difference((label, "generalist"), (_UNPERTURBED, "generalist")),
            difference((label, "generalist"), (label, "shape_matching")),
        ]
        for label in labels
        if any((label, method) in found for method in _COLUMNS)
    ]
    return markdown_table(["perturbation", *_COLUMNS.values(), *_COMPARED], rows)


def _needless_table(found: Mapping[Key, Sequence[Run]], labels: Sequence[str]) -> str:
    """Writes a table of the actions on objects without a cavity; it is empty without runs. It has
    one row for each perturbation with distractors."""

    def share(key: Key) -> str:
        summaries = [run.summary for run in found.get(key, ())]
        # Summaries of older versions do not have this count.
        if not summaries or not all("needless_actions" in item for item in summaries):
            return "-"
        needless, every = (
            sum(item[field] for item in summaries) for field in ("needless_actions", "actions")
        )
        return f"{needless} of {every}"

    rows = [
        [label, *cells]
        for label in labels
        if label.startswith(("`distractors", "`all"))
        and set(cells := [share((label, method)) for method in _COLUMNS]) != {"-"}
    ]
    headings = ["perturbation (actions on objects without cavity)", *_COLUMNS.values()]
    return markdown_table(headings, rows) if rows else ""


def _check_seeds(found: Mapping[Key, Sequence[Run]]) -> None:
    for (label, method), runs in found.items():
        counts = Counter(seed for run in runs for seed in run.summary["seeds"])
        twice = min((seed for seed, count in counts.items() if count > 1), default=None)
        if twice is not None:
            files = " and ".join(run.name for run in runs if twice in run.summary["seeds"])
            raise UserError(
                f"the runs {files} both have seed {twice} of {_COLUMNS[method]}, {label}: remove "
                "one of them (results --remove)"
            )


def _common(run: Run, label: str) -> bool:
    """Whether a run has the seeds that its table requires: all of `_SEEDS`; at the levels mild and
    severe, at least the first `_FEWEST` of them."""
    seeds = list(run.summary["seeds"])
    if _is_other_level(label):
        return len(seeds) >= _FEWEST and seeds == list(_SEEDS)[: len(seeds)]
    return seeds == list(_SEEDS)


def _is_other_level(label: str) -> bool:
    return ":mild" in label or ":severe" in label


def _strict(run: Run) -> tuple[int, int]:
    """Returns the number of objects that were placed strictly, and the number of all objects."""
    objects = sum(category["objects"] for category in run.summary["categories"].values())
    return round(run.summary["strict_success_rate"] * objects), objects


def with_figures(page: str, figures: str, name: str = "figures") -> str:
    """Returns a page with `figures` as the text between its two marks.

    Args:
        page: the page, with the marks `<!-- name -->` and `<!-- end of name -->`.
        figures: the new text.
        name: the name in the marks.

    Raises:
        UserError: the page lacks the marks.
    """
    start, stop = f"<!-- {name} -->\n", f"<!-- end of {name} -->\n"
    head, begin, rest = page.partition(start)
    _, end, tail = rest.partition(stop)
    if not begin or not end:
        raise UserError(
            f"robustness.md lacks the marks {start.strip()} and {stop.strip()}: restore them"
        )
    return f"{head}{begin}{figures}{end}{tail}"


def _shipped() -> dict[str, str | None]:
    """Returns the digests of the shipped weights, by method."""
    policies = {"generalist": Learned(weights=""), "so2": load_scenario(_UNSEEN).policy}
    return {method: policy.digest(SCENARIOS / "paper") for method, policy in policies.items()}


def _expected() -> dict[str, dict[str, Any]]:
    """Returns the scenario of each row, as JSON values."""
    path, task = _UNSEEN, f"task: {{tries: {_TRIES}}}"
    one, more = f"{{{task}}}", f"{{{task}, sensor_noise: {{frames: {_FRAMES}}}}}"
    rows: dict[str, tuple[str, str | None]] = {_UNPERTURBED: (one, None)}
    for level in LEVELS:
        rows |= {f"`{name}:{level}`": (one, f"{name}:{level}") for name in NAMES}
    for name in ("depth_noise", "all"):
        rows[f"`{name}:moderate`, {_FRAMES} frames"] = (more, f"{name}:moderate")
    return {
        label: described(load_scenario(path, text=text, perturb=perturb))
        for label, (text, perturb) in rows.items()
    }
