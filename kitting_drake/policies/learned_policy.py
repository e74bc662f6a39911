"""The learned policy as a function from an observation to an action (section III-A)."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

from kitting_drake.policies.correlation import Candidate, search
from kitting_drake.policies.images import rotation
from kitting_drake.policies.networks import Networks
from systems.signals import Observation, PickPlaceAction, PlanarPose, wrap_to_pi


@dataclass(frozen=True)
class Decision:
    """An answer, and the maps that it was read from."""

    action: PickPlaceAction
    pick_map: NDArray[np.float32]
    """(rows, cols): p(u, v), the picking module's probabilities."""
    angle_curve: NDArray[np.float32]
    """(n,): p(theta | u, v) at the angles pi i / n."""
    place_map: NDArray[np.float32]
    """(rows, cols): the best score over all turns, in nats below the best of all; coarse."""
    pick_pixel: NDArray[np.float64]
    """(row, col)."""
    place_pixel: NDArray[np.float64]
    """(row, col)."""


class LearnedPolicy:
    """Networks as what a `PickPlacePolicy` wraps: without memory."""

    def __init__(
        self,
        networks: Networks,
        *,
        orientations: int = 180,
        continuous: bool = True,
        watch: Callable[[Observation, Decision], None] | None = None,
    ) -> None:
        """
        Args:
            networks: for inference.
            orientations: N.
            continuous: answer between pixels and bins (not in the paper) instead of on them.
            watch: told of each decision.

        Raises:
            ValueError: the networks cannot answer at N orientations.
        """
        networks.check_orientations(orientations)
        self._networks = networks
        self._orientations = orientations
        self._continuous = continuous
        self._watch = watch

    def __call__(self, observation: Observation) -> PickPlaceAction:
        """The action; both gripper poses are in the world."""
        decision = self.decide(observation)
        if self._watch is not None:
            self._watch(observation, decision)
        return decision.action

    @torch.inference_mode()
    def decide(self, observation: Observation) -> Decision:
        """The action, and the maps that it was read from."""
        networks = self._networks
        image = observation.image
        logits = networks.position_logits(image, self._orientations)
        rows, cols = logits.shape
        row, col = divmod(int(logits.argmax()), cols)
        pixel = np.array([row, col], float)

        angles, between = networks.angle_answer(image, (row, col), self._orientations)
        theta = int(angles.argmax()) * math.tau / self._orientations
        pick = pixel
        if self._continuous:
            theta = theta if between is None else between
            pick = expected_position(logits, (row, col))

        # The crop is around the pixel: what is said of its middle is carried over to the pick.
        scene, encoding = networks.encode_scene(image), networks.encode_crop(image, (row, col))
        candidates, volume = search(scene, encoding, self._orientations, shape=(rows, cols))
        turn, place = best_placement(candidates[0], self._orientations, self._continuous)
        place = place + rotation(turn) @ (pick - pixel)
        return Decision(
            action=make_action(observation, pick, theta, place, turn),
            pick_map=F.softmax(logits.flatten(), 0).view(rows, cols).float().cpu().numpy(),
            angle_curve=F.softmax(angles, 0).float().cpu().numpy(),
            place_map=_place_map(volume, (rows, cols)),
            pick_pixel=pick,
            place_pixel=place,
        )


def expected_position(logits: Tensor, pixel: tuple[int, int]) -> NDArray[np.float64]:
    """The mean position of the probability around a pixel, its neighbours included.

    Networks trained with labels that are spread over the pixels around them answer so between them.

    Args:
        logits: (rows, cols).
        pixel: of the maximum.

    Returns:
        (row, col).
    """
    return _local_mean(logits[None], (0, *pixel))[1:]


def best_placement(
    candidate: Candidate, orientations: int, continuous: bool
) -> tuple[float, NDArray[np.float64]]:
    """A candidate's turn in radians and its position (row, col): the best bin, or between bins."""
    _, turn, row, col = candidate.best()
    answer = np.array([turn, row, col], float)
    if continuous:
        origin = np.array([candidate.first_bin, *candidate.corner])
        best = (turn - candidate.first_bin, row - candidate.corner[0], col - candidate.corner[1])
        answer = origin + _local_mean(candidate.scores, best)
    return wrap_to_pi(answer[0] * math.tau / orientations), answer[1:]


def _local_mean(logits: Tensor, index: tuple[int, int, int]) -> NDArray[np.float64]:
    """The mean index of the softmax over an entry and its neighbours."""
    starts = [max(i - 1, 0) for i in index]
    part = logits[
        starts[0] : index[0] + 2, starts[1] : index[1] + 2, starts[2] : index[2] + 2
    ].double()
    weights = F.softmax(part.flatten(), 0).view(part.shape).cpu().numpy()
    offsets = np.stack(np.meshgrid(*(np.arange(n) for n in part.shape), indexing="ij"))
    return np.array(starts) + (offsets * weights).sum(axis=(1, 2, 3))


def make_action(
    observation: Observation,
    pick: NDArray[np.float64],
    theta: float,
    place: NDArray[np.float64],
    turn: float,
) -> PickPlaceAction:
    """The action of an answer in pixels.

    Args:
        observation: what was seen.
        pick: (row, col).
        theta: of the gripper at the pick, in radians.
        place: (row, col).
        turn: of the object, in radians.
    """
    grid = observation.grid
    pick_x, pick_y = grid.to_world(pick)
    place_x, place_y = grid.to_world(place)
    theta = wrap_to_pi(theta)
    return PickPlaceAction(
        pick=PlanarPose(float(pick_x), float(pick_y), theta),
        place=PlanarPose(float(place_x), float(place_y), theta + turn),
    )


def _place_map(volume: Tensor, shape: tuple[int, int]) -> NDArray[np.float32]:
    best = volume.amax(0)
    size = (2 * best.shape[0] - 1, 2 * best.shape[1] - 1)
    full = F.interpolate(best[None, None], size=size, mode="bilinear", align_corners=True)[0, 0]
    full = full - full.max()
    return full[: shape[0], : shape[1]].float().cpu().numpy()
