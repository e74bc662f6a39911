"""Turns a real camera's frames into one pick and place in the robot's frame, without pydrake.

from pathlib import Path
from kitting_drake.real_camera import Frame, decide, load_policy, read_calibration

calibration = read_calibration(Path("calibration.yaml"))
policy = load_policy()                      # loads the generalist; call it once
failed = []
while True:
    color, depth = my_camera()              # (480, 640, 3) bytes, (480, 640) metres
    decision = decide({"front": Frame(color, depth)}, calibration, policy, failed)
    if decision.action.stop:
        break
    if not my_robot(decision.as_dict()):    # fingertips in the base frame: docs/bench.md
        failed.append(decision.action.pick)
"""

from kitting_drake.policies.choices import Choice
from kitting_drake.real_camera.calibrations.calibration import (
    BenchCamera,
    Calibration,
    read_calibration,
    write_calibration,
)
from kitting_drake.real_camera.deciders import BenchPolicy, load_policy
from kitting_drake.real_camera.deciders import ShapeMatchingDecider as ShapeMatching
from kitting_drake.real_camera.decision import BenchDecision, decide
from kitting_drake.real_camera.frames import Frame, read_frames
from kitting_drake.real_camera.robots.bench_robot import BenchRobot, read_robot
from kitting_drake.real_camera.robots.trajectory_files import load_trajectory, save_trajectory

__all__ = [
    "BenchCamera",
    "BenchDecision",
    "BenchPolicy",
    "BenchRobot",
    "Calibration",
    "Choice",
    "Frame",
    "ShapeMatching",
    "decide",
    "load_policy",
    "load_trajectory",
    "read_calibration",
    "read_frames",
    "read_robot",
    "save_trajectory",
    "write_calibration",
]
