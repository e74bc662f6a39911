"""Measures how far a policy's predictions deviate from an expert's actions, on observations that
were not used for training."""

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
"""The names of the errors in `prediction_errors`."""

_ARM = 50.0
"""The mean distance of a tool's points from its grasp, in mm; converts angles to displacements."""
_LOST = 20.0
"""An upper limit of displacements, in mm. If a pick is farther than this from the expert's, the
object counts as lost and has this displacement."""


def prediction_errors(
    decision: Decision, targets: Sequence[LabelledImage], millimetres: float
) -> NDArray[np.float64]:
    """Returns the errors of a prediction, relative to the target with the nearest pick.

    If the policy decided to stop, the errors are those of the action that it predicted
    nevertheless.

    Args:
        decision: the prediction.
        targets: the expert's possible actions.
        millimetres: the side of a pixel, in mm.

    Returns:
        (5,), in the order of `ERRORS`, in mm and degrees:

        - the distance between the picks;
        - the error of the pick angle, modulo pi;
        - the distance of the placed object from the expert's place;
        - the error of the object's rotation;
        - the resulting displacement of the object's points, at most 20 mm.
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
    """Chooses a threshold for the log-odds that there is something to pick. Below it, a policy
    should stop.

    Args:
        present: the log-odds in scenes with something to pick.
        absent: the log-odds in final observations.

    Returns:
        The threshold with the fewest wrong decisions; None if `present` or `absent` is empty. Of
            equally good thresholds it is the lowest, because an unneeded action does less harm than
            a forgotten object. A threshold between two neighbouring log-odds lies a quarter of the
            way from the lower to the higher one.
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
        policy: the policy; its stop threshold, if it has one, is ignored.
        scenes: at least one scene.
        finals: observations in which nothing is left to pick; empty if the networks cannot stop.

    Returns:
        - `median_...` and `p95_...` for each of `ERRORS`: its median and 95th percentile;
        - `displacement_mm`: the mean displacement;
        - `cost_mm`: the mean displacement over all scenes and final observations. A wrong decision
          to stop or to go on counts as 20 mm, and a right decision to stop as 0.

        If there are final observations, also:

        - `stop_threshold`: the threshold of `choose_stop_threshold`;
        - `stop_margin`: the log-odds that there is something to pick: their least value in
          `scenes` minus their largest value in `finals`, in nats;
        - `false_stops` and `missed_stops`: the numbers of wrong decisions to stop and to go on.
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
    # Networks without a stop class predict no odds.
    if absent and None not in (*present, *absent):
        report |= _stop_report(np.array(present, float), np.array(absent, float), displacements)
    return report


@torch.no_grad()
def mean_loss(networks: Networks, samples: Sequence[LabelledImage]) -> float:
    """Returns the mean, over samples, of the sum of all losses, in nats.

    Args:
        networks: the networks of any method, for inference.
        samples: at least one sample, prepared as for training.
    """
    values = [
        sum(float(loss()) for _, loss in networks.losses(sample, np.random.default_rng(index)))
        for index, sample in enumerate(samples)
    ]
    return float(np.mean(values))


def _stop_report(
    present: NDArray[np.float64], absent: NDArray[np.float64], displacements: NDArray[np.float64]
) -> dict[str, float]:
    """Returns the part of `validate`'s report about stopping.

    Args:
        present: the log-odds that there is something to pick, in scenes where there is.
        absent: the same log-odds in final observations.
        displacements: the displacements of the scenes, in mm.
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
