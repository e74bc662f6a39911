"""MuJoCo, as a second opinion, agrees with most of Drake's verdicts."""

from types import SimpleNamespace

import pytest
from rich.console import Console

from kitting_drake.common.errors import UserError
from kitting_drake.reproduction.benchmarks import second_opinion
from kitting_drake.reproduction.benchmarks.second_opinion import ask_mujoco, opinion_table


@pytest.mark.slow
def test_most_verdicts_agree():
    pytest.importorskip("mujoco")
    measured = ask_mujoco(8, 0, None, Console(quiet=True))
    assert measured["placements"] == len(measured["rows"]) == 8
    assert len({(row["seed"], row["object"]) for row in measured["rows"]}) == 8
    assert measured["equal_strict_success"] >= 0.75
    assert opinion_table(measured).row_count == 2


def test_an_oracle_that_releases_nothing_is_an_error(monkeypatch: pytest.MonkeyPatch):
    pytest.importorskip("mujoco")
    monkeypatch.setattr(second_opinion, "_episode", lambda *_: SimpleNamespace(releases={}))
    with pytest.raises(UserError, match="no tool was released in 5 episodes"):
        ask_mujoco(8, 0, 2, Console(quiet=True))
