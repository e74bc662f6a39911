"""Cameras are calibrated from rendered images of boards of markers."""

import json
import math
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image
from scipy.spatial.transform import Rotation

from kitting_drake.common.errors import UserError
from kitting_drake.real_camera.calibrations.calibration import read_calibration
from kitting_drake.real_camera.calibrations.layouts import Intrinsics
from kitting_drake.real_camera.frames.point_clouds import project_points
from kitting_drake.real_camera.markers.board_calibration import Calibrated, calibrate_cameras
from kitting_drake.real_camera.markers.board_poses import fit_board
from kitting_drake.real_camera.markers.boards import Board, read_board

cv2 = pytest.importorskip("cv2")

POSE = "pose: {position: [0.45, -0.1, 0.015], rpy_deg: [0, 0, 30]}\nthickness: 0.003\n"
CHARUCO = (
    f"type: charuco\ncolumns: 7\nrows: 5\nsquare: 0.04\nmarker: 0.03\ndictionary: 5X5_100\n{POSE}"
)
APRILTAG = f"type: apriltag\ncolumns: 4\nrows: 3\nmarker: 0.05\ngap: 0.015\n{POSE}"
ONE_TAG = f"type: apriltag\ncolumns: 1\nrows: 1\nmarker: 0.1\nfirst_id: 5\n{POSE}"
SIZE, FOCAL, CENTRE = (640, 480), (600.0, 602.0), (318.0, 242.0)
LENS = "width: 640, height: 480, fx: 600, fy: 602, cx: 318, cy: 242"
BROWN = (0.08, -0.15, 0.001, -0.0005, 0.02)
FISHEYE = (-0.02, 0.01, 0.0, 0.0)
SCALE = 3000.0
"""The resolution of the printed board, in pixels per metre."""


def described(folder: Path, text: str) -> Board:
    (folder / "board.yaml").write_text(text)
    return read_board(folder / "board.yaml")


def lenses(folder: Path, *names: str, more: str = "") -> Path:
    entries = "".join(f"  {name}: {{{LENS}{more}}}\n" for name in names)
    (folder / "lenses.yaml").write_text(f"cameras:\n{entries}")
    return folder / "lenses.yaml"


def above(board: Board, tilt: float, distance: float = 0.7, roll: float = 20) -> NDArray:
    """The pose X_MK (4, 4) of a camera that looks at the board's middle.

    The line of sight is `tilt` degrees from the board's normal.
    """
    x, y = board.size
    X_MK = np.eye(4)
    X_MK[:3, :3] = (
        Rotation.from_euler("z", roll, degrees=True)
        * Rotation.from_euler("x", 180 - tilt, degrees=True)
    ).as_matrix()
    X_MK[:3, 3] = np.array([x / 2, y / 2, 0]) - distance * X_MK[:3, 2]
    return X_MK


def render(
    board: Board, X_MK: NDArray, model: str = "", values: tuple[float, ...] = ()
) -> NDArray[np.uint8]:
    """The image (480, 640, 3) of a board on a grey table, with a noise of 2 grey levels."""
    fine = 2
    pixels = tuple(round(SCALE * side) for side in board.size)
    printed = board.pattern.generateImage(pixels, marginSize=0)
    border = int(0.01 * SCALE)
    printed = cv2.copyMakeBorder(printed, *4 * (border,), cv2.BORDER_CONSTANT, value=255)
    col, row = np.meshgrid(*(((np.arange(fine * n) + 0.5) / fine - 0.5) for n in SIZE))
    u, v = (col - CENTRE[0]) / FOCAL[0], (row - CENTRE[1]) / FOCAL[1]
    if values:
        points = np.stack([u.ravel(), v.ravel()], axis=-1)[:, None]
        if model:
            straight = cv2.fisheye.undistortPoints(points, np.eye(3), np.array(values))
        else:
            criteria = (cv2.TERM_CRITERIA_COUNT, 15, 0)
            straight = cv2.undistortPointsIter(
                points, np.eye(3), np.array(values), np.eye(3), np.eye(3), criteria
            )
        u, v = straight[:, 0].T.reshape(2, *u.shape)
    rays = np.stack([u, v, np.ones_like(u)], axis=-1) @ X_MK[:3, :3].T
    with np.errstate(divide="ignore", invalid="ignore"):
        reach = -X_MK[2, 3] / rays[..., 2]
    x, y = (X_MK[axis, 3] + reach * rays[..., axis] for axis in (0, 1))
    across, down = SCALE * x - 0.5 + border, SCALE * (board.size[1] - y) - 0.5 + border
    large = cv2.remap(
        printed,
        across.astype(np.float32),
        down.astype(np.float32),
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_CONSTANT,
        borderValue=110,
    )
    gray = cv2.resize(large, SIZE, interpolation=cv2.INTER_AREA).astype(float)
    gray = 20 + 0.8 * gray + np.random.default_rng(0).normal(0, 2, gray.shape)
    return np.dstack([np.clip(gray, 0, 255).astype(np.uint8)] * 3)


def save(folder: Path, image: NDArray[np.uint8], name: str = "color.png") -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    Image.fromarray(image).save(folder / name)
    return folder


def errors(found: NDArray, expected: NDArray) -> tuple[float, float]:
    """The position error in mm and the rotation error in degrees of a found pose."""
    turned = Rotation.from_matrix(found[:3, :3].T @ expected[:3, :3]).magnitude()
    return 1e3 * float(np.linalg.norm(found[:3, 3] - expected[:3, 3])), math.degrees(turned)


@pytest.mark.parametrize(
    ("text", "tilt", "model", "values"),
    [
        pytest.param(CHARUCO, 0, "", (), marks=pytest.mark.slow),
        pytest.param(CHARUCO, 15, "", BROWN, marks=pytest.mark.slow),
        pytest.param(CHARUCO, 30, "", (), marks=pytest.mark.slow),
        (CHARUCO, 45, "equidistant", FISHEYE),
        pytest.param(CHARUCO, 60, "", (), marks=pytest.mark.slow),
        pytest.param(APRILTAG, 5, "", (), marks=pytest.mark.slow),
        (APRILTAG, 40, "", BROWN),
    ],
)
def test_poses_are_found(
    tmp_path: Path, text: str, tilt: float, model: str, values: tuple[float, ...]
):
    board = described(tmp_path, text)
    X_MK = above(board, tilt)
    frame = save(tmp_path / "frame", render(board, X_MK, model, values))
    more = f", distortion: {list(values)}" + (f", distortion_model: {model}" if model else "")
    path = lenses(tmp_path, "front", more=more if values else "")
    result = calibrate_cameras(board, [frame], read_calibration(path, poses=False))
    moved, turned = errors(result.calibration.cameras[0].X_BC, board.X_BM @ X_MK)
    assert moved < 0.5
    assert turned < 0.1
    fit = result.cameras[0].fit
    assert fit.rms < 0.25
    assert math.degrees(fit.angle) == pytest.approx(tilt, abs=0.2)
    if fit.focal_error < 0.01:
        assert fit.focal_ratio == pytest.approx(1, abs=max(3 * fit.focal_error, 0.002))
    assert result.calibration.table_height == pytest.approx(0.012)


def test_one_tag_is_enough_at_a_slant(tmp_path: Path):
    board = described(tmp_path, ONE_TAG)
    X_MK = above(board, 40, distance=0.4)
    frame = save(tmp_path / "frame", render(board, X_MK))
    lens = read_calibration(lenses(tmp_path, "front"), poses=False)
    result = calibrate_cameras(board, [frame], lens)
    moved, turned = errors(result.calibration.cameras[0].X_BC, board.X_BM @ X_MK)
    assert moved < 3
    assert turned < 0.5


def test_a_wrong_focal_length_is_told(tmp_path: Path):
    board = described(tmp_path, CHARUCO)
    frame = save(tmp_path / "frame", render(board, above(board, 45, distance=0.4)))
    path = lenses(tmp_path, "front")
    path.write_text(path.read_text().replace("fx: 600, fy: 602", "fx: 588, fy: 589.96"))
    fit = calibrate_cameras(board, [frame], read_calibration(path, poses=False)).cameras[0].fit
    assert fit.focal_ratio == pytest.approx(1 / 0.98, abs=0.003)
    assert fit.focal_error < 0.003


def test_touched_corners_give_the_pose(tmp_path: Path):
    board = described(tmp_path, CHARUCO)
    x, y = board.size
    corners = board.X_BM @ np.array([[0, x, 0], [0, 0, y], [0, 0, 0], [1, 1, 1]])
    names = ("bottom_left", "bottom_right", "top_left")
    touch = "".join(
        f"  {name}: {corners[:3, i].round(6).tolist()}\n" for i, name in enumerate(names)
    )
    text = CHARUCO.replace(POSE, f"touch:\n{touch}")
    np.testing.assert_allclose(described(tmp_path, text).X_BM, board.X_BM, atol=1e-5)
    with pytest.raises(UserError, match=r"but the pattern is 350.0 x 250.0 mm: touch the corners"):
        described(tmp_path, text.replace("square: 0.04", "square: 0.05"))
    with pytest.raises(UserError, match="touch must have bottom_left, bottom_right, top_left"):
        described(tmp_path, text.replace("top_left", "top"))


def test_the_documented_board_is_read(tmp_path: Path):
    page = (Path(__file__).resolve().parents[4] / "docs" / "bench.md").read_text()
    (text,) = re.findall(r"```yaml\n(type: .*?)```", page, re.DOTALL)
    board = described(tmp_path, text)
    assert board.size == pytest.approx((0.33, 0.24))
    assert board.table_height == pytest.approx(0)


def two_cameras(folder: Path) -> tuple[Board, list[NDArray], Path]:
    board = described(folder, CHARUCO)
    X_MK = [above(board, 30), above(board, 35, roll=120)]
    for name, X in zip(("front", "rear"), X_MK, strict=True):
        image = render(board, X)
        for number in (1, 2):
            save(folder / f"frame{number}", image, f"{name}_color.png")
    return board, X_MK, lenses(folder, "front", "rear")


def test_the_command(tmp_path: Path, verb: Callable):
    """Two frames from each of two cameras give one calibration, a report and pictures."""
    board, X_MK, path = two_cameras(tmp_path)
    out, frames = tmp_path / "out", (tmp_path / "frame1", tmp_path / "frame2")
    given = ("--calibrate", tmp_path / "board.yaml", "--camera", path, "--output", out)
    done = verb("decide", *frames, *given)
    assert done.returncode == 0, done.stderr
    assert "table: 12.0 mm high, tilted by 0.00 degrees" in done.stdout
    found = read_calibration(out / "calibration.yaml")
    assert found.table_height == pytest.approx(0.012)
    for camera, X in zip(found.cameras, X_MK, strict=True):
        moved, turned = errors(camera.X_BC, board.X_BM @ X)
        assert moved < 0.5
        assert turned < 0.1
        with Image.open(out / f"calibrate_{camera.name}.png") as picture:
            assert picture.size == SIZE
    record = json.loads((out / "calibrate.json").read_text())
    assert record["cameras"]["rear"]["images"] == 2
    assert record["cameras"]["rear"]["rating"] == "good"
    again = verb("decide", *frames, *given, "--check")
    assert again.returncode == 2
    assert "--check cannot be combined with --calibrate" in again.stderr
    given = (*given[:2], "--camera", out / "calibration.yaml", *given[4:])
    again = verb("decide", *frames, *given)
    assert "calibration.yaml is the file of the intrinsics: give another --output" in again.stderr
    (out / "calibrate.json").unlink()
    again = verb("decide", *frames, *given[:2], "--camera", path, *given[4:])
    assert "calibration.yaml was not written by --calibrate: give another --out" in again.stderr


def calibrated(folder: Path, text: str, *images: NDArray[np.uint8]) -> Calibrated:
    board = described(folder, text)
    frames = [save(folder / f"frame{i}", image) for i, image in enumerate(images)]
    lens = read_calibration(lenses(folder, "front"), poses=False)
    return calibrate_cameras(board, frames, lens)


def test_images_that_tell_nothing_are_refused(tmp_path: Path):
    board = described(tmp_path, CHARUCO)
    good = render(board, above(board, 30))
    hidden = good.copy()
    hidden[:, 225:] = 110
    little, much = above(board, 30), above(board, 30)
    little[0, 3] += 0.003
    much[0, 3] += 0.03
    cases = [
        (CHARUCO, [np.full_like(good, 110)], "shows 0 of the board's 17 markers and 0 of its 92"),
        (CHARUCO, [hidden], r"shows \d of the board's 17 markers and \d+ of its 92 corners, but"),
        (CHARUCO.replace("5X5_100", "4X4_50"), [good], "shows 0 of the board's 17 markers"),
        (CHARUCO, [good[:, :600]], "is 600x480 pixels, but camera front was calibrated at 640x48"),
        (CHARUCO, [good, render(board, little)], "did the board or the camera move between the"),
        (CHARUCO, [good, render(board, much)], "and that neither board nor camera moved"),
        (CHARUCO, [render(board, above(board, 75, 0.45))], r"seen at 7\d degrees from its normal"),
    ]
    for text, images, message in cases:
        with pytest.raises(UserError, match=message) as raised:
            calibrated(tmp_path, text, *images)
        assert "\n" not in str(raised.value)


def test_a_small_far_tag_is_ambiguous():
    """The tag's perspective is lost in the noise of its corners, so two poses fit."""
    points = 0.05 * np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    X_KM = np.linalg.inv(above_tag(20))
    lens = Intrinsics(SIZE, FOCAL, CENTRE)
    pixels = np.stack(project_points(points @ X_KM[:3, :3].T + X_KM[:3, 3], lens), axis=-1)
    for seed in range(4):
        noisy = pixels + np.random.default_rng(seed).normal(0, 0.3, pixels.shape)
        with pytest.raises(UserError, match=r"two poses .* degrees apart"):
            fit_board(points, noisy, lens, "camera front")


def above_tag(tilt: float) -> NDArray:
    X_MK = np.eye(4)
    X_MK[:3, :3] = Rotation.from_euler("x", 180 - tilt, degrees=True).as_matrix()
    X_MK[:3, 3] = np.array([0.025, 0.025, 0]) - 1.2 * X_MK[:3, 2]
    return X_MK


def test_markers_of_another_board_are_named(tmp_path: Path):
    board = described(tmp_path, ONE_TAG)
    image = render(board, above(board, 20))
    with pytest.raises(UserError, match="shows the markers 5, which are not on the board of"):
        calibrated(tmp_path, ONE_TAG.replace("first_id: 5", "first_id: 6"), image)


def test_wrong_sizes_are_noticed(tmp_path: Path):
    board = described(tmp_path, CHARUCO)
    image = render(board, above(board, 45, distance=0.5))
    path = lenses(tmp_path, "front")
    path.write_text(path.read_text().replace("fx: 600", "fx: 400"))
    frame = save(tmp_path / "frame", image)
    with pytest.raises(UserError, match=r"root mean square error of .* pixels"):
        calibrate_cameras(board, [frame], read_calibration(path, poses=False))


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("charuco", "aprilgrid", "type must be charuco, apriltag or aruco, not 'aprilgrid'"),
        ("5X5_100", "5X5_99", "there is no dictionary 5X5_99: give one of"),
        ("marker: 0.03", "marker: 0.05", "cannot make a board of 7x5 with these sizes"),
        ("square: 0.04", "square: 40", "the board would be 280 m long: give sizes in metres"),
        ("square: 0.04", "square: 0", "square must be more than 0, in metres"),
        ("columns: 7", "columns: 0", "columns must be a whole number of 1 or more"),
        ("columns: 7\n", "", "board.yaml lacks 'columns'"),
        ("square:", "sqare:", "unknown field 'sqare': did you mean 'square'"),
        ("rpy_deg: [0, 0, 30]", "rpy_deg: [180, 0, 30]", "is tilted by 180.0 degrees: it must lie"),
        (POSE, "", "must have either 'pose' .of the board in the base frame. or 'touch'"),
    ],
)
def test_descriptions_that_cannot_be_used_are_refused(
    tmp_path: Path, old: str, new: str, message: str
):
    assert old in CHARUCO
    with pytest.raises(UserError, match=message) as raised:
        described(tmp_path, CHARUCO.replace(old, new))
    assert "\n" not in str(raised.value)


def test_a_large_board_has_enough_markers(tmp_path: Path):
    with pytest.raises(
        UserError, match="the board needs 450 markers, but its dictionary has only 100"
    ):
        described(tmp_path, CHARUCO.replace("columns: 7\nrows: 5", "columns: 30\nrows: 30"))


def test_files_are_of_the_only_camera(tmp_path: Path):
    board = described(tmp_path, CHARUCO)
    save(tmp_path / "frame1", np.zeros((480, 640, 3), np.uint8), "front_color.png")
    lens = read_calibration(lenses(tmp_path, "front", "rear"), poses=False)
    with pytest.raises(
        UserError, match=r"is an image of one camera, but the calibration has 2 cameras: give fold"
    ):
        calibrate_cameras(board, [tmp_path / "frame1" / "front_color.png"], lens)
    with pytest.raises(UserError, match="there is no file"):
        calibrate_cameras(board, [tmp_path / "nothing"], lens)
