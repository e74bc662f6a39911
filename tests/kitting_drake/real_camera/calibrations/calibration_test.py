"""Calibrations in the layouts of OpenCV, ROS and this project."""

import dataclasses
import math
import re
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from kitting_drake.common.errors import UserError
from kitting_drake.real_camera.calibrations.calibration import (
    Calibration,
    read_calibration,
    write_calibration,
)

OWN = """
table_height: 0.012
cameras:
  eye:
    width: 64
    height: 48
    fx: 50.0
    fy: 51
    cx: 31.5
    cy: 23.25
    distortion: [0.1, -0.05, 0.001, -0.002, 0.01]
    pose: {position: [0.5, 0.1, 0.9], rpy_deg: [180, 0, -90]}
"""
OPENCV = """%YAML:1.0
---
image_width: 64
image_height: 48
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 5.0e+01, 0., 3.15e+01, 0., 51., 2.325e+01, 0., 0., 1. ]
distortion_coefficients: !!opencv-matrix
   rows: 1
   cols: 5
   dt: d
   data: [ 1.0e-01, -5.0e-02, 1.0e-03, -2.0e-03, 1.0e-02 ]
R_cam2base: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 0., -1., 0., -1., 0., 0., 0., 0., -1. ]
t_cam2base: !!opencv-matrix
   rows: 3
   cols: 1
   dt: d
   data: [ 5.0e-01, 1.0e-01, 9.0e-01 ]
camera_name: eye
table_height: 0.012
"""
# The output of `ros2 topic echo --once`.
CAMERA_INFO = """
header:
  frame_id: eye_color_optical_frame
height: 48
width: 64
distortion_model: plumb_bob
d: [0.1, -0.05, 0.001, -0.002, 0.01]
k: [50.0, 0.0, 31.5, 0.0, 51.0, 23.25, 0.0, 0.0, 1.0]
r: [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
p: [50.0, 0.0, 31.5, 0.0, 0.0, 51.0, 23.25, 0.0, 0.0, 0.0, 1.0, 0.0]
---
"""
ROS = """
table_height: 0.012
cameras:
  eye:
    camera_info: eye_info.yaml
    transform:
      translation: {x: 0.5, y: 0.1, z: 0.9}
      rotation: {x: 0.7071067811865476, y: -0.7071067811865476, z: 0.0, w: 0.0}
"""


def read(folder: Path, text: str, **others: str) -> Calibration:
    for name, content in others.items():
        (folder / f"{name}.yaml").write_text(content)
    (folder / "calibration.yaml").write_text(text)
    return read_calibration(folder / "calibration.yaml")


def test_three_layouts_give_the_same_camera(tmp_path: Path):
    own = read(tmp_path, OWN)
    for text in (OPENCV, ROS):
        other = read(tmp_path, text, eye_info=CAMERA_INFO)
        assert other.grid == own.grid
        (one,), (two,) = own.cameras, other.cameras
        assert (two.name, two.intrinsics) == (one.name, one.intrinsics)
        np.testing.assert_allclose(two.X_BC, one.X_BC, atol=1e-12)
    # The camera looks straight down; the image's x axis (to the right) points along the base's -y.
    np.testing.assert_allclose(own.cameras[0].X_BC[:3, :3] @ [0, 0, 1], [0, 0, -1], atol=1e-12)
    np.testing.assert_allclose(own.cameras[0].X_BC[:3, :3] @ [1, 0, 0], [0, -1, 0], atol=1e-12)
    assert own.table_height == 0.012


def test_a_file_of_one_camera_may_give_the_table_height(tmp_path: Path):
    one = """
camera_name: eye
table_height: 0.012
camera_info: eye_info.yaml
transform:
  translation: {x: 0.5, y: 0.1, z: 0.9}
  rotation: {x: 0.7071067811865476, y: -0.7071067811865476, z: 0.0, w: 0.0}
"""
    found = read(tmp_path, one, eye_info=CAMERA_INFO)
    assert (found.cameras[0].name, found.table_height) == ("eye", 0.012)


def test_rays_invert_the_distortion(tmp_path: Path):
    """A pixel's ray, distorted by the formula in OpenCV's manual, hits that pixel again."""
    camera = read(tmp_path, OWN).cameras[0]
    x, y = camera.rays.u.astype(float), camera.rays.v.astype(float)
    k1, k2, p1, p2, k3 = camera.intrinsics.distortion
    r2 = x**2 + y**2
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    bent_x = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x**2)
    bent_y = y * radial + p1 * (r2 + 2 * y**2) + 2 * p2 * x * y
    # Pixel centres are whole numbers.
    np.testing.assert_allclose(50 * bent_x + 31.5, np.tile(np.arange(64), (48, 1)), atol=0.01)
    np.testing.assert_allclose(51 * bent_y + 23.25, np.tile(np.arange(48), (64, 1)).T, atol=0.01)


def test_a_written_calibration_reads_back_exactly(tmp_path: Path):
    before = read(tmp_path, OWN + "workspace: {rows: 100, cols: 90, max_height: 0.2}\n")
    turned = before.cameras[0].X_BC.copy()
    turned[:3, :3] = Rotation.from_rotvec([0.1, 0.2, 0.3]).as_matrix() @ turned[:3, :3]
    camera = dataclasses.replace(before.cameras[0], X_BC=turned, depth_scale=0.0002)
    calibration = dataclasses.replace(before, cameras=(camera,))
    write_calibration(tmp_path / "again.yaml", calibration)
    again = read_calibration(tmp_path / "again.yaml")
    assert again.grid == calibration.grid
    assert dataclasses.replace(again.cameras[0], X_BC=0) == dataclasses.replace(camera, X_BC=0)
    np.testing.assert_array_equal(again.cameras[0].X_BC, turned)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("fx: 50.0", "fx: wide"), "camera eye: fx must be a finite number, not 'wide'"),
        (("fx: 50.0", "fx: .nan"), "camera eye: fx must be a finite number"),
        (("    fx: 50.0\n", ""), "camera eye has no intrinsics"),
        (("    width: 64\n", ""), "camera eye has no image size"),
        (("cx: 31.5", "cx: 310"), "intrinsics those of another resolution"),
        (
            ("0.001, -0.002, 0.01]", "0.001]"),
            "must hold 0, 4, 5, 8, 12 or 14 numbers, not 3",
        ),
        (("[0.1, -0.05,", "[-9.0, -0.05,"), "distortion of camera eye cannot be inverted"),
        ((", rpy_deg: [180, 0, -90]", ""), "camera eye: pose has no rotation"),
        (("rpy_deg: [180, 0, -90]", "yaw: 3"), "camera eye: pose has the unknown field 'yaw'"),
        (
            ("rpy_deg: [180, 0, -90]", "rpy_deg: [0, 0, 0], quaternion_xyzw: [1, 0, 0, 0]"),
            "pose has quaternion_xyzw and rpy_deg: give one of them",
        ),
        (("{position:", "{translation: [9, 9, 9], position:"), "has position and translation"),
        (("fy: 51", "fy: 51\n    image_size: [48, 64]"), "has image_size and width and height"),
        (("fy: 51", "fy: 51\n    t_cam2base: [0, 0, 1]"), "has t_cam2base and pose: give only one"),
        (("rpy_deg: [180, 0, -90]", "quaternion_xyzw: [1, 1, 0, 0]"), "must be a unit quaternion"),
        (("position: [0.5, 0.1, 0.9]", "position: [500, 100, 900]"), "give positions in metres"),
        (("    pose:", "    where:"), "camera eye has no pose"),
        (
            ("fy: 51", "fy: 51\n    camera_to_base: []"),
            "camera eye has camera_to_base and pose: give only one",
        ),
        (("table_height: 0.012", "table_height: high"), "table_height must be a finite number"),
        (("cameras:", "workspace: {cells: 3}\ncameras:"), "unknown field"),
        (("  eye:\n", "  eye: {\n"), "line "),
        (("cameras:", "camera:"), "unknown field 'camera': did you mean 'cameras'?"),
        (("fx:", "fxx:"), "unknown field 'fxx': did you mean 'fx'?"),
        (("table_height:", "table_hieght:"), "unknown field 'table_hieght': did you mean 'table_h"),
        (("distortion:", "distorsion:"), "camera eye has the unknown field 'distorsion'"),
        (("fy: 51", "fy: 51\n    fy: 52"), "'fy' is given twice"),
        (("fy: 51", "fy: 51\n    min_depth: 300"), "min_depth 300 must be less than max_depth 10"),
        (("fy: 51", "fy: 51\n    table_height: 1"), "table_height.*beside 'cameras'"),
        (("table_height: 0.012", "when: 2024-13-45"), "is not YAML: month must be"),
        (("table_height: 0.012", "when: !!bool 5"), "is not YAML"),
        (("table_height: 0.012", "deep: " + 1200 * "["), "is nested too deeply"),
        (
            ("pose: {position: [0.5, 0.1, 0.9], rpy_deg: [180, 0, -90]}", "pose: &p {pose: *p}"),
            "pose has the unknown field 'pose'",
        ),
        (("cameras:", "workspace: {rows: 1000000, cols: 1000000}\ncameras:"), "resolution"),
    ],
)
def test_errors_are_one_sentence(tmp_path: Path, change: tuple[str, str], message: str):
    assert change[0] in OWN
    with pytest.raises(UserError, match=message) as raised:
        _ = read(tmp_path, OWN.replace(*change)).cameras[0].rays
    assert "\n" not in str(raised.value)


def test_a_pose_without_a_valid_rotation_is_rejected(tmp_path: Path):
    rows = "[[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 2, 1], [0, 0, 0, 1]]"
    text = OWN.replace("pose: {position: [0.5, 0.1, 0.9], rpy_deg: [180, 0, -90]}", "pose: " + rows)
    with pytest.raises(UserError, match="rotation"):
        read(tmp_path, text)


def test_a_transposed_camera_matrix_is_rejected(tmp_path: Path):
    transposed = "[50.0, 0.0, 0.0, 0.0, 51.0, 0.0, 31.5, 23.25, 1.0]"
    info = CAMERA_INFO.replace("[50.0, 0.0, 31.5, 0.0, 51.0, 23.25, 0.0, 0.0, 1.0]", transposed)
    with pytest.raises(UserError, match="transposed"):
        read(tmp_path, ROS, eye_info=info)


def test_poses_may_be_nested_as_in_ros(tmp_path: Path):
    """ROS nests them in this way in PoseWithCovarianceStamped."""
    pose = "{position: {x: 0.5, y: 0.1, z: 0.9}, orientation: {x: 0.7071068, y: -0.7071068}}"
    pose = pose.replace("-0.7071068}", "-0.7071068, z: 0.0, w: 0.0}")
    wrapped = f"{{header: {{frame_id: base}}, pose: {{pose: {pose}, covariance: [0.0]}}}}"
    text = OWN.replace("{position: [0.5, 0.1, 0.9], rpy_deg: [180, 0, -90]}", wrapped)
    np.testing.assert_allclose(
        read(tmp_path, text).cameras[0].X_BC, read(tmp_path, OWN).cameras[0].X_BC, atol=1e-6
    )


def test_misplaced_and_misspelt_fields_are_rejected(tmp_path: Path):
    """If they were ignored, a `distortion` beside `camera_info` would silently have no effect."""
    text = ROS.replace("camera_info:", "distortion: []\n    camera_info:")
    with pytest.raises(UserError, match="camera eye has the unknown field 'distortion'"):
        read(tmp_path, text, eye_info=CAMERA_INFO)
    long = OPENCV.replace("1.0e-01, 9.0e-01 ]", "1.0e-01, 9.0e-01, 1. ]")
    with pytest.raises(UserError, match=r"t_cam2base must hold 3 numbers \(3 x 1\), not 4"):
        read(tmp_path, long)
    read(tmp_path, OPENCV + "avg_reprojection_error: 0.2\nimage_height_mm: 3\n")
    with pytest.raises(UserError, match="field 'table_hieght': did you mean 'table_height'"):
        read(tmp_path, OPENCV + "table_hieght: 0.012\n")
    assert "distortion_coefficients:" in OPENCV
    for name in ("dist_coeff", "distCoeffs", "distortion_coefs"):
        with pytest.raises(UserError, match=f"unknown field '{name}': the lens's coefficients"):
            read(tmp_path, OPENCV.replace("distortion_coefficients", name))
    with pytest.raises(UserError, match="unknown field 'distortion_coeffs': the lens's"):
        read(tmp_path, ROS, eye_info=CAMERA_INFO.replace("\nd: ", "\ndistortion_coeffs: "))


def test_invalid_files_are_rejected(tmp_path: Path):
    with pytest.raises(UserError, match=r"cannot read .*No such file"):
        read_calibration(tmp_path / "nothing.yaml")
    with pytest.raises(UserError, match="must hold a mapping"):
        read(tmp_path, "- 1\n")
    read(tmp_path, OWN)
    with pytest.raises(UserError, match="table_height must be a finite number, not nan"):
        read_calibration(tmp_path / "calibration.yaml", table_height=math.nan)


def test_the_documented_examples_are_equal(tmp_path: Path):
    page = (Path(__file__).resolve().parents[4] / "docs" / "bench.md").read_text()
    own_text, opencv_text, ros_text = re.findall(r"```yaml\n(.*?)```", page, re.DOTALL)[:3]
    own, opencv = read(tmp_path, own_text), read(tmp_path, opencv_text)
    ros = read(tmp_path, ros_text, front_info=CAMERA_INFO)
    assert own.grid == opencv.grid == ros.grid
    assert own.cameras[0].intrinsics == opencv.cameras[0].intrinsics
    for other in (opencv, ros):
        assert other.cameras[0].name == "front"
        np.testing.assert_allclose(other.cameras[0].X_BC, own.cameras[0].X_BC, atol=1e-12)
