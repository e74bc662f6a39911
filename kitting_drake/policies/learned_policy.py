"""The learned policy: a function from an observation to an action (section III-A of the paper)."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray

from kitting_drake.policies.data.images import make_action
from kitting_drake.policies.draft import Draft, Look, Stage, make_draft, network_input
from kitting_drake.policies.networks.factored import Networks
from kitting_drake.policies.stages import StopRule, SubPixel
from systems.signals import Observation, PickPlaceAction, PlanarPose


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


DEFAULT_STAGES: tuple[Stage, ...] = (SubPixel(), StopRule())
"""The stages of a policy that knows nothing of its task."""


class LearnedPolicy:
    """Networks and the stages that refine what they propose; it has no memory."""

    def __init__(
        self,
        networks: Networks,
        *,
        orientations: int = 180,
        stages: Sequence[Stage] = DEFAULT_STAGES,
        watch: Callable[[Observation, Decision], None] | None = None,
    ) -> None:
        """
        Args:
            networks: for inference; their `stop_threshold` says when a `StopRule` stops.
            orientations: N.
            stages: each refines what the one before it made of the networks' action; none: the
                paper's own policy, whose actions are pixels and bins. See `make_stages`.
            watch: called with each observation and decision.

        Raises:
            ValueError: the networks cannot predict at N orientations.
        """
        networks.check_orientations(orientations)
        self._networks = networks
        self._orientations = orientations
        self._stages = tuple(stages)
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
        draft = self._draft(observation, failed_picks)
        if draft.mending is not None:
            return draft.mending, None
        decision = _decision(draft)
        if self._watch is not None:
            self._watch(observation, decision)
        return PickPlaceAction(stop=True) if decision.stop else decision.action, decision

    def decide(self, observation: Observation, failed_picks: Sequence[PlanarPose] = ()) -> Decision:
        """The action of the networks, and the distributions that it was read from; see `__call__`,
        which may mend something instead."""
        return _decision(self._draft(observation, failed_picks))

    @torch.inference_mode()
    def log_odds(self, observation: Observation) -> float | None:
        """The log-odds that there is something to pick; None where the networks cannot tell."""
        image = network_input(self._networks, observation)
        return self._networks.predict_pick(image, self._orientations).log_odds

    @torch.inference_mode()
    def _draft(self, observation: Observation, failed_picks: Sequence[PlanarPose]) -> Draft:
        look = Look(self._networks, self._orientations, observation, failed_picks)
        return make_draft(look, look.first_logits(), self._stages)


@torch.inference_mode()
def _decision(draft: Draft) -> Decision:
    logits, scores = draft.logits, draft.placing.score_map
    action = make_action(
        draft.look.observation, draft.pick, draft.theta, draft.place, draft.rotation
    )
    return Decision(
        action=dataclasses.replace(action, stop=draft.stop),
        pick_map=F.softmax(logits.flatten(), 0).view(logits.shape).float().cpu().numpy(),
        angle_curve=F.softmax(draft.angles.logits, 0).float().cpu().numpy(),
        place_map=(scores - scores.max()).float().cpu().numpy(),
        pick_pixel=draft.pick,
        place_pixel=draft.place,
        log_odds=draft.look.picking.log_odds,
        belongs=draft.belongs,
    )
