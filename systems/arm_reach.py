"""Checks whether a Franka arm can execute an action before anything moves."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from systems.arm_postures import ArmPostures, HandStop
from systems.motion_heights import MotionHeights
from systems.pick_place_parameters import PickPlaceParameters
from systems.signals import PlanarPose

_ROOM_BELOW = 0.02
"""How far below the expected height of the place the arm must be able to go down, in m."""
_ROOM_ABOVE = 0.03
"""How far above the clear height (see `MotionHeights`) the arm must be able to rise, in m. Motions
with rounded corners rise above it."""


def hand_stops(
    pick: PlanarPose,
    place: PlanarPose | None,
    heights: MotionHeights,
    table: float,
    parameters: PickPlaceParameters,
    around: tuple[float, float] = (math.inf, math.inf),
    lowest_place: float = -math.inf,
) -> list[HandStop]:
    """The places at which the hand goes down in an action.

    Args:
        pick: pose of the hand at the pick.
        place: pose of the hand at the place; None if the action is a press.
        heights: heights of the motion.
        table: height of the table, in m.
        parameters: parameters of the motion primitive.
        around: heights of the highest surfaces below the wrist, at the pick and at the place, in m;
            infinite if unknown.
        lowest_place: height of the fingertips at which the held object stands at the place, in m;
            if unknown, the hand must be able to go down to the table.
    """
    floor = table + parameters.floor_clearance
    highest = heights.clear - parameters.travel_clearance
    # A press may go down to the table.
    low = floor if place is None else min(heights.grasp, heights.pick_hover)
    high = max(heights.clear, heights.pick_hover) + _ROOM_ABOVE
    at_pick, at_place = (min(height, highest) for height in around)
    stops = [HandStop("the pick", pick.x, pick.y, pick.theta, low, high, at_pick, highest)]
    if place is not None:
        high = max(heights.travel, heights.place_hover) + _ROOM_ABOVE
        low = max(floor, min(lowest_place - _ROOM_BELOW, high))
        stops.append(
            HandStop("the place", place.x, place.y, place.theta, low, high, at_place, highest)
        )
    return stops


def reach_problem(
    postures: ArmPostures,
    stops: Sequence[HandStop],
    now: NDArray[np.float64] | None = None,
) -> str:
    """A sentence that says why an arm cannot bring its hand to the stops of an action; empty if it
    can.

    Args:
        postures: chooses the arm's postures.
        stops: the stops of `hand_stops`. The hand may be turned by half a turn, but then at all
            stops.
        now: (7) present joint positions, in rad; if None, the middles of the joints' ranges.
    """
    if now is None:
        now = (np.array(postures.limits.lower) + postures.limits.upper) / 2
    return postures.choose(stops, now)[1]
