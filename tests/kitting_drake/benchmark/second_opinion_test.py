"""The second opinion: that MuJoCo is asked about the right tool, in the right place."""

import pytest
from rich.console import Console

from kitting_drake.benchmark.second_opinion import ask_mujoco, opinion_table


@pytest.mark.slow
def test_most_verdicts_are_alike():
    pytest.importorskip("mujoco")
    measured = ask_mujoco(8, 0, None, Console(quiet=True))
    assert measured["placements"] == len(measured["rows"]) == 8
    assert len({(row["seed"], row["object"]) for row in measured["rows"]}) == 8
    assert measured["equal_strict_success"] >= 0.75
    assert opinion_table(measured).row_count == 2
