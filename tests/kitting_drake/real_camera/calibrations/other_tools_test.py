"""Reading calibrations that other tools wrote."""

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from kitting_drake.common.errors import UserError
from kitting_drake.real_camera.calibrations.calibration import (
    BenchCamera,
    read_calibration,
    write_calibration,
)
from kitting_drake.real_camera.calibrations.layouts import Intrinsics
from kitting_drake.real_camera.calibrations.lens_distortion import distort, undistort
from tests.kitting_drake.real_camera.calibrations import format_texts as texts

X_BC = np.array([[0, -1, 0, 0.5], [-1, 0, 0, 0.1], [0, 0, -1, 0.9], [0, 0, 0, 1]], float)
HAND = "hand_to_base: {position: [0.1, 0.2, 0.8], rpy_deg: [0, 0, 90]}"
X_BH = np.array([[0, -1, 0, 0.1], [1, 0, 0, 0.2], [0, 0, 1, 0.8], [0, 0, 0, 1]], float)
BROWN = (0.1, -0.05, 0.001, -0.002)


def read(folder: Path, entry: str, **files: str) -> BenchCamera:
    """Reads a camera from its entry in a calibration file, beside which other files are written."""
    for name, content in files.items():
        (folder / name.replace("__", ".")).write_text(content)
    path = folder / "calibration.yaml"
    path.write_text("cameras:\n  front:\n    " + entry.rstrip() + "\n")
    return read_calibration(path).cameras[0]


def same(found: NDArray[np.float64], expected: NDArray[np.float64]) -> None:
    np.testing.assert_allclose(found, expected, atol=1e-6)


@pytest.mark.parametrize(
    ("name", "text", "distortion"),
    [
        ("opencv.yml", texts.OPENCV_SAMPLE, (*BROWN, 0.01)),
        ("camchain.yaml", texts.KALIBR.partition("cam1:")[0], BROWN),
        ("intrinsic.json", texts.OPEN3D_INTRINSIC, ()),
        ("camera.json", texts.OPEN3D_PARAMETERS, ()),
        ("azure.json", texts.OPEN3D_AZURE, ()),
        ("realsense.json", texts.PYREALSENSE_JSON, ()),
        ("realsense.txt", texts.PYREALSENSE_TEXT, ()),
    ],
)
def test_intrinsics(tmp_path: Path, name: str, text: str, distortion: tuple[float, ...]):
    entry = f"intrinsics: {name}\n    pose: {{position: [0.5, 0.1, 0.9], rpy_deg: [180, 0, -90]}}"
    (tmp_path / name).write_text(text)
    camera = read(tmp_path, entry)
    assert camera.intrinsics == Intrinsics((64, 48), (50, 51), (31.5, 23.25), distortion)
    same(camera.X_BC, X_BC)


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("echo.txt", texts.TF_ECHO),
        ("echo2.txt", texts.TF2_ECHO),
        ("twice.txt", texts.TF2_ECHO + texts.TF2_ECHO),
        ("front_eye_on_base.yaml", texts.EASY_HANDEYE),
        ("old.yaml", texts.EASY_HANDEYE_OLD),
        ("front.calib", texts.EASY_HANDEYE2),
        ("camera.launch", texts.MOVEIT_LAUNCH),
        ("camera.launch.py", texts.MOVEIT_PYTHON),
        ("publish.sh", texts.ROS2_ARGUMENTS),
        ("publish1.sh", texts.ROS1_ARGUMENTS),
        ("stamped.yaml", texts.INVERSE_STAMPED),
        ("tf_static.yaml", texts.TF_STATIC),
        ("camera.json", texts.OPEN3D_PARAMETERS),
        ("matrix.txt", texts.MATRIX),
    ],
)
def test_poses(tmp_path: Path, name: str, text: str):
    (tmp_path / name).write_text(text)
    camera = read(tmp_path, f"{texts.LENS}    transform: {name}")
    same(camera.X_BC, X_BC)


def test_a_matrix_of_numpy_is_what_its_field_says(tmp_path: Path):
    np.save(tmp_path / "X.npy", np.linalg.inv(X_BC))
    same(read(tmp_path, texts.LENS + "    base_to_camera: X.npy").X_BC, X_BC)
    with pytest.raises(UserError, match="the last row of a pose must be 0 0 0 1: it is transposed"):
        np.save(tmp_path / "X.npy", X_BC.T)
        read(tmp_path, texts.LENS + "    camera_to_base: X.npy")


def test_open3d_writes_a_whole_camera(tmp_path: Path):
    (tmp_path / "camera.json").write_text(texts.OPEN3D_PARAMETERS)
    camera = read_calibration(tmp_path / "camera.json").cameras[0]
    assert camera.intrinsics.centre == (31.5, 23.25)
    same(camera.X_BC, X_BC)
    rows = '{"width": 64, "height": 48, "intrinsic_matrix": [50, 0, 31.5, 0, 51, 23.2, 0, 0, 1]}'
    (tmp_path / "camera.json").write_text(rows)
    with pytest.raises(UserError, match="Open3D writes it by columns"):
        read_calibration(tmp_path / "camera.json")


@pytest.mark.parametrize(
    "text",
    [
        texts.EASY_HANDEYE.replace("eye_on_hand: false", "eye_on_hand: true"),
        texts.EASY_HANDEYE2.replace("eye_on_base", "eye_in_hand"),
        texts.MOVEIT_LAUNCH.replace("panda_link0", "panda_hand"),
        texts.TF2_ECHO.replace("base_link", "tool0"),
    ],
)
def test_a_camera_on_the_hand_needs_the_hand(tmp_path: Path, text: str):
    (tmp_path / "eye").write_text(text)
    with pytest.raises(UserError, match=r"\(eye in hand\): give hand_to_base"):
        read(tmp_path, texts.LENS + "    pose: eye")
    same(read(tmp_path, f"{texts.LENS}    pose: eye\n    {HAND}").X_BC, X_BH @ X_BC)
    tf = texts.TF_ECHO.replace("At time", "tf_echo base_link tool0\nAt time")
    if "panda" not in text:
        found = read(tmp_path, f"{texts.LENS}    pose: eye\n    hand_to_base: tf", tf=tf)
        same(found.X_BC, X_BC @ X_BC)
    with pytest.raises(UserError, match="is the pose of wrist_3, but the camera's pose is in"):
        wrong = tf.replace("tool0", "wrist_3")
        read(tmp_path, f"{texts.LENS}    pose: eye\n    hand_to_base: tf", tf=wrong)


def test_a_hand_is_refused_where_it_is_not_needed(tmp_path: Path):
    with pytest.raises(UserError, match=r"front\.calib is the pose of a fixed camera"):
        entry = f"{texts.LENS}    pose: front.calib\n    {HAND}"
        read(tmp_path, entry, front__calib=texts.EASY_HANDEYE2)
    R, t = "[0, -1, 0, -1, 0, 0, 0, 0, -1]", "[0.5, 0.1, 0.9]"
    entry = f"{texts.LENS}    R_cam2gripper: {R}\n    t_cam2gripper: {t}\n    {HAND}"
    same(read(tmp_path, entry).X_BC, X_BH @ X_BC)


def test_a_hand_eye_calibration_needs_no_telling_names(tmp_path: Path):
    named = texts.EASY_HANDEYE2.replace("base_link", "ur5").replace("camera_color_optical", "eye")
    same(read(tmp_path, f"{texts.LENS}    pose: a.calib", a__calib=named).X_BC, X_BC)


def test_frames_tell_the_direction(tmp_path: Path):
    turned = texts.TF2_ECHO.replace(
        "tf2_echo base_link front_color_optical_frame",
        "tf2_echo front_color_optical_frame base_link",
    )
    same(read(tmp_path, f"{texts.LENS}    pose: tf", tf=turned).X_BC, np.linalg.inv(X_BC))
    with pytest.raises(UserError, match="name camera_to_base: rename the field to pose"):
        read(tmp_path, f"{texts.LENS}    camera_to_base: tf", tf=turned)
    same(read(tmp_path, f"{texts.LENS}    base_to_camera: tf", tf=turned).X_BC, np.linalg.inv(X_BC))
    strange = texts.TF2_ECHO.replace("base_link", "cell").replace("front_color_optical_frame", "A")
    with pytest.raises(UserError, match="A in cell, and it is not clear"):
        read(tmp_path, f"{texts.LENS}    pose: tf", tf=strange)
    names = "base_frame: cell\n    camera_frame: A"
    same(read(tmp_path, f"{texts.LENS}    pose: tf\n    {names}", tf=strange).X_BC, X_BC)


def test_a_body_is_not_an_optical_frame(tmp_path: Path):
    body = texts.EASY_HANDEYE.replace("camera_color_optical_frame", "camera_link")
    with pytest.raises(UserError, match="pose of camera_link, the camera's body: also give opt"):
        read(tmp_path, f"{texts.LENS}    pose: eye", eye=body)
    optical = "{position: [0, 0.015, 0], quaternion_xyzw: [-0.5, 0.5, -0.5, 0.5]}"
    camera = read(tmp_path, f"{texts.LENS}    pose: eye\n    optical_to_link: {optical}", eye=body)
    # The x axis of the body's frame points forward, like the z axis of the optical frame.
    same(camera.X_BC[:3, 2], X_BC[:3, 0])
    same(camera.X_BC[:3, 3], X_BC[:3, 3] + 0.015 * X_BC[:3, 1])


def test_kalibr_chains_give_poses(tmp_path: Path):
    pose = "pose: {position: [0.5, 0.1, 0.9], rpy_deg: [180, 0, -90]}"
    (tmp_path / "chain.yaml").write_text(texts.KALIBR)
    (tmp_path / "c.yaml").write_text(
        f"cameras:\n  left: {{camera_info: chain.yaml, {pose}}}\n"
        "  cam1: {camera_info: chain.yaml}\n"
    )
    left, right = read_calibration(tmp_path / "c.yaml").cameras
    assert (left.intrinsics.model, right.intrinsics.model) == ("", "equidistant")
    # A point's coordinates in the two cameras differ as the file's T_cn_cnm1 says.
    point = np.array([0.4, 0.2, 0.0, 1])
    seen = np.linalg.inv(left.X_BC) @ point
    same(np.linalg.inv(right.X_BC) @ point, seen + [-0.11, 0.02, 0, 0])
    (tmp_path / "c.yaml").write_text(f"cameras:\n  eye: {{camera_info: chain.yaml, {pose}}}\n")
    with pytest.raises(UserError, match="cam0, cam1: choose one, for example with `stream: cam0`"):
        read_calibration(tmp_path / "c.yaml")
    with pytest.raises(UserError, match="has the cameras cam0, cam1: choose one"):
        read_calibration(tmp_path / "chain.yaml")


def test_realsense_text_needs_a_resolution(tmp_path: Path):
    pose = "pose: {position: [0.5, 0.1, 0.9], rpy_deg: [180, 0, -90]}"
    with pytest.raises(UserError, match="sizes 128x96, 64x48: give resolution"):
        read(tmp_path, f"camera_info: rs\n    {pose}", rs=texts.REALSENSE)
    size = "resolution: [64, 48]"
    camera = read(tmp_path, f"camera_info: rs\n    {size}\n    {pose}")
    assert camera.intrinsics == Intrinsics((64, 48), (50, 51), (31.5, 23.25))
    depth = read(tmp_path, f"camera_info: rs\n    stream: Depth\n    {pose}").intrinsics
    assert depth.focal == (39, 39)
    large = read(tmp_path, f"camera_info: rs\n    resolution: [128, 96]\n    {pose}")
    assert large.intrinsics.model == "inverse_brown_conrady"
    # As in librealsense's rs2_deproject_pixel_to_point, the polynomial is applied to the pixel.
    x, y = (10 - 63.5) / 100, (20 - 47) / 102
    k1, k2, p1, p2, k3 = large.intrinsics.distortion
    r2 = x * x + y * y
    expected = x * (1 + k1 * r2 + k2 * r2**2 + k3 * r2**3) + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    assert large.rays.u[20, 10] == pytest.approx(expected, abs=1e-6)


@pytest.mark.parametrize(
    ("model", "values"),
    [
        ("", (0.1, -0.05, 0.001, -0.002, 0.01, 0.02, 0.003, 0.001, 1e-3, 2e-4, -1e-3, 1e-4)),
        ("equidistant", (0.03, -0.01, 0.002, -0.001)),
    ],
)
def test_lenses_agree_with_opencv(model: str, values: tuple[float, ...]):
    cv2 = pytest.importorskip("cv2")
    u, v = (item.ravel() for item in np.meshgrid(np.linspace(-0.6, 0.6, 9), [-0.4, 0.0, 0.3]))
    x, y = undistort(u, v, model, values, "front")
    points = np.stack([u, v], axis=-1)[:, None]
    if model:
        expected = cv2.fisheye.undistortPoints(points, np.eye(3), np.array(values))
    else:
        criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-12)
        expected = cv2.undistortPointsIter(
            points, np.eye(3), np.array(values), np.eye(3), np.eye(3), criteria
        )
    same(np.stack([x, y], axis=-1), expected[:, 0])
    same(np.stack(distort(x, y, model, values)), np.stack([u, v]))


def test_lenses_survive_writing(tmp_path: Path):
    lens = "distortion_model: equi\n    distortion: [0.1, 0.02, 0, 0]"
    color = "color: {width: 80, height: 60, fx: 60, fy: 60, cx: 40, cy: 30, depth_to_color: X}"
    color = color.replace("X", "{position: [0.015, 0, 0], rpy_deg: [0, 0, 1]}")
    pose = "camera_to_base: [0, -1, 0, 0.5, -1, 0, 0, 0.1, 0, 0, -1, 0.9, 0, 0, 0, 1]"
    camera = read(tmp_path, f"{texts.LENS}    {lens}\n    {color}\n    {pose}")
    write_calibration(tmp_path / "again.yaml", read_calibration(tmp_path / "calibration.yaml"))
    again = read_calibration(tmp_path / "again.yaml").cameras[0]
    assert again.intrinsics == camera.intrinsics
    assert again.intrinsics.model == "equidistant"
    assert camera.color is not None and again.color is not None
    assert again.color.intrinsics == camera.color.intrinsics
    np.testing.assert_array_equal(again.color.X_KC, camera.color.X_KC)


POSE = "    pose: {position: [0, 0, 1], rpy_deg: [180, 0, 0]}"
K = "width: 64\n    height: 48\n    k: [50, 0, 31.5, 0, 51, 23.25, 0, 0, 1]\n"


@pytest.mark.parametrize(
    ("entry", "message"),
    [
        (K.replace("50, 0", "50, 7.5"), "skew of 7.5 pixels"),
        (K + "    d: [0.1, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0.01, 0]\n", "d has a tilted sensor"),
        (K + "    binning_x: 2\n", "binning_x is 2, so the images are smaller"),
        (K + "    roi: {x_offset: 8, y_offset: 0, width: 32, height: 48}\n", "images are cropped"),
        (K + "    distortion_model: equidistant\n", "equidistant needs four numbers"),
        (K + "    distortion_model: equi\n    d: [0.1, 0]\n", "d must hold 4 numbers, not 2"),
        (K + "    distortion_model: omni\n    d: [0.1, 0]\n", "distortion_model omni is not"),
        (K + "    image_Width: 64\n", "has width and image_Width: give one of them"),
        (K + "    camera_to_hand: tf\n", "has pose and camera_to_hand: give only one pose"),
        ("intrinsics: lens\n    camera_info: lens\n", "has camera_info and intrinsics: give one"),
        ("intrinsics: nothing\n", r"cannot read .*nothing: No such file"),
        (K + "    color: {fx: 3}\n", "color lacks depth_to_color"),
        (K + "    color: {depth_to_color: [1], hue: 3}\n", "color has the unknown field 'hue'"),
    ],
)
def test_lenses_that_cannot_be_read_are_refused(tmp_path: Path, entry: str, message: str):
    with pytest.raises(UserError, match=message) as raised:
        read(tmp_path, entry + POSE, lens="a: 1", tf=texts.TF_ECHO)
    assert "\n" not in str(raised.value)


def test_zero_coefficients_are_none(tmp_path: Path):
    for count in (5, 12, 14):
        assert read(tmp_path, f"{K}    d: {[0.0] * count}\n{POSE}").intrinsics.distortion == ()
    values = [0.1, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0]
    assert len(read(tmp_path, f"{K}    d: {values}\n{POSE}").intrinsics.distortion) == 8


MOVING = texts.TF_ECHO + texts.TF_ECHO.replace("0.500", "0.510")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (MOVING, "has 2 poses of the same frame, which differ"),
        (
            texts.TF_ECHO.replace(", 0.900]", "]"),
            "three numbers after Translation and four after Quat",
        ),
        (texts.TF_ECHO.partition("- Rotation")[0] + "- Rotation:", "is not complete: tf2_echo"),
        (texts.TF_ECHO.replace("0.70710678", "0.9"), "must be a unit quaternion"),
        (texts.TF_ECHO.replace("0.900", "900"), "give positions in metres"),
        (texts.EASY_HANDEYE.replace("  qw: 0.0\n", ""), "transformation lacks 'qw'"),
        (texts.EASY_HANDEYE.replace("eye_on_hand: false", "eye: 1"), "lacks eye_on_hand"),
        (texts.EASY_HANDEYE2.replace("eye_on_base", "both"), "must be eye_in_hand or eye_on_base"),
        (texts.MOVEIT_LAUNCH[:-12], "is not complete XML"),
        (texts.MOVEIT_LAUNCH.replace(" 0.1 ", " $(arg y) "), "must have x y z yaw pitch roll"),
        (texts.MOVEIT_LAUNCH.replace("panda", "'panda"), "No closing quotation"),
        (texts.MOVEIT_PYTHON[:-60], "is not complete Python"),
        (texts.MOVEIT_PYTHON.replace('"0.5"', "x"), "must be written out, without variables"),
        (texts.MOVEIT_PYTHON.replace("--z", "--height"), "the unknown argument '--height'"),
        (texts.ROS2_ARGUMENTS.replace("--frame-id base_link", ""), "lacks --frame-id or"),
        (texts.ROS2_ARGUMENTS.replace("--x", "--qw 1 --x"), "a quaternion and roll, pitch, yaw"),
        (texts.TF_STATIC.replace("link_1", "rear_optical"), "2 of them are of a camera"),
        (texts.MATRIX.rpartition("0.0 0.0 0.0")[0], r"must hold 16 numbers \(4 x 4\), not 12"),
        ("hello: [", "holds no pose that can be read: give tf2_echo's text"),
        ("a: 1", "holds no pose that can be read"),
        ("", "holds no pose that can be read"),
    ],
)
def test_poses_that_cannot_be_read_are_refused(tmp_path: Path, text: str, message: str):
    with pytest.raises(UserError, match=message) as raised:
        read(tmp_path, texts.LENS + "    pose: tf", tf=text)
    assert "\n" not in str(raised.value)
