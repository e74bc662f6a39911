import argparse
import dataclasses
import os
from pathlib import Path

import pytest

from kitting_drake.common.processes import LocalWorkers
from kitting_drake.scenario.choosing import ChosenScenario
from kitting_drake.scenario.policies import Oracle, PythonPolicy
from kitting_drake.scenario.schema import Scenario
from kitting_drake.scenario.workers import add_workers_flags, open_workers


def parse(*flags: str) -> argparse.Namespace:
    parser = argparse.ArgumentParser()
    add_workers_flags(parser)
    return parser.parse_args(flags)


@pytest.mark.parametrize(("flags", "count"), [(("--workers", "3"), 3), ((), 7)])
def test_local_workers(flags: tuple[str, ...], count: int, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("os.cpu_count", lambda: 7)
    chosen = ChosenScenario(Scenario(), Path("mine.yaml"), "mine", None)
    with open_workers(parse(*flags), chosen) as (workers, sent):
        assert isinstance(workers, LocalWorkers)
        assert workers.capacity() == count
        assert sent is chosen


@pytest.mark.parametrize(
    ("policy", "processes"), [(Oracle(), 1), (PythonPolicy(function="mine:policy"), 2)]
)
def test_user_functions_get_a_new_process_per_episode(policy, processes: int):
    scenario = dataclasses.replace(Scenario(), policy=policy)
    chosen = ChosenScenario(scenario, Path("mine.yaml"), "mine", None)
    with open_workers(parse("--workers", "1"), chosen) as (workers, _):
        assert len({workers.run(os.getpid) for _ in range(2)}) == processes


@pytest.mark.parametrize("count", range(1, 5))
def test_workers_and_ray_exclude_each_other(count: int, capsys: pytest.CaptureFixture[str]):
    with pytest.raises(SystemExit):
        parse("--ray", "auto", "--workers", str(count))
    assert "argument --workers: not allowed with argument --ray" in capsys.readouterr().err
