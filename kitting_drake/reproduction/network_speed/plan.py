"""The plan, the machine and the observation that all network measurements share."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Hashable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from kitting_drake.common.errors import UserError
from kitting_drake.policies.data.demonstrations import read_demonstrations
from kitting_drake.policies.data.images import Image, crop, rotation_matrix
from kitting_drake.policies.data.recorded import record
from kitting_drake.policies.data.samples import ObservedScene, scenes
from kitting_drake.policies.networks import architecture as sizes
from kitting_drake.policies.networks.architecture import PRESETS
from kitting_drake.policies.networks.device import preferred_type
from kitting_drake.policies.networks.factored import Networks
from kitting_drake.policies.networks.weights import load_networks, save_weights
from kitting_drake.reproduction.network_speed.timing import (
    Timing,
    count_operations,
    memory_bytes,
    time_each,
)
from systems.signals import Observation, PickPlaceAction, PixelGrid, PlanarPose

_EXPECTED_SHARE = 0.3
"""Predicted times assume that the networks reach this share of the machine's peak rate."""


@dataclass(frozen=True)
class Plan:
    """The measurements to make, and the number of their repeats."""

    preset: str = "small"
    compared_preset: str | None = "paper"
    """Another preset, for which only the models of the pick angle are measured."""
    orientations: tuple[int, ...] = (36, 72, 120, 180)
    """The values of N in section V-B.1 of the paper."""
    finer: int = 720
    """An additional N for the SO(2) method."""
    repeats: int = 9
    """The number of timings for each median."""
    peak_side: int = 2048
    """The side of the matrices whose product gives the peak rate. On an accelerator it is four
    times as long."""
    budget: float = 60.0
    """The time in seconds after which a function is not run again. A function is skipped if one run
    is expected to take longer."""
    demonstrations: Path | None = None
    """The file from which to take the observation; None for a synthetic one."""

    def __post_init__(self) -> None:
        if self.preset not in PRESETS:
            raise UserError(f"--preset must be one of {', '.join(PRESETS)}, not '{self.preset}'")


@dataclass
class SpeedSetup:
    """The plan, the machine and the observation of all measurements."""

    plan: Plan
    device: torch.device
    folder: Path
    """The folder for the weights of exported networks."""
    scene: ObservedScene
    peak: dict[torch.dtype, dict[str, float]] = field(default_factory=dict)
    """The results of `measure_peak`, by type."""
    _counts: dict[Hashable, int] = field(default_factory=dict, init=False)

    def __post_init__(self) -> None:
        self.image: Image = self.scene.recorded.image
        row, col = np.rint(self.scene.targets[0].pick).astype(int)
        # Store the pixel, because `targets` decodes the image, which must not be timed.
        self.pixel = int(row), int(col)
        """The (row, col) of the expert's pick."""

    def observe(self) -> Observation:
        """Returns the observation of the timed decisions."""
        return Observation(self.image, self.scene.grid)

    def time_each(
        self, functions: dict[Any, Callable[[], object]], *, training: bool = False
    ) -> dict[Any, Timing]:
        """Times functions by `timing.time_each`, with the plan's repeats and budget."""
        plan = self.plan
        with torch.inference_mode(not training):
            return time_each(functions, self.device, repeats=plan.repeats, budget=plan.budget)

    def inputs(self, networks: Networks) -> dict[str, Tensor]:
        """Returns the input of each network."""
        scene = networks.prepare(self.image)
        return {
            "alpha": scene,
            "phi": scene,
            "psi": networks.prepare(crop(self.image, self.pixel, sizes.PLACE_CROP)),
            "beta": networks.prepare(crop(self.image, self.pixel, sizes.PICK_CROP)),
        }

    def export(self, networks: Networks, type_: torch.dtype) -> Networks:
        """Saves networks and loads them as plain convolutions, as in an evaluation."""
        path = self.folder / "networks.safetensors"
        save_weights(path, networks, {})
        return load_networks(path, type_).to(self.device)

    def count(self, key: Hashable, function: Callable[[], object]) -> int:
        """Counts operations by `timing.count_operations`, once for each key."""
        if key not in self._counts:
            self._counts[key] = count_operations(function)
        return self._counts[key]

    def why_not(self, outlined: Networks, operations: int) -> str | None:
        """Returns the reason to skip a measurement; None to run it.

        Args:
            outlined: the networks, on the meta device.
            operations: the number of operations of one run.
        """
        seconds = operations / (_EXPECTED_SHARE * self.peak[preferred_type()]["best"])
        if seconds > self.plan.budget:
            return f"not run: ~{seconds:.0f} s"
        size = 4 * sum(weight.numel() for weight in outlined.parameters())
        if size > memory_bytes(self.device) / 2:
            return f"not run: needs {size / 2**30:.0f} GiB"
        return None


def times_of(timing: Timing | None) -> dict[str, Any]:
    """Returns a timing in the format of the results."""
    return dataclasses.asdict(timing) if timing else {"seconds": None}


def type_name(type_: torch.dtype) -> str:
    """Returns a type's name in the format of the results, for example `float32`."""
    return str(type_).removeprefix("torch.")


def observed_scene(path: Path | None) -> ObservedScene:
    """Returns the first observation of a file of demonstrations, or a synthetic one.

    Raises:
        UserError: the demonstrations are unusable.
    """
    if path is None:
        return synthetic_scene(PixelGrid())
    demonstrations = read_demonstrations(path, 1)
    grid = demonstrations.origin.grid
    observed = scenes(demonstrations.demonstrations, grid, later_picks_possible=True)
    if not observed:
        raise UserError(f"{path} has no demonstrations")
    return observed[0]


def synthetic_scene(grid: PixelGrid) -> ObservedScene:
    """Returns a scene with four bars on a table, and a block with a recess for each bar."""
    random = np.random.default_rng(0)
    pixel = np.stack(np.meshgrid(np.arange(grid.rows), np.arange(grid.cols), indexing="ij"), -1)
    image = np.full((4, *grid.shape), 0.4, np.float32)
    image[3] = 0.0

    def bar(middle: NDArray[np.float64], angle: float, length: float, width: float) -> Any:
        """Returns the mask (rows, cols) of a bar. Lengths are in metres. At angle 0 the bar extends
        along the row index."""
        along, across = np.moveaxis(np.abs((pixel - middle) @ rotation_matrix(angle)), -1, 0)
        half = 0.5 * np.array([length, width]) / grid.resolution
        return (along <= half[0]) & (across <= half[1])

    rows, cols = grid.shape
    middle = np.array([0.5 * rows, 0.25 * cols])
    block = bar(middle, 0.0, 0.26, 0.28)
    image[:3, block], image[3, block] = 0.6, 0.05
    actions = []
    for index in range(4):
        pick = np.array([(0.2 + 0.2 * index) * rows, 0.75 * cols])
        place = middle + (0.0, (index - 1.5) * 0.06 / grid.resolution)
        theta = float(random.uniform(0.3, 1.2))
        hole, tool = bar(place, 0.0, 0.17, 0.03), bar(pick, theta, 0.17, 0.025)
        image[3, hole] = 0.03
        image[:3, tool] = random.uniform(0.1, 0.9, (3, 1))
        image[3, tool] = 0.02
        (pick_x, pick_y), (place_x, place_y) = grid.to_world([pick, place])
        actions.append(
            PickPlaceAction(PlanarPose(pick_x, pick_y, theta), PlanarPose(place_x, place_y, 0.0))
        )
    return ObservedScene(record(Observation(image, grid)), tuple(actions), grid)
