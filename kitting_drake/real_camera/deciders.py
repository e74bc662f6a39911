"""The policies of a bench. Each gives an action, a confidence and a picture."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

import numpy as np
from numpy.typing import NDArray

from kitting_drake.policies.factory import (
    LoadedPolicy,
    load_learned_policy,
    make_shape_matching,
)
from systems.pick_place_parameters import PickPlaceParameters
from systems.signals import Observation, PickPlaceAction, PixelGrid, PlanarPose

if TYPE_CHECKING:
    from kitting_drake.policies.learned_policy import Decision

_SAME_PICK = 0.010
"""Probability within this distance of the pick supports it, in metres ..."""
_OTHER_PICKS = 0.060
"""... and probability within this distance belongs to the same object."""
_SAME_ANGLE = math.radians(10)
"""Probability within this angle of the pick's angle supports it, in radians."""


@dataclass(frozen=True)
class Choice:
    """A policy's choice: an action with its confidence."""

    action: PickPlaceAction
    confidence: float | None
    """From 0 to 1; None for a rule of geometry without confidence."""
    parts: dict[str, float] = field(default_factory=dict)
    """The factors of the confidence."""
    draw: Callable[[], bytes] = bytes
    """Draws the decision as a PNG."""


class BenchPolicy(Protocol):
    """A policy for a bench."""

    @property
    def name(self) -> str:
        """Its name in records."""
        ...

    def check_grid(self, grid: PixelGrid) -> None:
        """Checks that the policy supports observations of this grid.

        Raises:
            UserError: the policy does not.
        """
        ...

    def choose(self, observation: Observation, failed_picks: Sequence[PlanarPose] = ()) -> Choice:
        """The choice for an observation, avoiding failed picks."""
        ...


@dataclass(frozen=True)
class ShapeMatchingDecider:
    """The training-free policy, which matches outlines (see `ShapeMatchingPolicy`).

    Its confidence is 1 for identical outlines of object and recess, and 0 for the largest accepted
    difference.
    """

    recover: bool = False
    parameters: PickPlaceParameters = field(default_factory=PickPlaceParameters)
    """How the robot picks and places; give `decide` the same."""

    @property
    def name(self) -> str:
        return "shape_matching"

    def check_grid(self, grid: PixelGrid) -> None:
        """Does nothing: shape matching supports every grid."""

    def choose(self, observation: Observation, failed_picks: Sequence[PlanarPose] = ()) -> Choice:
        policy = make_shape_matching(self.parameters, recover=self.recover)
        matched = policy.decide(observation, failed_picks)
        parts = {} if matched.agreement is None else {"outlines": matched.agreement}
        return Choice(
            matched.action,
            matched.agreement,
            parts,
            lambda: _draw_action(observation, matched.action),
        )


@dataclass(frozen=True)
class _Networks:
    """A learned policy; see `load_policy`."""

    loaded: LoadedPolicy

    @property
    def name(self) -> str:
        return self.loaded.path.stem

    def check_grid(self, grid: PixelGrid) -> None:
        self.loaded.check_grid(grid, "workspace.resolution")

    def choose(self, observation: Observation, failed_picks: Sequence[PlanarPose] = ()) -> Choice:
        action, decision = self.loaded.function.act(observation, failed_picks)
        if decision is None:
            return Choice(action, None, draw=lambda: _draw_action(observation, action))
        parts = confidence_parts(decision, observation.grid.resolution)

        def draw() -> bytes:
            # Import matplotlib lazily.
            from kitting_drake.evaluation.decision_figure import draw_decision

            return draw_decision(observation, decision)

        return Choice(action, math.prod(parts.values()) if parts else None, parts, draw)


def load_policy(
    weights: Path | None = None,
    *,
    orientations: int = 180,
    fit_outlines: bool = True,
    recover: bool = False,
    parameters: PickPlaceParameters | None = None,
) -> BenchPolicy:
    """A learned policy, as with `policy: !Learned` in a scenario.

    Args:
        weights: a file that `train` wrote; None for the generalist.
        orientations: N.
        fit_outlines: for tasks with insertion: refine places by outlines, and grasps by the jaws'
            room. Otherwise choose, among equivalent rotations of a place, one with room to let go.
        recover: mend failed insertions; see `Recovery`.
        parameters: how the robot picks and places; None for the cell's defaults. Give `decide` the
            same.

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
    return _Networks(loaded)


def confidence_parts(decision: Decision, resolution: float) -> dict[str, float]:
    """The networks' confidence in a decision, as shares of their own probabilities.

    - `something_to_pick`, or `nothing_to_pick` for a stop, by alpha's stop class, if it has one;
    - `pick`: of alpha's probability within 6 cm of the pick, the share within 1 cm. Other objects
      that could be picked as well do not lower it;
    - `angle`: beta's probability within 10 degrees of the pick's angle.

    There is no part for the place, whose scores are only relative.
    """
    parts: dict[str, float] = {}
    if decision.log_odds is not None:
        odds = decision.log_odds if not decision.stop else -decision.log_odds
        name = "nothing_to_pick" if decision.stop else "something_to_pick"
        parts[name] = 1 / (1 + math.exp(-max(-50.0, min(odds, 50.0))))
    if decision.stop:
        return parts
    rows, cols = np.indices(decision.pick_map.shape)
    row, col = decision.pick_pixel
    distance = np.hypot(rows - row, cols - col) * resolution
    about = _mass(decision.pick_map, distance < _OTHER_PICKS)
    parts["pick"] = _mass(decision.pick_map, distance < _SAME_PICK) / max(about, 1e-12)
    count = len(decision.angle_curve)
    angles = np.arange(count) * math.pi / count - decision.action.pick.theta
    off = np.abs((angles + math.pi / 2) % math.pi - math.pi / 2)
    parts["angle"] = _mass(decision.angle_curve, off <= _SAME_ANGLE)
    return {key: min(max(value, 0.0), 1.0) for key, value in parts.items()}


def _mass(probabilities: NDArray[np.float32], where: NDArray[np.bool_]) -> float:
    return float(probabilities[where].sum(dtype=float))


def _draw_action(observation: Observation, action: PickPlaceAction) -> bytes:
    from kitting_drake.evaluation.decision_figure import draw_action

    return draw_action(observation, action)
