"""Finds the first synchronised images of colour and depth in a ROS recording."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kitting_drake.common.errors import UserError
from kitting_drake.real_camera.calibrations.calibration import BenchCamera, Calibration
from kitting_drake.real_camera.calibrations.layouts import Intrinsics, read_intrinsics
from kitting_drake.real_camera.frames.bag_images import color_of_message, depth_of_message
from kitting_drake.real_camera.frames.image_files import depth_of_array
from kitting_drake.real_camera.recordings.recording import (
    CAMERA_INFO,
    COMPRESSED,
    IMAGE,
    RecordedMessage,
    Recording,
    camera_info_fields,
    open_recording,
)

Images = tuple[NDArray[np.uint8], NDArray[np.float32]]

_TOGETHER = 0.05
"""The times of the images of a frame differ by at most this, in seconds."""
_ALIGNED = re.compile(r"aligned_depth_to_color|depth_registered|depth_to_rgb|registered_depth")
_COLOUR = re.compile(r"colou?r|rgb")
_REALSENSE = re.compile(r"/device_\d+/sensor_\d+/")
_DIFFERENT = 0.02
"""If the intrinsics in the calibration and in a CameraInfo differ by more than this fraction of the
focal length or the width, they belong to two lenses."""
_UNITS = "std_msgs/msg/Float32"


def read_bag_frames(path: Path, calibration: Calibration, time: float | None) -> dict[str, Images]:
    """Returns colour and depth of each camera in a recording, by camera name.

    Args:
        path: the recording's path.
        calibration: the cameras' calibration.
        time: the time after the start of the recording, in seconds; None for the first images.

    Raises:
        UserError: topics are missing or ambiguous, depth is not registered to colour, no colour and
            depth images have nearly the same time, or a CameraInfo is that of another lens.
        MachineError: a library is missing.
    """
    images = {}
    alone = len(calibration.cameras) == 1
    with open_recording(path) as recording:
        for camera in calibration.cameras:
            topics = _topics(recording, camera, alone)
            color, depth = _first_pair(recording, topics, time)
            _check_registered(color, depth, camera, path)
            _check_lenses(recording, topics, camera)
            _check_scale(recording, topics[1], camera)
            steps = depth_of_message(depth.body, f"{path}: {depth.topic}")
            images[camera.name] = (
                color_of_message(color.body, f"{path}: {color.topic}"),
                depth_of_array(steps, camera.depth_scale, f"{path}: {depth.topic}"),
            )
    return images


def _topics(recording: Recording, camera: BenchCamera, alone: bool) -> tuple[str, str]:
    """Returns the topics of colour and of depth."""
    if camera.topics is not None:
        for topic in camera.topics:
            if topic not in recording.kinds:
                raise UserError(f"{recording.path} has no topic {topic} of camera {camera.name}")
        return camera.topics
    found = recording.topics(IMAGE, COMPRESSED)
    if not alone:
        found = [topic for topic in found if camera.name in topic.split("/")]
    depths = [topic for topic in found if "depth" in topic.lower()]
    colors = [topic for topic in found if topic not in depths]
    depths = [topic for topic in depths if _ALIGNED.search(topic)] or depths
    colors = [topic for topic in colors if _COLOUR.search(topic.lower())] or colors
    chosen = [_uncompressed(topics) for topics in (colors, depths)]
    for what, topics in zip(("colour", "depth"), chosen, strict=True):
        if len(topics) != 1:
            raise UserError(
                f"{recording.path} has {len(topics)} topics with {what} of camera {camera.name} "
                f"({', '.join(topics) or 'none'}): give topics: {{color: TOPIC, depth: TOPIC}} in "
                "the calibration"
            )
    return chosen[0][0], chosen[1][0]


def _uncompressed(topics: Sequence[str]) -> list[str]:
    """Returns the topics, except those that are compressed copies of others."""
    return [topic for topic in topics if topic.rpartition("/")[0] not in topics]


def _first_pair(
    recording: Recording, topics: tuple[str, str], time: float | None
) -> tuple[RecordedMessage, RecordedMessage]:
    """Returns the colour image and the depth image of the first moment that has both."""
    colors: list[RecordedMessage] = []
    depths: list[RecordedMessage] = []
    for message in recording.messages(topics):
        if time is not None and message.since < time:
            continue
        (colors if message.topic == topics[0] else depths).append(message)
        pair = _settled(colors, depths, ended=False)
        if pair is not None:
            return pair
    pair = _settled(colors, depths, ended=True)
    if pair is not None:
        return pair
    after = "" if time is None else f" after {time:g} s"
    raise UserError(
        f"{recording.path} has no images of {topics[0]} and {topics[1]} within "
        f"{1e3 * _TOGETHER:.0f} ms of each other{after}"
    )


def _settled(
    colors: list[RecordedMessage], depths: list[RecordedMessage], ended: bool
) -> tuple[RecordedMessage, RecordedMessage] | None:
    """Returns the first pair of images, or None if a later colour image might be closer in time to
    the depth image.

    Images that cannot belong to a pair are removed from the lists.

    Args:
        colors: the colour images so far, in the order of recording.
        depths: the depth images so far, in the order of recording.
        ended: whether the recording has no further images.
    """
    while depths and colors:
        first = depths[0]
        if not ended and colors[-1].stamp < first.stamp:
            colors[:] = [item for item in colors if item.stamp > first.stamp - _TOGETHER]
            return None
        nearest = min(colors, key=lambda item: abs(item.stamp - first.stamp))
        if abs(nearest.stamp - first.stamp) <= _TOGETHER:
            return nearest, first
        depths.pop(0)
    return None


def _check_registered(
    color: RecordedMessage, depth: RecordedMessage, camera: BenchCamera, path: Path
) -> None:
    if camera.color is not None or _ALIGNED.search(depth.topic):
        return
    frames = [str(message.body.header.frame_id) for message in (color, depth)]
    if _REALSENSE.search(depth.topic):
        raise UserError(
            f"{path} is a RealSense recording, whose depth is not registered to colour: give the "
            "depth's intrinsics in the calibration, and the colour's intrinsics and depth_to_color "
            "under color: (rs-enumerate-devices -c prints them)"
        )
    if frames[0] != frames[1]:
        raise UserError(
            f"{path}: {depth.topic} is in the frame {frames[1]}, and {color.topic} in {frames[0]}: "
            "record depth that is registered to colour (aligned_depth_to_color), or describe the "
            "colour's lens under 'color' in the calibration"
        )


def _check_lenses(recording: Recording, topics: tuple[str, str], camera: BenchCamera) -> None:
    """Compares the calibration with the CameraInfo of the images, if there is one."""
    lens = camera.intrinsics if camera.color is None else camera.color.intrinsics
    for topic, intrinsics in zip(topics, (lens, camera.intrinsics), strict=True):
        info = _sibling(recording, topic)
        first = next(iter(recording.messages([info])), None) if info else None
        if first is not None:
            _compare(first, intrinsics, camera, recording.path)


def _sibling(recording: Recording, topic: str) -> str | None:
    """Returns the topic of the CameraInfo that belongs to an image's topic."""
    parts, infos = topic.split("/"), recording.topics(CAMERA_INFO)
    for count in (1, 2):
        stem = "/".join(parts[:-count])
        for name in (f"{stem}/camera_info", f"{stem}/info/camera_info"):
            if name in infos:
                return name
    return None


def _compare(message: RecordedMessage, lens: Intrinsics, camera: BenchCamera, path: Path) -> None:
    fields = camera_info_fields(message.body)
    if not any(fields["k"]):
        return
    where = f"{path}: {message.topic}"
    # Distortion is not compared, so its model does not matter.
    told = read_intrinsics({**fields, "d": [], "distortion_model": ""}, where)
    values: list[tuple[str, Any, Any, float]] = [
        (name, told_value, value, _DIFFERENT * scale)
        for name, told_value, value, scale in (
            ("width", told.size[0], lens.size[0], 0),
            ("height", told.size[1], lens.size[1], 0),
            ("fx", told.focal[0], lens.focal[0], lens.focal[0]),
            ("fy", told.focal[1], lens.focal[1], lens.focal[1]),
            ("cx", told.centre[0], lens.centre[0], lens.size[0]),
            ("cy", told.centre[1], lens.centre[1], lens.size[0]),
        )
    ]
    for name, found, value, limit in values:
        if abs(found - value) > limit:
            raise UserError(
                f"{where} has {name} {found:g}, but camera {camera.name} was calibrated with "
                f"{value:g}: does the calibration belong to another lens or resolution?"
            )


def _check_scale(recording: Recording, topic: str, camera: BenchCamera) -> None:
    """Compares depth_scale with the depth units that a RealSense recording contains."""
    found = _REALSENSE.match(topic)
    name = f"{found.group()}option/Depth_Units/value" if found else ""
    if name not in recording.topics(_UNITS):
        return
    first = next(iter(recording.messages([name])), None)
    if first is not None and not np.isclose(first.body.data, camera.depth_scale, rtol=1e-3):
        raise UserError(
            f"{recording.path} has depth in steps of {first.body.data:.6g} m, but camera "
            f"{camera.name} has depth_scale {camera.depth_scale:g}: set depth_scale"
        )
