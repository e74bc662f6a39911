"""Corrects a failed insertion that the next o_t shows.

An object that protrudes from the fixture is not seated. If it protrudes a little, it is pressed
down once. If it protrudes more, or this did not help, it is moved to its place if it lies a little
beside it: such a short motion is more exact than the first one, in which an error of the cameras'
calibration counts twice if the object is rotated by half a turn. Else it is taken out and laid on
the table to be tried again. An object that is jammed below the rim is pressed down once, after
heaps are taken apart. This uses only heights and is not in the paper.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from kitting_drake.policies.data.images import make_action
from kitting_drake.policies.matching.inventory import Inventory
from kitting_drake.policies.matching.jaw_clearance import (
    RETRY_DISTANCE,
    JawGrasp,
    failed_pixels,
    jaw_grasps,
    untried,
)
from kitting_drake.policies.matching.regions.segmentation import Mask, Region, Segmentation
from kitting_drake.policies.matching.separating import (
    separating_action,
    topmost_layers,
    turning_action,
)
from systems.pick_place_parameters import PickPlaceParameters
from systems.signals import Observation, PickPlaceAction, PlanarPose

Array = NDArray[np.float64]

_PRESSED = 0.012
"""An object that protrudes by more than this, in metres, is not pressed down."""
_BESIDE = (0.003, 0.012)
"""An object that lies beside its place by a distance in this range, in metres, is moved there. Less
is not why it protrudes. More is measured badly, because a part of the object is hidden."""
_BELOW = 0.0015
"""An object in a recess is below the fixture's top by more than this, in metres."""
_FAR = 0.75
"""The far end of an object begins at this share of its largest distance from the grip."""
_TRIED = 0.020
"""An object is not pressed closer than this to an earlier press or failed grasp, in metres."""
_MOST_FAILURES = 3
"""An object is not gripped again after this many failed grasps."""
_NEARBY = 12
"""The height of the fixture's top is measured within this many pixels of an object."""
_ROOM = 0.045
"""The least distance between an object laid down and everything else, in metres."""


def recovery_action(
    inventory: Inventory, planner: PickPlaceParameters, tried: Sequence[PlanarPose] = ()
) -> PickPlaceAction | None:
    """Returns an action that moves, presses down or takes out a protruding object; None if no
    object protrudes or no correction is feasible.

    Objects that protrude more come first. An object that was already taken out and placed again is
    not taken out once more.

    Args:
        inventory: the objects and recesses of the observation.
        planner: parameters of the motion with which the hand will pick.
        tried: gripper poses of earlier failed grasps and presses.
    """
    observation, segmentation = inventory.observation, inventory.segmentation
    pickable = segmentation.visibility.pickable
    for region in segmentation.protruding:
        if region.height <= _PRESSED and pickable[region.mask].any():
            pressed = _press(observation, segmentation, region, pickable)
            if not _is_near(pressed.pick, tried):
                return pressed
        mended = _move_to_place(inventory, region, planner, tried) or _take_out(
            inventory, region, planner, tried
        )
        if mended is not None:
            return mended
    return None


def preparing_action(
    inventory: Inventory,
    planner: PickPlaceParameters,
    tried: Sequence[PlanarPose],
    mending: PickPlaceAction | None,
) -> PickPlaceAction | None:
    """Returns the next action if no object can be placed now; None if there is nothing to do.

    It mends what protrudes, then takes heaps apart, then presses on jammed objects. An object that
    may lean on the kit is part of a heap. Objects are turned over last: this is the riskiest
    action, and the number of actions is limited.

    Args:
        inventory: the objects and recesses of the observation.
        planner: parameters of the motion with which the hand will pick.
        tried: gripper poses of earlier failed grasps and presses.
        mending: the result of `recovery_action`.
    """
    return (
        clearing_action(inventory, planner, tried, mending)
        or _press_jammed(inventory, tried)
        or turning_action(inventory, planner, tried)
    )


def clearing_action(
    inventory: Inventory,
    planner: PickPlaceParameters,
    tried: Sequence[PlanarPose],
    mending: PickPlaceAction | None,
) -> PickPlaceAction | None:
    """Returns an action that mends what protrudes or takes a heap apart, in this order unless what
    protrudes may lean on the kit; None if there is nothing to do. The arguments are those of
    `preparing_action`."""
    if mending is not None and not inventory.leans(mending.pick):
        return mending
    return separating_action(inventory, planner, tried) or mending


def _press_jammed(inventory: Inventory, tried: Sequence[PlanarPose]) -> PickPlaceAction | None:
    """Returns an action that presses on an object that is jammed in its recess, below the fixture's
    top; None if there is none."""
    for place in inventory.memory.unseated:
        pressed = _press_far_end(inventory.observation, inventory.segmentation, place)
        if not _is_near(pressed.pick, tried):
            return pressed
    return None


def _press(
    observation: Observation, segmentation: Segmentation, region: Region, pickable: Mask
) -> PickPlaceAction:
    """Returns the action that presses on the highest visible part of a protruding object."""
    mask = region.mask & pickable
    pixels, heights = np.argwhere(mask), segmentation.relief[mask]
    highest = pixels[heights >= np.percentile(heights, 80)].astype(float)
    middle = highest[np.linalg.norm(highest - np.median(highest, axis=0), axis=1).argmin()]
    action = make_action(observation, middle, 0.0, middle, 0.0)
    return replace(action, press=True)


def _press_far_end(
    observation: Observation, segmentation: Segmentation, place: PlanarPose
) -> PickPlaceAction:
    """Returns the action that presses on an object that is jammed below the fixture's top.

    The heavy end, which is nearer to the grip, falls first. The other end is the one that jams.

    Args:
        observation: the heightmap o_t.
        segmentation: the regions of o_t.
        place: where the object was let go, in the world.
    """
    at_place = observation.grid.to_pixel((place.x, place.y))
    labels, _ = ndimage.label(segmentation.depth > _BELOW)
    row, col = np.rint(at_place).astype(int)
    middle = at_place
    if labels[row, col]:
        inside = ndimage.distance_transform_edt(labels == labels[row, col])
        pixels = np.argwhere(inside)
        away = np.linalg.norm(pixels - at_place, axis=1)
        end = pixels[away >= _FAR * away.max()]
        # Closed jaws need room, so press on the middle of the end.
        middle = end[inside[tuple(end.T)].argmax()].astype(float)
    action = make_action(observation, middle, place.theta, middle, 0.0)
    return replace(action, press=True)


def _take_out(
    inventory: Inventory,
    region: Region,
    planner: PickPlaceParameters,
    tried: Sequence[PlanarPose],
) -> PickPlaceAction | None:
    """Returns an action that lays a protruding object on a free part of the table; None if there is
    no such action."""
    observation, segmentation = inventory.observation, inventory.segmentation
    resolution = observation.grid.resolution
    free = _free_place(segmentation, resolution)
    if free is None:
        return None
    # If the region is several entangled objects, often only the topmost can be gripped.
    for part in (region, *topmost_layers(segmentation, region)):
        grasps = _untried_grasps(inventory, region, part, planner, tried)
        if grasps and not inventory.memory.was_removed(part):
            grasp = grasps[0]
            action = make_action(observation, grasp.pixel, grasp.theta, free, 0.0)
            return replace(action, aside=True)
    return None


def _move_to_place(
    inventory: Inventory,
    region: Region,
    planner: PickPlaceParameters,
    tried: Sequence[PlanarPose],
) -> PickPlaceAction | None:
    """Returns an action that moves a protruding object to the place from which it is off by a
    distance in the range `_BESIDE`; None if there is no such action."""
    observation = inventory.observation
    resolution = observation.grid.resolution
    off = inventory.memory.misplacement(region)
    if off is None or not _BESIDE[0] < np.linalg.norm(off) * resolution < _BESIDE[1]:
        return None
    grasps = _untried_grasps(inventory, region, region, planner, tried)
    if not grasps:
        return None
    best = grasps[0]
    return make_action(observation, best.pixel, best.theta, best.pixel - off, 0.0)


def _untried_grasps(
    inventory: Inventory,
    region: Region,
    part: Region,
    planner: PickPlaceParameters,
    tried: Sequence[PlanarPose],
) -> list[JawGrasp]:
    """Returns the feasible grasps of a part of a protruding region that have not failed yet, best
    first; none after `_MOST_FAILURES`. A press at the same point does not count."""
    observation, segmentation = inventory.observation, inventory.segmentation
    presses = [item.action.pick for item in observation.history if item.action.press]
    failed = failed_pixels(observation.grid, [pick for pick in tried if pick not in presses])
    resolution, top = observation.grid.resolution, _top_around(segmentation, region)
    away = [np.linalg.norm(part.pixels - pixel, axis=1).min() for pixel in failed]
    if sum(np.array(away) * resolution < RETRY_DISTANCE) >= _MOST_FAILURES:
        return []
    grasps = jaw_grasps(segmentation, part, resolution, planner, support=top)
    return untried(grasps, failed, resolution)


def _top_around(segmentation: Segmentation, region: Region) -> float:
    """The height of the fixture's top around an object, in metres above the table."""
    around = ndimage.binary_dilation(region.mask, iterations=_NEARBY) & segmentation.fixture
    return float(np.median(segmentation.relief[around & ~region.mask]))


def _free_place(segmentation: Segmentation, resolution: float) -> Array | None:
    """Returns the (row, col) on the table farthest from everything that lies there; None if there
    is not enough room."""
    # Mark the image's border as occupied, so that the object is laid inside the image.
    occupied = np.pad(segmentation.occupied, 1, constant_values=True)
    distance = ndimage.distance_transform_edt(~occupied)[1:-1, 1:-1]
    if distance.max() * resolution < _ROOM:
        return None
    return np.array(np.unravel_index(int(distance.argmax()), distance.shape), float)


def _is_near(pick: PlanarPose, tried: Sequence[PlanarPose]) -> bool:
    return any(math.dist((pick.x, pick.y), (item.x, item.y)) < _TRIED for item in tried)
