"""The second opinion: that MuJoCo is asked about the right tool, in the right place."""

from types import SimpleNamespace

import pytest
from rich.console import Console

from kitting_drake.common.errors import UserError
from kitting_drake.reproduction.benchmarks import second_opinion
from kitting_drake.reproduction.benchmarks.second_opinion import ask_mujoco, opinion_table


@pytest.mark.slow
def test_most_verdicts_are_alike():
    pytest.importorskip("mujoco")
    measured = ask_mujoco(8, 0, None, Console(quiet=True))
    assert measured["placements"] == len(measured["rows"]) == 8
    assert len({(row["seed"], row["object"]) for row in measured["rows"]}) == 8
    assert measured["equal_strict_success"] >= 0.75
    assert opinion_table(measured).row_count == 2


def test_who_lets_go_of_nothing_is_not_waited_for(monkeypatch: pytest.MonkeyPatch):
    pytest.importorskip("mujoco")
    monkeypatch.setattr(second_opinion, "_episode", lambda *_: SimpleNamespace(releases={}))
    with pytest.raises(UserError, match="nothing was let go of in 5 episodes"):
        ask_mujoco(8, 0, 2, Console(quiet=True))
