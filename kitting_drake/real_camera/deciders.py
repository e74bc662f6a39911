"""The policies for real cameras. Each returns an action, a confidence and a picture."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Protocol

from kitting_drake.policies.confidence import (
    certainty,
    evidence_of_networks,
    read_reliability,
)
from kitting_drake.policies.factory import (
    LoadedPolicy,
    load_learned_policy,
    make_shape_matching,
)
from systems.pick_place_parameters import PickPlaceParameters
from systems.signals import Observation, PickPlaceAction, PixelGrid, PlanarPose

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

    def choose(self, observation: Observation, failed_picks: Sequence[PlanarPose] = ()) -> Choice:
        """Chooses an action for an observation; avoids the failed picks."""
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

    def choose(self, observation: Observation, failed_picks: Sequence[PlanarPose] = ()) -> Choice:
        policy = make_shape_matching(self.parameters, recover=self.recover)
        matched = policy.decide(observation, failed_picks)
        draw = partial(_draw_action, observation, matched.action)
        if matched.geometry is None:
            return Choice(matched.action, None, draw=draw)
        reliability = read_reliability("shape_matching")
        least = reliability.threshold if self.least_confidence is None else self.least_confidence
        return _if_sure(reliability.confidence(matched.geometry), least, matched.action, {}, draw)


@dataclass(frozen=True)
class _Networks:
    """A learned policy; see `load_policy`."""

    loaded: LoadedPolicy
    least_confidence: float | None

    @property
    def name(self) -> str:
        return self.loaded.path.stem

    def check_grid(self, grid: PixelGrid) -> None:
        self.loaded.check_grid(grid, "workspace.resolution")

    def choose(self, observation: Observation, failed_picks: Sequence[PlanarPose] = ()) -> Choice:
        action, decision = self.loaded.function.act(observation, failed_picks)
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
            # use the networks' own certainty, and act at any certainty unless the caller sets a
            # threshold.
            return _if_sure(
                math.prod(parts.values()), self.least_confidence or 0.0, action, parts, draw
            )
        evidence = evidence_of_networks(observation, decision)
        reliability = read_reliability("networks", self.loaded.path)
        least = reliability.threshold if self.least_confidence is None else self.least_confidence
        return _if_sure(reliability.confidence(evidence), least, action, parts, draw)


def _if_sure(
    confidence: float,
    least: float,
    action: PickPlaceAction,
    parts: dict[str, float],
    draw: Draw,
) -> Choice:
    """Returns the action with its confidence, or a stop if the confidence is too low."""
    if confidence >= least:
        said = f"the probability of success is {confidence:.2f}"
        return Choice(action, confidence, parts, draw, said)
    said = f"the best action succeeds with probability {confidence:.2f}, less than {least:.2f}"
    return Choice(PickPlaceAction(stop=True, reason="not sure"), confidence, parts, draw, said)


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
            the threshold of `confidence.json`, 0.9.

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
    return _Networks(loaded, least_confidence)


def _draw_action(observation: Observation, action: PickPlaceAction, title: str) -> bytes:
    from kitting_drake.evaluation.decision_figure import draw_action

    return draw_action(observation, action, title=title)
