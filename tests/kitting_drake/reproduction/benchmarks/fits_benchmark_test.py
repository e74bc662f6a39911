"""`benchmark fits`: its conditions, its summary, and how it resumes."""

import io
import json
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from rich.console import Console

from kitting_drake.common.errors import UserError
from kitting_drake.reproduction.benchmarks.fits_benchmark import (
    FITS,
    Fit,
    fits_table,
    measure_fits,
)
from kitting_drake.reproduction.benchmarks.fits_figure import draw_fits


def episode(seed: int, kitted: int) -> dict:
    """An episode with two tools. The first `kitted` succeed, the others are blocked."""
    objects = [
        {
            "name": f"tool_{number}",
            "category": "wrench",
            "add_s_mm": 1.0,
            "strict_success": number < kitted,
            "success": number < kitted,
            "cause": None if number < kitted else "insertion blocked",
        }
        for number in range(2)
    ]
    peaks = [{"vertical": 8.0, "lateral": 3.0 + seed, "mode": "LOWER"}] * 2
    return {
        "seed": seed,
        "objects": objects,
        "failure": None,
        "timed_out": False,
        "actions_taken": [{"peak_force_n": peak} for peak in peaks],
        "stopped_actions": 0,
        "wall_seconds": 1.0,
    }


def test_conditions_are_those_of_the_scenario():
    chosen = Fit(0.3, "moderate", False).choose().scenario
    assert chosen.task.kit.clearance == pytest.approx(0.0003)
    assert chosen.task.kit.is_tight
    assert chosen.planner.search.steps == 0
    assert chosen.sensor_noise.rig_position_error > 0
    assert chosen.policy.name == "shape_matching"
    assert Fit(2.0, "perfect", True).choose().scenario.planner.search.steps > 0


def test_finished_episodes_are_not_run_again(tmp_path: Path):
    console = Console(quiet=True)
    measure_fits(0, 0, tmp_path, console, fits=[])
    fits = [fit for fit in FITS if fit.clearance_mm < 2]
    with (tmp_path / "episodes.jsonl").open("w") as file:
        for fit in fits:
            for seed in (4, 5):
                line = {"fit": asdict(fit), "episode": episode(seed, 2 if fit.search else 1)}
                file.write(json.dumps(line) + "\n")
    measured = measure_fits(2, 4, tmp_path, console, fits=fits)
    found = next(item for item in measured["fits"] if not item["search"])
    assert (found["strict"], found["tools"]) == (2, 4)
    assert found["causes"] == {"insertion blocked": 2}
    assert found["peak_force_n"] == {"median": 8.0, "max": 8.0}
    low, high = found["interval"]
    assert 0 < low < 0.5 < high < 1
    assert fits_table(measured).row_count == len(fits)
    picture = np.asarray(Image.open(io.BytesIO(draw_fits(measured))))
    assert picture.std() > 10


def test_a_folder_of_something_else_is_refused(tmp_path: Path):
    (tmp_path / "other.json").write_text("{}")
    with pytest.raises(UserError, match="other"):
        measure_fits(1, 0, tmp_path, Console(quiet=True))
