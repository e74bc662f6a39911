"""Chooses among a policy's proposals by their confidence, in the simulated cell and on a bench."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain, islice, takewhile
from typing import TYPE_CHECKING

from kitting_drake.policies.confidence import (
    MOST_PROPOSALS,
    certainty,
    evidence_of_networks,
    ranked,
    read_reliability,
)
from kitting_drake.policies.factory import LoadedPolicy
from systems.signals import Observation, PickPlaceAction, PlanarPose

if TYPE_CHECKING:
    from kitting_drake.policies.learned_policy import Decision
    from kitting_drake.policies.matching.shape_matching import Matched, ShapeMatchingPolicy


@dataclass(frozen=True)
class Choice:
    """A policy's choice: an action with its confidence."""

    action: PickPlaceAction
    confidence: float | None
    """The confidence from 0 to 1; None if the policy estimates none for this action."""
    parts: dict[str, float] = field(default_factory=dict)
    """The networks' certainty of each part of the decision, from 0 to 1; see `certainty`."""
    decision: Decision | None = None
    """The networks' decision; None if they made none."""
    reason: str = ""
    """A sentence that says why the policy acts or stops; empty if `action.reason` says it."""
    refused: PickPlaceAction | None = None
    """The action instead of which the policy stops, because it is not sure enough of it."""

    def stopped(self, reason: str) -> Choice:
        """Returns the choice to stop instead of acting: it is `not sure`, for a given reason."""
        stop = PickPlaceAction(stop=True, reason="not sure")
        return replace(self, action=stop, refused=self.action, reason=reason)


Choose = Callable[[Observation, Sequence[PlanarPose]], Iterator[Choice]]
"""A function that yields the choice for an observation o_t and the gripper poses of failed grasps.
If the choice is an action, the choices for other objects may follow, the surest first, for a robot
that cannot reach the first."""


def choose_by_shape(policy: ShapeMatchingPolicy, least: float | None = None) -> Choose:
    """Makes the choices of shape matching.

    Args:
        policy: the policy.
        least: the least confidence, from 0 to 1, with which it acts; None for the fitted threshold.
    """
    reliability = read_reliability("shape_matching")
    least = reliability.threshold if least is None else least

    def choice(matched: Matched) -> Choice:
        facts = matched.geometry
        return Choice(matched.action, None if facts is None else reliability.confidence(facts))

    def choose(observation: Observation, failed_picks: Sequence[PlanarPose]) -> Iterator[Choice]:
        return _surest_first(map(choice, policy.proposals(observation, failed_picks)), least)

    return choose


def choose_by_networks(loaded: LoadedPolicy, least: float) -> Choose:
    """Makes the choices of a learned policy.

    Args:
        loaded: the policy and its weights file.
        least: the least confidence, from 0 to 1, with which it acts.
    """

    def choose(observation: Observation, failed_picks: Sequence[PlanarPose]) -> Iterator[Choice]:
        proposals = loaded.function.proposals(observation, failed_picks)
        return _surest_first((_of_networks(loaded, observation, *it) for it in proposals), least)

    return choose


def _of_networks(
    loaded: LoadedPolicy,
    observation: Observation,
    action: PickPlaceAction,
    decision: Decision | None,
) -> Choice:
    if decision is None:
        return Choice(action, None)
    parts = certainty(decision, observation.grid.resolution)
    # A kit shows no cavity if earlier actions filled it. Only then is the reason one of these.
    is_filled = action.reason in ("done", "gave up")
    if decision.kit_seen is False and not is_filled:
        stop = PickPlaceAction(stop=True, reason="no kit seen", left_over=action.left_over)
        return Choice(stop, None, parts, decision)
    if action.stop:
        return Choice(action, parts.get("nothing_to_pick"), parts, decision)
    if decision.kit_seen is None:
        # The fitted confidence holds only for decisions that use outlines. For other decisions use
        # the networks' own certainty.
        return Choice(action, math.prod(parts.values()), parts, decision)
    evidence = evidence_of_networks(observation, decision)
    confidence = read_reliability("networks", loaded.path).confidence(evidence)
    return Choice(action, confidence, parts, decision)


def _surest_first(choices: Iterator[Choice], least: float) -> Iterator[Choice]:
    """Yields the first choice if it is a stop or has no confidence; else the actions whose
    confidence is at least `least`, the surest first, or a stop if there are none."""

    def is_estimated(choice: Choice) -> bool:
        return choice.confidence is not None and not choice.action.stop

    def confidence(choice: Choice) -> float:
        return choice.confidence or 0.0

    first = next(choices)
    if not is_estimated(first):
        yield first
        return
    proposals = islice(chain([first], takewhile(is_estimated, choices)), MOST_PROPOSALS)
    seen = ranked(proposals, confidence, least)
    best = seen[0]
    if confidence(best) < least:
        said = (
            f"the best action succeeds with probability {best.confidence:.2f}, "
            f"less than {least:.2f}"
        )
        yield best.stopped(said)
        return
    for choice in chain(seen, proposals):
        if confidence(choice) >= least:
            said = f"the probability of success is {choice.confidence:.2f}"
            yield replace(choice, reason=said)
