"""The policies for real cameras. Each yields actions, with a confidence and a picture."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import chain, islice, takewhile
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

from kitting_drake.policies.confidence import (
    MOST_PROPOSALS,
    certainty,
    evidence_of_networks,
    read_reliability,
    surest,
)
from kitting_drake.policies.factory import (
    LoadedPolicy,
    load_learned_policy,
    make_shape_matching,
)
from kitting_drake.policies.matching.shape_matching import Matched
from systems.pick_place_parameters import PickPlaceParameters
from systems.signals import Observation, PickPlaceAction, PixelGrid, PlanarPose

if TYPE_CHECKING:
    from kitting_drake.policies.learned_policy import Decision

Draw = Callable[[str], bytes]
"""A function that draws a decision as a PNG, with a given title."""


def _draw_nothing(title: str) -> bytes:
    return b""


@dataclass(frozen=True)
class Choice:
    """A policy's choice: an action with its confidence."""

    action: PickPlaceAction
    confidence: float | None
    """The confidence from 0 to 1; None if the policy estimates none for this action."""
    parts: dict[str, float] = field(default_factory=dict)
    """The networks' certainty of each part of the decision, from 0 to 1; see `certainty`."""
    draw: Draw = _draw_nothing
    """Draws the decision as a PNG with a given title; an empty title selects the default one."""
    reason: str = ""
    """A sentence that says why the policy acts or stops; empty if `action.reason` says it."""

    @classmethod
    def stopped(cls, observation: Observation) -> Choice:
        """Makes the choice to stop, for observations on which no policy decides."""
        action = PickPlaceAction(stop=True)
        return cls(action, None, draw=partial(_draw_action, observation, action))


class BenchPolicy(Protocol):
    """A policy for real cameras."""

    @property
    def name(self) -> str:
        """The policy's name in records."""
        ...

    def check_grid(self, grid: PixelGrid) -> None:
        """Checks that the policy supports observations of this grid.

        Raises:
            UserError: the policy does not support them.
        """
        ...

    def choices(
        self, observation: Observation, failed_picks: Sequence[PlanarPose] = ()
    ) -> Iterator[Choice]:
        """Yields the choice for an observation. If it is an action, the choices for other objects
        may follow, for a robot that cannot reach the first.

        Args:
            observation: the heightmap o_t.
            failed_picks: gripper poses at which a grasp failed before; they are avoided.
        """
        ...


@dataclass(frozen=True)
class ShapeMatchingDecider:
    """The training-free policy, which matches outlines (see `ShapeMatchingPolicy`)."""

    recover: bool = False
    """Whether to correct failed insertions; see `Recovery`."""
    parameters: PickPlaceParameters = field(default_factory=PickPlaceParameters)
    """The parameters of the robot's motion; give `decide` the same."""
    least_confidence: float | None = None
    """The least confidence, from 0 to 1, with which the policy acts; None for the fitted
    threshold."""

    @property
    def name(self) -> str:
        return "shape_matching"

    def check_grid(self, grid: PixelGrid) -> None:
        """Does nothing: shape matching supports every grid."""

    def choices(
        self, observation: Observation, failed_picks: Sequence[PlanarPose] = ()
    ) -> Iterator[Choice]:
        policy = make_shape_matching(self.parameters, recover=self.recover)
        reliability = read_reliability("shape_matching")
        least = reliability.threshold if self.least_confidence is None else self.least_confidence

        def choice(matched: Matched) -> Choice:
            facts = matched.geometry
            confidence = None if facts is None else reliability.confidence(facts)
            draw = partial(_draw_action, observation, matched.action)
            return Choice(matched.action, confidence, draw=draw)

        return _sure_choices(map(choice, policy.proposals(observation, failed_picks)), least)


@dataclass(frozen=True)
class _Networks:
    """A learned policy; see `load_policy`."""

    loaded: LoadedPolicy
    least: float
    """The least confidence, from 0 to 1, with which the policy acts."""

    @property
    def name(self) -> str:
        return self.loaded.path.stem

    def check_grid(self, grid: PixelGrid) -> None:
        self.loaded.check_grid(grid, "workspace.resolution")

    def choices(
        self, observation: Observation, failed_picks: Sequence[PlanarPose] = ()
    ) -> Iterator[Choice]:
        proposals = self.loaded.function.proposals(observation, failed_picks)
        return _sure_choices((self._choice(observation, *item) for item in proposals), self.least)

    def _choice(
        self, observation: Observation, action: PickPlaceAction, decision: Decision | None
    ) -> Choice:
        if decision is None:
            return Choice(action, None, draw=partial(_draw_action, observation, action))
        parts = certainty(decision, observation.grid.resolution)

        def draw(title: str) -> bytes:
            # Import matplotlib lazily.
            from kitting_drake.evaluation.decision_figure import draw_decision

            return draw_decision(observation, decision, title=title)

        if decision.kit_seen is False:
            stop = PickPlaceAction(stop=True, reason="no kit seen")
            return Choice(stop, None, parts, draw)
        if action.stop:
            return Choice(action, parts.get("nothing_to_pick"), parts, draw)
        if decision.kit_seen is None:
            # The fitted confidence holds only for decisions that use outlines. For other decisions
            # use the networks' own certainty.
            return Choice(action, math.prod(parts.values()), parts, draw)
        evidence = evidence_of_networks(observation, decision)
        confidence = read_reliability("networks", self.loaded.path).confidence(evidence)
        return Choice(action, confidence, parts, draw)


def _sure_choices(choices: Iterator[Choice], least: float) -> Iterator[Choice]:
    """Yields the first choice if it is a stop or has no confidence; else the actions whose
    confidence is at least `least`, or a stop if there are none."""

    def is_estimated(choice: Choice) -> bool:
        return choice.confidence is not None and not choice.action.stop

    def confidence(choice: Choice) -> float:
        return choice.confidence or 0.0

    first = next(choices)
    if not is_estimated(first):
        yield first
        return
    proposals = islice(chain([first], takewhile(is_estimated, choices)), MOST_PROPOSALS)
    best = surest(proposals, confidence, least)
    if confidence(best) < least:
        said = (
            f"the best action succeeds with probability {best.confidence:.2f}, "
            f"less than {least:.2f}"
        )
        yield replace(best, action=PickPlaceAction(stop=True, reason="not sure"), reason=said)
        return
    for choice in chain([best], proposals):
        if confidence(choice) >= least:
            said = f"the probability of success is {choice.confidence:.2f}"
            yield replace(choice, reason=said)


def load_policy(
    weights: Path | None = None,
    *,
    orientations: int = 180,
    fit_outlines: bool = True,
    recover: bool = False,
    parameters: PickPlaceParameters | None = None,
    least_confidence: float | None = None,
) -> BenchPolicy:
    """Loads a learned policy, as `policy: !Learned` does in a scenario.

    Args:
        weights: a file that `train` wrote; None for the generalist.
        orientations: the number N of orientations.
        fit_outlines: whether the task is to insert objects. If so, places are refined by outlines,
            and grasps by the clearance of the jaws. If not, the rotation of a place is chosen among
            equivalent ones so that the fingers have room to open.
        recover: whether to correct failed insertions; see `Recovery`.
        parameters: the parameters of the robot's motion; None for the simulated cell's defaults.
            Give `decide` the same.
        least_confidence: the least confidence, from 0 to 1, with which the policy acts; None for
            the threshold of `confidence.json`, 0.9, or for 0 without outlines.

    Raises:
        UserError: the file is unusable, or the networks do not support N orientations.
    """
    loaded = load_learned_policy(
        weights,
        PickPlaceParameters() if parameters is None else parameters,
        insertion=fit_outlines,
        orientations=orientations,
        orientations_field="--orientations",
        recover=recover,
    )
    least = 0.0
    if least_confidence is not None:
        least = least_confidence
    elif fit_outlines:
        least = read_reliability("networks", loaded.path).threshold
    return _Networks(loaded, least)


def _draw_action(observation: Observation, action: PickPlaceAction, title: str) -> bytes:
    from kitting_drake.evaluation.decision_figure import draw_action

    return draw_action(observation, action, title=title)
