"""Demonstrations to learn from: episodes of an expert, as (o_t, a_pick, a_place), in one file.

The file is HDF5. Its attributes are `format`, `format_version`, `first_seed`, `scenario_name` and,
as JSON, `scenario`, `grid`, `learning`, `versions` and `rejected`. Each demonstration of T steps is
a group, `seed_00010000`, with the attributes `seed` and `score` and the datasets

- `rgb` (T, 3, rows, cols), 8 bits, and `height` (T, rows, cols), metres: the observations,
- `pick` and `place` (T, 3), x and y in metres and theta in radians: the actions,
- `object` and `category` (T,): what was picked,
- `final_rgb` (3, rows, cols) and `final_height` (rows, cols): what was seen when nothing was left
  to do. They are absent where the episode ended before the hand was ready for another action.

A group tells the `commit` of the code that made it too, if that was a checkout.
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
    """Share of the objects that it placed."""
    steps: tuple[DemonstrationStep, ...]
    final: FinalObservation | None = None
    """None: the episode ended before the hand was ready for another action."""
    commit: str | None = None
    """The commit of the code that ran it; None where there was no checkout, or it is not known."""
    digest: str | None = None
    """The digest of all that its group in a file holds; None where it comes from no file."""


@dataclass(frozen=True)
class Rejection:
    """A seed with which the expert did not do well enough to be learned from."""

    seed: int
    score: float
    reason: str


@dataclass(frozen=True)
class Origin:
    """Where demonstrations come from."""

    scenario_name: str
    scenario: dict[str, Any]
    """Its fields, as JSON has them."""
    grid: PixelGrid
    first_seed: int
    """Demonstrations are of the first seeds from here on that were not rejected."""
    versions: dict[str, str]
    """The versions that the last of them were made with."""
    learning: Learning = field(default_factory=Learning)
    """The assumptions that the task allows in training."""


@dataclass(frozen=True)
class Demonstrations:
    """The contents of a file."""

    origin: Origin
    rejected: tuple[Rejection, ...]
    demonstrations: tuple[Demonstration, ...]
    """In the order of their seeds."""


@dataclass(frozen=True)
class Contents:
    """The contents of a file, without the demonstrations themselves."""

    origin: Origin
    rejected: tuple[Rejection, ...]
    seeds: tuple[int, ...]
    commits: tuple[str, ...] = ()
    """The commits of the code that made them, as far as they are recorded."""


def read_demonstrations(path: Path, first: int | None = None) -> Demonstrations:
    """Reads and checks a file of demonstrations; its images stay in the file (see `Stored`).

    Args:
        path: the file.
        first: how many, in the order of their seeds; all when None.

    Raises:
        UserError: the file cannot be used.
    """
    with _opened(path, keep=True) as file:
        contents = _contents(file)
        seeds = contents.seeds[:first]
        demonstrations = tuple(
            _read_group(file[_group_name(seed)], contents.origin.grid) for seed in seeds
        )
    return Demonstrations(contents.origin, contents.rejected, demonstrations)


def read_contents(path: Path) -> Contents:
    """Reads what a file of demonstrations holds, which is quick.

    Raises:
        UserError: the file cannot be used.
    """
    with _opened(path) as file:
        return _contents(file)


def write_demonstrations(
    path: Path,
    origin: Origin,
    demonstrations: Iterable[Demonstration],
    rejected: Iterable[Rejection] = (),
) -> None:
    """Writes a file of demonstrations atomically, over any that was there.

    Raises:
        UserError: the file cannot be written.
    """
    with _created(path, origin, rejected) as file:
        for demonstration in demonstrations:
            _write_group(file, demonstration)


def merge_demonstrations(
    path: Path, sources: Iterable[tuple[Path, int]], origin: Origin, rejected: Iterable[Rejection]
) -> None:
    """Writes atomically a file of demonstrations taken as they are from other files.

    Args:
        path: the file; may be one of the others.
        sources: files, each with the seed of a demonstration that is in it.
        origin: of them all.
        rejected: seeds left out.

    Raises:
        UserError: a file cannot be used or written.
    """
    with _created(path, origin, rejected) as file:
        for source, seed in sources:
            with _opened(source) as part:
                _copy(part, _group_name(seed), file, path)


def _copy(part: h5py.File, name: str, file: h5py.File, path: Path) -> None:
    """Copies a group; where that fails, nobody knows whether it was read or written."""
    try:
        part.copy(name, file)
    except (OSError, RuntimeError) as error:
        raise UserError(f"cannot copy {name} of {part.filename} to {path}: {error}") from error


def _group_name(seed: int) -> str:
    return f"seed_{seed:08d}"


@contextlib.contextmanager
def _created(path: Path, origin: Origin, rejected: Iterable[Rejection]) -> Iterator[h5py.File]:
    """A file to write demonstrations to; it comes to its place when all is written."""
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
        # HDF5 has the second for a disk that is full when it closes the file.
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
    """A file of demonstrations to read; whatever is wrong with it becomes a UserError.

    Args:
        path: the file.
        keep: leave it open for as long as anything refers to its datasets.
    """
    if not path.is_file():
        raise UserError(f"there is no file {path}: make it by python -m kitting_drake.collect")
    foreign = f"{path} is no file of demonstrations: make one by python -m kitting_drake.collect"
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
                    f"{path} is of format version {version}, and version {FORMAT_VERSION} is what "
                    "can be read: use the kitting_drake that made it, or collect anew"
                )
            yield file
    except UserError:
        raise
    except PermissionError as error:
        raise UserError(f"cannot read {path}: {error.strerror}") from error
    except (OSError, LookupError, TypeError, AttributeError, ValueError, RuntimeError) as error:
        # h5py has all of these for bytes that make no sense.
        raise UserError(
            f"{path} is truncated or damaged: delete it and collect again ({error})"
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
        raise ValueError(f"{group.name} holds no step")
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
    """A dataset of some shape, all of whose entries are finite; it is added to a digest."""
    dataset = group[name]
    values = dataset[()]
    if values.shape != shape:
        raise ValueError(f"{group.name}/{name} is of the shape {values.shape}")
    if not np.isfinite(values).all():
        raise ValueError(f"{group.name}/{name} holds what is no number")
    digest.update(np.ascontiguousarray(values).data)
    return dataset


def content_digest(demonstrations: Iterable[Demonstration]) -> str:
    """A digest of all that is learned from demonstrations that were read from a file."""
    return hashlib.sha256(repr([(d.seed, d.digest) for d in demonstrations]).encode()).hexdigest()
