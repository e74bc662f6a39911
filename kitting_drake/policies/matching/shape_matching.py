"""The policy that needs no training: it matches outlines to recesses, and grasps where the jaws
have room."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from kitting_drake.policies.data.images import make_action
from kitting_drake.policies.matching.evidence import Evidence, geometric_evidence
from kitting_drake.policies.matching.inventory import Inventory
from kitting_drake.policies.matching.jaw_clearance import failed_pixels, jaw_grasps, untried
from kitting_drake.policies.matching.recovery import preparing_action, recovery_action
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
        inventory = Inventory.of(observation)
        mending = None
        if self._recover:
            mending = recovery_action(inventory, self._planner, failed_picks)
        if mending is not None and mending.press:
            return Matched(mending)
        matched, reason = best_insertion(inventory, self._planner, failed_picks)
        if matched is not None:
            if mending is not None and inventory.needs_clearing(matched.action):
                return Matched(inventory.named(mending))
            return matched
        if self._recover:
            prepared = preparing_action(inventory, self._planner, failed_picks, mending)
            if prepared is not None:
                return Matched(inventory.named(prepared))
        reason = reason or inventory.why_stop
        return Matched(PickPlaceAction(stop=True, reason=reason, left_over=inventory.left_over))


def best_insertion(
    inventory: Inventory, planner: PickPlaceParameters, failed_picks: Sequence[PlanarPose] = ()
) -> tuple[Matched | None, str]:
    """Finds the best-fitting object for which the jaws have room.

    Args:
        inventory: the objects and recesses of the observation.
        planner: parameters of the motion with which the hand will pick and place.
        failed_picks: gripper poses at which a grasp failed before; they are avoided.

    Returns:
        The action that inserts the object, and an empty string. If no insertion is possible, None
            and the reason, a key of `STOP_REASONS`; it is empty if no object fits.
    """
    observation, segmentation = inventory.observation, inventory.segmentation
    failed = failed_pixels(observation.grid, failed_picks)
    resolution = observation.grid.resolution
    reason = ""
    for pair in inventory.pairs:
        reason, fit = "not seen", pair.fit
        region = segmentation.objects[pair.item]
        grasps = jaw_grasps(
            segmentation, region, resolution, planner, balance=inventory.memory.balance(region)
        )
        grasps = untried(grasps, failed, resolution)
        if not grasps:
            reason = "not sure"
            continue
        best = grasps[0]
        place = fit.moved(best.pixel)
        footprint = region.pixels.astype(float)
        if segmentation.visibility.place_is_seen(footprint, best.pixel, fit.rotation, place):
            action = make_action(observation, best.pixel, best.theta, place, fit.rotation)
            geometry = geometric_evidence(
                segmentation, best.pixel, fit.rotation, place, fit.cost, best.cost
            )
            return Matched(inventory.named(action), geometry), ""
    return None, reason
