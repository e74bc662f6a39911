"""Lists the objects and recesses in o_t, and what earlier actions tell about them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from kitting_drake.policies.data.images import moved_pixels
from kitting_drake.policies.matching.assignment import Pair, match, reversed_objects
from kitting_drake.policies.matching.refinement import nearest_region
from kitting_drake.policies.matching.regions.fixtures import CLEAN
from kitting_drake.policies.matching.regions.segmentation import Region, Segmentation, segment
from kitting_drake.policies.matching.splitting import split_touching
from systems.signals import Attempt, LeftOver, Observation, PickPlaceAction, PlanarPose
from systems.surface_heights import read_surface_heights

_THERE = 0.015
"""An object within this distance of an earlier pick or place, in metres, counts as the object that
was picked or placed there."""
_SAME_OBJECT = 0.060
"""If an object was left closer than this to a later pick, in metres, that pick was of this
object."""
_LOST = ("dropped", "stopped")
"""The outcomes of actions that lose an object on its way."""
_OBSTRUCTED = 0.05
"""A place is obstructed if more than this share of the object would lie on protruding things."""
_NOT_SEATED, _NOISE = 0.001, 4.0
"""A placed object is not seated if its top is higher than expected by more than `_NOT_SEATED`, in
metres, and by more than `_NOISE` standard deviations of the noise."""
_MOST_TRIES = 3
"""The largest number of actions on one object."""
_BESIDE = 3
"""Regions that are at most this many pixels apart touch each other."""
_MOST_REMOVALS = 3
"""The largest number of objects that are taken out of one part of the kit."""
_LEAST_SHARE = 0.5
"""A region that contains an object for an open recess has at least this share of the smallest open
recess's area."""
_LEAST_REACH = 0.4
"""Such a region reaches at least this share as far from its middle as the recess with the smallest
reach. A leaning or partly hidden object looks shorter than its recess."""
_SEVERAL = 0.75
"""A region that may contain several objects has at least this share of the total area of as many
open recesses, the largest ones."""
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
        pairs = match(segmentation, resolution)
        split = split_touching(segmentation, pairs, resolution)
        if split is not segmentation:
            pairs = match(split, resolution)
        wrong = reversed_objects(split, pairs, resolution)
        return cls(
            observation,
            split,
            tuple(pair for pair in pairs if pair.item not in wrong),
            tuple(split.objects[index] for index in wrong),
        )

    @cached_property
    def pairs(self) -> tuple[Pair, ...]:
        """The matches, except those of objects that were tried too often."""
        return tuple(
            pair
            for pair in self.matches
            if self.tries(self.segmentation.objects[pair.item]) < _MOST_TRIES
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
        moved = ([it for it in moves if it.outcome != "pressed"] for moves in self._moves)
        last = [moves[-1] for moves in moved if moves]
        done = [it.action for it in last if it.outcome == "placed"]
        filled = {id(self._recess_at(it.place)) for it in done if not it.aside} - wanted
        emptied = {id(self._recess_at(it.pick)) for it in done if it.aside}
        free = {id(item) for item in seen.free_recesses} | wanted | emptied
        return tuple(item for item in seen.recesses if id(item) in free - filled)

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
        reach = _LEAST_REACH * min(map(_reach, self.open_recesses))
        return tuple(
            item
            for item in self.strangers
            if least <= item.mask.sum() <= most and _reach(item) >= reach
        )

    @property
    def left_over(self) -> LeftOver:
        """The objects that are not in a recess, and the recesses that are free."""
        seen = self.segmentation
        return LeftOver(
            objects=tuple(self._middle(item) for item in (*seen.objects, *seen.protruding)),
            cavities=tuple(self._middle(item) for item in self.free_recesses),
        )

    @property
    def why_stop(self) -> str:
        """The reason, a key of `STOP_REASONS`, for which a policy stops if it finds nothing to
        do."""
        seen = self.segmentation
        if not seen.kit_seen and not self._has_filled:
            return "no kit seen"
        if not seen.objects and not seen.protruding:
            return "done"
        tried = any(self.tries(item) for item in (*seen.objects, *seen.protruding))
        if (self.free_recesses or seen.protruding) and tried:
            return "gave up"
        return "nothing fits" if seen.objects and self.free_recesses else "done"

    def pair_of(self, region: Region) -> Pair | None:
        """Returns the pair of an object and its recess; None if the object fits into no recess."""
        objects = self.segmentation.objects
        return next((pair for pair in self.pairs if objects[pair.item] is region), None)

    def is_reversed(self, region: Region | None) -> bool:
        """Whether an object must be turned over before it fits. For None the result is False."""
        return any(item is region for item in self.reversed_items)

    def is_tried(self, region: Region | None) -> bool:
        """Whether the objects of a region were tried often enough. For None the result is False.

        `_MOST_TRIES` actions on one object are enough. A region that fits into no recess is not
        tried once more if all objects that it can contain were laid there before and it touches no
        other region, which may hide a part of it.
        """
        if region is None:
            return False
        fits_nowhere = self.pair_of(region) is None and not self.is_reversed(region)
        laid = sum(moves[-1].outcome == "placed" for moves in self._moves_of(region))
        if fits_nowhere and laid and not self._may_contain(region, laid + 1):
            return self._is_alone(region) or self.tries(region) >= _MOST_TRIES
        return self.tries(region) >= _MOST_TRIES

    def tries(self, region: Region) -> int:
        """Returns how many earlier actions moved the object that lies in this region to where it
        lies, or failed to move it since then. Of several objects, the one that was left there last
        counts. Two actions that set the object down again count as one, because each shows better
        where it must be gripped."""
        last = (self._moves_of(region) or [[]])[-1]
        # An object that was lost on its way may lie far from where it was gripped.
        placed = [k for k, item in enumerate(last) if item.outcome == "placed"]
        since = placed[-1] if placed else -1
        here = [
            item.outcome
            for k, item in enumerate(last)
            if (k > since and item.outcome in _LOST) or self._is_there(_left_at(item), region)
        ]
        return len(here) - (here.count("set down") + 1) // 2

    def named(self, action: PickPlaceAction) -> PickPlaceAction:
        """Returns an action with the middle of the object that it picks, if it picks one."""
        if action.stop or action.press:
            return action
        pixel = np.array(self.observation.grid.to_pixel((action.pick.x, action.pick.y)))
        loose = (*self.segmentation.objects, *self.segmentation.protruding)
        region = nearest_region(loose, pixel)
        return action if region is None else replace(action, middle=self._middle(region))

    def needs_clearing(self, action: PickPlaceAction) -> bool:
        """Whether a protruding object must be taken out of the kit before an action: it lies where
        the action would put its object, or another one was taken out before it."""
        if self._removals:
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

    def was_removed(self, region: Region) -> bool:
        """Whether earlier actions took the object in a region out of the kit, and then placed it
        there again, or took out `_MOST_REMOVALS` objects there."""
        if sum(self._is_there(pick, region) for pick in self._removals) >= _MOST_REMOVALS:
            return True
        index = _nearest(self._moves, self._middle(region))
        removed = False
        for attempt in [] if index is None else self._moves[index]:
            if attempt.outcome != "placed":
                continue
            if attempt.action.aside:
                removed |= self._is_on_fixture(attempt.action.pick)
            elif removed:
                return True
        return False

    def misplacement(self, region: Region) -> NDArray[np.float64] | None:
        """Returns how far (rows, columns) an object lies from where an action let it go in the kit.

        Returns None if this is not known: the object was not placed there, or was moved within the
        kit before, or several placed objects lie in the region.
        """
        moves = self._moves_of(region)
        placing = [item for item in moves[0] if item.outcome != "pressed"] if moves else []
        if len(moves) != 1 or not placing or placing[-1].outcome != "placed":
            return None
        last = placing[-1].action
        if last.middle is None or last.aside:
            return None
        if self._is_on_fixture(last.pick) or not self._is_on_fixture(last.place):
            return None
        meant = self.observation.grid.to_pixel(_middle_left_at(placing[-1]))
        return np.asarray(region.pixels.mean(axis=0) - meant)

    @property
    def unseated(self) -> tuple[PlanarPose, ...]:
        """The places in the kit where an object was let go and does not stand on the floor: it is
        higher than it was on the table, relative to what it should stand on."""
        observation = self.observation
        doubt = max(_NOT_SEATED, _NOISE * self.segmentation.noise)
        found = []
        for moves in self._moves:
            attempt, place = moves[-1], moves[-1].action.place
            was_seated = attempt.outcome == "placed" and not attempt.action.aside
            if attempt.top is None or not was_seated or not self._is_on_fixture(place):
                continue
            if read_surface_heights(observation, place, place).pick_top > attempt.top + doubt:
                found.append(place)
        return tuple(found)

    def balance(self, region: Region) -> NDArray[np.float64] | None:
        """Returns (row, col) of an object's centre of mass; None if the hand has not measured it
        where the object lies now."""
        for attempt in reversed(self._history):
            if attempt.balance is not None and self._is_there(attempt.action.pick, region):
                return np.asarray(self.observation.grid.to_pixel(attempt.balance))
        return None

    def _moves_of(self, region: Region) -> list[list[Attempt]]:
        """Returns the earlier actions on each object that was left in a region, oldest first. The
        object that was left there last comes last.

        An object that was lost on its way need not lie where it was gripped. It is the nearest one,
        unless another object lies there.
        """
        found = [moves for moves in self._moves if self._is_there(_left_at(moves[-1]), region)]
        nearest = None if found else _nearest(self._moves, self._middle(region))
        if nearest is None or self._moves[nearest][-1].outcome not in _LOST:
            return found
        moves = self._moves[nearest]
        seen = (*self.segmentation.objects, *self.segmentation.protruding)
        is_left = any(self._is_there(_left_at(moves[-1]), it) for it in seen if it is not region)
        return found if is_left else [moves]

    @cached_property
    def _moves(self) -> list[list[Attempt]]:
        """The earlier actions on each object, oldest first. The object that was moved last comes
        last.

        An action is on the object whose middle was left nearest to the middle of its own object, if
        that is within `_SAME_OBJECT`; else on an object that no action was on before.
        """
        objects: list[list[Attempt]] = []
        for attempt in self._history:
            index = _nearest(objects, _found_at(attempt))
            objects.append([*([] if index is None else objects.pop(index)), attempt])
        return objects

    @property
    def _removals(self) -> list[PlanarPose]:
        """The picks at which earlier actions took objects out of the kit."""
        done = [item.action for item in self._history if item.outcome == "placed"]
        return [item.pick for item in done if item.aside and self._is_on_fixture(item.pick)]

    def _may_contain(self, region: Region, count: int) -> bool:
        """Whether a region is so large that it may contain this many objects for open recesses."""
        areas = sorted((int(item.mask.sum()) for item in self.open_recesses), reverse=True)
        largest = areas[:count]
        return len(largest) == count and bool(region.mask.sum() >= _SEVERAL * sum(largest))

    def _is_alone(self, region: Region) -> bool:
        """Whether no other object touches a region."""
        around = ndimage.binary_dilation(region.mask, iterations=_BESIDE)
        others = (item for item in self.segmentation.objects if item is not region)
        return not any((around & item.mask).any() for item in others)

    def _recess_at(self, pose: PlanarPose) -> Region | None:
        """Returns the recess at a gripper's pose; None if there is none."""
        pixel = np.array(self.observation.grid.to_pixel((pose.x, pose.y)))
        region = nearest_region(self.segmentation.recesses, pixel)
        return region if region is not None and self._is_there(pose, region) else None

    @property
    def _has_filled(self) -> bool:
        """Whether an earlier action placed an object onto the fixture that o_t shows. If so, a
        fixture without visible recesses is a filled kit."""
        return any(
            attempt.outcome == "placed" and self._is_on_fixture(attempt.action.place)
            for attempt in self._history
        )

    def _is_on_fixture(self, pose: PlanarPose) -> bool:
        grid = self.observation.grid
        if not grid.contains((pose.x, pose.y)):
            return False
        row, col = np.rint(grid.to_pixel((pose.x, pose.y))).astype(int)
        return bool(self.segmentation.fixture[row, col])

    @property
    def _history(self) -> tuple[Attempt, ...]:
        return self.observation.history

    def _is_there(self, pose: PlanarPose, region: Region) -> bool:
        grid = self.observation.grid
        pixel = grid.to_pixel((pose.x, pose.y))
        away = np.linalg.norm(region.pixels - pixel, axis=1).min() * grid.resolution
        return bool(away < _THERE)

    def _middle(self, region: Region) -> tuple[float, float]:
        x, y = self.observation.grid.to_world(region.pixels.mean(axis=0))
        return float(x), float(y)


def _nearest(objects: Sequence[Sequence[Attempt]], middle: tuple[float, float]) -> int | None:
    """Returns the index of the object that was left nearest to a point; None if none was left
    within `_SAME_OBJECT`. Of objects that were left at almost the same place, the last one lies on
    top.

    Args:
        objects: the actions on each object, oldest first; the object that was moved last comes
            last.
        middle: the middle of an object, in the world.
    """
    if not objects:
        return None
    away = np.array([math.dist(_middle_left_at(moves[-1]), middle) for moves in objects])
    nearest = int(np.flatnonzero(away < away.min() + _THERE)[-1])
    return nearest if away[nearest] < _SAME_OBJECT else None


def _reach(region: Region) -> float:
    """Returns the largest distance of a region's pixels from their mean, in pixels."""
    pixels = region.pixels
    return float(np.linalg.norm(pixels - pixels.mean(axis=0), axis=1).max())


def _found_at(attempt: Attempt) -> tuple[float, float]:
    """Returns the middle of an action's object before the action; if unknown, the pick."""
    pick = attempt.action.pick
    return attempt.action.middle or (pick.x, pick.y)


def _middle_left_at(attempt: Attempt) -> tuple[float, float]:
    """Returns the middle of an action's object after the action; if unknown, the point at which it
    was gripped."""
    action, left = attempt.action, _left_at(attempt)
    if action.middle is None:
        return left.x, left.y
    x, y = action.middle[0] - action.pick.x, action.middle[1] - action.pick.y
    turn = left.theta - action.pick.theta
    cos, sin = math.cos(turn), math.sin(turn)
    return left.x + cos * x - sin * y, left.y + sin * x + cos * y


def _left_at(attempt: Attempt) -> PlanarPose:
    """Returns the pose at which an action left its object, as far as the robot knows."""
    return attempt.action.place if attempt.outcome == "placed" else attempt.action.pick


def mask_of(regions: tuple[Region, ...], shape: tuple[int, int]) -> NDArray[np.bool_]:
    """Returns a mask (rows, cols) of the pixels of all regions."""
    mask = np.zeros(shape, bool)
    for region in regions:
        mask |= region.mask
    return mask
