"""Recorded episodes: actions and observations, whose images may stay in a file."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from kitting_drake.common.errors import UserError
from systems.signals import Observation, PickPlaceAction, PlanarPose


@dataclass(frozen=True)
class Stored:
    """An array in a file, read whenever NumPy asks for it.

    The file stays open, so the array does not change if the file is replaced.
    """

    file: h5py.File
    dataset: str
    """The name of the dataset. The dataset is opened for each access, because an open one would
    cache its data in memory."""
    shape: tuple[int, ...]
    """The array's shape."""
    dtype: np.dtype[Any]
    """The type of the array's entries."""
    row: int | None = None
    """The row of the dataset to read; None for the whole dataset."""

    @classmethod
    def of(cls, dataset: h5py.Dataset, row: int | None = None) -> Stored:
        """Refers to a dataset, or to one row of it."""
        shape = dataset.shape if row is None else dataset.shape[1:]
        return cls(dataset.file, dataset.name, shape, dataset.dtype, row)

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> NDArray[Any]:
        """Reads the array from the file.

        Raises:
            UserError: the file can no longer be read.
        """
        try:
            values = self.file[self.dataset][() if self.row is None else self.row]
        except (OSError, LookupError, RuntimeError) as error:
            raise UserError(
                f"cannot read the demonstration {self.dataset} again, because its file is damaged: "
                "collect again"
            ) from error
        return np.asarray(values, dtype)


@dataclass(frozen=True)
class Recorded:
    """An observation with 8-bit colours, in memory or in a file."""

    rgb: NDArray[np.uint8] | Stored
    """(3, rows, cols) red, green and blue from 0 to 255."""
    height: NDArray[np.float32] | Stored
    """(rows, cols) heights in metres above `grid.z_min`."""

    @property
    def image(self) -> NDArray[np.float32]:
        """(4, rows, cols) red, green, blue in [0, 1] and height in metres, like
        `Observation.image`. It is computed at each access."""
        image = np.empty((4, *self.height.shape), np.float32)
        np.divide(np.asarray(self.rgb), 255, out=image[:3], dtype=np.float32)
        image[3] = np.asarray(self.height)
        return image


@dataclass(frozen=True)
class DemonstrationStep(Recorded):
    """One observation and the expert's action."""

    pick: PlanarPose
    place: PlanarPose
    object: str
    """The name of the picked object."""
    category: str = ""
    """The object's category; empty if the task has no categories."""

    @staticmethod
    def of(
        observation: Observation, action: PickPlaceAction, *, name: str, category: str = ""
    ) -> DemonstrationStep:
        """Makes a step from an observation, with colours rounded to 8 bits."""
        seen = record(observation)
        return DemonstrationStep(seen.rgb, seen.height, action.pick, action.place, name, category)


@dataclass(frozen=True)
class FinalObservation(Recorded):
    """The observation at which the expert had nothing left to do (`PickPlaceAction.stop`)."""

    @staticmethod
    def of(observation: Observation) -> FinalObservation:
        """Makes a final observation, with colours rounded to 8 bits."""
        seen = record(observation)
        return FinalObservation(seen.rgb, seen.height)


def record(observation: Observation) -> Recorded:
    """Makes a recorded observation, with colours rounded to 8 bits."""
    return Recorded(np.rint(observation.rgb * 255).astype(np.uint8), observation.height.copy())
