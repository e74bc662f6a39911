"""The table of harder scenes: each run is in its scenario's row and its policy's column."""

from typing import Any

from kitting_drake.reproduction.page.harder_scenes import (
    FIRST_SEEDS,
    harder_scenes_table,
    stop_reasons_table,
)
from kitting_drake.reproduction.page.runs import Run


def run(scenario: str, method: str, share: float, seed: int = FIRST_SEEDS[-1], **scene: Any) -> Run:
    resolved = {"task": {}, "sensor_noise": {"depth_std": 0.0}} | scene
    summary = {
        "policy": method,
        "seeds": [seed],
        "policy_details": {"method": method},
        "scenario": scenario,
        "resolved_scenario": resolved,
        "strict_success_rate": share,
        "strict_ci95": [share - 0.05, share + 0.02],
        "peak_force_n": {"median": 4.0, "p95": 12.4, "max": 29.6},
        "stop_reasons": {"done": {"right": 21, "wrong": 1}, "gave up": {"right": 3, "wrong": 0}},
    }
    if method == "generalist":
        summary["policy_details"] = {"method": "so2", "scenario": "static scenes"}
    return Run("some", summary)


def rows(text: str) -> dict[str, list[str]]:
    lines = [line.strip("| ").split("|") for line in text.splitlines() if line.startswith("|")]
    return {line[0].strip(): [cell.strip() for cell in line[1:]] for line in lines}


def test_each_run_is_in_its_row():
    noise = {"sensor_noise": {"depth_std": 0.001}}
    unseen = "kitting_unseen:KittingUnseenToolsets"
    low = {"sensor_noise": {"depth_std": 0.0, "rig_height_error": -0.005}}
    shapes = {"task": {"shapes": "folder"}}
    table = rows(
        harder_scenes_table(
            [
                run("heaps:heap", "generalist", 0.75),
                run("heaps:heap", "shape_matching", 0.5),
                run("heaps:heap", "shape_matching", 0.25, seed=73000),
                run(unseen, "generalist", 0.98),
                run(unseen, "generalist", 0.94, **noise),
                run(unseen, "generalist", 0.96, **low),
                run("assembling_kits:Test", "oracle", 0.97, **shapes),
                run("heaps:crossed", "generalist", 0.1, seed=7),
            ]
        )
    )
    assert table["a heap of four tools"] == [
        "75.0 (70.0 to 77.0)",
        "50.0 (45.0 to 52.0)",
        "-",
        "12, 30",
        "24 of 25",
    ]
    assert table["unseen toolsets"][0].startswith("98.0")
    assert table["unseen toolsets, `--perturb all:moderate`"][0].startswith("94.0")
    assert table["unseen toolsets, cameras calibrated 5 mm too low"][0].startswith("96.0")
    public = table["five of Ravens' fourteen shapes in a kit"]
    assert public[:2] == ["-", "-"]
    assert public[2].startswith("97.0")
    assert public[3:] == ["-", "-"]
    assert not any("one across" in label for label in table)


def test_the_reasons_of_the_generalist_s_runs_are_added():
    runs = [run(name, "generalist", 0.9) for name in ("heaps:heap", "heaps:crossed")]
    others = [run("heaps:heap", "oracle", 1.0), run("heaps:heap", "generalist", 0.9, seed=7)]
    table = rows(stop_reasons_table([*runs, *others]))
    assert table["`done`"] == ["42", "2"]
    assert table["`gave up`"] == ["6", "0"]


def test_without_runs_there_is_no_table():
    assert harder_scenes_table([]) == stop_reasons_table([]) == "No runs yet.\n"
