"""Lists the objects and recesses in o_t, and what earlier actions tell about them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from kitting_drake.policies.data.images import moved_pixels
from kitting_drake.policies.matching.assignment import Pair, match, reversed_objects
from kitting_drake.policies.matching.memory import Memory
from kitting_drake.policies.matching.refinement import nearest_region
from kitting_drake.policies.matching.regions.fixtures import CLEAN
from kitting_drake.policies.matching.regions.segmentation import Region, Segmentation, segment
from kitting_drake.policies.matching.splitting import split_touching
from systems.signals import LeftOver, Observation, PickPlaceAction, PlanarPose

_OBSTRUCTED = 0.05
"""A place is obstructed if more than this share of the object would lie on protruding things."""
_PROUD = 0.003
"""An object that protrudes by more than this, in metres, is not placed. A seated object may itself
rise 1 mm above the kit, and strict success allows 2 mm more."""
_MOST_TRIES = 3
"""The largest number of actions on one object."""
_MOST_ASIDES = 2
"""How often an object that fits into no recess is laid aside."""
_BESIDE = 3
"""Regions that are at most this many pixels apart touch each other."""
_LEANS = 6
"""An object that leans on the kit is two regions, at most this many pixels apart: pixels near the
kit's edge belong to neither."""
_LEAST_SHARE = 0.5
"""A region that contains an object for an open recess has at least this share of the smallest open
recess's area."""
_LEAST_REACH = 0.4
"""Such a region reaches at least this share as far from its middle as the recess with the smallest
reach. A leaning or partly hidden object looks shorter than its recess."""
_SEVERAL = 0.75
"""A region that may contain several objects has at least this share of the total area of as many
open recesses, the largest ones."""
_LARGER = 1.2
"""A region counts as several objects if every open recess is smaller or shorter by this factor."""
_LARGEST_SHARE = 1.6
"""A region of objects for open recesses has at most this multiple of these recesses' total area."""


@dataclass(frozen=True)
class Inventory:
    """The objects and recesses of an observation, and the pairs of them that fit."""

    observation: Observation
    segmentation: Segmentation
    """The regions of o_t. Touching objects are separated if the outlines of recesses show where one
    object ends."""
    matches: tuple[Pair, ...]
    """All pairs of an object and a recess that fit, best fit first."""
    reversed_items: tuple[Region, ...] = ()
    """The objects that must be turned over before they fit."""

    @classmethod
    def of(cls, observation: Observation) -> Inventory:
        """Computes the inventory of an observation."""
        segmentation, resolution = segment(observation), observation.grid.resolution
        unfilled = Memory(observation, segmentation).unfilled_recesses
        pairs = match(segmentation, unfilled, resolution)
        split = split_touching(segmentation, pairs, resolution)
        if split is not segmentation:
            pairs = match(split, unfilled, resolution)
        wrong = reversed_objects(split, pairs, unfilled, resolution)
        return cls(
            observation,
            split,
            tuple(pair for pair in pairs if pair.item not in wrong),
            tuple(split.objects[index] for index in wrong),
        )

    @cached_property
    def memory(self) -> Memory:
        """What earlier actions tell about the objects and recesses."""
        return Memory(self.observation, self.segmentation)

    @cached_property
    def pairs(self) -> tuple[Pair, ...]:
        """The matches, except those of objects that were tried too often."""
        return tuple(
            pair
            for pair in self.matches
            if self.memory.tries(self.segmentation.objects[pair.item]) < _MOST_TRIES
        )

    @property
    def open_recesses(self) -> tuple[Region, ...]:
        """The free recesses into which no object is known to fit."""
        recesses = self.segmentation.recesses
        known = {id(recesses[pair.recess]) for pair in self.pairs}
        return tuple(item for item in self.free_recesses if id(item) not in known)

    @cached_property
    def free_recesses(self) -> tuple[Region, ...]:
        """The recesses that seem free, except those into which an object was placed.

        A flat tool in its recess looks like the recess's floor, and so does any tool if there is
        noise. But without noise, if an object is loose, what seems free is free. A recess into
        which a loose object fits is free, and so is one from which the object was taken out.
        """
        seen = self.segmentation
        if seen.noise <= CLEAN and seen.objects:
            return seen.free_recesses
        wanted = {id(seen.recesses[pair.recess]) for pair in self.matches}
        done = [it for it in self.memory.last if it.outcome == "placed"]
        filled = {id(it) for it in seen.recesses if self._is_filled(it)}
        emptied = {id(self.memory.recess_at(it.action.pick)) for it in done if it.action.aside}
        free = {id(item) for item in seen.free_recesses} | wanted | emptied
        return tuple(item for item in seen.recesses if id(item) in free - (filled - wanted))

    @property
    def strangers(self) -> tuple[Region, ...]:
        """The objects that fit into no recess and were not tried too often, largest first.

        Each is a region of o_t. It may be several touching objects, or one whose outline is partly
        hidden.
        """
        paired = {pair.item for pair in self.pairs}
        objects = enumerate(self.segmentation.objects)
        return tuple(
            item
            for index, item in objects
            if index not in paired and not self.is_reversed(item) and not self.is_tried(item)
        )

    @property
    def worth_a_try(self) -> tuple[Region, ...]:
        """The `strangers` that, by their size, may contain objects for the open recesses."""
        areas = [int(item.mask.sum()) for item in self.open_recesses]
        if not areas:
            return ()
        least, most = _LEAST_SHARE * min(areas), _LARGEST_SHARE * sum(areas)
        reach = _LEAST_REACH * min(item.reach for item in self.open_recesses)
        return tuple(
            item
            for item in self.strangers
            if least <= item.mask.sum() <= most and item.reach >= reach
        )

    @property
    def left_over(self) -> LeftOver:
        """The objects that are not in a recess, and the recesses that are free."""
        return LeftOver(
            objects=tuple(self.memory.middle(item) for item in self._not_placed),
            cavities=tuple(self.memory.middle(item) for item in self.free_recesses),
        )

    @property
    def why_stop(self) -> str:
        """The reason, a key of `STOP_REASONS`, for which a policy stops if it finds nothing to
        do."""
        seen, free = self.segmentation, self.free_recesses
        if not seen.kit_seen and not self.memory.has_filled:
            return "no kit seen"
        is_proud = len(self._not_placed) > len(seen.objects)
        is_missing = free and any(map(self.memory.is_missing, self.memory.last))
        is_tried = (free or is_proud) and any(map(self.memory.tries, self._not_placed))
        if is_missing or is_tried:
            return "gave up"
        if not seen.objects:
            return "not seen" if free and not seen.visibility.is_whole else "done"
        if not all(map(self._is_filled, seen.hidden_recesses)):
            return "not seen"
        if not free:
            return "done"
        if self.pairs:
            return "not sure"
        return "not seen" if any(map(self._is_cut, seen.objects)) else "nothing fits"

    @cached_property
    def _not_placed(self) -> tuple[Region, ...]:
        """The loose objects, and those that protrude from the kit by more than `_PROUD`."""
        seen = self.segmentation
        return (*seen.objects, *(item for item in seen.protruding if item.height > _PROUD))

    def _is_filled(self, recess: Region) -> bool:
        """Whether an object was placed into a recess."""
        return any(self.memory.covers(item, recess) for item in self.memory.inside)

    def pair_of(self, region: Region) -> Pair | None:
        """Returns the pair of an object and its recess; None if the object fits into no recess."""
        objects = self.segmentation.objects
        return next((pair for pair in self.pairs if objects[pair.item] is region), None)

    def is_reversed(self, region: Region | None) -> bool:
        """Whether an object must be turned over before it fits. For None the result is False."""
        return any(item is region for item in self.reversed_items)

    def is_tried(self, region: Region | None) -> bool:
        """Whether the objects of a region were tried often enough. For None the result is False.

        `_MOST_TRIES` actions on one object are enough. An object that fits into no recess is laid
        aside at most `_MOST_ASIDES` times. A region that fits into no recess is not tried once more
        if all objects that it can contain were laid there before, it is seen whole and it touches
        no other region, which may hide a part of it.
        """
        if region is None:
            return False
        memory = self.memory
        if memory.tries(region) >= _MOST_TRIES:
            return True
        fits_nowhere = self.pair_of(region) is None and not self.is_reversed(region)
        laid = sum(moves[-1].outcome == "placed" for moves in memory.moves_of(region))
        if not fits_nowhere or not laid or self._may_contain(region, laid + 1):
            return False
        is_whole = not self._is_cut(region) and self._is_alone(region)
        return is_whole or memory.asides(region) >= _MOST_ASIDES

    def is_heap(self, pixel: NDArray[np.float64]) -> bool:
        """Whether the region at a pixel (row, col) is `worth_a_try` but too large or too long for
        each open recess. It is probably several objects."""
        region = nearest_region(self.segmentation.objects, pixel)
        if region is None or not any(item is region for item in self.worth_a_try):
            return False
        area, reach = region.mask.sum() / _LARGER, region.reach / _LARGER
        return not any(it.mask.sum() >= area and it.reach >= reach for it in self.open_recesses)

    def named(self, action: PickPlaceAction) -> PickPlaceAction:
        """Returns an action with the middle and the spread of the object that it picks, if it picks
        one."""
        if action.stop or action.press:
            return action
        pixel = np.array(self.observation.grid.to_pixel((action.pick.x, action.pick.y)))
        loose = (*self.segmentation.objects, *self.segmentation.protruding)
        region = nearest_region(loose, pixel)
        if region is None:
            return action
        grid = self.observation.grid
        # A pixel is a square, whose own variance is 1/12.
        spread = np.cov(region.pixels.T, bias=True) + np.eye(2) / 12
        xx, xy, _, yy = (spread * grid.resolution**2).ravel().tolist()
        return replace(action, middle=self.memory.middle(region), spread=(xx, xy, yy))

    def needs_clearing(self, action: PickPlaceAction) -> bool:
        """Whether a protruding object must be taken out of the kit before an action: it lies where
        the action would put its object, or another one was taken out before it."""
        if self.memory.removals:
            return True
        grid, turn = self.observation.grid, action.place.theta - action.pick.theta
        pick, place = (np.array(grid.to_pixel((p.x, p.y))) for p in (action.pick, action.place))
        region = nearest_region(self.segmentation.objects, pick)
        if region is None:
            return False
        target = moved_pixels(region.pixels, pick, turn, place)
        target = target[((target >= 0) & (target < grid.shape)).all(axis=1)]
        mask = mask_of(self.segmentation.protruding, grid.shape)
        return bool(mask[tuple(target.T)].sum() > _OBSTRUCTED * len(region.pixels))

    def leans(self, pick: PlanarPose) -> bool:
        """Whether the object at a pick protrudes from the kit and touches an object on the table:
        the two are perhaps one that leans on the kit."""
        pixel = np.array(self.observation.grid.to_pixel((pick.x, pick.y)))
        region = nearest_region(self.segmentation.protruding, pixel)
        return region is not None and not self._is_alone(region, _LEANS)

    def _may_contain(self, region: Region, count: int) -> bool:
        """Whether a region is so large that it may contain this many objects for open recesses."""
        areas = sorted((int(item.mask.sum()) for item in self.open_recesses), reverse=True)
        largest = areas[:count]
        return len(largest) == count and bool(region.mask.sum() >= _SEVERAL * sum(largest))

    def _is_alone(self, region: Region, reach: int = _BESIDE) -> bool:
        """Whether no other loose object is within a number of pixels of a region."""
        around = ndimage.binary_dilation(region.mask, iterations=reach)
        others = (item for item in self.segmentation.objects if item is not region)
        return not any((around & item.mask).any() for item in others)

    def _is_cut(self, item: Region) -> bool:
        """Whether an object reaches the edge of o_t or of the cameras' views."""
        beyond = ~np.pad(self.segmentation.visibility.in_view, 1)
        return bool((ndimage.binary_dilation(beyond)[1:-1, 1:-1] & item.mask).any())


def mask_of(regions: tuple[Region, ...], shape: tuple[int, int]) -> NDArray[np.bool_]:
    """Returns a mask (rows, cols) of the pixels of all regions."""
    mask = np.zeros(shape, bool)
    for region in regions:
        mask |= region.mask
    return mask
