"""Relates the history of o_t to the objects and recesses that o_t shows."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kitting_drake.policies.data.images import rotation_matrix
from kitting_drake.policies.matching.refinement import nearest_region
from kitting_drake.policies.matching.regions.segmentation import Region, Segmentation
from systems.signals import Attempt, Observation, PlanarPose
from systems.surface_heights import read_surface_heights

_THERE = 0.015
"""An object within this distance of an earlier pick or place, in metres, counts as the object that
was picked or placed there."""
_LOST = ("dropped", "stopped")
"""The outcomes of actions that lose an object on its way."""
_UNMOVED = ("missed", "unreachable", "set down", "pressed")
"""The outcomes of actions that leave an object where it was."""
_SAME_OBJECT = 0.060
"""If an object was left closer than this to a later pick, in metres, that pick was of this
object."""
_DEVIATIONS = 2.2
"""An object and the gap around it reach this many standard deviations from its middle. A rod alone
reaches 1.7, an ellipse 2."""
_NOT_SEATED, _NOISE = 0.001, 4.0
"""A placed object is not seated if its top is higher than expected by more than `_NOT_SEATED`, in
metres, and by more than `_NOISE` standard deviations of the noise."""
_FILLED = 0.002
"""A recess is empty if its floor is seen where it was, to within this, in metres, or to within
`_NOISE` standard deviations of the noise."""
_STANDS_OUT, _WHOLE = 0.005, 0.8
"""A recess is no empty one if its object is higher than it is deep by more than `_STANDS_OUT`, in
metres, and its pixels have less than the share `_WHOLE` of the variance of the object's pixels."""
_AS_LARGE, _AS_WIDE = 0.45, 0.7
"""The pixels of an empty recess have at least the share `_AS_LARGE` of the variance of its object's
pixels. Its inner radius is at least `_AS_WIDE` standard deviations of them across the object."""
_MOST_REMOVALS = 3
"""The largest number of objects that are taken out of one part of the kit."""
_COVERED = 0.5
"""A part of a recess is filled if an object covers more than this share of it."""
_ON_AXIS = 0.6
"""A recess is what is left of a filled one only if its middle is this close to the long axis of the
placed object, in standard deviations of the object's points across the axis. Recesses beside the
object are farther away."""
_SLENDER = 0.33
"""The points of a single tool deviate at most this much across its long axis, as a share of their
deviation along it."""


@dataclass(frozen=True)
class Memory:
    """What the history of o_t tells about the objects and recesses that o_t shows."""

    observation: Observation
    segmentation: Segmentation

    @cached_property
    def moves(self) -> list[list[Attempt]]:
        """The earlier actions on each object (`_moves_by_object`)."""
        return _moves_by_object(self._history)

    @cached_property
    def last(self) -> tuple[Attempt, ...]:
        """The last action that moved each object, or should have moved it."""
        return self._last_but(("pressed",))

    @cached_property
    def inside(self) -> tuple[Attempt, ...]:
        """The actions that placed an object which still lies there, as far as o_t shows."""
        return tuple(
            it
            for it in self._last_but(_UNMOVED)
            if it.outcome == "placed" and not it.action.aside and not self.is_empty(it)
        )

    @cached_property
    def unfilled_recesses(self) -> tuple[Region, ...]:
        """The recesses into which objects may go. What is left of a filled recess is not one of
        them."""
        unfilled = self.segmentation.unfilled_recesses
        return tuple(item for item in unfilled if not self.is_left_over(item))

    def is_left_over(self, recess: Region) -> bool:
        """Whether a recess is what is left of one that an object fills. Another object may seem to
        fit into it."""
        return any(self._is_left_of(attempt, recess) for attempt in self.inside)

    def is_missing(self, last: Attempt) -> bool:
        """Whether an object, by the last action on it, may be lost: the action moved it, but the
        recess at its place is still empty."""
        return last.outcome in ("placed", *_LOST) and self.is_empty(last)

    def is_empty(self, attempt: Attempt) -> bool:
        """Whether the recess at an action's place is as deep as before the action, and about as
        large as the action's object.

        The hole of a placed ring and the gap around a placed object are as deep, but smaller or
        narrower. If no camera sees the floor, the lowest point that is seen is on a wall, and a
        hammer's handle may lie at its height. Then the head is missing from the recess, and the
        hammer is higher than the recess is deep.
        """
        action, resolution = attempt.action, self.observation.grid.resolution
        recess = self.recess_at(action.place)
        if attempt.floor is None or action.spread is None or action.aside or recess is None:
            return False
        xx, xy, yy = action.spread
        narrow = np.linalg.eigvalsh([[xx, xy], [xy, yy]])[0]
        share = recess.pixels.var(axis=0).sum() * resolution**2 / (xx + yy)
        if share < _AS_LARGE or recess.inner_radius * resolution < _AS_WIDE * math.sqrt(narrow):
            return False
        higher = 0.0 if attempt.top is None else attempt.top - attempt.floor - recess.height
        if higher > _STANDS_OUT and share < _WHOLE:
            return False
        doubt = max(_FILLED, _NOISE * self.segmentation.noise)
        if attempt.top is not None:
            doubt = min(doubt, (attempt.top - attempt.floor) / 2)
        floor = read_surface_heights(self.observation, action.place, action.place).place_floor
        return bool(abs(floor - attempt.floor) < doubt)

    @property
    def has_filled(self) -> bool:
        """Whether an earlier action placed an object onto the fixture that o_t shows. If so, a
        fixture without visible recesses is a filled kit."""
        return any(
            attempt.outcome == "placed" and self.is_on_fixture(attempt.action.place)
            for attempt in self._history
        )

    @property
    def removals(self) -> list[PlanarPose]:
        """The picks at which earlier actions took objects out of the kit."""
        done = [item.action for item in self._history if item.outcome == "placed"]
        return [item.pick for item in done if item.aside and self.is_on_fixture(item.pick)]

    def moves_of(self, region: Region) -> list[list[Attempt]]:
        """Returns the earlier actions on each object that was left in a region, oldest first. The
        object that was left there last comes last.

        An object that was lost on its way need not lie where it was gripped. It is the nearest one,
        unless another object lies there.
        """
        found = [moves for moves in self.moves if self._is_there(_left_at(moves[-1]), region)]
        nearest = None if found else _nearest_moved(self.moves, self.middle(region))
        if nearest is None or self.moves[nearest][-1].outcome not in _LOST:
            return found
        moves = self.moves[nearest]
        seen = (*self.segmentation.objects, *self.segmentation.protruding)
        is_left = any(self._is_there(_left_at(moves[-1]), it) for it in seen if it is not region)
        return found if is_left else [moves]

    def tries(self, region: Region) -> int:
        """Returns how many earlier actions moved the object that lies in this region to where it
        lies, or failed to move it since then. Of several objects, the one that was left there last
        counts. Two actions that set the object down again count as one, because each shows better
        where it must be gripped."""
        last = (self.moves_of(region) or [[]])[-1]
        # An object that was lost on its way may lie far from where it was gripped.
        placed = [k for k, item in enumerate(last) if item.outcome == "placed"]
        since = placed[-1] if placed else -1
        here = [
            item.outcome
            for k, item in enumerate(last)
            if (k > since and item.outcome in _LOST) or self._is_there(_left_at(item), region)
        ]
        return len(here) - (here.count("set down") + 1) // 2

    def asides(self, region: Region) -> int:
        """Returns how often the object in a region was laid aside. Of several objects, the one that
        was left there last counts. Taking it out of the kit, or turning it over the kit's edge,
        does not count."""
        done = (it.action for it in (self.moves_of(region) or [[]])[-1] if it.outcome == "placed")
        near = self._is_near_fixture
        return sum(it.aside and not near(it.pick) and not near(it.place) for it in done)

    def was_removed(self, region: Region) -> bool:
        """Whether earlier actions took the object in a region out of the kit, and then placed it
        there again, or took out `_MOST_REMOVALS` objects there."""
        if sum(self._is_there(pick, region) for pick in self.removals) >= _MOST_REMOVALS:
            return True
        index = _nearest_moved(self.moves, self.middle(region))
        removed = False
        for attempt in [] if index is None else self.moves[index]:
            if attempt.outcome != "placed":
                continue
            if attempt.action.aside:
                removed |= self.is_on_fixture(attempt.action.pick)
            elif removed:
                return True
        return False

    def misplacement(self, region: Region) -> NDArray[np.float64] | None:
        """Returns how far (rows, columns) an object lies from where an action let it go in the kit.

        Returns None if this is not known: the object was not placed there, or was moved within the
        kit before, or several placed objects lie in the region.
        """
        moves = self.moves_of(region)
        placing = [item for item in moves[0] if item.outcome != "pressed"] if moves else []
        if len(moves) != 1 or not placing or placing[-1].outcome != "placed":
            return None
        last = placing[-1].action
        if last.middle is None or last.aside:
            return None
        if self.is_on_fixture(last.pick) or not self.is_on_fixture(last.place):
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
        for moves in self.moves:
            attempt, place = moves[-1], moves[-1].action.place
            was_seated = attempt.outcome == "placed" and not attempt.action.aside
            if attempt.top is None or not was_seated or not self.is_on_fixture(place):
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

    def recess_at(self, pose: PlanarPose) -> Region | None:
        """Returns the recess at a gripper's pose; None if there is none."""
        pixel = np.array(self.observation.grid.to_pixel((pose.x, pose.y)))
        region = nearest_region(self.segmentation.recesses, pixel)
        return region if region is not None and self._is_there(pose, region) else None

    def covers(self, attempt: Attempt, recess: Region) -> bool:
        """Whether the object that an action placed is in a recess, or in the part of it that o_t
        shows."""
        away = self._offsets(attempt, recess.pixels)
        if away is None:
            return self.recess_at(attempt.action.place) is recess
        return bool(((away**2).sum(axis=1) < _DEVIATIONS**2).mean() > _COVERED)

    def _is_left_of(self, attempt: Attempt, recess: Region) -> bool:
        """Whether a recess is what is left of the one that an action's object fills: the object is
        slender and covers it, and its middle is on the object's long axis.

        The points of a heap, from which one object was picked, are not slender.
        """
        if attempt.action.spread is None:
            return False
        xx, xy, yy = attempt.action.spread
        narrow, wide = np.linalg.eigvalsh([[xx, xy], [xy, yy]])
        middle = self._offsets(attempt, recess.pixels.mean(axis=0, keepdims=True))
        is_on_axis = middle is not None and abs(middle[0, 0]) < _ON_AXIS
        return bool(narrow < _SLENDER**2 * wide) and is_on_axis and self.covers(attempt, recess)

    def _offsets(self, attempt: Attempt, pixels: NDArray[Any]) -> NDArray[np.float64] | None:
        """Returns the offsets (n, 2) of n pixels from the middle of an action's object after the
        action, across and along its long axis, in standard deviations of its points; None if these
        are unknown."""
        action = attempt.action
        if action.spread is None:
            return None
        xx, xy, yy = action.spread
        variances, axes = np.linalg.eigh([[xx, xy], [xy, yy]])
        turn = rotation_matrix(_left_at(attempt).theta - action.pick.theta)
        away = self.observation.grid.to_world(pixels) - _middle_left_at(attempt)
        return np.asarray(away @ turn @ axes / np.sqrt(variances))

    def middle(self, region: Region) -> tuple[float, float]:
        """Returns the middle of a region, (x, y) in the world, in m."""
        x, y = self.observation.grid.to_world(region.pixels.mean(axis=0))
        return float(x), float(y)

    def is_on_fixture(self, pose: PlanarPose) -> bool:
        """Whether a gripper's pose is above a fixture."""
        grid = self.observation.grid
        if not grid.contains((pose.x, pose.y)):
            return False
        row, col = np.rint(grid.to_pixel((pose.x, pose.y))).astype(int)
        return bool(self.segmentation.fixture[row, col])

    def _is_near_fixture(self, pose: PlanarPose) -> bool:
        grid, pixels = self.observation.grid, np.argwhere(self.segmentation.fixture)
        away = np.linalg.norm(pixels - grid.to_pixel((pose.x, pose.y)), axis=1)
        return bool(away.min(initial=np.inf) * grid.resolution < _THERE)

    def _last_but(self, ignored: Sequence[str]) -> tuple[Attempt, ...]:
        """The last action on each object, apart from actions with some outcomes."""
        counted = ([it for it in moves if it.outcome not in ignored] for moves in self.moves)
        return tuple(moves[-1] for moves in counted if moves)

    @property
    def _history(self) -> tuple[Attempt, ...]:
        return self.observation.history

    def _is_there(self, pose: PlanarPose, region: Region) -> bool:
        grid = self.observation.grid
        pixel = grid.to_pixel((pose.x, pose.y))
        away = np.linalg.norm(region.pixels - pixel, axis=1).min() * grid.resolution
        return bool(away < _THERE)


def _moves_by_object(history: Sequence[Attempt]) -> list[list[Attempt]]:
    """Returns the earlier actions on each object, oldest first. The object that was moved last
    comes last.

    An action is on the object whose middle was left nearest to the middle of its own object, if
    that is within `_SAME_OBJECT`; else on an object that no action was on before.
    """
    objects: list[list[Attempt]] = []
    for attempt in history:
        pick = attempt.action.pick
        index = _nearest_moved(objects, attempt.action.middle or (pick.x, pick.y))
        objects.append([*([] if index is None else objects.pop(index)), attempt])
    return objects


def _nearest_moved(objects: Sequence[Sequence[Attempt]], middle: tuple[float, float]) -> int | None:
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
    found = int(np.flatnonzero(away < away.min() + _THERE)[-1])
    return found if away[found] < _SAME_OBJECT else None


def _left_at(attempt: Attempt) -> PlanarPose:
    """Returns the pose at which an action left its object, as far as the robot knows."""
    return attempt.action.place if attempt.outcome == "placed" else attempt.action.pick


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
