"""Makes models/sample_frame/: the images that two real cameras would take of a kit and four tools.

Run it from the root of the repository: `.venv/bin/python docs/examples/make_sample_frame.py
[FOLDER]`.
"""

import dataclasses
import json
import math
import sys
from pathlib import Path

import numpy as np
from PIL import Image

from kitting_drake.common.paths import SCENARIOS
from kitting_drake.real_camera import BenchCamera, Calibration, Frame, write_calibration
from kitting_drake.real_camera.calibrations.calibration import with_poses
from kitting_drake.real_camera.calibrations.layouts import Intrinsics
from kitting_drake.scenario import load_scenario
from kitting_drake.scenario.cameras import camera_pose
from kitting_drake.station import build_station

SEED = 1516
NOISE = "depth_noise:moderate,depth_holes:moderate,calibration:mild"
CAMERAS = """
planner: {home: [-0.4, 0.0, 0.4, 0.0]}
cameras:
  left: !LookAt {position: [1.02, 0.38, 0.80], target: [0.49, 0.0, 0.0], focal_length: 600.0}
  right: !LookAt {position: [1.02, -0.38, 0.80], target: [0.49, 0.0, 0.0], focal_length: 600.0}
"""
DEPTH_SCALE = 0.0001  # Metres per step of the depth images.
POINTS = 200  # Points of a tool's surface in truth.json.
FARTHEST = 6.5  # The largest depth that fits into 16 bits, in metres; larger depths are left out.


def calibration_of(scenario, depth_scale=0.001):
    """Returns the true calibration of a scenario's cameras."""
    cameras = tuple(
        BenchCamera(
            name,
            Intrinsics(
                (config.width, config.height),
                (config.focal_length, config.focal_length),
                (config.width / 2 - 0.5, config.height / 2 - 0.5),
            ),
            camera_pose(config).GetAsMatrix4(),
            depth_scale=depth_scale,
        )
        for name, config in scenario.cameras.items()
    )
    return Calibration(cameras, scenario.heightmap.grid())


def take_frames(station, context):
    """Takes the frames of a station's cameras.

    Args:
        station: a `KittingStation` with cameras.
        context: the station's own context.

    Returns:
        The frames, and the poses in the station's calibration, by camera name.
    """
    frames, poses = {}, {}
    for name in station.scenario.cameras:
        color, depth, X_WB = (
            station.GetOutputPort(f"{port}_{name}").Eval(context)
            for port in ("color_image", "depth_image", "camera_pose")
        )
        frames[name] = Frame(color.data[:, :, :3].copy(), depth.data[:, :, 0].copy())
        poses[name] = X_WB.GetAsMatrix4()
    return frames, poses


def truth(scene):
    """Returns the true poses (x, y, yaw) of the tools and of their places as JSON, in metres and
    radians.

    A tool's points (x, y), in metres, are a sample of its surface in its own frame. A rotation by 2
    pi / symmetry maps the tool to itself.
    """
    tools = {}
    for goal in scene.goals:
        (index,) = goal.objects
        tool = scene.objects[index]
        every = max(1, len(tool.p_BPoints) // POINTS)
        tools[tool.name] = {
            "pose": _planar(tool.X_WB),
            "places": [_planar(pose) for pose in goal.poses],
            "symmetry": tool.symmetry,
            "points": np.round(tool.p_BPoints[::every, :2], 3).tolist(),
        }
    return tools


def _planar(X):
    R, p = X.rotation().matrix(), X.translation()
    return [round(float(v), 5) for v in (p[0], p[1], math.atan2(R[1, 0], R[0, 0]))]


def write_sample(folder, frames, calibration, true):
    """Writes frames with depth in steps of 0.1 mm, `calibration.yaml` and `truth.json`."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, frame in frames.items():
        Image.fromarray(frame.color).save(folder / f"{name}_color.jpg", quality=88)
        near = np.isfinite(frame.depth) & (frame.depth < FARTHEST)
        steps = np.rint(np.where(near, frame.depth, 0) / DEPTH_SCALE).astype(np.uint16)
        Image.fromarray(steps).save(folder / f"{name}_depth.png", optimize=True)
    write_calibration(folder / "calibration.yaml", calibration)
    # Put each tool on a line of its own.
    lines = ",\n".join(f"{json.dumps(name)}: {json.dumps(tool)}" for name, tool in true.items())
    (folder / "truth.json").write_text(f"{{\n{lines}\n}}\n")


def main(folder=Path("models/sample_frame"), seed=SEED):
    scenario = load_scenario(SCENARIOS / "kitting_unseen.yaml", None, CAMERAS, NOISE)
    # Keep these two cameras only; the default has a third one.
    cameras = {name: scenario.cameras[name] for name in ("left", "right")}
    scenario = dataclasses.replace(scenario, cameras=cameras)
    station = build_station(scenario, seed, SCENARIOS)
    frames, poses = take_frames(station, station.CreateDefaultContext())
    calibration = with_poses(calibration_of(scenario, DEPTH_SCALE), poses)
    # The calibration counts as verified, because its errors are known (1 mm, 0.1 degrees).
    calibration = dataclasses.replace(calibration, verified=True)
    write_sample(folder, frames, calibration, truth(station.scene))
    size = sum(path.stat().st_size for path in folder.iterdir())
    print(f"{folder}: {1e-3 * size:.0f} kB")


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:]))
