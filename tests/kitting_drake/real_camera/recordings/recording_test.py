"""Frames and intrinsics from recordings of ROS 1, ROS 2 and RealSense."""

import dataclasses
import io
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from kitting_drake.common.errors import MachineError, UserError
from kitting_drake.real_camera.calibrations.calibration import (
    BenchCamera,
    Calibration,
    ColorLens,
    read_calibration,
)
from kitting_drake.real_camera.calibrations.layouts import Intrinsics
from kitting_drake.real_camera.frames import Frame, read_frames
from systems.signals import PixelGrid

pytest.importorskip("rosbags")

W, H = 8, 6
DEPTH = np.linspace(0.6, 0.9, W * H).reshape(H, W)
STEPS = np.rint(1e3 * DEPTH).astype(np.uint16)
COLOR = np.arange(W * H * 3, dtype=np.uint8).reshape(H, W, 3)
LENS = Intrinsics((W, H), (10.0, 10.0), (3.5, 2.5))
CAMERA = BenchCamera("front", LENS, np.eye(4))
COLOR_TOPIC = "/camera/color/image_raw"
DEPTH_TOPIC = "/camera/aligned_depth_to_color/image_raw"
INFO_TOPIC = "/camera/color/camera_info"
OPTICAL = "camera_color_optical_frame"

Sent = tuple[str, float, Any]
"""A topic, a time in seconds, and a message."""


class Ros:
    """Makes messages of ROS 1 or ROS 2 and writes recordings of them."""

    def __init__(self, version: int) -> None:
        from rosbags import typesys

        self.version = version
        store = typesys.Stores.ROS1_NOETIC if version == 1 else typesys.Stores.ROS2_HUMBLE
        self.types = typesys.get_typestore(store)

    def make(self, kind: str, **fields: Any) -> Any:
        return self.types.types[kind](**fields)

    def header(self, time: float, frame: str) -> Any:
        fields = {"sec": int(time), "nanosec": round(1e9 * (time % 1))}
        stamp = self.make("builtin_interfaces/msg/Time", **fields)
        sequence = {"seq": 0} if self.version == 1 else {}
        return self.make("std_msgs/msg/Header", **sequence, stamp=stamp, frame_id=frame)

    def image(
        self, array: NDArray[Any], encoding: str, time: float, frame: str = OPTICAL, pad: int = 0
    ) -> Any:
        """An image message with `pad` additional bytes after each row."""
        rows = np.ascontiguousarray(array).view(np.uint8).reshape(array.shape[0], -1)
        rows = np.pad(rows, ((0, 0), (0, pad)))
        return self.make(
            "sensor_msgs/msg/Image",
            header=self.header(time, frame),
            height=array.shape[0],
            width=array.shape[1],
            encoding=encoding,
            is_bigendian=int(array.dtype.byteorder == ">"),
            step=rows.shape[1],
            data=rows.ravel(),
        )

    def compressed(self, data: bytes, form: str, time: float) -> Any:
        return self.make(
            "sensor_msgs/msg/CompressedImage",
            header=self.header(time, OPTICAL),
            format=form,
            data=np.frombuffer(data, np.uint8),
        )

    def info(self, fx: float = 10.0, width: int = W) -> Any:
        roi = {"x_offset": 0, "y_offset": 0, "height": 0, "width": 0, "do_rectify": False}
        matrices = {
            "d": np.array([0.1, 0, 0, 0, 0]),
            "k": np.array([fx, 0, 3.5, 0, 10, 2.5, 0, 0, 1]),
            "r": np.eye(3).ravel(),
            "p": np.eye(3, 4).ravel(),
        }
        if self.version == 1:
            matrices = {key.upper(): value for key, value in matrices.items()}
        return self.make(
            "sensor_msgs/msg/CameraInfo",
            header=self.header(1.0, OPTICAL),
            height=H,
            width=width,
            distortion_model="plumb_bob",
            **matrices,
            binning_x=0,
            binning_y=0,
            roi=self.make("sensor_msgs/msg/RegionOfInterest", **roi),
        )

    def write(self, path: Path, sent: list[Sent], mcap: bool = False) -> Path:
        from rosbags import rosbag1, rosbag2

        if self.version == 1:
            writer: Any = rosbag1.Writer(path)
            writer.set_compression(rosbag1.Writer.CompressionFormat.LZ4)
            pack = self.types.serialize_ros1
        else:
            plugin = rosbag2.StoragePlugin.MCAP if mcap else rosbag2.StoragePlugin.SQLITE3
            writer = rosbag2.Writer(path, version=8, storage_plugin=plugin)
            pack = self.types.serialize_cdr
        with writer:
            connections: dict[str, Any] = {}
            for topic, time, message in sent:
                kind = message.__msgtype__
                if topic not in connections:
                    connections[topic] = writer.add_connection(topic, kind, typestore=self.types)
                writer.write(connections[topic], int(1e9 * time), pack(message, kind))
        return path


def session(ros: Ros) -> list[Sent]:
    """The messages of a recording: colour starts before depth, and both change after 0.5 s."""
    return [
        (INFO_TOPIC, 1.0, ros.info()),
        (COLOR_TOPIC, 1.0, ros.image(0 * COLOR, "rgb8", 1.0)),
        (COLOR_TOPIC, 1.1, ros.image(COLOR, "rgb8", 1.1, pad=4)),
        (DEPTH_TOPIC, 1.11, ros.image(STEPS, "16UC1", 1.102)),
        (COLOR_TOPIC, 1.14, ros.image(0 * COLOR, "rgb8", 1.14)),
        (COLOR_TOPIC, 1.6, ros.image(COLOR[:, :, ::-1], "bgr8", 1.6)),
        (DEPTH_TOPIC, 1.6, ros.image((DEPTH + 0.1).astype(">f4"), "32FC1", 1.6)),
    ]


def read(path: Path, camera: BenchCamera = CAMERA, time: float | None = None) -> Frame:
    return read_frames([path], Calibration((camera,), PixelGrid()), time=time)["front"]


def written(folder: Path, kind: str, sent: list[Sent] | None = None) -> Path:
    ros = Ros(1 if kind == "bag" else 2)
    path = folder / ("a.bag" if kind == "bag" else "a")
    ros.write(path, session(ros) if sent is None else sent, mcap=kind.endswith("mcap"))
    return next(path.glob("*.mcap")) if kind == "mcap" else path


@pytest.mark.parametrize("kind", ["bag", "sqlite", "folder of mcap", "mcap"])
def test_the_first_pair(tmp_path: Path, kind: str):
    path = written(tmp_path, kind)
    frame = read(path)
    np.testing.assert_array_equal(frame.color, COLOR)
    np.testing.assert_allclose(frame.depth, 1e-3 * STEPS, atol=1e-7)
    later = read(path, time=0.3)
    np.testing.assert_array_equal(later.color, COLOR)
    np.testing.assert_allclose(later.depth, DEPTH + 0.1, atol=1e-6)
    with pytest.raises(UserError, match=r"has no images of .* within 50 ms .* after 5 s"):
        read(path, time=5)


@pytest.mark.parametrize("kind", ["bag", "mcap"])
def test_intrinsics_of_a_recording(tmp_path: Path, kind: str):
    path = written(tmp_path, kind)
    pose = "{position: [0, 0, 1], rpy_deg: [0, 0, 0]}"
    entry = f"camera_info: {path.relative_to(tmp_path)}\n    pose: {pose}"
    (tmp_path / "c.yaml").write_text(f"cameras:\n  front:\n    {entry}\n")
    lens = read_calibration(tmp_path / "c.yaml").cameras[0].intrinsics
    assert lens == dataclasses.replace(LENS, distortion=(0.1, 0, 0, 0, 0))


def test_compressed_images(tmp_path: Path):
    ros, files = Ros(1), []
    for array in (COLOR, STEPS):
        file = io.BytesIO()
        Image.fromarray(array).save(file, "PNG")
        files.append(file.getvalue())
    sent = [
        ("/front/rgb/compressed", 1.0, ros.compressed(files[0], "bgr8; png compressed bgr8", 1.0)),
        (
            "/front/depth/compressedDepth",
            1.0,
            ros.compressed(12 * b"\0" + files[1], "16UC1; compressedDepth png", 1.0),
        ),
    ]
    frame = read(ros.write(tmp_path / "a.bag", sent))
    np.testing.assert_array_equal(frame.color, COLOR)
    np.testing.assert_allclose(frame.depth, 1e-3 * STEPS, atol=1e-7)


def test_several_cameras_by_their_names(tmp_path: Path):
    ros = Ros(2)
    sent = [
        (topic.replace("/camera", f"/{name}"), 1.0, ros.image(image, encoding, 1.0))
        for name, shift in (("front", 0), ("rear", 9))
        for topic, image, encoding in (
            (COLOR_TOPIC, COLOR + np.uint8(shift), "rgb8"),
            (DEPTH_TOPIC, STEPS + np.uint16(shift), "16UC1"),
        )
    ]
    path = ros.write(tmp_path / "a", sent)
    cameras = (CAMERA, dataclasses.replace(CAMERA, name="rear"))
    frames = read_frames([path], Calibration(cameras, PixelGrid()))
    np.testing.assert_array_equal(frames["rear"].color, COLOR + np.uint8(9))
    np.testing.assert_allclose(frames["rear"].depth - frames["front"].depth, 0.009, atol=1e-6)
    with pytest.raises(UserError, match=r"has 2 topics with colour .*/front/.*/rear/.*give top"):
        read(path)
    named = dataclasses.replace(
        CAMERA, topics=tuple(t.replace("/camera", "/rear") for t in (COLOR_TOPIC, DEPTH_TOPIC))
    )
    np.testing.assert_array_equal(read(path, named).color, COLOR + np.uint8(9))
    with pytest.raises(UserError, match="has no topic /x of camera front"):
        read(path, dataclasses.replace(CAMERA, topics=("/x", "/y")))


def realsense(folder: Path, units: float = 0.0001) -> Path:
    ros = Ros(1)
    depth, color = "/device_0/sensor_0/Depth_0", "/device_0/sensor_1/Color_0"
    value = ros.make("std_msgs/msg/Float32", data=np.float32(units))
    sent = [
        ("/device_0/sensor_0/option/Depth_Units/value", 1.0, value),
        (f"{depth}/info/camera_info", 1.0, ros.info()),
        (f"{color}/info/camera_info", 1.0, ros.info()),
        (f"{depth}/image/data", 1.0, ros.image(10 * STEPS, "mono16", 1.0, "0")),
        (f"{color}/image/data", 1.0, ros.image(COLOR, "rgb8", 1.0, "0")),
    ]
    return ros.write(folder / "a.bag", sent)


def test_realsense_recordings_need_the_lens_of_colour(tmp_path: Path):
    path = realsense(tmp_path)
    with pytest.raises(UserError, match="is a RealSense recording, whose depth is not registered"):
        read(path)
    camera = dataclasses.replace(CAMERA, color=ColorLens(LENS, np.eye(4)))
    with pytest.raises(UserError, match=r"steps of 0.0001 m, .* depth_scale 0.001: set depth_s"):
        read(path, camera)
    frame = read(path, dataclasses.replace(camera, depth_scale=1e-4))
    np.testing.assert_array_equal(frame.color, COLOR)
    np.testing.assert_allclose(frame.depth, 1e-3 * STEPS, atol=1e-6)


def swapped(ros: Ros, **changes: Sent) -> list[Sent]:
    """A session in which the given messages replace all messages of their topics."""
    new = {sent[0]: sent for sent in changes.values()}
    return [new.get(sent[0], sent) for sent in session(ros)]


def test_recordings_that_cannot_be_used_are_refused(tmp_path: Path):
    ros = Ros(1)
    cases: list[tuple[list[Sent], str]] = [
        (
            [sent for sent in session(ros) if sent[0] != DEPTH_TOPIC],
            r"has 0 topics with depth of camera front \(none\)",
        ),
        (
            swapped(ros, info=(INFO_TOPIC, 1.0, ros.info(fx=11.0))),
            "camera_info has fx 11, but camera front was calibrated with 10",
        ),
        (
            swapped(ros, info=(INFO_TOPIC, 1.0, ros.info(width=16))),
            "camera_info has width 16, but camera front was calibrated with 8",
        ),
        (
            swapped(ros, color=(COLOR_TOPIC, 1.1, ros.image(COLOR[..., :2], "yuv422", 1.1))),
            "has the encoding yuv422: convert it to rgb8",
        ),
        (
            swapped(ros, depth=(DEPTH_TOPIC, 1.1, ros.image(STEPS, "rgb8", 1.1))),
            "has the encoding rgb8: depth must be 16UC1 or 32FC1",
        ),
        (
            swapped(ros, color=(COLOR_TOPIC, 9.0, ros.image(COLOR, "rgb8", 9.0))),
            "within 50 ms of each other",
        ),
        (
            swapped(ros, color=(COLOR_TOPIC, 1.1, ros.image(COLOR[:3], "rgb8", 1.1))),
            "is 8x3 pixels, but camera front was calibrated at 8x6",
        ),
        (
            [
                ("/front/rgb", 1.0, ros.image(COLOR, "rgb8", 1.0)),
                ("/front/depth", 1.0, ros.image(STEPS, "16UC1", 1.0, "depth_frame")),
            ],
            "is in the frame depth_frame, and /front/rgb in camera_color_optical_frame: record",
        ),
    ]
    for number, (sent, message) in enumerate(cases):
        path = ros.write(tmp_path / f"{number}.bag", sorted(sent, key=lambda item: item[1]))
        with pytest.raises(UserError, match=message) as raised:
            read(path)
        assert "\n" not in str(raised.value)


@pytest.mark.parametrize("kind", ["bag", "sqlite", "mcap"])
@pytest.mark.parametrize("share", [0.0, 0.1, 0.6])
def test_truncated_recordings_are_refused(tmp_path: Path, kind: str, share: float):
    path = written(tmp_path, kind)
    file = next(path.glob("*.db3")) if kind == "sqlite" else path
    content = file.read_bytes()
    file.write_bytes(content[: int(share * len(content))])
    with pytest.raises(
        UserError, match=r"(damaged|is) or not complete|is not complete|has no"
    ) as got:
        read(path)
    assert "\n" not in str(got.value)


def test_a_missing_library_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    path = written(tmp_path, "bag")
    monkeypatch.setitem(__import__("sys").modules, "rosbags", None)
    with pytest.raises(MachineError, match=r"needs the package rosbags: pip install"):
        read(path)


def test_a_recording_is_given_alone(tmp_path: Path):
    path = written(tmp_path, "bag")
    with pytest.raises(UserError, match=r"a.bag is a recording: give no other files"):
        read_frames([path, path], Calibration((CAMERA,), PixelGrid()))
    (tmp_path / "x.db3").touch()
    with pytest.raises(UserError, match=r"has no metadata.yaml beside it: run `ros2 bag rei"):
        read(tmp_path / "x.db3")
