"""The stages that refine the networks' decision.

Each stage takes a `Draft` and returns a refined one. The paper has no such stages: it quantizes
every action and never stops.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kitting_drake.policies.data.images import make_action, rotation_matrix
from kitting_drake.policies.draft import Draft, Stage, expected_position
from kitting_drake.policies.matching.inventory import mask_of
from kitting_drake.policies.matching.jaw_clearance import jaw_grasps, untried
from kitting_drake.policies.matching.recovery import (
    clearing_action,
    preparing_action,
    recovery_action,
)
from kitting_drake.policies.matching.refinement import nearest_region, refine_grasp, refine_place
from kitting_drake.policies.matching.regions.placed_object import (
    MOST_OUTSIDE,
    at_pixel,
    held_outside,
    placed_mask,
    recess_under,
)
from kitting_drake.policies.matching.regions.visibility import Visibility
from kitting_drake.policies.matching.release_clearance import blocked_at_place
from kitting_drake.policies.matching.shape_matching import best_insertion
from systems.pick_place_parameters import PickPlaceParameters
from systems.signals import wrap_to_pi

_AS_GOOD = 2.0
"""A rotation counts as equally good if its score is at most this many nats below the best score,
and its place is within `_SAME_PLACE` of the best rotation's place."""
_SAME_PLACE = 4.0
"""The largest distance, in pixels, between two places that count as the same."""
_TRIES = 4
"""The policy stops after this many proposals whose pick or place is not seen well enough."""
_ANOTHER = 0.010
"""If a pick is not seen well enough, the next pick is farther than this from it, in metres."""
_NOTHING_FITS = 2.0
"""If the outlines show nothing to pick, the policy stops unless the networks' log-odds exceed the
stop threshold by at least this, in nats.

Among distractors both the networks and the outlines may be wrong, but seldom at the same time.
"""


def make_stages(
    planner: PickPlaceParameters,
    *,
    insertion: bool,
    continuous: bool = True,
    fit_outlines: bool = True,
    recover: bool = False,
    may_stop: bool = True,
) -> tuple[Stage, ...]:
    """Returns the stages of a policy, in the order in which they are applied.

    Args:
        planner: parameters of the motion with which the hand will pick and place.
        insertion: whether objects are inserted into recesses. Outlines are used only then.
        continuous: whether to refine actions beyond the networks' pixels and bins.
        fit_outlines: whether to refine actions by the geometry of o_t as well; used only with
            `continuous`.
        recover: whether to correct failed insertions, take heaps apart and turn objects over.
        may_stop: whether to stop when there is nothing left to pick.
    """
    outlines = insertion and continuous and fit_outlines
    stages: list[Stage] = []
    if continuous:
        stages.append(SubPixel())
    if outlines:
        stages += [JawRoom(planner), OutlinePlace(), HeldInside(planner), BelongingFirst()]
    elif continuous and fit_outlines:
        stages.append(ReleaseRoom(planner))
    if may_stop:
        stages.append(OutlineStop() if outlines else StopRule())
    if continuous:
        stages.append(SeenOnly(planner))
    if recover:
        stages.append(Recovery(planner))
    return tuple(stages)


@dataclass(frozen=True)
class SubPixel:
    """Refines positions to less than a pixel and angles to less than a bin."""

    def refine(self, draft: Draft) -> Draft:
        refined = draft.angles.refined
        draft = dataclasses.replace(
            draft,
            continuous=True,
            pick=expected_position(draft.logits, draft.pixel),
            theta=draft.theta if refined is None else refined,
        )
        rotation, goal = draft.placement(draft.placing.candidates[0])
        return dataclasses.replace(draft, rotation=rotation, goal=goal)


@dataclass(frozen=True)
class JawRoom:
    """Replaces a grasp for which the jaws lack room (`refine_grasp`)."""

    planner: PickPlaceParameters

    def refine(self, draft: Draft) -> Draft:
        look = draft.look
        region = nearest_region(look.segmentation.objects, draft.pick)
        grasp = refine_grasp(
            look.segmentation,
            draft.pick,
            draft.theta,
            look.resolution,
            self.planner,
            look.failed_pixels,
            None if region is None else look.inventory.memory.balance(region),
        )
        if grasp is None:
            return draft
        return dataclasses.replace(draft, pick=grasp.pick, theta=grasp.theta, grasp_cost=grasp.cost)


@dataclass(frozen=True)
class OutlinePlace:
    """Moves the place so that the object's outline fits the recess's, if the outlines agree.

    The fit starts at the networks' place (`refine_place`). If it fails, the stage uses the recess
    into which the object fits (`Inventory.pairs`), if there is one.
    """

    def refine(self, draft: Draft) -> Draft:
        look = draft.look
        draft = dataclasses.replace(draft, outlined=True)
        region = nearest_region(look.segmentation.objects, draft.pick)
        if look.inventory.is_reversed(region):
            return draft
        fitted = refine_place(
            look.segmentation,
            draft.pick,
            draft.rotation,
            draft.place,
            look.resolution,
            look.inventory.memory.unfilled_recesses,
            look.inventory.pairs,
        )
        if fitted is not None:
            return dataclasses.replace(
                draft,
                rotation=fitted.rotation,
                fitted=fitted.place,
                fit_cost=fitted.cost,
                belongs=True,
            )
        pair = None if region is None else look.inventory.pair_of(region)
        if pair is None:
            return draft
        return dataclasses.replace(
            draft,
            rotation=wrap_to_pi(pair.fit.rotation),
            fitted=pair.fit.moved(draft.pick),
            fit_cost=pair.fit.cost,
            belongs=True,
        )


@dataclass(frozen=True)
class HeldInside:
    """Chooses another grasp of an object that fits into a recess, if much of what the jaws hold
    would lie outside the recess (`held_outside`)."""

    planner: PickPlaceParameters

    def refine(self, draft: Draft) -> Draft:
        look, region = draft.look, draft.region
        if draft.fitted is None or region is None:
            return draft
        motion = draft.pick, draft.rotation, draft.fitted
        recess = recess_under(look.segmentation, placed_mask(region, *motion))
        if recess is None:
            return draft
        outside = held_outside(region, recess, *motion, look.resolution)
        if at_pixel(outside, draft.pick) <= MOST_OUTSIDE:
            return draft
        balance = look.inventory.memory.balance(region)
        grasps = jaw_grasps(
            look.segmentation, region, look.resolution, self.planner, balance=balance
        )
        for grasp in untried(grasps, look.failed_pixels, look.resolution):
            if at_pixel(outside, grasp.pixel) <= MOST_OUTSIDE:
                moved = rotation_matrix(draft.rotation) @ (grasp.pixel - draft.pick)
                return dataclasses.replace(
                    draft,
                    pick=grasp.pixel,
                    theta=grasp.theta,
                    grasp_cost=grasp.cost,
                    fitted=draft.fitted + moved,
                )
        return dataclasses.replace(draft, grasp_cost=None)


@dataclass(frozen=True)
class ReleaseRoom:
    """Chooses the rotation that leaves the fingers most room at release (`blocked_at_place`).

    It chooses only among rotations that score equally well. A cube, for example, has four of them.
    """

    planner: PickPlaceParameters

    def refine(self, draft: Draft) -> Draft:
        candidates = draft.placing.candidates
        score = candidates[0].best()[0]
        as_good = [
            found
            for candidate in candidates
            if candidate.best()[0] >= score - _AS_GOOD
            and np.linalg.norm((found := draft.placement(candidate))[1] - draft.goal) <= _SAME_PLACE
        ]
        pixel = np.array(draft.pixel, float)

        def blocked(placement: tuple[float, NDArray[np.float64]]) -> float:
            look = draft.look
            return blocked_at_place(
                look.image[3], look.resolution, pixel, draft.theta, *placement, self.planner
            )

        # Of equally blocked rotations `min` returns the first, which has the highest score.
        rotation, goal = min(as_good, key=blocked)
        return dataclasses.replace(draft, rotation=rotation, goal=goal)


@dataclass(frozen=True)
class BelongingFirst:
    """Picks first the objects that fit into a recess (`Inventory.pairs`), then the regions that may
    contain such an object (`Inventory.worth_a_try`)."""

    def refine(self, draft: Draft) -> Draft:
        inventory = draft.look.inventory
        objects, shape = inventory.segmentation.objects, draft.look.observation.grid.shape
        region = nearest_region(objects, draft.pick)
        if draft.belongs and draft.grasp_cost is not None and not inventory.is_tried(region):
            return draft
        pairs = tuple(objects[pair.item] for pair in inventory.pairs)
        for regions in (pairs, inventory.worth_a_try):
            while regions:
                found = draft.among(mask_of(regions, shape))
                if found is None:
                    break
                if found.grasp_cost is not None:
                    return found
                # The jaws have no room at this object, so try the next.
                blocked = nearest_region(regions, found.pick)
                regions = tuple(item for item in regions if item is not blocked)
        return draft


@dataclass(frozen=True)
class StopRule:
    """Stops when the networks' log-odds that something is left to pick are below the threshold."""

    def refine(self, draft: Draft) -> Draft:
        odds, threshold = draft.look.picking.log_odds, draft.look.networks.stop_threshold
        if odds is None or threshold is None or odds >= threshold:
            return draft
        return dataclasses.replace(draft, stop=True, reason="done")


@dataclass(frozen=True)
class OutlineStop:
    """Stops when both the networks and the outlines show that nothing is left to do.

    - An object that fits into a recess is picked, even if the networks predict that nothing is
      left.
    - A region that may contain such an object (`Inventory.worth_a_try`) is picked if the networks'
      log-odds that something is left to pick reach the threshold.
    - Any other object is picked only if the log-odds exceed the threshold by at least
      `_NOTHING_FITS`. In a scene without a fixture, reaching the threshold is enough.
    - An object that lies upside down, or should not be tried again (`Inventory.is_tried`), is not
      picked, and nothing is placed into what is left of a filled recess (`Memory.is_left_over`).
    """

    def refine(self, draft: Draft) -> Draft:
        inventory = draft.look.inventory
        region = nearest_region(inventory.segmentation.objects, draft.pick)
        if draft.belongs and not inventory.is_tried(region):
            return draft
        recess = nearest_region(inventory.segmentation.recesses, draft.place)
        is_filled = recess is not None and inventory.memory.is_left_over(recess)
        if is_filled or inventory.is_reversed(region):
            return dataclasses.replace(draft, stop=True, reason=inventory.why_stop)
        odds, threshold = draft.look.picking.log_odds, draft.look.networks.stop_threshold
        new = region is not None and any(item is region for item in inventory.worth_a_try)
        if odds is not None and threshold is not None:
            margin = 0.0 if new or not inventory.segmentation.fixture.any() else _NOTHING_FITS
            if odds >= threshold + margin and not inventory.is_tried(region):
                return draft
        return dataclasses.replace(draft, stop=True, reason=inventory.why_stop)


@dataclass(frozen=True)
class SeenOnly:
    """Picks and places only where enough of o_t is seen (see `Visibility`). Stops if no action
    qualifies."""

    planner: PickPlaceParameters

    def refine(self, draft: Draft) -> Draft:
        visibility = Visibility.of(draft.look.observation)
        allowed = visibility.pickable
        found: Draft | None = draft
        for number in range(_TRIES):
            if found is None or found.stop:
                break
            if allowed[found.pixel] and self._is_seen(found, visibility):
                return found
            allowed = allowed & ~found.near(_ANOTHER)
            region = found.region
            if number % 2 and region is not None:
                # A second pick of the same object did not help, so try another object.
                allowed = allowed & ~region.mask
            found = draft.among(allowed)
        if draft.stop:
            return draft
        return dataclasses.replace(draft, stop=True, reason="not seen")

    def _is_seen(self, draft: Draft, visibility: Visibility) -> bool:
        picks = draft.pick[None], np.array([draft.theta])
        if not visibility.picks_are_seen(*picks, self.planner.open_width).all():
            return False
        region = draft.region
        footprint = None if region is None else region.pixels.astype(float)
        return visibility.place_is_seen(footprint, draft.pick, draft.rotation, draft.place)


@dataclass(frozen=True)
class Recovery:
    """Corrects failed insertions (`recovery_action`), and prepares objects that cannot be placed
    yet (`preparing_action`).

    If the networks find no grasp of an object that fits into a recess, the outlines may find one
    (`best_insertion`). It presses a protruding object down at once, and moves it or takes it out if
    the next object needs its place (`Inventory.needs_clearing`). If the networks pick from a heap,
    it is taken apart, if possible. The other corrections take several actions, so they come only
    when no object fits into a recess.
    """

    planner: PickPlaceParameters

    def refine(self, draft: Draft) -> Draft:
        look = draft.look
        mending = recovery_action(look.inventory, self.planner, look.failed_picks)
        if mending is not None and mending.press:
            return dataclasses.replace(draft, mending=mending)
        if draft.belongs and not draft.stop:
            poses = draft.pick, draft.theta, draft.place, draft.rotation
            action = make_action(look.observation, *poses)
            first = mending is not None and look.inventory.needs_clearing(action)
            return dataclasses.replace(draft, mending=mending) if first else draft
        arguments = look.inventory, self.planner, look.failed_picks
        if draft.stop:
            # The networks' grasp may lack room where another grasp of the object has room.
            inserted = best_insertion(*arguments)
            if inserted is not None:
                first = mending is not None and look.inventory.needs_clearing(inserted)
                return dataclasses.replace(draft, mending=mending if first else inserted)
            mending = preparing_action(*arguments, mending)
        elif look.inventory.is_heap(draft.pick):
            # The networks would place whatever lies on top.
            mending = clearing_action(*arguments, mending)
        return dataclasses.replace(draft, mending=mending)
