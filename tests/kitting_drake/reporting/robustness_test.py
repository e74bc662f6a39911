"""The table of what perturbations cost: each summary goes where its scenario says."""

from typing import Any

import pytest

from kitting_drake.common.errors import UserError
from kitting_drake.common.paths import SCENARIOS
from kitting_drake.reporting.robustness import robustness_table, with_figures
from kitting_drake.reporting.runs import Run, described
from kitting_drake.scenario.loader import load_scenario

UNSEEN = SCENARIOS / "kitting_unseen.yaml"


def run(perturb: str | None, share: float, tries: int = 2, **details: Any) -> Run:
    scenario = load_scenario(UNSEEN, text=f"{{task: {{tries: {tries}}}}}", perturb=perturb)
    return Run(
        "some.json",
        {
            "policy": "shape_matching",
            "policy_details": {"method": "shape_matching", "recover": True} | details,
            "resolved_scenario": described(scenario),
            "strict_success_rate": share,
            "strict_ci95": [share - 0.1, min(1.0, share + 0.1)],
            "seeds": [1, 2],
            "episodes": 2,
            "outcomes": [{"seed": seed, "strict_success_rate": share} for seed in (1, 2)],
        },
    )


def test_each_run_goes_into_the_row_that_its_scenario_says():
    table = robustness_table([run(None, 1.0), run("mass:mild", 0.9), run("all", 0.5)])
    rows = {line.split("|")[1].strip(): line for line in table.splitlines() if "|" in line}
    assert "100.0 (90 to 100)" in rows["as it is"]
    assert "90.0 (80 to 100)" in rows["`mass:mild`"]
    assert "50.0 (40 to 60)" in rows["`all:moderate`"]
    assert "`mass:moderate`" not in rows
    assert "2 episodes from seed 1." in table


def test_runs_of_other_seeds_are_all_told():
    later = run("all", 0.5)
    later.summary["seeds"] = [7, 8]
    table = robustness_table([later, run("all", 0.9)])
    assert "| 90.0 (80 to 100)<br>50.0 (40 to 60) |" in table


def test_the_generalist_is_compared_on_the_seeds_that_both_ran():
    learned = {"method": "generalist"}
    better, worse = run("all", 0.9, **learned), run("all", 0.5)
    elsewhere = run("all", 0.1)
    elsewhere.summary["outcomes"] = [{"seed": 7, "strict_success_rate": 0.1}]
    table = robustness_table([run(None, 1.0, **learned), better, worse, elsewhere])
    rows = {line.split("|")[1].strip(): line for line in table.splitlines() if "|" in line}
    *_, lost, ahead, _ = map(str.strip, rows["`all:moderate`"].split("|"))
    assert lost.startswith("-10.0 (")
    assert ahead.startswith("+40.0 (")
    *_, lost, ahead, _ = map(str.strip, rows["as it is"].split("|"))
    assert (lost, ahead) == ("-", "-")


def test_what_is_something_else_is_left_out():
    others = [run("mass", 0.9, tries=1), run("mass", 0.9, recover=False)]
    others.append(run("mass,light", 0.9))
    assert robustness_table(others) == "No runs yet.\n"


def test_the_figures_are_put_between_their_marks():
    page = "before\n<!-- figures -->\nold\n<!-- end of figures -->\nafter\n"
    new = with_figures(page, "new\n")
    assert new == "before\n<!-- figures -->\nnew\n<!-- end of figures -->\nafter\n"
    with pytest.raises(UserError, match="lacks"):
        with_figures("no marks\n", "new\n")
