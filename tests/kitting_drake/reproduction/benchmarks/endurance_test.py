"""`benchmark endurance`: what it counts, how it resumes, and when the shift ends."""

import json
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from kitting_drake.common.errors import UserError
from kitting_drake.episode import EpisodeResult
from kitting_drake.episode.episode import ObjectResult
from kitting_drake.reproduction.benchmarks.shift import endurance
from kitting_drake.reproduction.benchmarks.shift.endurance import (
    ShiftScene,
    is_on_table,
    run_shift,
    shift_scene,
    summarise_shift,
)
from kitting_drake.reproduction.benchmarks.shift.endurance_report import (
    draw_endurance,
    endurance_table,
)
from kitting_drake.scenario.choosing import ChosenScenario
from kitting_drake.scenario.schema import Scenario
from kitting_drake.tasks import Kitting
from kitting_drake.tasks.task import ActionRecord
from systems.signals import PlanarPose

CHOSEN = ChosenScenario(Scenario(task=Kitting()), Path("mine.yaml"), "mine", text=None)


def item(name: str, success: bool, strict: bool, cause: str | None, height: float = 0.0):
    return ObjectResult(name, "tool", 1.0, success, strict, 1.0, 1.0, height, cause)


def result(**changes) -> EpisodeResult:
    at = PlanarPose(0.0, 0.0, 0.0)
    names = ["wrench", "pliers", "hammer", "driver", "hammer"]
    records = [ActionRecord(name, "tool", "placed", at, at, *[None] * 4) for name in names]
    values = {
        "scenario": "mine",
        "policy": "oracle",
        "seed": 3,
        "objects": [
            item("wrench", True, True, None),
            item("pliers", True, False, None, height=4.0),
            item("hammer", True, True, None),
            item("driver", False, False, "slipped"),
        ],
        "success_rate": 0.75,
        "strict_success_rate": 0.5,
        "actions": 5,
        "missed_grasps": 0,
        "dropped_objects": 1,
        "stopped_actions": 0,
        "actions_taken": records,
        "sim_seconds": 25.0,
        "wall_seconds": 1.0,
        "point_contact_pairs": 0,
        "moving_at_end": [],
        "failure": None,
        "timed_out": False,
        "interrupted": False,
        "stop_reason": "done",
    }
    return EpisodeResult(**(values | changes))


def test_a_unit_is_finished_by_its_last_action_and_all_else_is_an_assist():
    scene = shift_scene(result(), [4.0, 8.0, 12.0, 16.0, 21.0], off_table=["driver"])
    assert scene.unit_seconds == [4.0, 21.0]
    assert scene.cycles() == [4.0, 17.0]
    assert scene.assists == {"pliers": "protruding", "driver": "off the table"}


@pytest.mark.parametrize(
    ("changes", "cause"),
    [({"failure": "it broke"}, "failed episode"), ({"timed_out": True}, "timed out")],
)
def test_all_objects_of_a_lost_scene_are_assists(changes, cause):
    scene = shift_scene(result(**changes), [])
    assert scene.unit_seconds == [] and set(scene.assists.values()) == {cause}
    assert len(scene.assists) == 4


def test_below_or_beside_the_table_is_off_it():
    assert is_on_table(np.array([0.5, 0.0, 0.01]))
    for p in ([0.5, 0.0, -0.3], [0.5, 0.9, 0.01], [float("nan")] * 3):
        assert not is_on_table(np.array(p))


class Here:
    """`Workers` that run in this process."""

    def capacity(self) -> int:
        return 1

    def run(self, function, *arguments):
        return function(*arguments)

    def stop(self) -> None:
        pass


def test_a_shift_resumes_and_ends_when_its_hours_are_over(tmp_path: Path, monkeypatch):
    ran = []

    def run_scene(chosen: ChosenScenario, seed: int) -> ShiftScene:
        ran.append(seed)
        assists = {"driver": "slipped"} if seed == 8 else {}
        return ShiftScene(seed, 20.0, 4, [4.0, 8.0, 13.0][: 3 - len(assists)], assists)

    monkeypatch.setattr(endurance, "_run_scene", run_scene)

    def run(hours: float) -> list[ShiftScene]:
        quiet = Console(quiet=True)
        return run_shift(
            CHOSEN, hours, 10.0, 7, tmp_path, workers=Here(), sent=CHOSEN, console=quiet
        )

    assert [scene.seed for scene in run(60 / 3600)] == ran == [7, 8]
    scenes = run(100 / 3600)
    assert [scene.seed for scene in scenes] == ran == [7, 8, 9, 10]
    # The folder has four scenes. A shorter shift counts only the first two.
    assert [scene.seed for scene in run(60 / 3600)] == [7, 8]
    measured = summarise_shift(scenes, CHOSEN, 10.0)
    assert measured["units"] == 11 and measured["hours"] == pytest.approx(120 / 3600)
    assert measured["units_per_hour"] == pytest.approx(330)
    assert measured["units_per_hour_without_exchange"] == pytest.approx(495)
    assert measured["minutes_between_assists"] == pytest.approx(2.0)
    low, high = measured["minutes_between_assists_ci95"]
    assert 0 < low < 2.0 < high
    assert measured["causes"] == {"slipped": 1}
    assert measured["cycle_seconds"]["median"] == 4.0
    assert sum(measured["cycle_seconds"]["histogram"]) == 11
    json.dumps(measured)
    assert draw_endurance(measured, scenes).startswith(b"\x89PNG")
    assert endurance_table(measured).row_count == 8


def test_a_scenario_that_never_begins_ends_the_shift(tmp_path: Path, monkeypatch):
    lost = lambda chosen, seed: endurance._lost(seed, "there is no room")  # noqa: E731
    monkeypatch.setattr(endurance, "_run_scene", lost)
    with pytest.raises(UserError, match=r"20 scenes in a row could not begin.*no room"):
        run_shift(
            CHOSEN, 8.0, 0.0, 0, tmp_path, workers=Here(), sent=CHOSEN, console=Console(quiet=True)
        )
