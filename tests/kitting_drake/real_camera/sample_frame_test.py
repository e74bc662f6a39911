"""The action for the frame in models/sample_frame is right, and is found without Drake."""

import json
import math
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from kitting_drake.common.paths import MODELS
from kitting_drake.real_camera import ShapeMatching, decide, read_calibration, read_frames
from kitting_drake.real_camera.annotation_page import AnnotationServer
from kitting_drake.real_camera.checking.table_check import check_table
from kitting_drake.real_camera.checking.table_finding import find_table
from kitting_drake.real_camera.outside_demonstrations import find_demonstrations
from systems.signals import PickPlaceAction

ROOT = Path(__file__).resolve().parents[3]
SAMPLE = MODELS / "sample_frame"
CALIBRATION = read_calibration(SAMPLE / "calibration.yaml")
FRAMES = read_frames([SAMPLE], CALIBRATION)


def test_it_is_small_and_names_no_machine():
    files = list(SAMPLE.iterdir())
    assert sum(path.stat().st_size for path in files) < 500_000
    for path in (SAMPLE / "calibration.yaml", SAMPLE / "truth.json"):
        assert str(ROOT) not in path.read_text()


def errors(action: PickPlaceAction) -> tuple[float, float, float]:
    """The errors of an action, judged by the nearest tool.

    They are the distance of the pick from the tool (m), the distance of the action's place from the
    place that brings the tool into a cavity (m), and the error of the tool's yaw (rad).
    """
    pick = np.array([action.pick.x, action.pick.y])
    found = []
    for tool in json.loads((SAMPLE / "truth.json").read_text()).values():
        x, y, yaw = tool["pose"]
        local = turned(pick - (x, y), -yaw)
        away = float(np.hypot(*(np.array(tool["points"]) - local).T).min())
        ahead = action.place.theta - action.pick.theta + yaw
        for place in tool["places"]:
            off = math.remainder(ahead - place[2], math.tau / tool["symmetry"])
            # The picked point comes to `goal` if the tool lands exactly at `place`.
            goal = turned(local, ahead - off) + place[:2]
            miss = math.dist(goal, (action.place.x, action.place.y))
            found.append((away, miss, abs(off)))
    return min(found)


def turned(xy: np.ndarray, angle: float) -> np.ndarray:
    c, s = math.cos(angle), math.sin(angle)
    return np.array([c * xy[0] - s * xy[1], s * xy[0] + c * xy[1]])


def test_shape_matching_decides_it_rightly():
    decision = decide(FRAMES, CALIBRATION, ShapeMatching(least_confidence=0.0))
    assert decision.result == "pick and place" and decision.warnings == []
    away, miss, off = errors(decision.action)
    assert away < 0.008 and miss < 0.002 and off < math.radians(1.0)


@pytest.mark.slow
def test_the_generalist_decides_it_rightly():
    from kitting_drake.real_camera import load_policy

    decision = decide(FRAMES, CALIBRATION, load_policy(least_confidence=0.0))
    away, miss, off = errors(decision.action)
    assert away < 0.008 and miss < 0.002 and off < math.radians(1.0)


@pytest.mark.slow
def test_the_command_of_the_readme_needs_no_drake(tmp_path: Path):
    program = """
import runpy, sys
sys.modules["pydrake"] = None
runpy.run_module("kitting_drake.decide", run_name="__main__")
"""
    arguments = [SAMPLE, "--camera", SAMPLE / "calibration.yaml", "--output", tmp_path]
    command = [sys.executable, "-c", program, *map(str, arguments), "--shape_matching"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("pick and place")


def test_its_table_is_found():
    found = find_table(FRAMES, CALIBRATION)
    assert abs(found.calibration.table_height) < 0.002
    assert found.tilt < math.radians(0.2)
    grid = found.calibration.grid
    assert grid.shape == (160, 320)
    assert (grid.x_min, grid.y_min) == pytest.approx((0.25, -0.5), abs=0.02)
    # All tools and their places are on the table that was found.
    for tool in json.loads((SAMPLE / "truth.json").read_text()).values():
        poses = np.array([tool["pose"], *tool["places"]])
        assert found.calibration.contains(poses[:, :2]).all()
    assert check_table(FRAMES, found.calibration) == []


def test_the_page_shows_it(tmp_path: Path):
    shutil.copytree(SAMPLE, tmp_path / "first" / "step1")
    steps = find_demonstrations(tmp_path)[0]
    with AnnotationServer(steps, CALIBRATION) as server:
        assert server.observation(0).height.max() > 0.03
        assert [step["name"] for step in server.describe()["steps"]] == ["first/step1"]
