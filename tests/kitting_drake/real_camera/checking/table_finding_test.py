"""The table, its outline and the workspace are found in one frame."""

import math
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from kitting_drake import decide as decide_command
from kitting_drake.common.errors import UserError
from kitting_drake.real_camera import BenchCamera, Calibration, Frame, read_calibration
from kitting_drake.real_camera.calibrations.calibration import with_poses, write_calibration
from kitting_drake.real_camera.calibrations.layouts import Intrinsics
from kitting_drake.real_camera.calibrations.table_outline import inside_polygon
from kitting_drake.real_camera.checking.outline_tracing import trace
from kitting_drake.real_camera.checking.table_finding import find_table
from systems.signals import PixelGrid

FLOOR = -0.7
TABLE = 0.05
Box = tuple[tuple[float, float], tuple[float, float], float]
"""A box: its range in x, its range in y, and the height of its top, in metres."""
TOP: Box = ((0.30, 0.70), (-0.30, 0.35), TABLE)
KIT: Box = ((0.45, 0.67), (0.05, 0.30), TABLE + 0.04)
POST: Box = ((0.32, 0.40), (-0.05, 0.05), TABLE + 0.25)
EDGE: Box = ((0.30, 0.70), (-0.33, -0.30), TABLE + 0.03)
"""A rail along the table's edge, 30 mm higher than the table."""


def camera(degrees: float = 35.0) -> Calibration:
    """A camera that looks at the table from 1.1 m away, `degrees` off the vertical."""
    angle = math.radians(degrees)
    X = np.eye(4)
    # The image's x axis (to the right) points along the base's +y; the camera looks back towards
    # the robot.
    forward = np.array([-math.sin(angle), 0, -math.cos(angle)])
    X[:3, :3] = np.column_stack([[0, 1, 0], np.cross(forward, [0, 1, 0]), forward])
    X[:3, 3] = np.array([0.5, 0.0, TABLE]) - 1.1 * forward
    lens = Intrinsics((320, 240), (260.0, 260.0), (159.5, 119.5))
    return Calibration((BenchCamera("eye", lens, X),), PixelGrid())


def look(calibration: Calibration, boxes: list[Box], noise: float = 0.001) -> dict[str, Frame]:
    """Frames of boxes that stand on the floor, seen by the calibration's camera."""
    (eye,) = calibration.cameras
    u, v = np.broadcast_arrays(eye.rays.u, eye.rays.v)
    rays = np.stack([u, v, np.ones_like(u)], axis=-1).astype(float) @ eye.X_BC[:3, :3].T
    origin = eye.X_BC[:3, 3]
    depth = np.where(rays[..., 2] < 0, (FLOOR - origin[2]) / rays[..., 2], np.inf)
    for x, y, top in boxes:
        limits = np.array([x, y, (FLOOR, top)])
        with np.errstate(divide="ignore"):
            hits = (limits.T[:, None, None] - origin) / rays
        near, far = hits.min(axis=0).max(axis=-1), hits.max(axis=0).min(axis=-1)
        depth = np.where((near < far) & (near > 0), np.minimum(depth, near), depth)
    depth += np.random.default_rng(0).normal(0, noise, depth.shape)
    color = np.full((*depth.shape, 3), 120, np.uint8)
    return {"eye": Frame(color, np.where(np.isfinite(depth), depth, 0).astype(np.float32))}


def test_a_table_above_the_floor_is_found():
    eye = camera()
    found = find_table(look(eye, [TOP, KIT, EDGE]), eye)
    calibration = found.calibration
    assert calibration.table_height == pytest.approx(TABLE, abs=0.001)
    assert found.tilt < math.radians(0.2)
    grid = calibration.grid
    assert grid.rows % 16 == grid.cols % 16 == 0 and grid.resolution == 0.003125
    assert (grid.x_min, grid.x_max) == pytest.approx((0.28, 0.72), abs=0.04)
    assert grid.cols * grid.resolution == pytest.approx(0.65, abs=0.06)
    region = calibration.outline.region
    assert 4 <= len(region) <= 12
    # The first three points are on the table, some of them below the kit. The others are on the
    # rail or beside the table.
    xy = [[0.5, 0.2], [0.65, 0.28], [0.35, -0.25], [0.5, -0.32], [0.5, 0.37], [0.28, 0.0]]
    assert calibration.contains(np.array(xy)).tolist() == [True] * 3 + [False] * 3
    x, y = np.array(region).T
    assert x.min() > 0.295 and x.max() < 0.705 and y.max() < 0.355


def test_tall_things_are_ignored():
    eye = camera()
    calibration = find_table(look(eye, [TOP, POST]), eye).calibration
    assert len(calibration.outline.ignore) == 1
    assert calibration.contains(np.array([[0.36, 0.0], [0.6, 0.2]])).tolist() == [False, True]


def test_a_large_table_is_cropped_near_the_robot():
    eye = camera()
    found = find_table(look(eye, [((-0.3, 1.6), (-1.2, 1.2), TABLE)]), eye)
    grid = found.calibration.grid
    assert grid.shape == (160, 320) and "nearest to the robot" in found.chosen
    assert grid.x_min == pytest.approx(0.25, abs=0.03)
    assert abs(grid.y_min + 0.5) < 0.1


def test_a_tilted_table_is_told_and_a_wall_is_none(tmp_path: Path):
    eye = camera()
    frames = look(eye, [TOP, KIT])
    X = eye.cameras[0].X_BC.copy()
    for degrees, level in ((3.0, True), (25.0, False)):
        turned = X.copy()
        turned[:3, :3] = Rotation.from_euler("x", degrees, degrees=True).as_matrix() @ X[:3, :3]
        tilted = with_poses(eye, {"eye": turned})
        if level:
            assert math.degrees(find_table(frames, tilted).tilt) == pytest.approx(3, abs=0.3)
            continue
        with pytest.raises(UserError, match="no level plane is seen") as raised:
            find_table(frames, tilted)
        assert "\n" not in str(raised.value)


@pytest.fixture
def told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture) -> str:
    """What `--find` prints about a table that is tilted in the calibration."""
    eye = camera()
    frame = look(eye, [TOP, KIT])["eye"]
    np.save(tmp_path / "depth.npy", frame.depth)
    Image.fromarray(frame.color).save(tmp_path / "color.png")
    X = eye.cameras[0].X_BC.copy()
    X[:3, :3] = Rotation.from_euler("x", 3, degrees=True).as_matrix() @ X[:3, :3]
    write_calibration(tmp_path / "eye.yaml", with_poses(eye, {"eye": X}))
    arguments = [tmp_path, "--find", "--camera", tmp_path / "eye.yaml", "--output", tmp_path]
    monkeypatch.setattr(sys, "argv", ["decide", *map(str, arguments)])
    decide_command.main()
    return capsys.readouterr().out


def test_find_writes_a_calibration_and_a_picture(told: str, tmp_path: Path):
    assert told.splitlines()[0].startswith("table      z 0.0")
    assert "correct the pose with --check first" in told.replace("\n", " ")
    found = read_calibration(tmp_path / "found.yaml")
    assert found.region is not None and 0.3 < found.region.mean() <= 1
    with Image.open(tmp_path / "found.png") as picture:
        assert picture.width == 1320


def test_an_outline_has_few_corners_inside():
    grid = PixelGrid(resolution=0.00625, rows=120, cols=120)
    rows, cols = np.indices(grid.shape)
    disc = (rows - 60) ** 2 + (cols - 55) ** 2 < 45**2
    polygon = trace(disc, grid)
    assert 6 <= len(polygon) <= 12
    covered = inside_polygon(grid.to_world(np.stack([rows, cols], axis=-1)), polygon)
    assert (covered & ~disc).sum() == 0
    assert covered.sum() > 0.85 * disc.sum()
