"""How far a policy's predictions are from an expert's, on observations not trained on."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from kitting_drake.policies.data.images import LabelledImage, Pictured
from kitting_drake.policies.data.samples import ObservedScene, observed
from kitting_drake.policies.learned_policy import Decision, LearnedPolicy
from kitting_drake.policies.networks.factored import Networks

ERRORS = ("pick_mm", "pick_deg", "place_mm", "rotation_deg", "displacement_mm")
"""The names of what `prediction_errors` returns."""

_ARM = 50.0
"""The mean distance of a tool's points from its grasp, in mm: what an error of an angle moves."""
_LOST = 20.0
"""An object that is displaced by this much or more is lost, however far it is, in mm."""


def prediction_errors(
    decision: Decision, targets: Sequence[LabelledImage], millimetres: float
) -> NDArray[np.float64]:
    """Errors of a prediction against the target whose pick is nearest, as if it did not stop.

    Args:
        decision: the prediction.
        targets: the expert's possible actions.
        millimetres: the side of a pixel.

    Returns:
        (5,), as `ERRORS` names them: the pick's distance from the target's; the pick angle's error
        modulo pi; the distance of the object, where it is put, from where the expert puts it; the
        error of its rotation; and the displacement of the object's points due to all of these, at
        most 20 mm.
    """

    def distance(target: LabelledImage) -> float:
        return float(np.hypot(*(decision.pick_pixel - target.pick)))

    target = min(targets, key=distance)
    action = decision.action
    angle = math.remainder(action.pick.theta - target.pick_theta, math.pi)
    rotation = math.remainder(action.place.theta - action.pick.theta - target.rotation, math.tau)
    goal = target.place_of(decision.pick_pixel)
    place = float(np.hypot(*(decision.place_pixel - goal))) * millimetres
    pick = distance(target) * millimetres
    displacement = place + _ARM * (abs(angle) + abs(rotation))
    if pick > _LOST:
        displacement = _LOST
    return np.array(
        [
            pick,
            abs(math.degrees(angle)),
            place,
            abs(math.degrees(rotation)),
            min(displacement, _LOST),
        ]
    )


def choose_stop_threshold(present: ArrayLike, absent: ArrayLike) -> float | None:
    """The log-odds below which a policy should stop.

    Args:
        present: the log-odds of scenes in which there is something to pick.
        absent: the log-odds of final observations, in which there is not.

    Returns:
        The threshold with the fewest errors. It is a quarter of the way up from the log-odds below
        it to those above, and of several such thresholds the lowest: an action too many costs less
        than an object that stays where it is. None where either kind is missing: never stop.
    """
    present, absent = np.sort(np.asarray(present, float)), np.sort(np.asarray(absent, float))
    if not len(present) or not len(absent):
        return None
    values = np.unique(np.concatenate([present, absent]))
    between = values[:-1] + np.diff(values) / 4
    thresholds = np.concatenate([[values[0] - 1.0], between, [values[-1] + 1.0]])
    false_stops = np.searchsorted(present, thresholds)
    missed_stops = len(absent) - np.searchsorted(absent, thresholds)
    return float(thresholds[np.argmin(false_stops + missed_stops)])


def validate(
    policy: LearnedPolicy, scenes: Sequence[ObservedScene], finals: Sequence[Pictured] = ()
) -> dict[str, float]:
    """Validates a policy on scenes with something to pick, and on final observations.

    Args:
        policy: what to validate; whether it has a threshold for stopping already does not matter.
        scenes: at least one.
        finals: in which there is nothing left to pick; none if the networks cannot stop.

    Returns:
        For each of `ERRORS` its median over the scenes, as `median_...`, its 95th percentile, as
        `p95_...`, and as `displacement_mm` the mean displacement. Where there are final
        observations, also the `stop_threshold` chosen for them, by how many nats the two kinds
        are separated, as `stop_margin` (negative: they overlap), and how many scenes are judged
        wrongly: `false_stops`, in which there is something to pick, and `missed_stops`.
        And `cost_mm`, by which a checkpoint is chosen where the expert's action is the only right
        one: the mean displacement over all scenes and
        final observations, where what is judged wrongly counts as lost (20 mm) and a final
        observation that is judged rightly as 0.
    """
    errors, present = [], []
    for scene in scenes:
        targets = scene.targets
        decision = policy.decide(observed(targets[0].image, scene.grid))
        errors.append(prediction_errors(decision, targets, 1e3 * scene.grid.resolution))
        present.append(decision.log_odds)
    table = np.array(errors)
    displacements = table[:, -1]
    report = {"displacement_mm": float(displacements.mean())}
    for name, column in zip(ERRORS, table.T, strict=True):
        report[f"median_{name}"] = float(np.median(column))
        report[f"p95_{name}"] = float(np.percentile(column, 95))
    report["cost_mm"] = report["displacement_mm"]
    grid = scenes[0].grid
    absent = [policy.log_odds(observed(final.image, grid)) for final in finals]
    # Where the networks cannot tell, there are no odds.
    if absent and None not in (*present, *absent):
        report |= _stop_report(np.array(present, float), np.array(absent, float), displacements)
    return report


@torch.no_grad()
def mean_loss(networks: Networks, samples: Sequence[LabelledImage]) -> float:
    """The mean over samples of the sum of all losses, in nats: of the action that was taken, how
    improbable it is to the networks.

    Args:
        networks: of any method, for inference.
        samples: at least one, as networks of their kind learn from.
    """
    values = [
        sum(float(loss()) for _, loss in networks.losses(sample, np.random.default_rng(index)))
        for index, sample in enumerate(samples)
    ]
    return float(np.mean(values))


def _stop_report(
    present: NDArray[np.float64], absent: NDArray[np.float64], displacements: NDArray[np.float64]
) -> dict[str, float]:
    """The part of `validate`'s report that is about stopping.

    Args:
        present: the log-odds of scenes in which there is something to pick.
        absent: those of final observations.
        displacements: of the scenes, in mm.
    """
    threshold = choose_stop_threshold(present, absent)
    assert threshold is not None
    stopped, missed = present < threshold, int((absent >= threshold).sum())
    costs = np.where(stopped, _LOST, displacements).sum() + _LOST * missed
    return {
        "cost_mm": float(costs / (len(present) + len(absent))),
        "stop_threshold": threshold,
        "stop_margin": float(present.min() - absent.max()),
        "false_stops": int(stopped.sum()),
        "missed_stops": missed,
    }
