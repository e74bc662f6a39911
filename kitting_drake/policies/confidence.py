"""Estimates the probability that a pick and place succeeds.

The estimate is a logistic regression on facts about the decision: the networks' certainty, how well
the outlines of object and recess fit, how well the jaws can grip, and how much is seen. `benchmark
reliability` fits it to scenes with random cameras, on which no network was trained. This is not in
the paper.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cache
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from kitting_drake.common.errors import UserError
from kitting_drake.common.paths import MODELS
from kitting_drake.policies.matching.evidence import Evidence
from systems.signals import Observation

if TYPE_CHECKING:
    from kitting_drake.policies.learned_policy import Decision

_Item = TypeVar("_Item")

FILE = MODELS / "policies" / "confidence.json"
"""The file of the fitted regressions, one for each kind of policy."""
MOST_PROPOSALS = 3
"""A policy that is not sure of an action proposes actions for at most this many objects."""
CLEARLY_SURE = 0.98
"""A policy that is at least this sure of an action proposes no other."""
_SAME_PICK = 0.010
"""Pixels within this distance of the pick, in metres, count as the same pick."""
_OTHER_PICKS = 0.060
"""Pixels within this distance of the pick, in metres, count as picks of the same object."""
_SAME_ANGLE = math.radians(10)
"""Angles that differ from the chosen pick angle by at most this, in radians, count as the same."""


@dataclass(frozen=True)
class Reliability:
    """A fitted logistic regression and the threshold for its result."""

    weights: dict[str, float]
    """The weight of each fact, by the fact's name; the empty name has the constant term."""
    threshold: float
    """The least confidence at which the robot acts."""

    def confidence(self, evidence: Evidence) -> float:
        """Returns the estimated probability of success, from 0 to 1.

        A fact that is newer than the regression has no weight.
        """
        total = self.weights[""]
        total += sum(self.weights.get(name, 0.0) * value for name, value in evidence.items())
        return 1 / (1 + math.exp(-max(-30.0, min(total, 30.0))))


def ranked(
    items: Iterable[_Item], confidence: Callable[[_Item], float], least: float = 0.0
) -> list[_Item]:
    """Returns a policy's proposals for one observation, the surest first.

    Proposals are considered until one is clearly sure (`CLEARLY_SURE`), and at most
    `MOST_PROPOSALS` of them.

    Args:
        items: the proposals, in the order in which the policy prefers them.
        confidence: the confidence of a proposal, from 0 to 1.
        least: the least confidence with which the robot acts. No proposal below it is clearly sure.
    """
    seen: list[_Item] = []
    for item in islice(items, MOST_PROPOSALS):
        seen.append(item)
        if confidence(item) >= max(CLEARLY_SURE, least):
            break
    return sorted(seen, key=confidence, reverse=True)


def read_reliability(policy: str, weights: Path | None = None) -> Reliability:
    """Reads a fitted regression.

    Args:
        policy: `networks` or `shape_matching`.
        weights: the networks' file. If there is a file beside it with the same name and the ending
            `.confidence.json`, the regression is read from that file.
    """
    own = None if weights is None else weights.with_suffix(".confidence.json")
    return _read(FILE if own is None or not own.exists() else own, policy)


@cache
def _read(path: Path, policy: str) -> Reliability:
    try:
        record: dict[str, Any] = json.loads(path.read_text())[policy]
        return Reliability(record["weights"], record["threshold"])
    except (OSError, ValueError, LookupError, TypeError) as error:
        raise UserError(
            f"{path} has no valid regression for the policy {policy}: fit it by "
            "`benchmark reliability --fit`"
        ) from error


def evidence_of_networks(observation: Observation, decision: Decision) -> Evidence:
    """Returns the facts about a decision of the networks. The decision must not be a stop."""
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
    """Returns how certain the networks are of a decision, as numbers from 0 to 1:

    - `something_to_pick` (for a stop, `nothing_to_pick`): the predicted probability that there is
      something (or nothing) left to pick; missing if the networks have no stop class;
    - `pick`: the probability of the pixels within 1 cm of the pick, divided by that of the pixels
      within 6 cm, so that other objects do not count; missing for a stop;
    - `angle`: the probability of the angles within 10 degrees of the chosen one; missing for a
      stop.
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


def _logit(share: float) -> float:
    share = min(max(share, 0.01), 0.99)
    return math.log(share / (1 - share))


def _mass(probabilities: NDArray[np.float32], where: NDArray[np.bool_]) -> float:
    return float(probabilities[where].sum(dtype=float))
