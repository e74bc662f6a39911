import io
import json
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest
from PIL import Image
from rich.console import Console

from kitting_drake.real_camera import BenchRobot
from kitting_drake.reproduction.benchmarks.reach import draw_reach, measure_reach, reach_table
from systems.arm_kinematics import ArmBase
from systems.signals import PixelGrid


@pytest.mark.slow
def test_maps_the_reach_and_finds_a_better_base():
    grid = PixelGrid(x_min=0.4, y_min=-0.15, rows=80, cols=96)
    given = BenchRobot("fr3", ArmBase(-0.3, 0.0, 0.0))
    measured = measure_reach(given, grid, Console(quiet=True))
    assert json.loads(json.dumps(measured)) == measured
    assert 0.1 < measured["share"] < 0.8
    # The workspace's near edge is reached, its far edge is not.
    lowest = measured["shares"][0]
    middle = len(measured["y"]) // 2
    assert lowest[0][middle] == 1.0
    assert lowest[-1][middle] == 0.0
    assert measured["best_share"] == pytest.approx(1.0)
    x, y, z = measured["best_base"]["base"]
    assert z == 0.0
    # The best base is outside the workspace.
    assert max(0.4 - x, x - 0.65, -0.15 - y, y - 0.15) > 0.0
    size = Image.open(io.BytesIO(draw_reach(measured))).size
    assert size > (1000, 500)
    assert reach_table(measured).row_count == 2


def test_the_command_refuses_an_unknown_arm(
    verb: Callable[..., subprocess.CompletedProcess[str]], tmp_path: Path
):
    (tmp_path / "robot.yaml").write_text("model: kuka")
    done = verb("benchmark", "reach", "--robot", tmp_path / "robot.yaml", "--output", tmp_path)
    assert done.returncode == 2
    assert "model must be fr3 or panda, not 'kuka'" in done.stderr
