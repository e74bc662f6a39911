"""The probability that a decided pick and place succeeds.

It is a logistic regression on what is known about the decision: the networks' certainty, the fit of
the outlines, the room for the jaws, and how much is seen. `benchmark reliability` fits it to scenes
with random cameras that no network was trained on. This is not in the paper.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from kitting_drake.common.paths import MODELS
from kitting_drake.policies.data.images import rotation_matrix
from kitting_drake.policies.matching.refinement import nearest_region
from systems.signals import Observation

if TYPE_CHECKING:
    from kitting_drake.policies.learned_policy import Decision
    from kitting_drake.policies.matching.segmentation import Segmentation

Array = NDArray[np.float64]

FILE = MODELS / "policies" / "confidence.json"
"""The fitted regressions, by policy."""
_SAME_PICK = 0.010
"""Probability within this distance of the pick supports it, in metres ..."""
_OTHER_PICKS = 0.060
"""... and probability within this distance belongs to the same object."""
_SAME_ANGLE = math.radians(10)
"""Probability within this angle of the pick's angle supports it, in radians."""
_RING = 3
"""The surroundings of an object extend this far, in pixels."""
_HOLE = 0.003
"""What is lower than its rim by more than this is a hole, in metres."""
_WORST_FIT = 0.002
_WORST_GRASP = 5.0

Evidence = dict[str, float]
"""Named facts about a decision; the same names for all decisions of a policy."""


@dataclass(frozen=True)
class Reliability:
    """A fitted regression."""

    weights: dict[str, float]
    """By name of the fact; '' is the constant."""
    threshold: float
    """The least confidence with which to act."""

    def confidence(self, evidence: Evidence) -> float:
        """The probability of success, from 0 to 1."""
        total = self.weights[""]
        total += sum(self.weights[name] * value for name, value in evidence.items())
        return 1 / (1 + math.exp(-max(-30.0, min(total, 30.0))))


@cache
def read_reliability(policy: str) -> Reliability:
    """The fitted regression of `networks` or `shape_matching`."""
    record: dict[str, Any] = json.loads(FILE.read_text())[policy]
    return Reliability(record["weights"], record["threshold"])


def evidence_of_networks(observation: Observation, decision: Decision) -> Evidence:
    """The facts about a decision of networks that acts."""
    parts = certainty(decision, observation.grid.resolution)
    return {
        "something_to_pick": float(np.clip(decision.log_odds or 0.0, -8, 8)),
        "pick": _logit(parts["pick"]),
        "angle": _logit(parts["angle"]),
        "place_margin": min(decision.place_margin, 10.0),
        "moved_pick": decision.moved_pick,
        "moved_place": decision.moved_place,
        **decision.geometry,
    }


def certainty(decision: Decision, resolution: float) -> dict[str, float]:
    """The networks' certainty in a decision, as shares of their own probabilities.

    - `something_to_pick`, or `nothing_to_pick` for a stop, by alpha's stop class, if it has one;
    - `pick`: of alpha's probability within 6 cm of the pick, the share within 1 cm. Other objects
      that could be picked as well do not lower it;
    - `angle`: beta's probability within 10 degrees of the pick's angle.
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


def geometric_evidence(
    segmentation: Segmentation,
    pick: Array,
    rotation: float,
    place: Array,
    fit_cost: float | None,
    grasp_cost: float | None,
) -> Evidence:
    """The facts about a pick and place that o_t shows.

    Args:
        segmentation: of o_t.
        pick: (row, col).
        rotation: of the object, in radians.
        place: (row, col).
        fit_cost: the mean difference of the outlines of object and recess, in metres; None if they
            do not fit.
        grasp_cost: see `JawGrasp.cost`; None without a feasible grasp.
    """
    fits, grasped = fit_cost is not None, grasp_cost is not None
    evidence = {
        "outlines_fit": float(fits),
        "fit": 1e3 * min(fit_cost, _WORST_FIT) if fit_cost is not None else 0.0,
        "jaws_have_room": float(grasped),
        "grasp": min(grasp_cost, _WORST_GRASP) if grasp_cost is not None else 0.0,
        "is_object": 0.0,
        "object_seen": 0.0,
        "place_seen": 0.0,
        "depth": 0.0,
        "hole": 0.0,
    }
    region = nearest_region(segmentation.objects, pick)
    if region is None:
        return evidence
    seen, relief = segmentation.visibility.seen, segmentation.relief
    rows, cols = seen.shape
    there = np.rint(place + (region.pixels - pick) @ rotation_matrix(rotation).T).astype(int)
    inside = ((there >= 0) & (there < (rows, cols))).all(axis=1)
    target = np.zeros_like(seen)
    target[tuple(there[inside].T)] = True
    target = ndimage.binary_closing(target, iterations=2) | target
    around = _ring(target)
    rim = float(np.percentile(relief[around], 75)) if around.any() else 0.0
    low = relief[target] < rim - _HOLE if target.any() else np.zeros(1, bool)
    floor = float(np.percentile(relief[target], 25)) if target.any() else 0.0
    return evidence | {
        "is_object": 1.0,
        "object_seen": float(seen[_ring(region.mask)].mean()),
        "place_seen": float(seen[around].mean()) if around.any() else 0.0,
        "depth": float(np.clip(1e3 * (rim - floor), -10.0, 30.0)),
        "hole": float(low.mean()),
    }


def _ring(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    return ndimage.binary_dilation(mask, iterations=_RING) & ~mask


def _logit(share: float) -> float:
    share = min(max(share, 0.01), 0.99)
    return math.log(share / (1 - share))


def _mass(probabilities: NDArray[np.float32], where: NDArray[np.bool_]) -> float:
    return float(probabilities[where].sum(dtype=float))
