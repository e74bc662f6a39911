"""The learned policy: a function from an observation to an action (section III-A of the paper)."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

from kitting_drake.policies.data.images import Image, make_action, rotation_matrix
from kitting_drake.policies.matching.jaw_clearance import RETRY_DISTANCE
from kitting_drake.policies.matching.recovery import recovery_action
from kitting_drake.policies.matching.refinement import refine_grasp, refine_place
from kitting_drake.policies.matching.release_clearance import blocked_at_place
from kitting_drake.policies.matching.segmentation import Segmentation, segment
from kitting_drake.policies.matching.shape_matching import belonging, certain_fits
from kitting_drake.policies.networks.factored import Networks, PickPrediction
from kitting_drake.policies.networks.layers.correlation import Candidate
from systems.signals import (
    Observation,
    PickPlaceAction,
    PixelGrid,
    PlanarPose,
    fill_unseen,
    wrap_to_pi,
)

_NEVER = -math.inf
"""The logit of a pixel that must not be chosen."""
_AS_GOOD = 2.0
"""A rotation whose score is less by at most this is as good, in nats, ..."""
_SAME_PLACE = 4.0
"""... where the places are at most this far apart, in pixels."""
_SOMETHING_FITS, _NOTHING_FITS = -1.0, 2.0
"""By how much the threshold for stopping moves with what the outlines say, in nats. With everything
kitted and other things about, networks and outlines each err at times, and seldom both."""


@dataclass(frozen=True)
class Decision:
    """An action, and the distributions that it was read from."""

    action: PickPlaceAction
    """Where it says stop, its poses and all that follows are what the policy would have done."""
    pick_map: NDArray[np.float32]
    """(rows, cols): p(u, v), the picking module's probabilities."""
    angle_curve: NDArray[np.float32]
    """(n,): p(theta | u, v) at the angles pi i / n."""
    place_map: NDArray[np.float32]
    """(rows, cols): the best score over all rotations, in nats below the best of all; coarse."""
    pick_pixel: NDArray[np.float64]
    """(row, col)."""
    place_pixel: NDArray[np.float64]
    """(row, col)."""
    log_odds: float | None = None
    """That there is something to pick; None where the networks cannot tell."""
    belongs: bool = False
    """Whether the outlines say that the object belongs where it is to be placed."""

    @property
    def stop(self) -> bool:
        """Whether there is nothing left to pick."""
        return self.action.stop


class LearnedPolicy:
    """Networks as the function that a `PickPlacePolicy` evaluates; it has no memory."""

    def __init__(
        self,
        networks: Networks,
        *,
        orientations: int = 180,
        continuous: bool = True,
        fit_outlines: bool = False,
        recover: bool = False,
        clear_jaws: bool = False,
        may_stop: bool = True,
        watch: Callable[[Observation, Decision], None] | None = None,
    ) -> None:
        """
        Args:
            networks: for inference; their `stop_threshold` says when the policy stops.
            orientations: N.
            continuous: refine the action beyond pixels and orientation bins (sub-pixel and sub-bin
                refinement, not in the paper) instead of quantizing it.
            fit_outlines: refine the place by the outlines of object and recess, where they agree
                (`refine_place`), and the grasp by what room there is for the jaws
                (`refine_grasp`); and where the networks would stop while an object certainly fits
                (`certain_fits`), pick that one, unless `recover`. Not in the paper.
            recover: press down what protrudes, pick what belongs into a recess before anything
                else (`belonging`), let that have a say in when to stop, and at last take out what
                could not be pressed down (`recovery_action`). Not in the paper.
            clear_jaws: of rotations that the networks hold for as good, as a cube has four, take
                the one where the fingers have most room when they let go (`blocked_at_place`). Not
                in the paper.
            may_stop: whether to stop where there is nothing left to pick. Not in the paper.
            watch: called with each observation and decision.

        Raises:
            ValueError: the networks cannot predict at N orientations.
        """
        networks.check_orientations(orientations)
        self._networks = networks
        self._orientations = orientations
        self._continuous = continuous
        self._fit_outlines = fit_outlines
        self._recover = recover
        self._clear_jaws = clear_jaws
        self._may_stop = may_stop
        self._watch = watch

    def __call__(
        self, observation: Observation, failed_picks: Sequence[PlanarPose] = ()
    ) -> PickPlaceAction:
        """The action; both gripper poses are in the world.

        Args:
            observation: o_t.
            failed_picks: where a grasp failed before: there it is not tried again.
        """
        return self.act(observation, failed_picks)[0]

    def act(
        self, observation: Observation, failed_picks: Sequence[PlanarPose] = ()
    ) -> tuple[PickPlaceAction, Decision | None]:
        """The action, and the decision that it is; None where it mends something instead.

        The arguments are those of `__call__`.
        """
        segmentation = self._segment(observation)
        mending = None
        if self._recover and segmentation is not None:
            mending = recovery_action(observation, segmentation, failed_picks)
        if mending is not None and mending.press:
            return mending, None
        decision = self._decide(observation, segmentation, failed_picks)
        # What must be taken out waits: it may fail again, and actions are counted.
        if mending is not None and (decision.stop or not decision.belongs):
            return mending, None
        if self._watch is not None:
            self._watch(observation, decision)
        return PickPlaceAction(stop=True) if decision.stop else decision.action, decision

    @torch.inference_mode()
    def log_odds(self, observation: Observation) -> float | None:
        """The log-odds that there is something to pick; None where the networks cannot tell."""
        image = self._input(observation)
        return self._networks.predict_pick(image, self._orientations).log_odds

    def _input(self, observation: Observation) -> Image:
        """The input of the networks: without colours where they see heights alone."""
        if self._networks.config.colour:
            return observation.image
        filled = fill_unseen(observation.height, observation.valid)
        return np.concatenate([observation.rgb, filled[None]])

    def _segment(self, observation: Observation) -> Segmentation | None:
        """The segmentation of an observation, where geometry has a say."""
        return segment(observation) if self._fit_outlines or self._recover else None

    def decide(self, observation: Observation, failed_picks: Sequence[PlanarPose] = ()) -> Decision:
        """The action of the networks, and the distributions that it was read from; see `__call__`,
        which may mend something first."""
        return self._decide(observation, self._segment(observation), failed_picks)

    @torch.inference_mode()
    def _decide(
        self,
        observation: Observation,
        segmentation: Segmentation | None,
        failed_picks: Sequence[PlanarPose],
    ) -> Decision:
        image = self._input(observation)
        picking = self._networks.predict_pick(image, self._orientations)
        logits = picking.position
        if failed_picks:
            logits = _without(logits, near_failed(observation.grid, failed_picks))
        outlines = segmentation if self._fit_outlines else None
        resolution = observation.grid.resolution
        places = np.array([(pick.x, pick.y) for pick in failed_picks]).reshape(-1, 2)
        failed = observation.grid.to_pixel(places)
        choice = self._choose(image, picking, logits, outlines, resolution, failed)
        belongs = choice.fits
        if self._recover and segmentation is not None and not belongs:
            # The network's favourite may have no business here: what does, goes first.
            left = _within(logits, belonging(segmentation, resolution))
            belongs = left is not None
            if left is not None:
                logits = left
                choice = self._choose(image, picking, logits, outlines, resolution, failed)
        odds, threshold = picking.log_odds, self._networks.stop_threshold
        say = 0.0
        if self._recover and segmentation is not None and segmentation.fixture.any():
            say = _SOMETHING_FITS if belongs else _NOTHING_FITS
        stop = False
        if self._may_stop and odds is not None and threshold is not None:
            stop = odds < threshold + say
        if stop and not self._recover and outlines is not None:
            # To the networks nothing looks like an object; an outline says that something is one.
            left = _within(logits, certain_fits(outlines, resolution))
            stop = left is None
            if left is not None:
                logits = left
                choice = self._choose(image, picking, logits, outlines, resolution, failed)
        action = make_action(observation, choice.pick, choice.theta, choice.place, choice.rotation)
        return Decision(
            action=dataclasses.replace(action, stop=stop),
            pick_map=F.softmax(logits.flatten(), 0).view(logits.shape).float().cpu().numpy(),
            angle_curve=choice.angle_curve,
            place_map=choice.place_map,
            pick_pixel=choice.pick,
            place_pixel=choice.place,
            log_odds=odds,
            belongs=belongs,
        )

    def _choose(
        self,
        image: Image,
        picking: PickPrediction,
        logits: Tensor,
        outlines: Segmentation | None,
        resolution: float,
        failed: NDArray[np.float64],
    ) -> _Choice:
        """The best action among the pixels that logits leave.

        Args:
            image: what the networks see.
            picking: what they predict of it.
            logits: (rows, cols), of the pick.
            outlines: to refine by; None: not refined by outlines.
            resolution: of a pixel, in metres.
            failed: (n, 2), the (row, col) of where grasps failed.
        """
        row, col = divmod(int(logits.argmax()), logits.shape[1])
        pixel = np.array([row, col], float)
        angles, refined = picking.angle((row, col))
        theta = int(angles.argmax()) * math.tau / self._orientations
        pick = pixel
        if self._continuous:
            theta = theta if refined is None else refined
            pick = expected_position(logits, (row, col))
        if outlines is not None:
            grasp = refine_grasp(outlines, pick, theta, resolution, failed)
            if grasp is not None:
                pick, theta = grasp.pick, grasp.theta

        # The crop is centred on a pixel. Its predicted motion applies to the refined pick too.
        placing = self._networks.predict_place(image, (row, col), self._orientations)
        rotation, place = self._placement(placing.candidates, image[3], resolution, pixel, theta)
        place = place + rotation_matrix(rotation) @ (pick - pixel)
        fits = False
        if outlines is not None:
            fitted = refine_place(outlines, pick, rotation, place, resolution)
            if fitted is not None:
                rotation, place, fits = fitted.rotation, fitted.place, True
        return _Choice(
            pick=pick,
            theta=theta,
            place=place,
            rotation=rotation,
            fits=fits,
            angle_curve=F.softmax(angles, 0).float().cpu().numpy(),
            place_map=(placing.score_map - placing.score_map.max()).float().cpu().numpy(),
        )

    def _placement(
        self,
        candidates: Sequence[Candidate],
        height: NDArray[np.float32],
        resolution: float,
        pixel: NDArray[np.float64],
        theta: float,
    ) -> tuple[float, NDArray[np.float64]]:
        """The rotation in radians and the position (row, col) of the best candidate, or of one as
        good that leaves the fingers more room.

        Args:
            candidates: the best first.
            height: (rows, cols) of o_t, in metres.
            resolution: of a pixel, in metres.
            pixel: (row, col) of the pick.
            theta: of the gripper there, in radians.
        """

        def placement(candidate: Candidate) -> tuple[float, NDArray[np.float64]]:
            return best_placement(candidate, self._orientations, self._continuous)

        first = placement(candidates[0])
        if not self._clear_jaws:
            return first
        score = candidates[0].best()[0]
        as_good = [
            found
            for candidate in candidates
            if candidate.best()[0] >= score - _AS_GOOD
            and np.linalg.norm((found := placement(candidate))[1] - first[1]) <= _SAME_PLACE
        ]
        # Of equals the first: it has the best score.
        return min(
            as_good, key=lambda item: blocked_at_place(height, resolution, pixel, theta, *item)
        )


@dataclass(frozen=True)
class _Choice:
    """An action in pixels, and what it was read from; see `Decision`."""

    pick: NDArray[np.float64]
    theta: float
    place: NDArray[np.float64]
    rotation: float
    fits: bool
    """Whether the outlines of object and recess agree."""
    angle_curve: NDArray[np.float32]
    place_map: NDArray[np.float32]


def _without(logits: Tensor, mask: NDArray[np.bool_]) -> Tensor:
    """Logits by which no pixel of a mask is chosen."""
    return logits.masked_fill(torch.from_numpy(mask).to(logits.device), _NEVER)


def _within(logits: Tensor, mask: NDArray[np.bool_] | None) -> Tensor | None:
    """Logits by which only pixels of a mask are chosen; None if it leaves none."""
    if mask is None:
        return None
    left = _without(logits, ~mask)
    return left if bool((left > _NEVER).any()) else None


def near_failed(grid: PixelGrid, failed_picks: Sequence[PlanarPose]) -> NDArray[np.bool_]:
    """(rows, cols): the pixels that are too near to a failed pick to try again."""
    rows, cols = np.indices(grid.shape)
    world = grid.to_world(np.stack([rows, cols], axis=-1))
    near = np.zeros(grid.shape, bool)
    for pick in failed_picks:
        near |= np.linalg.norm(world - (pick.x, pick.y), axis=-1) < RETRY_DISTANCE
    return near


def expected_position(logits: Tensor, pixel: tuple[int, int]) -> NDArray[np.float64]:
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
) -> tuple[float, NDArray[np.float64]]:
    """A candidate's rotation in radians and its position (row, col), quantized or refined."""
    _, rotation, row, col = candidate.best()
    found = np.array([rotation, row, col], float)
    if continuous:
        origin = np.array([candidate.first_bin, *candidate.corner])
        index = found.astype(int) - origin
        found = origin + _local_mean(candidate.scores, (index[0], index[1], index[2]))
    return wrap_to_pi(found[0] * math.tau / orientations), found[1:]


def _local_mean(logits: Tensor, index: tuple[int, int, int]) -> NDArray[np.float64]:
    """The mean index under the softmax over an entry and its neighbours."""
    starts = [max(i - 1, 0) for i in index]
    part = logits[
        starts[0] : index[0] + 2, starts[1] : index[1] + 2, starts[2] : index[2] + 2
    ].double()
    weights = F.softmax(part.flatten(), 0).view(part.shape).cpu().numpy()
    offsets = np.stack(np.meshgrid(*(np.arange(n) for n in part.shape), indexing="ij"))
    return np.array(starts) + (offsets * weights).sum(axis=(1, 2, 3))
