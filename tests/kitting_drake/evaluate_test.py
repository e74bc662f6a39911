import json
import math
import os
import signal
from pathlib import Path

import pytest
from rich.console import Console

import kitting_drake.evaluate as evaluation
from kitting_drake.cli import ChosenScenario
from kitting_drake.errors import UserError
from kitting_drake.scenario import Scenario

CHOSEN = ChosenScenario(Scenario(), Path("mine.yaml"), "mine", None)
QUIET = Console(quiet=True)


def episode(seed: int, errors_mm: list[float], failure: str | None = None) -> evaluation.Episode:
    objects = [
        {
            "category": "wrench",
            "success": error < 3.5,
            "add_s_mm": error,
            "position_error_mm": error,
            "angle_error_deg": -error,
            "height_error_mm": 0.0,
        }
        for error in errors_mm
    ]
    lost = evaluation._lost_episode(CHOSEN, seed, 1, 2.0)
    rate = sum(item["success"] for item in objects) / len(objects) if not failure else 0.0
    return lost | {"objects": objects, "failure": failure, "success_rate": rate}


def test_a_failed_episode_counts_zero_and_is_never_dropped():
    episodes = [episode(0, [1.0, 1.0]), episode(1, [1.0, 9.0]), episode(2, [1.0, 1.0], "solver")]
    summary = evaluation.summarise(episodes, CHOSEN)
    assert summary["episodes"] == 3
    assert summary["failed_episodes"] == 1
    assert summary["success_rate"] == pytest.approx(0.5)
    assert summary["add_s_mm"]["median"] == pytest.approx(1.0)
    assert summary["angle_error_deg"]["max"] == pytest.approx(9.0)
    assert summary["seeds"] == [0, 1, 2]


def test_wilson_interval():
    # 8 of 10: the textbook's 0.490 to 0.943.
    assert evaluation.wilson_interval(0.8, 10) == pytest.approx([0.4902, 0.9433], abs=1e-4)
    low, high = evaluation.wilson_interval(1.0, 200)
    assert high == pytest.approx(1.0)
    assert low == pytest.approx(200 / (200 + 1.959964**2))


def fake_run(chosen: ChosenScenario, seed: int) -> evaluation.Episode:
    return episode(seed, [float(seed)])


def test_goes_on_where_it_was_stopped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    ran = []

    def run(chosen: ChosenScenario, seed: int) -> evaluation.Episode:
        ran.append(seed)
        return fake_run(chosen, seed)

    monkeypatch.setattr(evaluation, "_run_apart", run)
    evaluation.evaluate(CHOSEN, [0, 1], tmp_path, workers=1, console=QUIET)
    path = tmp_path / "episodes.jsonl"
    # Killed while the third line was being written.
    path.write_text(path.read_text() + '{"seed": 2, "obj')
    episodes = evaluation.evaluate(CHOSEN, range(4), tmp_path, workers=1, console=QUIET)
    assert ran == [0, 1, 2, 3]
    assert [item["seed"] for item in episodes] == [0, 1, 2, 3]
    assert [json.loads(line)["seed"] for line in path.read_text().splitlines()] == [0, 1, 2, 3]


def test_a_folder_of_another_scenario_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(evaluation, "_run_apart", fake_run)
    evaluation.evaluate(CHOSEN, [0], tmp_path, workers=1, console=QUIET)
    other = ChosenScenario(Scenario(time_limit=1.0), Path("mine.yaml"), "mine", None)
    with pytest.raises(UserError, match="another scenario"):
        evaluation.evaluate(other, [0], tmp_path, workers=1, console=QUIET)


def die(chosen: ChosenScenario, seed: int, sender) -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def test_an_episode_whose_process_dies_is_a_failed_one(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(evaluation, "_work", die)
    lost = evaluation._run_apart(CHOSEN, 7)
    assert lost["seed"] == 7
    assert lost["success_rate"] == 0.0
    assert str(-signal.SIGKILL) in lost["failure"]


def test_two_short_episodes_side_by_side(verb, tmp_path: Path):
    done = verb(
        "evaluate",
        "scenarios/kitting_oracle.yaml",
        *("--episodes", 2, "--workers", 2, "--output", tmp_path),
        *("--scenario_text", "{time_limit: 0.2}"),
    )
    assert done.returncode == 0, done.stderr
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["episodes"] == 2
    assert summary["failed_episodes"] == 0
    assert summary["success_rate"] == 0.0
    assert math.isclose(summary["sim_seconds"], 0.4)
    assert summary["point_contact_pairs"] == 0
