"""The tables of robustness: each run goes into the row of its scenario's perturbation."""

import copy
import functools
from typing import Any

import pytest

from kitting_drake.common.errors import UserError
from kitting_drake.common.paths import SCENARIOS
from kitting_drake.reproduction.page.robustness import robustness_table, with_figures
from kitting_drake.reproduction.page.runs import Run, described
from kitting_drake.scenario.loader import load_scenario
from kitting_drake.scenario.policies import Learned

UNSEEN = SCENARIOS / "paper/kitting_unseen.yaml"


SAME = range(2870, 2895)
"""The seeds that all cells of the first table have in common."""


@functools.cache
def resolved(perturb: str | None, tries: int) -> dict[str, Any]:
    text = f"{{task: {{tries: {tries}}}}}"
    return described(load_scenario(UNSEEN, text=text, perturb=perturb))


def run(
    perturb: str | None,
    share: float,
    tries: int = 2,
    seeds: range = SAME,
    digest: str | None = None,
    **details: Any,
) -> Run:
    return Run(
        "some.json",
        {
            "policy": "shape_matching",
            "policy_digest": digest,
            "policy_details": {"method": "shape_matching", "recover": True} | details,
            "resolved_scenario": copy.deepcopy(resolved(perturb, tries)),
            "strict_success_rate": share,
            "seeds": list(seeds),
            "episodes": len(seeds),
            "categories": {
                "hammer": {"objects": 3 * len(seeds)},
                "wrench": {"objects": len(seeds)},
            },
            "outcomes": [{"seed": seed, "strict_success_rate": share} for seed in seeds],
        },
    )


def rows(table: str) -> dict[str, list[str]]:
    """The cells of each row, by the row's label. If rows share a label, the last one counts."""
    lines = [line.strip("|").split("|") for line in table.splitlines() if "|" in line]
    return {line[0].strip(): [cell.strip() for cell in line[1:]] for line in lines}


def test_each_run_goes_into_the_row_of_its_scenario():
    table = robustness_table([run(None, 1.0), run("mass:mild", 0.9), run("all", 0.5)])
    found = rows(table)
    assert found["unperturbed"][2] == "100.0 (96 to 100)"
    assert found["`mass:mild`"][2] == "90.0 (83 to 94), 100"
    assert found["`all:moderate`"][2] == "50.0 (40 to 60)"
    assert "`mass:moderate`" not in found
    assert "25 episodes from seed 2870" in table


def test_runs_on_other_seeds_are_pooled_in_another_table():
    elsewhere = run("all", 0.5, seeds=range(7, 32))
    table = robustness_table([elsewhere, run("all", 0.9), run(None, 1.0)])
    first, second = table.split("The last table has")
    assert rows(first)["`all:moderate`"][2] == "90.0 (83 to 94)"
    assert rows(second)["`all:moderate`"][2] == "70.0 (63 to 76), 200"
    assert "unperturbed" not in rows(second)


def test_other_levels_use_the_first_seeds_and_show_their_number():
    first = run("mass:severe", 0.5, seeds=SAME[:12])
    table = robustness_table([run(None, 1.0), first, run("mass:mild", 1.0, seeds=SAME[:5])])
    _, levels = table.split("Levels `mild` and `severe`")
    levels, pooled = levels.split("The last table has")
    assert rows(levels)["`mass:severe`"][2] == "50.0 (36 to 64), 48"
    assert "`mass:mild`" not in levels
    assert "`mass:mild`" in pooled
    assert "severe" not in pooled


def test_the_generalist_is_compared_on_common_seeds():
    learned = {"method": "generalist", "digest": Learned(weights="").digest(SCENARIOS)}
    better, worse = run("all", 0.9, **learned), run("all", 0.5)
    table = robustness_table(
        [run(None, 1.0, **learned), better, worse, run("all", 0.1, seeds=range(7, 32))]
    )
    for part in table.split("The last table has"):
        lost, ahead = rows(part)["`all:moderate`"][-2:]
        assert lost.startswith("-10.0 (")
        assert ahead.startswith("+40.0 (")
    assert rows(table)["unperturbed"][-2:] == ["-", "-"]


def test_other_runs_are_ignored():
    others = [run("mass", 0.9, tries=1), run("mass", 0.9, recover=False)]
    others.append(run("mass,light", 0.9))
    others.append(run("mass", 0.9, method="generalist", digest="sha256 of earlier weights"))
    assert robustness_table(others) == "No runs yet.\n"


def test_a_seed_in_two_runs_is_an_error():
    with pytest.raises(UserError, match="seed 2880 of shape matching, `all:moderate`"):
        robustness_table([run("all", 0.9), run("all", 0.9, seeds=range(2880, 2881))])


def test_needless_actions_are_shown_for_scenes_with_distractors():
    runs = [run("all", 0.9), run("mass", 1.0)]
    assert "no cavity" not in robustness_table(runs)
    for item in runs:
        item.summary.update(needless_actions=3, actions=120)
    _, table = robustness_table(runs).split("no cavity")
    assert rows(table)["`all:moderate`"] == ["-", "-", "3 of 120"]
    assert "`mass:moderate`" not in rows(table)


def test_the_figures_are_inserted_between_their_marks():
    page = "before\n<!-- figures -->\nold\n<!-- end of figures -->\nafter\n"
    new = with_figures(page, "new\n")
    assert new == "before\n<!-- figures -->\nnew\n<!-- end of figures -->\nafter\n"
    with pytest.raises(UserError, match="lacks"):
        with_figures("no marks\n", "new\n")
