"""Refinement of what a network predicted: the place by fitting the object's outline to the recess,
and the grasp by what room o_t leaves the jaws.

Not in the paper. It corrects by millimetres and degrees, and tells a place from the one a half turn
away, which differs only at the object's ends. Where the outlines do not agree, as with a recess
that is hidden or an object that is not inserted, the prediction stays as it is.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kitting_drake.policies.data.images import rotation_matrix
from kitting_drake.policies.matching.jaw_clearance import JawGrasp, jaw_grasps, untried
from kitting_drake.policies.matching.registration import (
    Outline,
    Registration,
    coarse_cost,
    is_covered,
    mismatch,
    preference,
    register,
    trace_outline,
)
from kitting_drake.policies.matching.segmentation import Region, Segmentation
from systems.pick_place_parameters import PickPlaceParameters
from systems.signals import wrap_to_pi

Array = NDArray[np.float64]

_WORST_COST = 0.0016
"""Outlines that differ by more on average say nothing, in metres."""
_HALF_TURN_GAIN = 0.00005
"""The half turn is taken if it fits better by more than this where the two differ, in metres."""
_RIVAL_GAIN = 0.85
"""Another recess is taken if its mismatch is at most this share of the predicted one's."""
_PROMISING = 1.2
"""Another is registered if its coarse cost is at most this many times the predicted one's."""
_LARGEST_SHIFT = 0.010
"""A correction moves the object's middle by at most this, in metres, ..."""
_LARGEST_ROTATION = math.radians(10)
"""... and rotates it by at most this, but for a half turn."""
_LEVER = 0.03
"""A rotation of the jaws by a radian counts as this way, in metres."""
_POOR = 0.03
"""A cost of a grasp of one counts as this way, in metres."""
_SAME_PLACE, _SAME_ANGLE = 0.008, math.radians(8)
"""Grasps that are nearer to each other than this, in metres and radians, are the same."""
_NEAR = 6.0
"""A position this near to a region, in pixels, belongs to it."""


@dataclass(frozen=True)
class RefinedPlace:
    """A rotation, and where it brings the pick."""

    rotation: float
    """In radians."""
    place: Array
    """(row, col)."""


def refine_place(
    segmentation: Segmentation, pick: Array, rotation: float, place: Array, resolution: float
) -> RefinedPlace | None:
    """A predicted place, refined; None where the outlines cannot tell.

    Args:
        segmentation: of o_t.
        pick: (row, col).
        rotation: predicted, of the object, in radians.
        place: (row, col) predicted for the object's point under the pick.
        resolution: of a pixel, in metres.
    """
    taken = _nearest(segmentation.objects, pick)
    if taken is None:
        return None
    outline = trace_outline(taken.mask, resolution, close=True)
    goal = place + rotation_matrix(rotation) @ (outline.middle - pick)
    recess = _nearest(segmentation.recesses, goal)
    if recess is None:
        return None
    target = trace_outline(recess.mask, resolution)

    def fit(angle: float, middle: Array) -> Registration | None:
        """From where the object's middle is brought to `middle`; None if it ends far away."""
        start = (angle, middle - rotation_matrix(angle) @ outline.middle)
        found = register(outline, target, starts=(start,))
        away = np.linalg.norm(found.moved(outline.middle) - middle) * resolution
        turned = abs(wrap_to_pi(found.rotation - angle))
        return found if away <= _LARGEST_SHIFT and turned <= _LARGEST_ROTATION else None

    best, reverse = fit(rotation, goal), fit(rotation + math.pi, target.middle)
    if reverse is not None and (
        best is None or preference(outline, target, reverse, best) > _HALF_TURN_GAIN
    ):
        best = reverse
    if best is None or best.cost > _WORST_COST:
        return None
    others = [other for other in segmentation.recesses if other is not recess]
    elsewhere = _better_elsewhere(taken, outline, recess, target, best, others, resolution)
    if elsewhere is not None:
        best = elsewhere
    elif not is_covered(outline, target, best):
        return None
    return RefinedPlace(wrap_to_pi(best.rotation), best.moved(pick))


def _better_elsewhere(
    taken: Region,
    outline: Outline,
    recess: Region,
    target: Outline,
    fit: Registration,
    others: list[Region],
    resolution: float,
) -> Registration | None:
    """The fit to another recess where that is clearly better than to the predicted one; else None.

    Args:
        taken: the object.
        outline: its outline.
        recess: the predicted one.
        target: its outline.
        fit: of the one to the other.
        others: the other recesses.
        resolution: of a pixel, in metres.
    """
    best, least = None, _RIVAL_GAIN * mismatch(fit, taken, recess)
    enough = _PROMISING * coarse_cost(outline, target)
    for other in others:
        rival = trace_outline(other.mask, resolution)
        if coarse_cost(outline, rival) > enough:
            continue
        found = register(outline, rival)
        fits = found.cost < _WORST_COST and is_covered(outline, rival, found)
        if fits and mismatch(found, taken, other) < least:
            best, least = found, mismatch(found, taken, other)
    return best


def _nearest(regions: tuple[Region, ...], pixel: Array) -> Region | None:
    """The region that is nearest to a position (row, col), if it is near."""
    best, least = None, _NEAR
    for region in regions:
        distance = float(np.linalg.norm(region.pixels - pixel, axis=1).min())
        if distance < least:
            best, least = region, distance
    return best


@dataclass(frozen=True)
class RefinedGrasp:
    """A grasp that the jaws can take."""

    pick: Array
    """(row, col)."""
    theta: float
    """In radians."""


def refine_grasp(
    segmentation: Segmentation,
    pick: Array,
    theta: float,
    resolution: float,
    planner: PickPlaceParameters,
    failed: Array | None = None,
) -> RefinedGrasp | None:
    """A grasp near a predicted one for which o_t leaves the jaws no room; None if it does leave it,
    or there is none.

    Args:
        segmentation: of o_t.
        pick: (row, col) predicted.
        theta: of the gripper, predicted, in radians.
        resolution: of a pixel, in metres.
        planner: how the hand will pick.
        failed: (n, 2), the (row, col) of where grasps failed: none is taken there.
    """
    taken = _nearest(segmentation.objects, pick)
    if taken is None:
        return None

    def away(grasp: JawGrasp) -> tuple[float, float]:
        """The distance from the predicted grasp, in metres, and the rotation, in radians."""
        distance = float(np.linalg.norm(grasp.pixel - pick)) * resolution
        return distance, abs(math.remainder(grasp.theta - theta, math.pi))

    def is_same(distance: float, turned: float) -> bool:
        return distance < _SAME_PLACE and turned < _SAME_ANGLE

    def departure(grasp: JawGrasp) -> float:
        distance, turned = away(grasp)
        return distance + _LEVER * turned + _POOR * grasp.cost

    grasps = jaw_grasps(segmentation, taken, resolution, planner)
    # A network knows more of a grasp than that the jaws have room: where they have, it stays.
    if not grasps or any(is_same(*away(grasp)) for grasp in grasps):
        return None
    if failed is not None:
        grasps = untried(grasps, failed, resolution)
    best = min(grasps, key=departure, default=None)
    if best is None:
        return None
    return RefinedGrasp(best.pixel, best.theta)
