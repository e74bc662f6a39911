"""Demonstrations as a LeRobotDataset v3.0, which LeRobot loads without conversion.

See docs/learning.md, and https://huggingface.co/docs/lerobot/lerobot-dataset-v3 for the format:
Parquet files of frames (`data/`) and of episodes (`meta/episodes/`), tasks (`meta/tasks.parquet`),
statistics (`meta/stats.json`) and features (`meta/info.json`). The export needs pyarrow, but
neither LeRobot nor torch.

A demonstration is an episode. A frame is a decision, one pick and one place, rather than a time
step. Colours are PNG and heights are TIFF of float32, both inside the Parquet files, because video
compression would be lossy. Metadata that LeRobot does not know (grid, seeds, scenario, versions) is
in `meta/kitting_drake.json`.
"""

from __future__ import annotations

import contextlib
import dataclasses
import io
import itertools
import json
import os
import re
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
from kitting_drake.common.files import write_json
from kitting_drake.policies.data.demonstrations import (
    Demonstration,
    Demonstrations,
    Origin,
    content_digest,
    read_demonstrations,
)
from kitting_drake.policies.data.lerobot_statistics import aggregate, statistics_of
from systems.signals import PixelGrid

ACTION = ("pick_x", "pick_y", "pick_theta", "place_x", "place_y", "place_theta", "stop")
"""The entries of an action as in the Gymnasium environments (`kitting_drake.gym.spaces`): gripper
poses in the world, in metres and radians, and whether to stop instead (0 or 1)."""

COLOUR = "observation.images.colour"
HEIGHT = "observation.images.height"

Track = Callable[[Sequence[Demonstration]], Iterable[Demonstration]]
"""Iterates over demonstrations and shows progress, as `rich.progress.track` does."""

FPS = 1
"""Decisions per second. It is nominal, because LeRobot requires a value: `timestamp` counts
decisions."""

_MEGABYTES = 100
"""The largest size of a file of frames, LeRobot's default; the next episode begins a new file."""
_FILES_PER_CHUNK = 1000
_DATA = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
_RECORD = Path("meta", "kitting_drake.json")


def require_export(folder: Path) -> None:
    """Checks before new demonstrations are made that they can be exported.

    Raises:
        UserError: pyarrow is not installed, or the folder exists.
    """
    require_pyarrow()
    if folder.exists():
        raise UserError(f"{folder} already exists, without the new demonstrations: delete it")


def export_lerobot(
    source: Path, folder: Path, task: str | None = None, *, track: Track = iter
) -> None:
    """Writes demonstrations as a LeRobotDataset, episode by episode, atomically.

    A folder that already holds this export is left unchanged.

    Args:
        source: a file of demonstrations, from `collect` or `demonstrate`.
        folder: the new dataset.
        task: the instruction to policies, in words; None for the name of the scenario's task.
        track: shows progress over the demonstrations.

    Raises:
        UserError: the demonstrations are unusable, the folder holds something else or cannot be
            written, or pyarrow is not installed.
    """
    pyarrow = require_pyarrow()
    read = read_demonstrations(source)
    if not read.demonstrations:
        raise UserError(f"{source} holds no demonstrations: collect some")
    task = task or _task(read.origin)
    record = _record(read, task)
    if folder.exists():
        if _found(folder / _RECORD) == record:
            return
        raise UserError(f"{folder} exists but is not an export of the current {source}: delete it")
    scratch = folder.with_name(f".{folder.name}.scratch")
    try:
        # Remove what a killed process left.
        shutil.rmtree(scratch, ignore_errors=True)
        (scratch / "meta").mkdir(parents=True)
        _write(pyarrow, scratch, read, task, track)
        write_json(scratch / _RECORD, record)
        os.replace(scratch, folder)
    except OSError as error:
        raise UserError(f"cannot write {folder}: {error.strerror or error}") from error
    finally:
        shutil.rmtree(scratch, ignore_errors=True)


def features(grid: PixelGrid) -> dict[str, dict[str, Any]]:
    """The `features` of `meta/info.json`, which are the columns of a frame."""
    sides = ["height", "width", "channels"]
    scalars = {
        "object": "string",
        "category": "string",
        "next.done": "bool",
        "timestamp": "float32",
        "frame_index": "int64",
        "episode_index": "int64",
        "index": "int64",
        "task_index": "int64",
    }
    # LeRobot treats a single channel of metric values as a depth map. These are heights above
    # `grid.z_min`, not depths below a camera.
    height = {"is_depth_map": True, "depth_unit": "m"}
    return {
        COLOUR: {"dtype": "image", "shape": [*grid.shape, 3], "names": sides},
        HEIGHT: {"dtype": "image", "shape": [*grid.shape, 1], "names": sides, "info": height},
        "action": {"dtype": "float32", "shape": [len(ACTION)], "names": list(ACTION)},
        **{name: {"dtype": kind, "shape": [1], "names": None} for name, kind in scalars.items()},
    }


def require_pyarrow() -> ModuleType:
    return import_extra("pyarrow", "parquet", purpose="--export lerobot", extra="lerobot")


def _task(origin: Origin) -> str:
    """The task's name in words: `stack block pyramid` for `!StackBlockPyramid`."""
    task = origin.scenario.get("task", origin.scenario_name)
    name = str(task["_tag"] if isinstance(task, dict) else task)
    return re.sub(r"(?<=[a-z])(?=[A-Z])", " ", name.lstrip("!")).lower()


def _record(read: Demonstrations, task: str) -> dict[str, Any]:
    origin = dataclasses.asdict(read.origin)
    described = {
        "task": task,
        "episode_seeds": [item.seed for item in read.demonstrations],
        "content": content_digest(read.demonstrations),
        **origin,
    }
    return json.loads(json.dumps(described, default=str))


def _found(path: Path) -> Any:
    try:
        return json.loads(path.read_text())
    except (OSError, ValueError):
        return None


def _write(
    pyarrow: ModuleType, folder: Path, read: Demonstrations, task: str, track: Track
) -> None:
    described = features(read.origin.grid)
    episodes: list[dict[str, Any]] = []
    of_episodes: list[dict[str, Any]] = []
    frames = 0
    with contextlib.closing(_DataFiles(pyarrow, folder, described)) as data:
        for number, demonstration in enumerate(track(read.demonstrations)):
            columns = _columns(demonstration, number, frames)
            count = len(columns["index"])
            chunk, file = data.write(columns)
            statistics = {
                name: statistics_of(columns[name], image=described[name]["dtype"] == "image")
                for name in described
                if described[name]["dtype"] != "string"
            }
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
        "robot_type": None,
        "total_episodes": len(episodes),
        "total_frames": frames,
        "total_tasks": 1,
        "chunks_size": _FILES_PER_CHUNK,
        "data_files_size_in_mb": _MEGABYTES,
        "video_files_size_in_mb": 200,
        "fps": FPS,
        "splits": {"train": f"0:{len(episodes)}"},
        "data_path": _DATA,
        "video_path": None,
        "features": described,
    }
    write_json(folder / "meta" / "info.json", info)


def _write_tasks(pyarrow: ModuleType, path: Path, task: str) -> None:
    """Writes the tasks as a pandas table, which LeRobot indexes by task."""
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


def _columns(demonstration: Demonstration, number: int, first: int) -> dict[str, Any]:
    """An episode's frames by feature: one per step, and one for the final observation.

    The final frame is labelled stop and repeats the last step's poses, which keeps placeholders out
    of the statistics.

    Args:
        demonstration: the episode; without a final observation it has no stop frame.
        number: the episode's index.
        first: the index of its first frame.
    """
    steps, final = demonstration.steps, demonstration.final
    seen = [*steps, *([final] if final else [])]
    poses = np.array([[*step.pick.as_array(), *step.place.as_array()] for step in steps])
    action = np.zeros((len(seen), len(ACTION)), np.float32)
    action[: len(steps), :-1] = poses
    action[len(steps) :, :-1] = poses[-1]
    action[len(steps) :, -1] = 1.0
    frame = np.arange(len(seen))
    nothing = [""] * (len(seen) - len(steps))
    return {
        COLOUR: np.stack([np.moveaxis(np.asarray(item.rgb), 0, -1) for item in seen]),
        HEIGHT: np.stack([np.asarray(item.height)[..., None] for item in seen]),
        "action": action,
        "object": [*(step.object for step in steps), *nothing],
        "category": [*(step.category for step in steps), *nothing],
        "next.done": frame == len(seen) - 1,
        "timestamp": (frame / FPS).astype(np.float32),
        "frame_index": frame,
        "episode_index": np.full(len(seen), number),
        "index": first + frame,
        "task_index": np.zeros(len(seen), np.int64),
    }


class _DataFiles:
    """The files of `data/`, with one row group per episode."""

    def __init__(self, pyarrow: ModuleType, folder: Path, described: dict[str, Any]) -> None:
        self._pyarrow = pyarrow
        self._folder = folder
        self._described = described
        kinds = {name: self._type(feature) for name, feature in described.items()}
        # The package datasets recognizes image columns by the schema's metadata.
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
            encode = _tiff if self._described[name]["shape"][-1] == 1 else _png
            return [{"bytes": encode(image), "path": None} for image in values]
        return list(values)


def _png(image: NDArray[np.uint8]) -> bytes:
    content = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(image)).save(content, "PNG")
    return content.getvalue()


def _tiff(image: NDArray[np.float32]) -> bytes:
    content = io.BytesIO()
    Image.fromarray(image[..., 0]).save(content, "TIFF", compression="tiff_adobe_deflate")
    return content.getvalue()


def _hugging_face(feature: dict[str, Any]) -> dict[str, Any]:
    """A feature in the format of the package datasets."""
    if feature["dtype"] == "image":
        return {"_type": "Image"}
    value = {"dtype": feature["dtype"], "_type": "Value"}
    (size,) = feature["shape"]
    return value if size == 1 else {"feature": value, "length": size, "_type": "Sequence"}
