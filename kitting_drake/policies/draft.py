"""A decision in progress: the networks' proposal, which the stages then refine."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

from kitting_drake.policies.data.images import Image, rotation_matrix
from kitting_drake.policies.matching.inventory import Inventory
from kitting_drake.policies.matching.jaw_clearance import RETRY_DISTANCE, failed_pixels
from kitting_drake.policies.matching.refinement import nearest_region
from kitting_drake.policies.matching.regions.segmentation import Region, Segmentation
from kitting_drake.policies.networks.factored import AnglePrediction, Networks, PlacePrediction
from kitting_drake.policies.networks.layers.correlation import Candidate
from systems.signals import (
    Observation,
    PickPlaceAction,
    PixelGrid,
    PlanarPose,
    wrap_to_pi,
)

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_NEVER = -math.inf
"""The logit of a pixel that must not be chosen."""


def network_input(
    networks: Networks, observation: Observation, resolution: float | None = None
) -> Image:
    """Prepares the networks' input, (4, rows, cols), from an observation.

    For networks that see only heights, unseen pixels are filled in. If such networks were trained
    with pixels of another size, heights are scaled by the ratio of the sizes. A scene of half the
    size, seen with pixels of half the size, then looks the same.

    Args:
        networks: networks that are prepared for inference.
        observation: the heightmap o_t.
        resolution: the side of a pixel in training, in metres; None if unknown.
    """
    if networks.config.colour:
        return observation.image
    filled = observation.filled_height
    if resolution is not None and not math.isclose(resolution, observation.grid.resolution):
        filled = filled * np.float32(resolution / observation.grid.resolution)
    return np.concatenate([observation.rgb, filled[None]])


class Look:
    """An observation, with cached results that several stages need."""

    def __init__(
        self,
        networks: Networks,
        orientations: int,
        observation: Observation,
        failed_picks: Sequence[PlanarPose],
        resolution: float | None = None,
    ) -> None:
        """
        Args:
            networks: networks that are prepared for inference.
            orientations: N, the number of orientations in a full turn.
            observation: the heightmap o_t.
            failed_picks: gripper poses at which a grasp failed before.
            resolution: the side of a pixel in training, in metres; None if unknown.
        """
        self.networks = networks
        self.orientations = orientations
        self.observation = observation
        self.failed_picks = failed_picks
        self.image = network_input(networks, observation, resolution)
        self.picking = networks.predict_pick(self.image, orientations)

    @property
    def resolution(self) -> float:
        """The side of a pixel in metres."""
        return self.observation.grid.resolution

    @cached_property
    def inventory(self) -> Inventory:
        """The objects and recesses of o_t, and the pairs of them that fit."""
        return Inventory.of(self.observation)

    @property
    def segmentation(self) -> Segmentation:
        """The segmentation of o_t by height, in which touching objects are separated."""
        return self.inventory.segmentation

    @cached_property
    def failed_pixels(self) -> Array:
        """(n, 2): the (row, col) of each failed pick."""
        return failed_pixels(self.observation.grid, self.failed_picks)

    def first_logits(self) -> Tensor:
        """Returns the logits (rows, cols) of the pick, which are -inf near failed picks."""
        logits = self.picking.position
        if not self.failed_picks:
            return logits
        return without(logits, near_failed(self.observation.grid, self.failed_picks))


class Stage(Protocol):
    """One step of the refinement of a decision. It keeps no state between decisions."""

    def refine(self, draft: Draft) -> Draft:
        """Returns the refined draft, or the same draft if the stage does not apply."""
        ...


@dataclass(frozen=True)
class Draft:
    """An action in pixels, and the predictions behind it."""

    look: Look
    stages: tuple[Stage, ...]
    """The stages that have been applied so far."""
    logits: Tensor
    """(rows, cols): the logits of the pick, -inf at pixels that must not be picked."""
    pixel: tuple[int, int]
    """(row, col) of the largest logit. The networks' crops are centred on it."""
    angles: AnglePrediction
    """The predicted distribution of the pick angle at `pixel`."""
    placing: PlacePrediction
    """The predicted placements of the object at `pixel`."""
    pick: Array
    """(row, col) of the pick, which may lie between pixels."""
    theta: float
    """The gripper's angle at the pick, in radians."""
    rotation: float
    """The object's rotation from pick to place, in radians."""
    goal: Array
    """The predicted (row, col) to which the object's point at `pixel` goes."""
    continuous: bool = False
    """Whether positions and angles are refined beyond the networks' pixels and bins."""
    outlined: bool = False
    """Whether a stage compared the outlines of object and recess."""
    grasp_cost: float | None = None
    """The cost of the grasp, see `JawGrasp.cost`; None if no feasible grasp is known."""
    fit_cost: float | None = None
    """The mean difference of the outlines of object and recess, in metres; None if they do not
    fit."""
    fitted: Array | None = None
    """(row, col) of the place at which the outlines of object and recess fit; None if they do not
    fit."""
    belongs: bool = False
    """Whether the outlines show that the object fits into the recess at the place."""
    stop: bool = False
    """Whether the policy stops: nothing is left to pick, or nothing is seen well enough."""
    reason: str = ""
    """Why the policy stops; see `PickPlaceAction.reason`."""
    mending: PickPlaceAction | None = None
    """An action of the stage `Recovery`, which replaces this draft; None if there is none."""

    @property
    def place(self) -> Array:
        """(row, col) of the place, to which the object's point at `pick` goes.

        Without a fitted place, the motion predicted for `pixel` is applied to the refined pick.
        """
        if self.fitted is not None:
            return self.fitted
        return self.goal + rotation_matrix(self.rotation) @ (self.pick - np.array(self.pixel))

    def placement(self, candidate: Candidate) -> tuple[float, Array]:
        """Returns the rotation in radians and the goal (row, col) of one of the networks'
        candidates."""
        return best_placement(candidate, self.look.orientations, self.continuous)

    def among(self, mask: Mask) -> Draft | None:
        """Returns the best pick within a mask (rows, cols), refined by `stages`; None if the mask
        leaves no pixel to pick."""
        left = without(self.logits, ~mask)
        return make_draft(self.look, left, self.stages) if is_any_left(left) else None

    @property
    def region(self) -> Region | None:
        """The object at the pick; None if there is none, or if `outlined` is false."""
        if not self.outlined:
            return None
        return nearest_region(self.look.segmentation.objects, self.pick)

    def near(self, distance: float) -> Mask:
        """(rows, cols) mask of the pixels at most `distance` metres from `pixel`."""
        rows, cols = np.indices(tuple(self.logits.shape))
        away = np.hypot(rows - self.pixel[0], cols - self.pixel[1])
        return np.asarray(away * self.look.resolution <= distance)


def make_draft(look: Look, logits: Tensor, stages: Sequence[Stage]) -> Draft:
    """Returns the networks' best action after all stages have refined it.

    Args:
        look: the observation and the networks.
        logits: (rows, cols) logits of the pick position.
        stages: the stages, in the order in which they are applied.
    """
    row, col = divmod(int(logits.argmax()), logits.shape[1])
    angles = look.picking.angle((row, col))
    placing = look.networks.predict_place(look.image, (row, col), look.orientations)
    rotation, goal = best_placement(placing.candidates[0], look.orientations, continuous=False)
    draft = Draft(
        look=look,
        stages=(),
        logits=logits,
        pixel=(row, col),
        angles=angles,
        placing=placing,
        pick=np.array([row, col], float),
        theta=int(angles.logits.argmax()) * math.tau / look.orientations,
        rotation=rotation,
        goal=goal,
    )
    for index, stage in enumerate(stages):
        draft = dataclasses.replace(stage.refine(draft), stages=tuple(stages[: index + 1]))
    return draft


def near_failed(grid: PixelGrid, failed_picks: Sequence[PlanarPose]) -> Mask:
    """Returns a mask (rows, cols) of the pixels within `RETRY_DISTANCE` of a failed pick."""
    rows, cols = np.indices(grid.shape)
    world = grid.to_world(np.stack([rows, cols], axis=-1))
    near = np.zeros(grid.shape, bool)
    for pick in failed_picks:
        near |= np.linalg.norm(world - (pick.x, pick.y), axis=-1) < RETRY_DISTANCE
    return near


def expected_position(logits: Tensor, pixel: tuple[int, int]) -> Array:
    """Returns the mean position under the softmax over a pixel and its neighbours.

    Networks trained with interpolated labels (see `losses`) predict this mean.

    Args:
        logits: (rows, cols) logits of positions.
        pixel: (row, col) of the maximum.

    Returns:
        (row, col) of the mean position.
    """
    return _local_mean(logits[None], (0, *pixel))[1:]


def best_placement(
    candidate: Candidate, orientations: int, continuous: bool
) -> tuple[float, Array]:
    """Returns a candidate's best rotation, in radians, and best position (row, col).

    If `continuous`, they are refined to less than a bin and less than a pixel.
    """
    _, rotation, row, col = candidate.best()
    found = np.array([rotation, row, col], float)
    if continuous:
        origin = np.array([candidate.first_bin, *candidate.corner])
        index = found.astype(int) - origin
        found = origin + _local_mean(candidate.scores, (index[0], index[1], index[2]))
    return wrap_to_pi(found[0] * math.tau / orientations), found[1:]


def is_any_left(logits: Tensor) -> bool:
    """Whether the logits (rows, cols) allow any pixel."""
    return bool((logits > _NEVER).any())


def without(logits: Tensor, mask: Mask) -> Tensor:
    """Returns the logits (rows, cols) with -inf at the pixels of the mask."""
    return logits.masked_fill(torch.from_numpy(mask).to(logits.device), _NEVER)


def _local_mean(logits: Tensor, index: tuple[int, int, int]) -> Array:
    """Returns the mean index (3) under the softmax over the entry at `index` and its neighbours."""
    starts = [max(i - 1, 0) for i in index]
    part = logits[
        starts[0] : index[0] + 2, starts[1] : index[1] + 2, starts[2] : index[2] + 2
    ].double()
    weights = F.softmax(part.flatten(), 0).view(part.shape).cpu().numpy()
    offsets = np.stack(np.meshgrid(*(np.arange(n) for n in part.shape), indexing="ij"))
    return np.array(starts) + (offsets * weights).sum(axis=(1, 2, 3))
