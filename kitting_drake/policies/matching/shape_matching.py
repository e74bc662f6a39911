"""The policy that needs no training: it matches outlines to recesses, and grasps where the jaws
have room."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from kitting_drake.policies.data.images import make_action
from kitting_drake.policies.matching.evidence import Evidence, geometric_evidence
from kitting_drake.policies.matching.inventory import Inventory
from kitting_drake.policies.matching.jaw_clearance import failed_pixels, jaw_grasps, untried
from kitting_drake.policies.matching.recovery import preparing_action, recovery_action
from kitting_drake.policies.matching.regions.placed_object import (
    MOST_OUTSIDE,
    at_pixel,
    held_outside,
)
from systems.pick_place_parameters import PickPlaceParameters
from systems.signals import Observation, PickPlaceAction, PlanarPose


@dataclass(frozen=True)
class Matched:
    """An action, and facts about it that o_t shows."""

    action: PickPlaceAction
    geometry: Evidence | None = None
    """The facts about a pick and place; None for any other action."""


class ShapeMatchingPolicy:
    """A policy that needs no training. It uses no colour.

    It segments loose objects and recesses by height, registers every outline to every recess, and
    assigns objects to recesses by linear assignment. It picks the best-fitting object for which the
    jaws have room, and stops when nothing fits. Its only memory is the observation's history.
    """

    def __init__(self, planner: PickPlaceParameters, *, recover: bool = False) -> None:
        """
        Args:
            planner: parameters of the motion with which the hand will pick and place.
            recover: whether to prepare objects that cannot be placed yet. Protruding objects are
                pressed down at once, and taken out if the next object needs their place
                (`recovery_action`). For what the policy does if nothing fits see
                `preparing_action`.
        """
        self._planner = planner
        self._recover = recover

    def __call__(
        self, observation: Observation, failed_picks: Sequence[PlanarPose] = ()
    ) -> PickPlaceAction:
        """Returns the action; both gripper poses are in the world.

        Args:
            observation: the heightmap o_t.
            failed_picks: gripper poses at which a grasp failed before; they are avoided.
        """
        return self.decide(observation, failed_picks).action

    def decide(self, observation: Observation, failed_picks: Sequence[PlanarPose] = ()) -> Matched:
        """Returns the action and facts about it. For the arguments see `__call__`."""
        return next(self.proposals(observation, failed_picks))

    def proposals(
        self, observation: Observation, failed_picks: Sequence[PlanarPose] = ()
    ) -> Iterator[Matched]:
        """Yields the result of `decide`, then, if that is a pick and place, the insertions of the
        other objects that fit, best first.

        Insertions for which another object must first be moved away are left out there.

        The arguments are those of `__call__`.
        """
        inventory = Inventory.of(observation)
        arguments = inventory, self._planner, failed_picks
        mending = recovery_action(*arguments) if self._recover else None
        if mending is not None and mending.press:
            yield Matched(mending)
            return
        found, reason = False, ""
        for matched in insertions(*arguments):
            if matched.action.stop:
                reason = matched.action.reason
                continue
            if mending is None or not inventory.needs_clearing(matched.action):
                yield matched
            elif not found:
                yield Matched(inventory.named(mending))
                return
            found = True
        if found:
            return
        if self._recover:
            prepared = preparing_action(*arguments, mending)
            if prepared is not None:
                yield Matched(inventory.named(prepared))
                return
        reason = reason or inventory.why_stop
        yield Matched(PickPlaceAction(stop=True, reason=reason, left_over=inventory.left_over))


def best_insertion(
    inventory: Inventory, planner: PickPlaceParameters, failed_picks: Sequence[PlanarPose] = ()
) -> PickPlaceAction | None:
    """Returns the action that inserts the best-fitting object, of those for which the jaws have
    room; None if no insertion is possible.

    The arguments are those of `insertions`.
    """
    found = (item.action for item in insertions(inventory, planner, failed_picks))
    return next((action for action in found if not action.stop), None)


def insertions(
    inventory: Inventory, planner: PickPlaceParameters, failed_picks: Sequence[PlanarPose] = ()
) -> Iterator[Matched]:
    """Yields the insertion of each object that fits into a recess, best fit first.

    An insertion is a stop with a reason if the jaws lack room, if they would hold too much that
    would lie outside the recess, or if too little is seen.

    Args:
        inventory: the objects and recesses of the observation.
        planner: parameters of the motion with which the hand will pick and place.
        failed_picks: gripper poses at which a grasp failed before; they are avoided.
    """
    observation, segmentation = inventory.observation, inventory.segmentation
    failed = failed_pixels(observation.grid, failed_picks)
    resolution = observation.grid.resolution
    for pair in inventory.pairs:
        region, fit = segmentation.objects[pair.item], pair.fit
        grasps = jaw_grasps(
            segmentation, region, resolution, planner, balance=inventory.memory.balance(region)
        )
        recess = segmentation.recesses[pair.recess]
        outside = held_outside(region, recess, np.zeros(2), fit.rotation, fit.shift, resolution)
        grasps = [
            grasp
            for grasp in untried(grasps, failed, resolution)
            if at_pixel(outside, grasp.pixel) <= MOST_OUTSIDE
        ]
        if not grasps:
            yield Matched(PickPlaceAction(stop=True, reason="not sure"))
            continue
        best = grasps[0]
        place = fit.moved(best.pixel)
        footprint = region.pixels.astype(float)
        if not segmentation.visibility.place_is_seen(footprint, best.pixel, fit.rotation, place):
            yield Matched(PickPlaceAction(stop=True, reason="not seen"))
            continue
        action = make_action(observation, best.pixel, best.theta, place, fit.rotation)
        geometry = geometric_evidence(
            segmentation, best.pixel, fit.rotation, place, fit.cost, best.cost
        )
        yield Matched(inventory.named(action), geometry)
