"""The training-free policy: match outlines to recesses, and grasp where the jaws have room."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from kitting_drake.policies.data.images import make_action
from kitting_drake.policies.matching.evidence import Evidence, geometric_evidence
from kitting_drake.policies.matching.jaw_clearance import jaw_grasps, untried
from kitting_drake.policies.matching.recovery import recovery_action
from kitting_drake.policies.matching.registration import (
    Registration,
    coarse_cost,
    is_covered,
    mismatch,
    register,
    trace_outline,
)
from kitting_drake.policies.matching.segmentation import Segmentation, segment
from systems.pick_place_parameters import PickPlaceParameters
from systems.signals import Observation, PickPlaceAction, PlanarPose

_WORST_COST = 0.0019
"""The largest mean difference of an outline and its recess, in metres."""
_CERTAIN_COST = 0.0010
"""Pairs that differ by less certainly belong together, in metres."""
_PROMISING = 2.0
"""A recess is registered if its coarse cost is at most this multiple of the object's least."""


@dataclass(frozen=True)
class Matched:
    """An action, and what o_t tells about it."""

    action: PickPlaceAction
    geometry: Evidence | None = None
    """The facts about a pick and place; None for another action."""


class ShapeMatchingPolicy:
    """A training-free function from an observation to an action. It uses no colour.

    It segments loose objects and recesses by height, registers every outline to every recess, and
    assigns objects to recesses by linear assignment. It picks the best-fitting object for which the
    jaws have room, and stops when nothing fits. It has no memory.
    """

    def __init__(self, planner: PickPlaceParameters, *, recover: bool = False) -> None:
        """
        Args:
            planner: how the hand will pick and place.
            recover: press protruding objects down at once; take out those that could not be
                pressed down when nothing else fits (`recovery_action`).
        """
        self._planner = planner
        self._recover = recover

    def __call__(
        self, observation: Observation, failed_picks: Sequence[PlanarPose] = ()
    ) -> PickPlaceAction:
        """The action; both gripper poses are in the world.

        Args:
            observation: o_t.
            failed_picks: poses at which a grasp failed before; it avoids them.
        """
        return self.decide(observation, failed_picks).action

    def decide(self, observation: Observation, failed_picks: Sequence[PlanarPose] = ()) -> Matched:
        """The action with what o_t tells about it; see `__call__`."""
        segmentation = segment(observation)
        mending = None
        if self._recover:
            mending = recovery_action(observation, segmentation, self._planner, failed_picks)
        if mending is not None and mending.press:
            return Matched(mending)
        places = np.array([(pick.x, pick.y) for pick in failed_picks]).reshape(-1, 2)
        failed = observation.grid.to_pixel(places)
        resolution = observation.grid.resolution
        reason = ""
        for index, fit in match(segmentation, resolution):
            reason = "not seen"
            grasps = untried(
                jaw_grasps(segmentation, segmentation.objects[index], resolution, self._planner),
                failed,
                resolution,
            )
            if not grasps:
                reason = "not sure"
                continue
            best = grasps[0]
            place = fit.moved(best.pixel)
            footprint = segmentation.objects[index].pixels.astype(float)
            if segmentation.visibility.place_is_seen(footprint, best.pixel, fit.rotation, place):
                action = make_action(observation, best.pixel, best.theta, place, fit.rotation)
                geometry = geometric_evidence(
                    segmentation, best.pixel, fit.rotation, place, fit.cost, best.cost
                )
                return Matched(action, geometry)
        # Taking out comes last: it may fail again, and the number of actions is limited.
        stop = PickPlaceAction(stop=True, reason=reason or why_stop(segmentation))
        return Matched(mending or stop)


def why_stop(segmentation: Segmentation) -> str:
    """Why a policy stops if it finds nothing to pick; see `STOP_REASONS`."""
    if not segmentation.kit_seen:
        return "no kit seen"
    left = segmentation.objects and segmentation.free_recesses
    return "nothing fits" if left else "done"


def certain_fits(segmentation: Segmentation, resolution: float) -> NDArray[np.bool_]:
    """(rows, cols): the loose objects that certainly belong into a free recess; see `match`."""
    mask = np.zeros(segmentation.fixture.shape, bool)
    for index, fit in match(segmentation, resolution):
        if fit.cost < _CERTAIN_COST:
            mask |= segmentation.objects[index].mask
    return mask


def belonging(segmentation: Segmentation, resolution: float) -> NDArray[np.bool_] | None:
    """(rows, cols): the loose objects that `match` assigns to a recess; None without a fixture."""
    if not segmentation.fixture.any():
        return None
    mask = np.zeros(segmentation.fixture.shape, bool)
    for index, _ in match(segmentation, resolution):
        mask |= segmentation.objects[index].mask
    return mask


def match(segmentation: Segmentation, resolution: float) -> list[tuple[int, Registration]]:
    """The indices of the loose objects and their fits into recesses, best fit first.

    Args:
        segmentation: the segmentation of an observation.
        resolution: the side of its pixels, in metres.
    """
    objects, regions = segmentation.objects, segmentation.recesses
    if not objects or not regions:
        return []
    outlines = [trace_outline(item.mask, resolution, close=True) for item in objects]
    recesses = [trace_outline(item.mask, resolution) for item in regions]
    coarse = np.array([[coarse_cost(o, c) for c in recesses] for o in outlines])
    fits: dict[tuple[int, int], Registration] = {}
    costs = np.full(coarse.shape, 10 * _WORST_COST)
    for i, j in np.argwhere(coarse <= _PROMISING * coarse.min(axis=1, keepdims=True)):
        fits[i, j] = register(outlines[i], recesses[j])
        if is_covered(outlines[i], recesses[j], fits[i, j]):
            costs[i, j] = mismatch(fits[i, j], objects[i], regions[j])
    chosen = _assign(costs)
    good = [(i, j) for i, j in chosen if costs[i, j] < _WORST_COST]
    return [(int(i), fits[i, j]) for i, j in sorted(good, key=lambda pair: costs[pair])]


def _assign(costs: NDArray[np.float64]) -> list[tuple[int, int]]:
    """The pairs of the assignment with the least sum; costs are clipped to `_WORST_COST`."""
    rows, cols = linear_sum_assignment(np.minimum(costs, _WORST_COST))
    return list(zip(rows.tolist(), cols.tolist(), strict=True))
