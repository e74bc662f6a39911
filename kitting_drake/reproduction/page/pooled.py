"""Writes the section on the shipped policies on the paper's unseen toolsets, with all runs
pooled."""

from collections import Counter
from collections.abc import Sequence
from typing import Any

from kitting_drake.common.errors import UserError
from kitting_drake.common.paths import SCENARIOS
from kitting_drake.evaluation.intervals import proportion_interval
from kitting_drake.reproduction.page.markdown import markdown_table, rate_text
from kitting_drake.reproduction.page.prose import prose
from kitting_drake.reproduction.page.runs import Run, described
from kitting_drake.scenario.loader import load_scenario
from kitting_drake.scenario.policies import Learned, Policy, ShapeMatching
from kitting_drake.scenario.schema import Scenario
from kitting_drake.tasks import PAPER_TASKS

_, _UNSEEN = PAPER_TASKS


def pooled_section(runs: Sequence[Run]) -> list[str]:
    """Writes the section that pools the runs of each shipped policy with its default options.

    Only runs whose weights have the digest of the shipped ones count. Without such runs, the
    section is empty.

    Args:
        runs: all reproducible runs that fill no cell of the paper's tables.

    Raises:
        UserError: two runs of a policy share a seed.
    """
    rows = []
    for label, policy in shipped_policies().items():
        found = [run for run in runs if run.paper_task == _UNSEEN and _is_of(run, policy)]
        if not found:
            continue
        _check_seeds(label, found)
        ends = [
            end
            for run in found
            for episode in run.summary["outcomes"]
            for end in episode["objects"].values()
        ]
        shares = [
            rate_text(count / len(ends), proportion_interval(count, len(ends)))
            for count in (sum(end == 2 for end in ends), sum(end > 0 for end in ends))
        ]
        seeds = ", ".join(run.seeds for run in sorted(found, key=lambda run: run.summary["seeds"]))
        rows.append([label, seeds, str(len(ends)), *shares])
    if not rows:
        return []
    return [
        "### Unseen toolsets, all runs of the shipped policies\n",
        prose("pooled"),
        markdown_table(
            ["policy", "seeds", "objects", "strict success, %", "paper's measure, %"], rows, 2
        ),
    ]


def shipped_policies() -> dict[str, Policy]:
    """Returns the policies that come with the project, by their names in tables."""
    return {
        "generalist": Learned(weights=""),
        "from 100 demonstrations": load_scenario(SCENARIOS / "paper/kitting_unseen.yaml").policy,
        "shape matching": ShapeMatching(),
    }


def _is_of(run: Run, policy: Policy) -> bool:
    """Whether a run is of this policy, with its weights and options.

    Options that the run's summary lacks are ignored.
    """
    found: dict[str, Any] = run.summary["resolved_scenario"]["policy"]
    expected: dict[str, Any] = described(Scenario(policy=policy))["policy"]
    return run.summary.get("policy_digest") == policy.digest(SCENARIOS / "paper") and all(
        found.get(key, value) == value for key, value in expected.items() if key != "weights"
    )


def _check_seeds(label: str, runs: Sequence[Run]) -> None:
    counts = Counter(seed for run in runs for seed in run.summary["seeds"])
    twice = min((seed for seed, count in counts.items() if count > 1), default=None)
    if twice is not None:
        files = " and ".join(run.name for run in runs if twice in run.summary["seeds"])
        raise UserError(
            f"the runs {files} both have seed {twice} of {label}: remove one of them "
            "(results --remove)"
        )
