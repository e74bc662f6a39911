"""Exports frames of episodes as a LeRobotDataset v3.0, which LeRobot loads without conversion.

See docs/learning.md, and https://huggingface.co/docs/lerobot/lerobot-dataset-v3 for the format:
Parquet files of frames (`data/`) and of episodes (`meta/episodes/`), tasks (`meta/tasks.parquet`),
statistics (`meta/stats.json`) and features (`meta/info.json`). The export needs pyarrow, but
neither LeRobot nor torch.

Images are PNG inside the Parquet files: they are small, and video would be lossy. Metadata that
LeRobot does not know (seeds, scenario, versions) is in `meta/kitting_drake.json`.
"""

from __future__ import annotations

import contextlib
import io
import itertools
import json
import os
import shutil
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from kitting_drake.common.errors import UserError
from kitting_drake.common.extras import import_extra
from kitting_drake.common.files import files_digest, write_json
from kitting_drake.policies.data.frames import (
    ACTION,
    STATE,
    EpisodeFrames,
    image_key,
    read_frames,
)
from kitting_drake.policies.data.lerobot_statistics import aggregate, statistics_of

Track = Callable[[Sequence[Path]], Iterable[Path]]
"""Iterates over files and shows progress, as `rich.progress.track` does."""

_MOST_MEASURED = 50
"""The largest number of images of an episode that are used for the statistics. They are evenly
spaced."""
_MEGABYTES = 100
"""The largest size of a file of frames with several episodes, in megabytes. It is LeRobot's
default."""
_FILES_PER_CHUNK = 1000
_DATA = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
_RECORD = Path("meta", "kitting_drake.json")


def require_export(folder: Path) -> None:
    """Checks, before new demonstrations are made, that they can be exported.

    Raises:
        UserError: pyarrow is not installed, or the folder exists.
    """
    require_pyarrow()
    if folder.exists():
        raise UserError(
            f"{folder} already exists and does not contain the new demonstrations: delete it"
        )


def export_lerobot(
    sources: Sequence[Path],
    folder: Path,
    task: str,
    *,
    robot: str | None = None,
    about: dict[str, Any] | None = None,
    track: Track = iter,
) -> None:
    """Writes episodes as a LeRobotDataset, atomically. Only one episode at a time is in memory.

    A folder that already holds this export is left unchanged.

    Args:
        sources: files of `EpisodeFrames`, with equal rates, names and cameras.
        folder: the new dataset.
        task: the task as an instruction in words, which policies may read.
        robot: the robot's name; None if it is not given.
        about: further values for `meta/kitting_drake.json`.
        track: shows progress over the files.

    Raises:
        UserError: the episodes are unusable, the folder holds something else or cannot be written,
            or pyarrow is not installed.
    """
    pyarrow = require_pyarrow()
    if not sources:
        raise UserError(f"{folder}: there are no episodes to export: collect some")
    described = {"task": task, "content": files_digest(sources), **(about or {})}
    record = json.loads(json.dumps(described, default=str))
    if folder.exists():
        if _found(folder / _RECORD) == record:
            return
        raise UserError(f"{folder} exists but is not an export of these episodes: delete it")
    scratch = folder.with_name(f".{folder.name}.scratch")
    try:
        # Remove the files of a process that was killed.
        shutil.rmtree(scratch, ignore_errors=True)
        (scratch / "meta").mkdir(parents=True)
        _write(pyarrow, scratch, sources, task, robot, track)
        write_json(scratch / _RECORD, record)
        os.replace(scratch, folder)
    except OSError as error:
        raise UserError(f"cannot write {folder}: {error.strerror or error}") from error
    finally:
        shutil.rmtree(scratch, ignore_errors=True)


def features(first: EpisodeFrames) -> dict[str, dict[str, Any]]:
    """Returns the `features` of `meta/info.json`, which are the columns of a frame.

    Args:
        first: an episode, with at least one frame.
    """
    sides = ["height", "width", "channels"]
    scalars = {
        "next.reward": "float32",
        "next.success": "bool",
        "next.done": "bool",
        "timestamp": "float32",
        "frame_index": "int64",
        "episode_index": "int64",
        "index": "int64",
        "task_index": "int64",
    }
    images = {
        image_key(camera): {
            "dtype": "image",
            "shape": list(decode(pictures[0]).shape),
            "names": sides,
        }
        for camera, pictures in first.images.items()
    }
    joints = {"dtype": "float32", "shape": [len(first.names)], "names": list(first.names)}
    return {
        **images,
        STATE: joints,
        ACTION: joints,
        **{name: {"dtype": kind, "shape": [1], "names": None} for name, kind in scalars.items()},
    }


def decode(picture: bytes) -> NDArray[np.uint8]:
    """Decodes a PNG to an image (height, width, 3)."""
    return np.asarray(Image.open(io.BytesIO(picture)))


def require_pyarrow() -> ModuleType:
    return import_extra("pyarrow", "parquet", purpose="--export lerobot", extra="lerobot")


def _found(path: Path) -> Any:
    try:
        return json.loads(path.read_text())
    except (OSError, ValueError):
        return None


def _write(
    pyarrow: ModuleType,
    folder: Path,
    sources: Sequence[Path],
    task: str,
    robot: str | None,
    track: Track,
) -> None:
    first = read_frames(sources[0])
    described = features(first)
    episodes: list[dict[str, Any]] = []
    of_episodes: list[dict[str, Any]] = []
    frames = 0
    with contextlib.closing(_DataFiles(pyarrow, folder, described)) as data:
        for number, source in enumerate(track(sources)):
            read = read_frames(source)
            _check_alike(read, first, source)
            columns = _columns(read, number, frames)
            count = len(read)
            chunk, file = data.write(columns)
            statistics = _statistics(columns, described)
            episode = {
                "episode_index": number,
                "tasks": [task],
                "length": count,
                "data/chunk_index": chunk,
                "data/file_index": file,
                "dataset_from_index": frames,
                "dataset_to_index": frames + count,
                "meta/episodes/chunk_index": 0,
                "meta/episodes/file_index": 0,
            }
            for name, of_feature in statistics.items():
                for key, value in of_feature.items():
                    episode[f"stats/{name}/{key}"] = value.tolist()
            episodes.append(episode)
            of_episodes.append(statistics)
            frames += count
    path = folder / "meta" / "episodes" / "chunk-000" / "file-000.parquet"
    path.parent.mkdir(parents=True)
    pyarrow.parquet.write_table(pyarrow.Table.from_pylist(episodes), path)
    _write_tasks(pyarrow, folder / "meta" / "tasks.parquet", task)
    aggregated = {
        name: aggregate([statistics[name] for statistics in of_episodes]) for name in of_episodes[0]
    }
    write_json(folder / "meta" / "stats.json", aggregated)
    info = {
        "codebase_version": "v3.0",
        "robot_type": robot,
        "total_episodes": len(episodes),
        "total_frames": frames,
        "total_tasks": 1,
        "chunks_size": _FILES_PER_CHUNK,
        "data_files_size_in_mb": _MEGABYTES,
        "video_files_size_in_mb": 200,
        "fps": first.fps,
        "splits": {"train": f"0:{len(episodes)}"},
        "data_path": _DATA,
        "video_path": None,
        "features": described,
    }
    write_json(folder / "meta" / "info.json", info)


def _check_alike(read: EpisodeFrames, first: EpisodeFrames, source: Path) -> None:
    for name in ("fps", "names"):
        if getattr(read, name) != getattr(first, name):
            raise UserError(
                f"{source}: {name} is {getattr(read, name)}, but {getattr(first, name)} in the "
                "first episode: export only episodes with the same settings"
            )
    if list(read.images) != list(first.images) or not len(read):
        raise UserError(
            f"{source}: it has {len(read)} frames from {_cameras_of(read)}, but the first episode "
            f"has {len(first)} from {_cameras_of(first)}: export only episodes with at least one "
            "frame and the same settings"
        )


def _cameras_of(episode: EpisodeFrames) -> str:
    return ", ".join(episode.images) or "no camera"


def _statistics(
    columns: dict[str, Any], described: dict[str, dict[str, Any]]
) -> dict[str, dict[str, NDArray[Any]]]:
    found = {}
    for name, feature in described.items():
        values = columns[name]
        if image := feature["dtype"] == "image":
            chosen = np.linspace(0, len(values) - 1, min(len(values), _MOST_MEASURED)).astype(int)
            values = np.stack([decode(values[index]) for index in chosen])
        found[name] = statistics_of(values, image=image)
    return found


def _write_tasks(pyarrow: ModuleType, path: Path, task: str) -> None:
    """Writes the table of tasks in the form of a pandas table, with the task as index."""
    table = pyarrow.table({"task_index": pyarrow.array([0], pyarrow.int64()), "task": [task]})
    column = {"metadata": None, "pandas_type": "int64", "numpy_type": "int64"}
    text = {"metadata": None, "pandas_type": "unicode", "numpy_type": "object"}
    described = {
        "index_columns": ["task"],
        "column_indexes": [],
        "columns": [
            {"name": "task_index", "field_name": "task_index", **column},
            {"name": "task", "field_name": "task", **text},
        ],
        "creator": {"library": "pyarrow", "version": pyarrow.__version__},
        "pandas_version": "2.0.0",
    }
    pyarrow.parquet.write_table(
        table.replace_schema_metadata({"pandas": json.dumps(described)}), path
    )


def _columns(read: EpisodeFrames, number: int, first: int) -> dict[str, Any]:
    """Returns an episode's frames as one column for each feature.

    Args:
        read: the episode.
        number: index of the episode.
        first: index of the episode's first frame in the dataset.
    """
    frame = np.arange(len(read))
    return {
        **{image_key(camera): pictures for camera, pictures in read.images.items()},
        STATE: read.state,
        ACTION: read.action,
        "next.reward": read.reward,
        "next.success": read.success,
        "next.done": frame == len(read) - 1,
        "timestamp": (frame / read.fps).astype(np.float32),
        "frame_index": frame,
        "episode_index": np.full(len(read), number),
        "index": first + frame,
        "task_index": np.zeros(len(read), np.int64),
    }


class _DataFiles:
    """Writes the files of `data/`, with one Parquet row group per episode."""

    def __init__(self, pyarrow: ModuleType, folder: Path, described: dict[str, Any]) -> None:
        self._pyarrow = pyarrow
        self._folder = folder
        self._described = described
        kinds = {name: self._type(feature) for name, feature in described.items()}
        # The package `datasets` recognizes image columns by the schema's metadata.
        named = {name: _hugging_face(feature) for name, feature in described.items()}
        metadata = {"huggingface": json.dumps({"info": {"features": named}})}
        self._schema = pyarrow.schema(kinds, metadata=metadata)
        self._numbers = itertools.count()
        self._writer: Any = None
        self._place = (0, 0)
        self._bytes = 0

    def write(self, columns: dict[str, Any]) -> tuple[int, int]:
        """Writes an episode and returns its chunk and file numbers."""
        values = {name: self._encoded(name, columns[name]) for name in self._described}
        table = self._pyarrow.table(values, schema=self._schema)
        if not self._writer or self._bytes + table.nbytes > _MEGABYTES * 2**20:
            self._begin()
        self._writer.write_table(table)
        self._bytes += table.nbytes
        return self._place

    def close(self) -> None:
        """Closes the current file."""
        if self._writer:
            self._writer.close()

    def _begin(self) -> None:
        self.close()
        chunk, file = self._place = divmod(next(self._numbers), _FILES_PER_CHUNK)
        path = self._folder / _DATA.format(chunk_index=chunk, file_index=file)
        path.parent.mkdir(parents=True, exist_ok=True)
        self._writer = self._pyarrow.parquet.ParquetWriter(path, self._schema)
        self._bytes = 0

    def _type(self, feature: dict[str, Any]) -> Any:
        if feature["dtype"] == "image":
            return self._pyarrow.struct(
                {"bytes": self._pyarrow.binary(), "path": self._pyarrow.string()}
            )
        kind = self._pyarrow.type_for_alias(feature["dtype"])
        (size,) = feature["shape"]
        return kind if size == 1 else self._pyarrow.list_(kind, size)

    def _encoded(self, name: str, values: Any) -> Any:
        if self._described[name]["dtype"] == "image":
            return [{"bytes": picture, "path": None} for picture in values]
        return list(values)


def _hugging_face(feature: dict[str, Any]) -> dict[str, Any]:
    """Returns a feature in the format of the package `datasets`."""
    if feature["dtype"] == "image":
        return {"_type": "Image"}
    value = {"dtype": feature["dtype"], "_type": "Value"}
    (size,) = feature["shape"]
    return value if size == 1 else {"feature": value, "length": size, "_type": "Sequence"}
