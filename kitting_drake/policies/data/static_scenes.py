"""Reads and writes files of static scenes, and draws training samples from them (see
`static_scenes.drawing`).

The file is HDF5, with the attributes `format`, `format_version`, `first_seed` and, as JSON, `grid`
and `versions`, and these datasets for n scenes with m actions in all:

- `height` (n, rows, cols), uint16, steps of 0.1 mm above `grid.z_min`: o_t, with unseen pixels
  filled in (`Observation.filled_height`);
- `actions` (m, 8): index of the object, cost of the grasp, pick x, y, theta, place x, y, theta, in
  metres and radians;
- `first` (n + 1,): scene i has the actions from `first[i]` up to but not including `first[i + 1]`.
  In a scene without actions nothing is left to pick;
- `batch_ends` (b,): the number of scenes up to the end of each batch. Scenes share tools only
  within a batch. Older files lack this dataset.
"""

from __future__ import annotations

import dataclasses
import hashlib
import io
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, overload

import h5py
import numpy as np
from numpy.typing import NDArray

from kitting_drake.common.errors import UserError
from kitting_drake.common.files import write_atomically
from kitting_drake.policies.data.images import LabelledImage
from systems.signals import Observation, PixelGrid

STATIC = "static scenes"
"""The scenario name in the card of weights trained on static scenes."""

FORMAT = "kitting_drake static scenes"
FORMAT_VERSION = 1

_STEP = 1e-4
"""The quantization step of the stored heights, in metres."""
_TEMPERATURE = 0.6
"""A grasp is drawn with a probability proportional to exp(-cost / temperature)."""
_HEIGHT_SHIFT = 0.002
"""The standard deviation of the random shift that is added to all heights of a sample, in
metres."""
_DRAWS = 64
"""The number of samples per scene, each with its own random grasps."""


@dataclass(frozen=True)
class StaticScene:
    """One observed scene."""

    height: NDArray[np.uint16]
    """(rows, cols) heights above `grid.z_min`, in steps of 0.1 mm."""
    actions: NDArray[np.float64]
    """(m, 8) the scene's actions, one in each row; for the columns see the module's docstring."""

    @classmethod
    def of(cls, observation: Observation, actions: NDArray[np.float64]) -> StaticScene:
        """Makes a static scene from an observation and the scene's possible actions."""
        filled = observation.filled_height
        steps = np.clip(np.rint(filled / _STEP), 0, 65535)
        return cls(steps.astype(np.uint16), actions)

    @property
    def image(self) -> NDArray[np.float32]:
        """(4, rows, cols) image like `Observation.image`, with black colours."""
        image = np.zeros((4, *self.height.shape), np.float32)
        image[3] = self.height * np.float32(_STEP)
        return image

    def label(self, image: NDArray[np.float32], row: int, grid: PixelGrid) -> LabelledImage:
        """Returns an image labelled with the action in one row of `actions`."""
        _, _, x, y, theta, place_x, place_y, place_theta = self.actions[row]
        return LabelledImage(
            image=image,
            pick=grid.to_pixel((x, y)),
            pick_theta=float(theta),
            place=grid.to_pixel((place_x, place_y)),
            rotation=float(place_theta - theta),
        )


@dataclass(frozen=True)
class StaticScenes:
    """The contents of a file of static scenes."""

    grid: PixelGrid
    scenes: tuple[StaticScene, ...]
    first_seed: int = 0
    versions: dict[str, Any] = dataclasses.field(default_factory=dict)
    batch_ends: tuple[int, ...] = ()
    """The number of scenes up to the end of each batch; by default all scenes are one batch."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "batch_ends", self.batch_ends or (len(self.scenes),))

    def part(self, first: int, last: int) -> StaticScenes:
        """Returns the scenes from index `first` up to but not including `last`."""
        scenes = self.scenes[first:last]
        inside = (end - first for end in self.batch_ends if first < end < first + len(scenes))
        return dataclasses.replace(self, scenes=scenes, batch_ends=(*inside, len(scenes)))

    def digest(self) -> str:
        """Returns a digest of all heights and actions."""
        found = hashlib.sha256()
        for scene in self.scenes:
            found.update(np.ascontiguousarray(scene.height).tobytes())
            found.update(np.ascontiguousarray(scene.actions, np.float64).tobytes())
        return found.hexdigest()


def write_static_scenes(path: Path, content: StaticScenes) -> None:
    """Writes a file atomically.

    Raises:
        MachineError: the file cannot be written.
    """
    counts = [len(scene.actions) for scene in content.scenes]
    # Build the file in memory, because HDF5 crashes when the disk is full.
    data = io.BytesIO()
    with h5py.File(data, "w") as file:
        file.attrs["format"], file.attrs["format_version"] = FORMAT, FORMAT_VERSION
        file.attrs["first_seed"] = content.first_seed
        file.attrs["grid"] = json.dumps(dataclasses.asdict(content.grid))
        file.attrs["versions"] = json.dumps(content.versions)
        heights = np.array([scene.height for scene in content.scenes], np.uint16)
        heights = heights.reshape(-1, *content.grid.shape)
        # HDF5 cannot store an empty dataset in chunks.
        packed: dict[str, Any] = {"chunks": (1, *content.grid.shape), "compression": "gzip"}
        file.create_dataset("height", data=heights, **(packed if len(heights) else {}))
        file["actions"] = np.concatenate([np.zeros((0, 8)), *(s.actions for s in content.scenes)])
        file["first"] = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
        file["batch_ends"] = np.array(content.batch_ends, np.int64)
    write_atomically(path, data.getvalue())


def is_static_scenes(path: Path) -> bool:
    """Whether a file holds static scenes."""
    try:
        with h5py.File(path) as file:
            return file.attrs.get("format") == FORMAT
    except OSError:
        return False


def read_static_scenes(path: Path) -> StaticScenes:
    """Reads a file of static scenes.

    Raises:
        UserError: the file is unreadable or not a file of static scenes.
    """
    try:
        with h5py.File(path) as file:
            if file.attrs.get("format") != FORMAT:
                raise UserError(
                    "not a file of static scenes: make one with python -m kitting_drake.draw_scenes"
                )
            version = file.attrs["format_version"]
            if version != FORMAT_VERSION:
                raise UserError(
                    f"the format version is {version}, but version {FORMAT_VERSION} is needed: "
                    "draw the scenes again"
                )
            grid = PixelGrid(**json.loads(file.attrs["grid"]))
            heights, actions, first = (file[key][()] for key in ("height", "actions", "first"))
            _check(heights, actions, first, grid)
            scenes = tuple(
                StaticScene(height, actions[first[i] : first[i + 1]])
                for i, height in enumerate(heights)
            )
            seed, versions = int(file.attrs["first_seed"]), json.loads(file.attrs["versions"])
            ends = file["batch_ends"][()] if "batch_ends" in file else np.array([len(scenes)])
            _check_batches(ends, len(scenes))
    except (OSError, LookupError, ValueError, TypeError, AttributeError, RuntimeError) as error:
        # For damaged bytes, h5py may raise any of these exceptions.
        reason = error if isinstance(error, (OSError, ValueError)) else "it is damaged"
        raise UserError(f"cannot read {path}: {reason}") from error
    return StaticScenes(grid, scenes, seed, versions, tuple(ends.tolist()))


def _check(heights: NDArray, actions: NDArray, first: NDArray, grid: PixelGrid) -> None:
    """Raises ValueError if the contents are inconsistent."""
    if heights.shape[1:] != grid.shape or heights.dtype != np.uint16:
        rows, cols = grid.shape
        raise ValueError(
            f"`height` must be uint16 with the shape (scenes, {rows}, {cols}), but is "
            f"{heights.dtype} with the shape {heights.shape}"
        )
    if actions.ndim != 2 or actions.shape[1] != 8 or not np.isfinite(actions).all():
        raise ValueError(
            f"`actions` must be rows of 8 finite numbers, but has the shape {actions.shape}"
        )
    bounds = first.shape == (len(heights) + 1,) and first.dtype.kind in "iu"
    if not bounds or first[0] != 0 or first[-1] != len(actions) or (np.diff(first) < 0).any():
        raise ValueError(
            f"`first` must be {len(heights) + 1} integers that begin with 0, never "
            f"decrease, and end with the number of actions, {len(actions)}"
        )


def _check_batches(ends: NDArray, count: int) -> None:
    """Raises ValueError unless `ends` divides the scenes into batches."""
    whole = ends.ndim == 1 and ends.dtype.kind in "iu" and len(ends) > 0
    if not whole or ends[-1] != count or (np.diff(ends) <= 0).any():
        raise ValueError(
            f"`batch_ends` must be increasing integers that end with the number of scenes, {count}"
        )


class StaticSamples(Sequence[LabelledImage]):
    """Samples drawn from static scenes on demand.

    A sample has one grasp of each loose object. Grasps with a lower cost are drawn more often. Over
    many samples a network learns the distribution of all feasible grasps.
    """

    def __init__(self, content: StaticScenes) -> None:
        self._grid = content.grid
        self._scenes = [scene for scene in content.scenes if len(scene.actions)]

    def __len__(self) -> int:
        return len(self._scenes) * _DRAWS

    @overload
    def __getitem__(self, index: int) -> LabelledImage: ...

    @overload
    def __getitem__(self, index: slice) -> Sequence[LabelledImage]: ...

    def __getitem__(self, index: int | slice) -> LabelledImage | Sequence[LabelledImage]:
        if isinstance(index, slice):
            return [self[i] for i in range(*index.indices(len(self)))]
        index = range(len(self))[index]
        scene = self._scenes[index % len(self._scenes)]
        random = np.random.default_rng(index)
        image = scene.image
        image[3] = np.maximum(image[3] + np.float32(random.normal(0, _HEIGHT_SHIFT)), 0)
        objects = np.unique(scene.actions[:, 0])
        labels = []
        for number in random.permutation(objects):
            rows = np.flatnonzero(scene.actions[:, 0] == number)
            odds = np.exp(-scene.actions[rows, 1] / _TEMPERATURE)
            row = int(random.choice(rows, p=odds / odds.sum()))
            labels.append(scene.label(image, row, self._grid))
        return dataclasses.replace(
            labels[0],
            other_picks=np.array([label.pick for label in labels[1:]]).reshape(-1, 2),
            other_thetas=np.array([label.pick_theta for label in labels[1:]]),
        )
