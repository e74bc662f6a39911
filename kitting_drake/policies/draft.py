"""A decision in the making: what the networks propose, and what later stages have made of it."""

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
from kitting_drake.policies.matching.jaw_clearance import RETRY_DISTANCE
from kitting_drake.policies.matching.segmentation import Segmentation, segment
from kitting_drake.policies.networks.factored import AnglePrediction, Networks, PlacePrediction
from kitting_drake.policies.networks.layers.correlation import Candidate
from systems.signals import (
    Observation,
    PickPlaceAction,
    PixelGrid,
    PlanarPose,
    fill_unseen,
    wrap_to_pi,
)

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_NEVER = -math.inf
"""The logit of a pixel that must not be chosen."""


def network_input(networks: Networks, observation: Observation) -> Image:
    """(4, rows, cols): what the networks are shown; where they see heights alone, what no camera
    saw is filled in."""
    if networks.config.colour:
        return observation.image
    filled = fill_unseen(observation.height, observation.valid)
    return np.concatenate([observation.rgb, filled[None]])


class Look:
    """One observation, and what is read off it once."""

    def __init__(
        self,
        networks: Networks,
        orientations: int,
        observation: Observation,
        failed_picks: Sequence[PlanarPose],
    ) -> None:
        """
        Args:
            networks: for inference.
            orientations: N.
            observation: o_t.
            failed_picks: where grasps failed before.
        """
        self.networks = networks
        self.orientations = orientations
        self.observation = observation
        self.failed_picks = failed_picks
        self.image = network_input(networks, observation)
        self.picking = networks.predict_pick(self.image, orientations)

    @property
    def resolution(self) -> float:
        """The side of a pixel, in metres."""
        return self.observation.grid.resolution

    @cached_property
    def segmentation(self) -> Segmentation:
        """The regions of o_t, by height."""
        return segment(self.observation)

    @cached_property
    def failed_pixels(self) -> Array:
        """(n, 2): the (row, col) of where grasps failed."""
        places = np.array([(pick.x, pick.y) for pick in self.failed_picks]).reshape(-1, 2)
        return self.observation.grid.to_pixel(places)

    def first_logits(self) -> Tensor:
        """(rows, cols): the logits of the pick; none is chosen where a grasp failed before."""
        logits = self.picking.position
        if not self.failed_picks:
            return logits
        return _without(logits, near_failed(self.observation.grid, self.failed_picks))


class Stage(Protocol):
    """One stage of a decision; it keeps nothing from one decision to the next."""

    def refine(self, draft: Draft) -> Draft:
        """The draft with this stage's change, or the draft as it was."""
        ...


@dataclass(frozen=True)
class Draft:
    """An action in pixels, and what it was read from."""

    look: Look
    stages: tuple[Stage, ...]
    """The stages that it has passed."""
    logits: Tensor
    """(rows, cols): of the pick, -inf where it must not be."""
    pixel: tuple[int, int]
    """(row, col) of the largest logit: the networks see the crops around it."""
    angles: AnglePrediction
    """The pick's angle there."""
    placing: PlacePrediction
    """Where the networks bring what is at that pixel."""
    pick: Array
    """(row, col)."""
    theta: float
    """Of the gripper at the pick, in radians."""
    rotation: float
    """Of the object on its way, in radians."""
    goal: Array
    """(row, col) where the networks bring the pixel."""
    continuous: bool = False
    """Whether positions and angles are refined beyond pixels and bins."""
    fitted: Array | None = None
    """(row, col) of the place, where the outlines of object and recess say it."""
    belongs: bool = False
    """Whether the outlines say that the object belongs where it is to be placed."""
    stop: bool = False
    """Whether there is nothing left to pick."""
    mending: PickPlaceAction | None = None
    """What is done instead, to mend an earlier action."""

    @property
    def place(self) -> Array:
        """(row, col) where the pick is brought: the predicted motion of the pixel applies to the
        refined pick too."""
        if self.fitted is not None:
            return self.fitted
        return self.goal + rotation_matrix(self.rotation) @ (self.pick - np.array(self.pixel))

    def placement(self, candidate: Candidate) -> tuple[float, Array]:
        """The rotation, in radians, and the goal (row, col) of a candidate of the networks."""
        return best_placement(candidate, self.look.orientations, self.continuous)

    def among(self, mask: Mask) -> Draft | None:
        """The draft, after the same stages, of the best pick within a mask (rows, cols) instead;
        None where the mask leaves no pixel to pick."""
        left = _without(self.logits, ~mask)
        if not bool((left > _NEVER).any()):
            return None
        return make_draft(self.look, left, self.stages)


def make_draft(look: Look, logits: Tensor, stages: Sequence[Stage]) -> Draft:
    """The networks' best action, passed through all stages.

    Args:
        look: what is looked at.
        logits: (rows, cols), of the pick.
        stages: in their order.
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
    """(rows, cols): the pixels that are too near to a failed pick to try again."""
    rows, cols = np.indices(grid.shape)
    world = grid.to_world(np.stack([rows, cols], axis=-1))
    near = np.zeros(grid.shape, bool)
    for pick in failed_picks:
        near |= np.linalg.norm(world - (pick.x, pick.y), axis=-1) < RETRY_DISTANCE
    return near


def expected_position(logits: Tensor, pixel: tuple[int, int]) -> Array:
    """Sub-pixel refinement: the mean position under the softmax over a pixel and its neighbours.

    Networks that are trained with interpolated labels (see `losses`) predict this mean.

    Args:
        logits: (rows, cols).
        pixel: (row, col) of the maximum.

    Returns:
        (row, col).
    """
    return _local_mean(logits[None], (0, *pixel))[1:]


def best_placement(
    candidate: Candidate, orientations: int, continuous: bool
) -> tuple[float, Array]:
    """A candidate's rotation in radians and its position (row, col), quantized or refined."""
    _, rotation, row, col = candidate.best()
    found = np.array([rotation, row, col], float)
    if continuous:
        origin = np.array([candidate.first_bin, *candidate.corner])
        index = found.astype(int) - origin
        found = origin + _local_mean(candidate.scores, (index[0], index[1], index[2]))
    return wrap_to_pi(found[0] * math.tau / orientations), found[1:]


def _without(logits: Tensor, mask: Mask) -> Tensor:
    """Logits by which no pixel of a mask is chosen."""
    return logits.masked_fill(torch.from_numpy(mask).to(logits.device), _NEVER)


def _local_mean(logits: Tensor, index: tuple[int, int, int]) -> Array:
    """The mean index under the softmax over an entry and its neighbours."""
    starts = [max(i - 1, 0) for i in index]
    part = logits[
        starts[0] : index[0] + 2, starts[1] : index[1] + 2, starts[2] : index[2] + 2
    ].double()
    weights = F.softmax(part.flatten(), 0).view(part.shape).cpu().numpy()
    offsets = np.stack(np.meshgrid(*(np.arange(n) for n in part.shape), indexing="ij"))
    return np.array(starts) + (offsets * weights).sum(axis=(1, 2, 3))
