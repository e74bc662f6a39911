"""Demonstrations: an expert's episodes, as observations o_t and actions (a_pick, a_place), in one
HDF5 file.

The file's attributes are `format`, `format_version`, `first_seed`, `scenario_name` and, as JSON,
`scenario`, `grid`, `learning`, `versions` and `rejected`. Each demonstration of T steps is a group,
such as `seed_00010000`, with the attributes `seed` and `score` and the datasets

- `rgb` (T, 3, rows, cols), 8 bits, and `height` (T, rows, cols), metres: the observations,
- `pick` and `place` (T, 3), x and y in metres and theta in radians: the actions,
- `object` and `category` (T,): names of the picked object and of its category,
- `final_rgb` (3, rows, cols) and `final_height` (rows, cols): the observation with nothing left to
  do. They are absent if the episode ended before the hand was ready for another action.

A group also has the attribute `commit`, the code's commit, if the code ran from a checkout.
"""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import json
import os
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from kitting_drake.common.errors import UserError
from kitting_drake.policies.data.learning import Learning
from kitting_drake.policies.data.recorded import DemonstrationStep, FinalObservation, Stored
from systems.signals import PixelGrid, PlanarPose

FORMAT = "kitting_drake demonstrations"
FORMAT_VERSION = 2


@dataclass(frozen=True)
class Demonstration:
    """One episode of the expert."""

    seed: int
    score: float
    """The task's reward at the end, from 0 to 1."""
    steps: tuple[DemonstrationStep, ...]
    final: FinalObservation | None = None
    """The observation at the end; None if the episode ended before the hand was ready for another
    action."""
    commit: str | None = None
    """The commit of the code that ran the episode; None if unknown."""
    digest: str | None = None
    """The digest of the demonstration's group in the file; None if it was not read from a file."""


@dataclass(frozen=True)
class Rejection:
    """A seed without a demonstration, because its episode is unsuitable for learning."""

    seed: int
    score: float
    reason: str


@dataclass(frozen=True)
class Origin:
    """The scenario and the software that made demonstrations."""

    scenario_name: str
    scenario: dict[str, Any]
    """The scenario's fields as JSON values."""
    grid: PixelGrid
    first_seed: int
    """The first seed. The demonstrations have consecutive seeds from this one on, except for
    rejected seeds."""
    versions: dict[str, str]
    """Versions of the packages that made the latest demonstrations."""
    learning: Learning = field(default_factory=Learning)
    """What training may assume about the task."""


@dataclass(frozen=True)
class Demonstrations:
    """The contents of a file of demonstrations."""

    origin: Origin
    rejected: tuple[Rejection, ...]
    demonstrations: tuple[Demonstration, ...]
    """The demonstrations, in the order of their seeds."""


@dataclass(frozen=True)
class Contents:
    """The contents of a file of demonstrations, except the demonstrations themselves."""

    origin: Origin
    rejected: tuple[Rejection, ...]
    seeds: tuple[int, ...]
    commits: tuple[str, ...] = ()
    """The recorded commits of the code that made the demonstrations."""


def read_demonstrations(path: Path, first: int | None = None) -> Demonstrations:
    """Reads and checks a file of demonstrations; its images stay in the file (see `Stored`).

    Args:
        path: path of the file.
        first: number of demonstrations to read, in the order of their seeds; None for all.

    Raises:
        UserError: the file is unusable.
    """
    with _opened(path, keep=True) as file:
        contents = _contents(file)
        seeds = contents.seeds[:first]
        demonstrations = tuple(
            _read_group(file[_group_name(seed)], contents.origin.grid) for seed in seeds
        )
    return Demonstrations(contents.origin, contents.rejected, demonstrations)


def read_contents(path: Path) -> Contents:
    """Quickly reads the contents of a file, except the demonstrations themselves.

    Raises:
        UserError: the file is unusable.
    """
    with _opened(path) as file:
        return _contents(file)


def write_demonstrations(
    path: Path,
    origin: Origin,
    demonstrations: Iterable[Demonstration],
    rejected: Iterable[Rejection] = (),
) -> None:
    """Writes a file of demonstrations atomically, replacing any existing one.

    Raises:
        UserError: the file cannot be written.
    """
    with _created(path, origin, rejected) as file:
        for demonstration in demonstrations:
            _write_group(file, demonstration)


def merge_demonstrations(
    path: Path, sources: Iterable[tuple[Path, int]], origin: Origin, rejected: Iterable[Rejection]
) -> None:
    """Copies demonstrations from other files into one file, atomically.

    Args:
        path: the file; may be one of the sources.
        sources: pairs of a file and the seed of a demonstration in it.
        origin: the origin of the new file.
        rejected: the rejected seeds.

    Raises:
        UserError: a file is unusable or cannot be written.
    """
    with _created(path, origin, rejected) as file:
        for source, seed in sources:
            with _opened(source) as part:
                _copy(part, _group_name(seed), file, path)


def _copy(part: h5py.File, name: str, file: h5py.File, path: Path) -> None:
    """Copies a group. The error message names both files, because HDF5 does not say whether reading
    or writing failed."""
    try:
        part.copy(name, file)
    except (OSError, RuntimeError) as error:
        raise UserError(f"cannot copy {name} of {part.filename} to {path}: {error}") from error


def _group_name(seed: int) -> str:
    return f"seed_{seed:08d}"


@contextlib.contextmanager
def _created(path: Path, origin: Origin, rejected: Iterable[Rejection]) -> Iterator[h5py.File]:
    """Opens a new file of demonstrations, and moves it to `path` when it is complete."""
    scratch = path.with_name(f".{path.name}.scratch")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with h5py.File(scratch, "w") as file:
            file.attrs["format"] = FORMAT
            file.attrs["format_version"] = FORMAT_VERSION
            file.attrs["scenario_name"] = origin.scenario_name
            file.attrs["scenario"] = json.dumps(origin.scenario)
            file.attrs["grid"] = json.dumps(dataclasses.asdict(origin.grid))
            file.attrs["learning"] = json.dumps(dataclasses.asdict(origin.learning))
            file.attrs["first_seed"] = origin.first_seed
            file.attrs["versions"] = json.dumps(origin.versions)
            file.attrs["rejected"] = json.dumps([dataclasses.asdict(item) for item in rejected])
            yield file
        os.replace(scratch, path)
    except (OSError, RuntimeError) as error:
        # If the disk is full, HDF5 raises RuntimeError when it closes the file.
        reason = getattr(error, "strerror", None) or error
        raise UserError(f"cannot write {path}: {reason}") from error
    finally:
        scratch.unlink(missing_ok=True)


def _write_group(file: h5py.File, demonstration: Demonstration) -> None:
    steps = demonstration.steps
    group = file.create_group(_group_name(demonstration.seed))
    group.attrs["seed"] = demonstration.seed
    group.attrs["score"] = demonstration.score
    if demonstration.commit is not None:
        group.attrs["commit"] = demonstration.commit
    for name in ("rgb", "height"):
        images = np.stack([getattr(step, name) for step in steps])
        _write_images(group, name, images, chunks=(1, *images.shape[1:]))
        if demonstration.final is not None:
            image = getattr(demonstration.final, name)
            _write_images(group, f"final_{name}", image, chunks=image.shape)
    group["pick"] = np.stack([step.pick.as_array() for step in steps])
    group["place"] = np.stack([step.place.as_array() for step in steps])
    for name in ("object", "category"):
        texts = [getattr(step, name) for step in steps]
        group.create_dataset(name, data=texts, dtype=h5py.string_dtype())


def _write_images(
    group: h5py.Group, name: str, images: NDArray[Any], chunks: tuple[int, ...]
) -> None:
    group.create_dataset(
        name, data=images, chunks=chunks, compression="gzip", compression_opts=4, shuffle=True
    )


@contextlib.contextmanager
def _opened(path: Path, *, keep: bool = False) -> Iterator[h5py.File]:
    """Opens a file of demonstrations, turning any failure into a UserError.

    Args:
        path: the path of the file.
        keep: whether the file stays open as long as its datasets are in use.
    """
    if not path.is_file():
        raise UserError(f"there is no file {path}: make it with python -m kitting_drake.collect")
    foreign = (
        f"{path} is not a file of demonstrations: make one with python -m kitting_drake.collect"
    )
    try:
        if not h5py.is_hdf5(path):
            raise UserError(foreign)
        file = h5py.File(path, "r")
        with contextlib.nullcontext() if keep else file:
            if file.attrs.get("format") != FORMAT:
                raise UserError(foreign)
            version = file.attrs["format_version"]
            if version != FORMAT_VERSION:
                raise UserError(
                    f"{path} has format version {version}, but version {FORMAT_VERSION} is needed: "
                    "use the version of kitting_drake that made it, or collect again"
                )
            yield file
    except UserError:
        raise
    except PermissionError as error:
        raise UserError(f"cannot read {path}: {error.strerror}") from error
    except (OSError, LookupError, TypeError, AttributeError, ValueError, RuntimeError) as error:
        # For damaged bytes, h5py may raise any of these exceptions.
        detail = f" ({error})" if isinstance(error, (OSError, ValueError)) else ""
        raise UserError(
            f"{path} is truncated or damaged{detail}: delete it and collect again"
        ) from error


def _contents(file: h5py.File) -> Contents:
    attributes = file.attrs
    origin = Origin(
        scenario_name=str(attributes["scenario_name"]),
        scenario=json.loads(attributes["scenario"]),
        grid=PixelGrid(**json.loads(attributes["grid"])),
        first_seed=int(attributes["first_seed"]),
        versions=json.loads(attributes["versions"]),
        learning=Learning(**json.loads(attributes["learning"])),
    )
    rejected = tuple(Rejection(**item) for item in json.loads(attributes["rejected"]))
    seeds = sorted(int(group.attrs["seed"]) for group in file.values())
    commits = {str(group.attrs["commit"]) for group in file.values() if "commit" in group.attrs}
    return Contents(origin, rejected, tuple(seeds), tuple(sorted(commits)))


def _read_group(group: h5py.Group, grid: PixelGrid) -> Demonstration:
    texts = [group[name].asstr()[()] for name in ("object", "category")]
    steps = len(texts[0])
    if not steps:
        raise ValueError(f"{group.name} has no steps")
    digest = hashlib.sha256(repr([list(text) for text in texts]).encode())

    def checked(name: str, *shape: int) -> h5py.Dataset:
        return _checked(group, name, shape, digest)

    rgb, height = checked("rgb", steps, 3, *grid.shape), checked("height", steps, *grid.shape)
    actions = [checked(name, steps, 3)[()] for name in ("pick", "place")]
    final = None
    if "final_rgb" in group:
        final = FinalObservation(
            rgb=Stored.of(checked("final_rgb", 3, *grid.shape)),
            height=Stored.of(checked("final_height", *grid.shape)),
        )
    return Demonstration(
        seed=int(group.attrs["seed"]),
        score=float(group.attrs["score"]),
        steps=tuple(
            DemonstrationStep(
                rgb=Stored.of(rgb, row),
                height=Stored.of(height, row),
                pick=PlanarPose(*map(float, pick)),
                place=PlanarPose(*map(float, place)),
                object=str(name),
                category=str(category),
            )
            for row, (pick, place, name, category) in enumerate(zip(*actions, *texts, strict=True))
        ),
        final=final,
        commit=group.attrs.get("commit"),
        digest=digest.hexdigest(),
    )


def _checked(group: h5py.Group, name: str, shape: tuple[int, ...], digest: Any) -> h5py.Dataset:
    """Returns a dataset after checking its shape and that its entries are finite. Adds the
    dataset's content to a digest."""
    dataset = group[name]
    values = dataset[()]
    if values.shape != shape:
        raise ValueError(f"{group.name}/{name} must have the shape {shape}, not {values.shape}")
    if not np.isfinite(values).all():
        raise ValueError(f"{group.name}/{name} has entries that are not finite")
    digest.update(np.ascontiguousarray(values).data)
    return dataset


def content_digest(demonstrations: Iterable[Demonstration]) -> str:
    """Returns a digest of the content of demonstrations that were read from a file."""
    return hashlib.sha256(repr([(d.seed, d.digest) for d in demonstrations]).encode()).hexdigest()
