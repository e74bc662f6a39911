"""The section on the shipped policies pools all runs of their weights and settings."""

from typing import Any

import pytest

from kitting_drake.common.errors import UserError
from kitting_drake.common.paths import SCENARIOS
from kitting_drake.reproduction.page.pooled import pooled_section, shipped_policies
from kitting_drake.reproduction.page.runs import Run, described
from kitting_drake.scenario.loader import load_scenario

UNSEEN = SCENARIOS / "paper/kitting_unseen.yaml"
GENERALIST = shipped_policies()["generalist"].digest(SCENARIOS)


def run(
    ends: list[int], seeds: range, recover: str = "false", limit: float = 180.0, **fields: Any
) -> Run:
    """A run of the generalist. In every episode, `ends` are the outcomes of the objects."""
    policy = f"!Learned {{weights: '', recover: {recover}}}"
    scenario = load_scenario(UNSEEN, text=f"{{policy: {policy}, time_limit: {limit}}}")
    objects = {str(index): end for index, end in enumerate(ends)}
    summary = {
        "task": scenario.task.title,
        "policy": "learned",
        "policy_details": {},
        "policy_digest": GENERALIST,
        "resolved_scenario": described(scenario),
        "seeds": list(seeds),
        "outcomes": [{"seed": seed, "objects": objects} for seed in seeds],
    }
    return Run(f"from_{seeds[0]}", summary | fields)


def test_all_runs_of_the_shipped_weights_are_pooled():
    _, _, table = pooled_section([run([2, 2], range(9, 29)), run([2, 0], range(4))])
    row = [cell.strip() for cell in table.splitlines()[-1].strip("|").split("|")]
    assert row[:3] == ["generalist", "0 to 3, 9 to 28", "48"]
    # The share is 44 of 48 objects.
    assert [cell.split(" ")[0] for cell in row[3:]] == ["91.7", "91.7"]


@pytest.mark.parametrize(
    "other",
    [
        run([0], range(4), policy_digest="sha256 of others"),
        run([0], range(4), limit=9.0),
        run([0], range(4), recover="true"),
    ],
)
def test_other_runs_are_ignored(other: Run):
    assert pooled_section([other]) == []


def test_a_seed_in_two_runs_is_an_error():
    with pytest.raises(UserError, match="from_0 and from_3 both have seed 3"):
        pooled_section([run([2], range(4)), run([2], range(3, 9))])
