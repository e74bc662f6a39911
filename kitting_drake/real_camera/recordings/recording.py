"""Opens a recording of ROS 1, ROS 2 or RealSense, and reads its messages."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from kitting_drake.common.errors import UserError
from kitting_drake.common.extras import import_extra

CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
IMAGE = "sensor_msgs/msg/Image"
COMPRESSED = "sensor_msgs/msg/CompressedImage"
_ENDINGS = (".bag", ".mcap", ".db3")


@dataclass(frozen=True)
class RecordedMessage:
    """One message of a recording."""

    topic: str
    since: float
    """The time of recording, in seconds after the recording's first message."""
    stamp: float
    """The time of measurement that the message's header states, in seconds. If it states none, the
    time of recording."""
    body: Any


class Recording:
    """An open recording."""

    def __init__(self, path: Path, kinds: dict[str, str]) -> None:
        self.path = path
        self.kinds = kinds
        """The types of messages by topic, in the style of ROS 2."""

    def topics(self, *kinds: str) -> list[str]:
        """Returns the topics whose messages are of one of the given types, sorted."""
        return sorted(topic for topic, kind in self.kinds.items() if kind in kinds)

    def messages(self, topics: Sequence[str]) -> Iterator[RecordedMessage]:
        """Yields the messages of the given topics, in the order of recording."""
        raise NotImplementedError


def is_recording(path: Path) -> bool:
    """Whether a path is a recording's file, or a folder with a ROS 2 recording."""
    return path.suffix in _ENDINGS or (path / "metadata.yaml").is_file()


@contextlib.contextmanager
def open_recording(path: Path) -> Iterator[Recording]:
    """Opens a recording.

    Raises:
        UserError: the recording is damaged.
        MachineError: a library is missing. The message names it.
    """
    if not path.exists():
        raise UserError(f"there is no recording {path}")
    if path.suffix == ".mcap":
        opened = _open_mcap(path)
    elif path.suffix == ".bag":
        opened = _open_rosbag(path, "rosbag1", "ROS1_NOETIC", "deserialize_ros1")
    else:
        folder = path.parent if path.is_file() else path
        if not (folder / "metadata.yaml").is_file():
            raise UserError(f"{path} has no metadata.yaml beside it: run `ros2 bag reindex`")
        opened = _open_rosbag(folder, "rosbag2", "ROS2_HUMBLE", "deserialize_cdr")
    try:
        with opened as recording:
            yield recording
    except UserError:
        raise
    except Exception as error:
        # A damaged file may raise an exception of any of a dozen libraries.
        told = str(error).partition("\n")[0].strip("= ") or type(error).__name__
        raise UserError(f"the recording {path} is damaged or not complete: {told}") from error


def camera_info_of(path: Path, stream: str) -> dict[str, Any]:
    """Returns the first CameraInfo of a recording, as its fields in ROS 2.

    Args:
        path: the recording's path.
        stream: the topic, or one of its parts, such as a camera's name. If it matches no topic, it
            is ignored.

    Raises:
        UserError: there is no CameraInfo, or it is unclear which of several topics is meant.
    """
    with open_recording(path) as recording:
        topics = recording.topics(CAMERA_INFO)
        named = [topic for topic in topics if stream in (topic, *topic.split("/"))]
        if not named:
            named = [topic for topic in topics if "color" in topic.lower()] or topics
        if len(named) != 1:
            raise UserError(
                f"{path} has {len(named)} topics with a CameraInfo ({', '.join(named) or 'none'}): "
                "give stream: TOPIC"
            )
        for message in recording.messages(named):
            return camera_info_fields(message.body)
    raise UserError(f"{path} has no message on the topic {named[0]}")


def camera_info_fields(body: Any) -> dict[str, Any]:
    """Returns the fields of a CameraInfo message that a calibration needs, by their names in ROS
    2."""
    roi = body.roi
    return {
        "width": int(body.width),
        "height": int(body.height),
        "distortion_model": str(body.distortion_model),
        **{
            key: [float(item) for item in getattr(body, key, getattr(body, key.upper(), []))]
            for key in ("k", "d")
        },
        "binning_x": int(body.binning_x),
        "binning_y": int(body.binning_y),
        "roi": {key: int(getattr(roi, key)) for key in ("x_offset", "y_offset", "width", "height")},
    }


class _Rosbag(Recording):
    """A recording that is read by the package rosbags."""

    def __init__(self, path: Path, reader: Any, deserialize: Any) -> None:
        kinds = {item.topic: item.msgtype for item in reader.connections}
        super().__init__(path, kinds)
        self._reader, self._deserialize = reader, deserialize

    def messages(self, topics: Sequence[str]) -> Iterator[RecordedMessage]:
        wanted = [item for item in self._reader.connections if item.topic in topics]
        start = self._reader.start_time
        for connection, time, data in self._reader.messages(connections=wanted):
            body = self._deserialize(data, connection.msgtype)
            yield _message(connection.topic, time, start, body)


class _Mcap(Recording):
    """An MCAP file with messages of ROS 2."""

    def __init__(self, path: Path, reader: Any) -> None:
        summary = reader.get_summary()
        if summary is None or summary.statistics is None:
            raise UserError(f"{path} is not complete: repair it with `mcap recover {path.name}`")
        kinds = {}
        for channel in summary.channels.values():
            if channel.message_encoding != "cdr":
                raise UserError(
                    f"{path} has messages encoded as {channel.message_encoding}: only those of "
                    "ROS 2, encoded as cdr, can be read"
                )
            kinds[channel.topic] = summary.schemas[channel.schema_id].name
        super().__init__(path, kinds)
        self._reader, self._start = reader, summary.statistics.message_start_time

    def messages(self, topics: Sequence[str]) -> Iterator[RecordedMessage]:
        # Without topics, select a topic that does not exist: an empty list would mean all topics.
        for _, channel, message, body in self._reader.iter_decoded_messages(topics or [""]):
            yield _message(channel.topic, message.log_time, self._start, body)


def _message(topic: str, time: int, start: int, body: Any) -> RecordedMessage:
    stamp = getattr(getattr(body, "header", None), "stamp", None)
    taken = 0.0
    if stamp is not None:
        taken = stamp.sec + 1e-9 * getattr(stamp, "nanosec", getattr(stamp, "nsec", 0))
    return RecordedMessage(topic, 1e-9 * (time - start), taken or 1e-9 * time, body)


_Opened = contextlib.AbstractContextManager[Recording]


def _open_rosbag(path: Path, module: str, store: str, deserialize: str) -> _Opened:
    purpose = "reading a recording of ROS"
    rosbags = import_extra("rosbags", module, "typesys", purpose=purpose, extra="camera")
    bags, typesys = getattr(rosbags, module), rosbags.typesys
    types = typesys.get_typestore(getattr(typesys.Stores, store))

    @contextlib.contextmanager
    def opened() -> Iterator[Recording]:
        with bags.Reader(path) as reader:
            yield _Rosbag(path, reader, getattr(types, deserialize))

    return opened()


def _open_mcap(path: Path) -> _Opened:
    purpose = "reading an MCAP file"
    mcap = import_extra("mcap", "reader", purpose=purpose, extra="camera")
    mcap_ros2 = import_extra("mcap_ros2", "decoder", purpose=purpose, extra="camera")

    @contextlib.contextmanager
    def opened() -> Iterator[Recording]:
        with path.open("rb") as file:
            factories = [mcap_ros2.decoder.DecoderFactory()]
            yield _Mcap(path, mcap.reader.make_reader(file, decoder_factories=factories))

    return opened()
