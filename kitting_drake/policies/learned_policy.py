"""The learned policy: a function from an observation to an action (section III-A of the paper)."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

from kitting_drake.policies.data.images import make_action, rotation_matrix
from kitting_drake.policies.draft import (
    Draft,
    Look,
    Stage,
    is_any_left,
    make_draft,
    network_input,
    without,
)
from kitting_drake.policies.matching.evidence import Evidence, geometric_evidence
from kitting_drake.policies.matching.refinement import belonging_to, nearest_region
from kitting_drake.policies.matching.regions.segmentation import Region
from kitting_drake.policies.networks.factored import Networks
from kitting_drake.policies.stages import StopRule, SubPixel
from systems.signals import LeftOver, Observation, PickPlaceAction, PlanarPose

_ELSEWHERE = 8.0
"""The distance, in pixels, beyond which two places count as different."""
_MOST_MARGIN = 20.0
"""Upper limit of `Decision.place_margin`, in nats."""


@dataclass(frozen=True)
class Decision:
    """An action, and the predicted distributions from which it was chosen."""

    action: PickPlaceAction
    """The action. If its `stop` is set, its poses are those that the policy would have chosen
    without the stop."""
    pick_map: NDArray[np.float32]
    """(rows, cols): p(u, v), the picking module's probabilities."""
    angle_curve: NDArray[np.float32]
    """(n,): p(theta | u, v) at the angles pi i / n."""
    place_map: NDArray[np.float32]
    """(rows, cols): each pixel's best score over all rotations, minus the best score of all pixels,
    in nats. The scores may be interpolated from a coarse search."""
    pick_pixel: NDArray[np.float64]
    """(row, col) of the pick."""
    place_pixel: NDArray[np.float64]
    """(row, col) of the place."""
    log_odds: float | None = None
    """The log-odds that there is something to pick; None if the networks do not predict it."""
    belongs: bool = False
    """Whether the outlines show that the object fits into the recess at the place."""
    moved_pick: float = 0.0
    """How far the stages moved the pick from the networks' proposal, in mm; clipped at 40."""
    moved_place: float = 0.0
    """How far the stages moved the place from the networks' proposal, in mm; clipped at 20."""
    geometry: Evidence = dataclasses.field(default_factory=dict)
    """Geometric facts about the action (`geometric_evidence`); empty if outlines are not used."""
    kit_seen: bool | None = None
    """Whether o_t shows a kit; None if outlines are not used."""
    place_margin: float = 0.0
    """The difference between the scores of the chosen place and of the best other place, in
    nats."""

    @property
    def stop(self) -> bool:
        """Whether the policy stops."""
        return self.action.stop


DEFAULT_STAGES: tuple[Stage, ...] = (SubPixel(), StopRule())
"""The stages that suit every task."""


class LearnedPolicy:
    """A policy of networks and of stages that refine the networks' proposal. It has no memory."""

    def __init__(
        self,
        networks: Networks,
        *,
        orientations: int = 180,
        stages: Sequence[Stage] = DEFAULT_STAGES,
        resolution: float | None = None,
    ) -> None:
        """
        Args:
            networks: networks that are prepared for inference. The stage `StopRule` uses their
                `stop_threshold`.
            orientations: N, the number of orientations in a full turn.
            stages: the stages, in the order in which they are applied (see `make_stages`). Without
                stages this is the paper's policy, whose actions are quantized to pixels and bins.
            resolution: the side of a pixel in training, in metres; None if unknown.

        Raises:
            ValueError: the networks do not support N orientations.
        """
        networks.check_orientations(orientations)
        self._networks = networks
        self._orientations = orientations
        self._stages = tuple(stages)
        self._resolution = resolution

    def __call__(
        self, observation: Observation, failed_picks: Sequence[PlanarPose] = ()
    ) -> PickPlaceAction:
        """Returns the action; both gripper poses are in the world.

        Args:
            observation: the heightmap o_t.
            failed_picks: gripper poses at which a grasp failed before; they are avoided.
        """
        return self.act(observation, failed_picks)[0]

    def act(
        self, observation: Observation, failed_picks: Sequence[PlanarPose] = ()
    ) -> tuple[PickPlaceAction, Decision | None]:
        """Returns the action, and the decision that led to it. The decision is None for an action
        of the stage `Recovery`.

        The arguments are those of `__call__`.
        """
        return next(self.proposals(observation, failed_picks))

    def proposals(
        self, observation: Observation, failed_picks: Sequence[PlanarPose] = ()
    ) -> Iterator[tuple[PickPlaceAction, Decision | None]]:
        """Yields the result of `act`, then, if that is a pick and place, those for the other
        objects.

        Without outlines the objects are not known, so only the first result is yielded.

        The arguments are those of `__call__`.
        """
        look = self._look(observation, failed_picks)
        first = self._draft(look, look.first_logits())
        yield self._result(first)
        if first.stop or first.mending is not None or not first.outlined:
            return
        objects, tried = look.segmentation.objects, [first.region]
        while others := tuple(item for item in objects if not _is_among(item, tried)):
            known = [item for item in objects if _is_among(item, tried)]
            near_others = belonging_to(others, known, observation.grid.shape)
            logits = without(look.first_logits(), ~near_others)
            if not is_any_left(logits):
                return
            draft = self._draft(look, logits)
            proposed = nearest_region(others, np.array(draft.pixel, float))
            if draft.stop or proposed is None:
                return
            # The stages may have moved the pick to an object that was tried.
            is_new = draft.region is not None and not _is_among(draft.region, tried)
            if is_new and draft.mending is None:
                yield self._result(draft)
            tried += [proposed, draft.region]

    def _result(self, draft: Draft) -> tuple[PickPlaceAction, Decision | None]:
        if draft.mending is not None:
            return draft.look.inventory.named(draft.mending), None
        decision = _decision(draft)
        if decision.stop:
            action = decision.action
            stop = PickPlaceAction(stop=True, reason=action.reason, left_over=action.left_over)
            return stop, decision
        return decision.action, decision

    def decide(self, observation: Observation, failed_picks: Sequence[PlanarPose] = ()) -> Decision:
        """Returns the decision of the networks, even if the stage `Recovery` would replace its
        action.

        The arguments are those of `__call__`.
        """
        look = self._look(observation, failed_picks)
        return _decision(self._draft(look, look.first_logits()))

    @torch.inference_mode()
    def log_odds(self, observation: Observation) -> float | None:
        """Returns the log-odds that there is something to pick; None if the networks do not predict
        it."""
        image = network_input(self._networks, observation, self._resolution)
        return self._networks.predict_pick(image, self._orientations).log_odds

    @torch.inference_mode()
    def _look(self, observation: Observation, failed_picks: Sequence[PlanarPose]) -> Look:
        return Look(self._networks, self._orientations, observation, failed_picks, self._resolution)

    @torch.inference_mode()
    def _draft(self, look: Look, logits: Tensor) -> Draft:
        return make_draft(look, logits, self._stages)


def _is_among(region: Region, regions: Sequence[Region | None]) -> bool:
    return any(region is item for item in regions)


@torch.inference_mode()
def _decision(draft: Draft) -> Decision:
    logits, scores = draft.logits, draft.placing.score_map
    action = make_action(
        draft.look.observation, draft.pick, draft.theta, draft.place, draft.rotation
    )
    if draft.outlined:
        action = draft.look.inventory.named(action)
    return Decision(
        action=dataclasses.replace(
            action, stop=draft.stop, reason=draft.reason, left_over=_left_over(draft)
        ),
        pick_map=F.softmax(logits.flatten(), 0).view(logits.shape).float().cpu().numpy(),
        angle_curve=F.softmax(draft.angles.logits, 0).float().cpu().numpy(),
        place_map=(scores - scores.max()).float().cpu().numpy(),
        pick_pixel=draft.pick,
        place_pixel=draft.place,
        log_odds=draft.look.picking.log_odds,
        belongs=draft.belongs,
        kit_seen=draft.look.segmentation.kit_seen if draft.outlined else None,
        place_margin=_place_margin(draft),
        **_outline_fields(draft),
    )


def _left_over(draft: Draft) -> LeftOver | None:
    """Returns the objects and recesses that the policy still sees when it stops.

    Returns None if it does not stop, or does not use outlines.
    """
    return draft.look.inventory.left_over if draft.stop and draft.outlined else None


def _outline_fields(draft: Draft) -> dict[str, Any]:
    """Returns the fields `moved_pick`, `moved_place` and `geometry` of a `Decision`; empty if
    outlines are not used."""
    if draft.stop or not draft.outlined:
        return {}
    millimetres = 1e3 * draft.look.resolution
    predicted = draft.goal + rotation_matrix(draft.rotation) @ (draft.pick - np.array(draft.pixel))
    return {
        "moved_pick": min(np.linalg.norm(draft.pick - draft.pixel) * millimetres, 40.0),
        "moved_place": min(np.linalg.norm(draft.place - predicted) * millimetres, 20.0),
        "geometry": geometric_evidence(
            draft.look.segmentation,
            draft.pick,
            draft.rotation,
            draft.place,
            draft.fit_cost,
            draft.grasp_cost,
        ),
    }


def _place_margin(draft: Draft) -> float:
    """Returns the score of the best place minus that of the best place elsewhere (see
    `_ELSEWHERE`), in nats."""
    candidates = draft.placing.candidates
    best, _, row, col = candidates[0].best()
    others = [
        score
        for score, _, other_row, other_col in (item.best() for item in candidates[1:])
        if math.hypot(other_row - row, other_col - col) > _ELSEWHERE
    ]
    return min(best - max(others), _MOST_MARGIN) if others else _MOST_MARGIN
