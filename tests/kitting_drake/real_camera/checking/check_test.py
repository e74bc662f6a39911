"""The check of cameras finds known errors in frames of an empty table, or of a block on it."""

import dataclasses
import functools
import math
from typing import Any

import numpy as np
import pytest
from pydrake.systems.sensors import CameraInfo
from scipy.spatial.transform import Rotation

from kitting_drake.common.errors import UserError
from kitting_drake.real_camera.calibrations.calibration import Calibration, with_poses
from kitting_drake.real_camera.checking.check import Check, check_cameras
from kitting_drake.real_camera.checking.kit_block import Block
from kitting_drake.real_camera.checking.meaning import (
    BAD,
    Finding,
    explains_depth,
    findings,
    offset,
    scales,
)
from kitting_drake.real_camera.frames import Frame
from kitting_drake.scenario.schema import Scenario
from systems.pick_place_parameters import PickPlaceParameters
from systems.sensor_noise import SensorNoiseParameters, noisy_depth
from tests.kitting_drake.real_camera.frames import calibration_of, cast, render_table

SCENARIO = Scenario()
TRUE = calibration_of(SCENARIO)
ONE = dataclasses.replace(TRUE, cameras=TRUE.cameras[:1])
BLOCK = Block((0.20, 0.15, 0.05), (0.45, -0.2, 1.1))
MODERATE = SensorNoiseParameters(depth_std=0.002, depth_step=0.001, flying_share=0.2)
"""The noise of `--perturb depth_noise:moderate`."""
MILD = SensorNoiseParameters(depth_std=0.001, depth_step=0.0005, flying_share=0.1)


def slow(value: Any) -> Any:
    """A parameter value that is tested by `make test-slow` only."""
    return pytest.param(value, marks=pytest.mark.slow)


@pytest.fixture(scope="module")
def table(rendering: None) -> dict[str, Frame]:
    return render_table(SCENARIO)


@functools.cache
def frames_of_block() -> dict[str, Frame]:
    """Frames of the block, which are shared by tests and must not be changed."""
    return cast(TRUE, BLOCK)


def noisy(
    frames: dict[str, Frame], longer: float = 0.0, *, noise=MODERATE, takes: int = 1
) -> dict[str, Frame]:
    """Frames with noise. Each depth is the median of some takes, and too long by `longer` (m)."""
    random = np.random.default_rng(0)
    result = {}
    for name, frame in frames.items():
        height, width = frame.depth.shape
        camera = CameraInfo(width, height, 450.0, 450.0, width / 2, height / 2)
        drawn = [noisy_depth(frame.depth, noise, camera, random) for _ in range(takes)]
        depth = np.median(drawn, axis=0).astype(np.float32)
        result[name] = Frame(frame.color, depth + np.float32(longer))
    return result


def moved(name: str, *, shift=(0.0, 0.0, 0.0), rotvec_deg=(0.0, 0.0, 0.0)) -> Calibration:
    """A calibration in which the pose of one camera is wrong by this shift and rotation."""
    X = next(camera.X_BC for camera in TRUE.cameras if camera.name == name).copy()
    X[:3, :3] = Rotation.from_rotvec(rotvec_deg, degrees=True).as_matrix() @ X[:3, :3]
    X[:3, 3] += shift
    return with_poses(TRUE, {name: X})


def test_correct_cameras_pass(table: dict[str, Frame]):
    check = check_cameras(table, TRUE)
    for camera in check.cameras.values():
        assert math.degrees(camera.table.tilt_angle) < 0.002
        assert abs(camera.table.bias) < 2e-5
        assert camera.table.holes < 0.001
    assert {line.verdict for line in findings(check)} == {"good"}


@pytest.mark.parametrize("longer", [0.002, slow(-0.002)])
def test_finds_a_depth_bias(table: dict[str, Frame], longer: float):
    check = check_cameras(noisy(table, longer), TRUE)
    for camera in check.cameras.values():
        assert camera.depth_bias == pytest.approx(longer, rel=0.2)
        assert explains_depth(camera)
        # If depths are too long, the table looks lower.
        assert camera.table.bias * longer < 0


@pytest.mark.parametrize("axis", [slow((0.3, 0, 0)), slow((0, -0.3, 0)), (0.18, 0.24, 0)])
def test_finds_a_tilt_and_its_axis(table: dict[str, Frame], axis: tuple[float, float, float]):
    check = check_cameras(noisy(table), moved("left", rotvec_deg=axis))
    found = np.degrees(check.cameras["left"].table.tilt)
    np.testing.assert_allclose(found, axis[:2], atol=0.06)
    assert math.degrees(check.cameras["right"].table.tilt_angle) < 0.03


def test_finds_a_camera_that_is_too_high(table: dict[str, Frame]):
    check = check_cameras(noisy(table), moved("front", shift=(0, 0, 0.003)))
    # If `table_height` is 3 mm too low, the clearance of 1.5 mm above it is not enough.
    assert "may go 1.5 mm into the table" in _meaning(check, "height bias")
    lines = findings(check, PickPlaceParameters(floor_clearance=0.0025))
    assert any("may go 0.5 mm into the table" in line.meaning for line in lines)
    low = check_cameras(table, moved("front", shift=(0, 0, -0.003)))
    assert "into the table" not in _meaning(low, "height bias")
    assert check.cameras["front"].table.bias == pytest.approx(0.003, rel=0.2)
    assert abs(check.cameras["left"].table.bias) < 0.0003
    assert check.disagreements["front", "left"] == pytest.approx(0.003, rel=0.2)
    assert abs(check.disagreements["left", "right"]) < 0.0003
    # The measured noise is that of `noisy`.
    assert check.cameras["front"].table.noise == pytest.approx(0.0016, rel=0.5)


@pytest.mark.parametrize(
    "size", [(0.20, 0.15, 0.05), slow((0.15, 0.20, 0.03)), slow((0.16, 0.16, 0.05))]
)
def test_a_block_shows_the_displacement_of_a_camera(size: tuple[float, float, float]):
    block = dataclasses.replace(BLOCK, size=size)
    believed = moved("left", shift=(0.003, 0, 0), rotvec_deg=(0, 0, 0.4))
    check = check_cameras(noisy(cast(TRUE, block), noise=MILD, takes=5), believed, block)
    seen = {name: camera.block for name, camera in check.cameras.items()}
    shift = check.block_shifts["front", "right"]
    assert np.linalg.norm(shift) < 0.0008
    for name in ("front", "right"):
        assert scales(seen[name], block) == pytest.approx((1, 1, 1), abs=0.015)
        assert math.degrees(seen[name].corner) == pytest.approx(90, abs=0.7)
    x, y, yaw = offset(seen["left"], block)
    X_left = TRUE.cameras[1].X_BC
    arm = np.array(block.pose[:2]) - X_left[:2, 3]
    expected = Rotation.from_euler("z", 0.4, degrees=True).as_matrix()[:2, :2] @ arm - arm
    np.testing.assert_allclose((x, y), expected + (0.003, 0), atol=0.0006)
    assert math.degrees(yaw) == pytest.approx(0.4, abs=0.2)


@pytest.mark.parametrize("yaw", [slow(-0.5), 0.7, slow(1.2)])
def test_a_square_block_is_never_off_by_a_quarter_turn(yaw: float):
    block = Block((0.16, 0.16, 0.05), (0.45, -0.2, yaw))
    for camera in check_cameras(cast(ONE, block), ONE, block).cameras.values():
        assert math.degrees(offset(camera.block, block)[2]) == pytest.approx(0, abs=0.3)


@pytest.mark.parametrize("pose", [slow((0.45, -0.2, 1.1)), slow((0.6, 0.2, 0.3))])
def test_distortion_does_not_displace_the_block(pose: tuple[float, float, float]):
    """Pixels near the border of a distorted image see more of the table, so they weigh more."""
    block = Block((0.20, 0.15, 0.05), pose)
    cameras = (
        dataclasses.replace(
            item, intrinsics=dataclasses.replace(item.intrinsics, distortion=(-0.3, 0.1, 0, 0))
        )
        for item in ONE.cameras
    )
    bent = Calibration(tuple(cameras), TRUE.grid)
    for camera in check_cameras(cast(bent, block), bent, block).cameras.values():
        assert np.hypot(*offset(camera.block, block)[:2]) < 3e-4


def test_the_scale_distinguishes_depth_and_focal_length_errors():
    frames = {"front": frames_of_block()["front"]}
    stretched = {k: Frame(f.color, f.depth * np.float32(1.01)) for k, f in frames.items()}
    check = check_cameras(stretched, ONE, BLOCK)
    assert scales(check.cameras["front"].block, BLOCK) == pytest.approx((1.01,) * 3, abs=0.004)
    assert "depth_scale" in _meaning(check, "scale")
    lens = dataclasses.replace(TRUE.cameras[0].intrinsics, focal=(445.5, 445.5))
    wrong = dataclasses.replace(
        TRUE, cameras=(dataclasses.replace(TRUE.cameras[0], intrinsics=lens),)
    )
    check = check_cameras(frames, wrong, BLOCK)
    length, width, height = scales(check.cameras["front"].block, BLOCK)
    assert (length + width) / 2 == pytest.approx(1.01, abs=0.006)
    assert abs(height - 1) < 0.02


def test_opposite_errors_of_two_focal_lengths_do_not_cancel():
    lens = dataclasses.replace(TRUE.cameras[0].intrinsics, focal=(459.0, 441.0))
    cameras = (dataclasses.replace(TRUE.cameras[0], intrinsics=lens),)
    block = dataclasses.replace(BLOCK, pose=(0.45, -0.2, 0.0))
    check = check_cameras(cast(ONE, block), dataclasses.replace(TRUE, cameras=cameras), block)
    assert _line(check, "scale").verdict == BAD


def test_a_rotation_about_the_block_is_reported_as_an_offset():
    x, y, _ = BLOCK.pose
    R = Rotation.from_euler("z", 1.5, degrees=True).as_matrix()
    X = TRUE.cameras[0].X_BC.copy()
    X[:3, :3] = R @ X[:3, :3]
    X[:3, 3] = R @ (X[:3, 3] - (x, y, 0)) + (x, y, 0)
    frames = {"front": frames_of_block()["front"]}
    check = check_cameras(frames, with_poses(ONE, {"front": X}), BLOCK)
    assert np.hypot(*offset(check.cameras["front"].block, BLOCK)[:2]) < 5e-4
    # The error is zero at the block's middle, but 2.6 mm at a distance of 10 cm from it.
    assert _line(check, "offset").verdict == BAD


@pytest.mark.parametrize("high", [0.3, slow(0.6)])
def test_a_camera_that_looks_straight_down_can_be_checked(high: float):
    down = dataclasses.replace(
        TRUE.cameras[0],
        X_BC=np.array([[0.0, -1, 0, 0.5], [-1, 0, 0, 0], [0, 0, -1, high], [0, 0, 0, 1]]),
    )
    block = Block((0.20, 0.15, 0.05), (0.5, 0.0, 0.0))
    alone = Calibration((down,), TRUE.grid)
    check = check_cameras(cast(alone, block), alone, block)
    assert np.hypot(*offset(check.cameras["front"].block, block)[:2]) < 5e-4


def _line(check: Check, what: str) -> Finding:
    return next(line for line in findings(check) if line.what == what)


def _meaning(check: Check, what: str) -> str:
    return _line(check, what).meaning


def test_corrected_poses_are_the_true_ones():
    """If the block's pose is known, both rotations and shifts of cameras are corrected."""
    believed = with_poses(
        moved("left", shift=(0.002, -0.001, 0.003), rotvec_deg=(0.3, 0.1, -0.2)),
        {"right": moved("right", rotvec_deg=(-0.2, 0.2, 0)).cameras[2].X_BC},
    )
    frames = noisy(frames_of_block(), noise=MILD, takes=3)
    corrected = check_cameras(frames, believed, BLOCK).corrected
    for camera, true in zip(corrected.cameras, TRUE.cameras, strict=True):
        away = np.linalg.inv(true.X_BC) @ camera.X_BC
        assert np.degrees(Rotation.from_matrix(away[:3, :3]).magnitude()) < 0.15
    again = check_cameras(frames, corrected, BLOCK)
    for camera in again.cameras.values():
        assert abs(camera.table.bias) < 1e-4
        assert math.degrees(camera.table.tilt_angle) < 0.01
        assert np.hypot(*offset(camera.block, BLOCK)[:2]) < 5e-4


def test_a_missing_or_different_block_is_an_error():
    with pytest.raises(UserError, match="camera front sees no block 50 mm high"):
        check_cameras(cast(TRUE), TRUE, BLOCK)
    other = dataclasses.replace(BLOCK, size=(0.6, 0.15, 0.05))
    with pytest.raises(UserError, match="sees a block of 200 x 150 x 50 mm"):
        check_cameras(frames_of_block(), TRUE, other)
