from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from kitting_drake.reporting.summary import (
    policy_details,
    summarise,
    summary_notes,
    summary_table,
    task_name,
    wilson_interval,
)
from kitting_drake.scenario.command_line import ChosenScenario
from kitting_drake.scenario.schema import (
    ArrangedKitting,
    Kitting,
    Oracle,
    PythonPolicy,
    QuantisedOracle,
    Scenario,
    ToolsetKitting,
)

CHOSEN = ChosenScenario(Scenario(), Path("mine.yaml"), "mine", None)
Make = Callable[..., dict[str, Any]]

# Fixed by the design: other programs read them.
KEYS = {
    "episodes",
    "failed_episodes",
    "success_rate",
    "ci95",
    "add_s_mm",
    "position_error_mm",
    "angle_error_deg",
    "sim_seconds",
    "wall_seconds",
    "policy",
    "scenario",
    "seeds",
}
NO_CAUSE = {
    "missed grasp": 0,
    "slipped": 0,
    "jammed": 0,
    "wrong cavity": 0,
    "flipped": 0,
    "misplaced": 0,
    "never picked": 0,
    "failed episode": 0,
}


def test_a_failed_episode_counts_zero_and_is_never_dropped(made_up_episode: Make):
    episodes = [
        made_up_episode(0, [1.0, 1.0]),
        made_up_episode(1, [1.0, 9.0]),
        made_up_episode(2, [1.0, 1.0], "solver"),
    ]
    summary = summarise(episodes, CHOSEN, wall_seconds_total=25.0)
    assert summary.keys() >= KEYS
    assert summary["episodes"] == 3
    assert summary["failed_episodes"] == 1
    assert summary["success_rate"] == pytest.approx(0.5)
    assert summary["ci95"] == wilson_interval(0.5, 6)
    assert summary["add_s_mm"]["median"] == pytest.approx(1.0)
    assert summary["angle_error_deg"]["max"] == pytest.approx(9.0)
    assert summary["seeds"] == [0, 1, 2]
    assert (summary["wall_seconds"], summary["wall_seconds_total"]) == (30.0, 25.0)
    assert summary["answers"]["place_position_error_mm"]["max"] == pytest.approx(18.0)
    assert summary["causes"] == NO_CAUSE | {"jammed": 1, "failed episode": 2}


def test_categories_add_up_to_the_whole(made_up_episode: Make):
    # The last one's process died: nobody knows any more what it held.
    lost = made_up_episode(3, [1.0], "died") | {"objects": [], "actions_taken": []}
    episodes = [
        made_up_episode(0, [1.0, 1.0]),
        made_up_episode(1, [2.0, 9.0]),
        made_up_episode(2, [1.0, 1.0], "solver"),
        lost,
    ]
    summary = summarise(episodes, CHOSEN, wall_seconds_total=1.0)
    hammer, pliers = (summary["categories"][name] for name in ("hammer", "pliers"))
    assert list(summary["categories"]) == ["hammer", "pliers"]
    assert (hammer["objects"], hammer["success_rate"]) == (4, 0.5)
    assert (pliers["objects"], pliers["success_rate"]) == (4, 0.25)
    assert summary["success_rate"] == pytest.approx((0.5 + 0.25) / 2)
    assert pliers["ci95"] == wilson_interval(0.25, 4)
    assert hammer["position_error_mm"]["median"] == pytest.approx(1.5)
    assert hammer["answers"]["place_angle_error_deg"]["median"] == pytest.approx(4.5)
    assert pliers["causes"] == NO_CAUSE | {"jammed": 1, "failed episode": 2}
    for cause, count in summary["causes"].items():
        assert count == sum(row["causes"][cause] for row in summary["categories"].values())


def test_successes_in_doubt_are_counted(made_up_episode: Make):
    """ADD-S forgives a flat tool that stands proud, or lies the wrong way round."""
    episode = made_up_episode(0, [1.0, 1.0, 1.0, 9.0])
    hammer, pliers, wrench, lost = episode["objects"]
    hammer["height_error_mm"] = 2.5
    pliers["angle_error_deg"] = -178.0
    wrench["height_error_mm"] = 1.5
    lost["height_error_mm"] = 20.0
    summary = summarise([episode], CHOSEN, wall_seconds_total=1.0)
    assert summary["doubts"] == {"proud": 1, "turned": 1}
    assert summary["categories"]["pliers"]["doubts"] == {"proud": 0, "turned": 1}
    assert "kitted, but: 1 proud, 1 turned" in summary_notes(summary)


def test_nothing_but_failures_has_a_summary(made_up_episode: Make):
    lost = made_up_episode(0, [1.0], "died") | {"objects": [], "actions_taken": []}
    summary = summarise([lost], CHOSEN, wall_seconds_total=1.0)
    assert summary["success_rate"] == 0.0
    assert summary["add_s_mm"]["median"] is None
    assert summary["categories"] == {}
    assert summary["causes"]["failed episode"] == 1
    assert "1 failed episode" in summary_notes(summary)
    assert summary_table(summary).row_count == 0


def test_wilson_interval():
    # 8 of 10: the textbook's 0.490 to 0.943.
    assert wilson_interval(0.8, 10) == pytest.approx([0.4902, 0.9433], abs=1e-4)
    low, high = wilson_interval(1.0, 200)
    assert high == pytest.approx(1.0)
    assert low == pytest.approx(200 / (200 + 1.959964**2))


@pytest.mark.parametrize(
    ("task", "name"),
    [
        (Kitting(), "kitting-seen-toolset"),
        (ToolsetKitting(), "kitting-unseen-toolsets"),
        (ToolsetKitting(split="train"), "kitting-train-toolsets"),
        # An easier task is not the paper's.
        (Kitting(success_threshold=0.01), "kitting"),
        (Kitting(tools=["claw_hammer"]), "kitting"),
        (ToolsetKitting(yaw_range_deg=10.0), "kitting"),
        (ArrangedKitting(), "arranged"),
    ],
)
def test_task_names(task: Kitting | ToolsetKitting | ArrangedKitting, name: str):
    assert task_name(task) == name


def test_policy_details():
    assert policy_details(Oracle(), Path()) == {"method": "oracle"}
    rounded = policy_details(QuantisedOracle(orientations=72), Path())
    assert rounded == {"method": "quantised_oracle", "orientations": 72}
    assert policy_details(PythonPolicy(), Path()) is None


def test_what_the_terminal_shows(made_up_episode: Make):
    episodes = [made_up_episode(seed, [1.0, 9.0, 1.0, 1.0]) for seed in range(2)]
    summary = summarise(episodes, CHOSEN, wall_seconds_total=1.0)
    console = Console(width=100)
    with console.capture() as shown:
        console.print(summary_table(summary))
    assert "75.0% kitted" in shown.get()
    rows = [line.split() for line in shown.get().splitlines() if "/" in line]
    assert [(row[1], row[3]) for row in rows] == [
        ("hammer", "2/2"),
        ("pliers", "0/2"),
        ("wrench", "2/2"),
        ("screwdriver", "2/2"),
        ("all", "6/8"),
    ]
    assert summary_notes(summary).splitlines() == [
        "not kitted: 2 jammed",
        "kitted, but: none",
        "answers, median error: pick 1.00 mm 2.00 deg, place 2.00 mm 3.00 deg",
    ]
