"""How far a policy's answers are from an expert's, on observations that it did not learn from."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from kitting_drake.policies.images import LabelledImage
from kitting_drake.policies.learned_policy import Decision, LearnedPolicy
from kitting_drake.policies.samples import Scene
from systems.signals import Observation, PixelGrid

ERRORS = ("pick_mm", "pick_deg", "place_mm", "turn_deg", "displacement_mm")
"""What `answer_errors` gives."""

_ARM = 50.0
"""Mean distance of a tool's points from its grasp, in mm: what an angle moves."""
_LOST = 20.0
"""A displacement beyond this is as bad as this, in mm."""


def answer_errors(decision: Decision, scene: Scene, grid: PixelGrid) -> NDArray[np.float64]:
    """Errors of an answer against the target whose pick is nearest.

    Returns:
        (5,), as `ERRORS` names them: distance of the pick; angle of the pick, up to a half turn;
        distance of the object, where it is put, from where the expert puts it; its angle; and how
        far its points end up from where they should, all errors together, no more than 20 mm.
    """
    millimetres = 1e3 * grid.resolution

    def distance(target: LabelledImage) -> float:
        return float(np.hypot(*(decision.pick_pixel - target.pick)))

    target = min(scene.targets, key=distance)
    action = decision.action
    angle = math.remainder(action.pick.theta - target.pick_theta, math.pi)
    turn = math.remainder(action.place.theta - action.pick.theta - target.turn, math.tau)
    goal = target.place_of(decision.pick_pixel)
    place = float(np.hypot(*(decision.place_pixel - goal))) * millimetres
    pick = distance(target) * millimetres
    displacement = place + _ARM * (abs(angle) + abs(turn))
    if pick > _LOST:
        displacement = _LOST
    return np.array(
        [
            pick,
            abs(math.degrees(angle)),
            place,
            abs(math.degrees(turn)),
            min(displacement, _LOST),
        ]
    )


def validate(policy: LearnedPolicy, scenes: Sequence[Scene], grid: PixelGrid) -> dict[str, float]:
    """Errors over some scenes.

    Returns:
        For each of `ERRORS` its median, as `median_...`, its 95th percentile, as `p95_...`, and as
        `displacement_mm` the mean displacement, by which a policy is chosen.
    """
    errors = np.array(
        [
            answer_errors(policy.decide(Observation(scene.image, grid)), scene, grid)
            for scene in scenes
        ]
    )
    report = {"displacement_mm": float(errors[:, -1].mean())}
    for name, column in zip(ERRORS, errors.T, strict=True):
        report[f"median_{name}"] = float(np.median(column))
        report[f"p95_{name}"] = float(np.percentile(column, 95))
    return report
