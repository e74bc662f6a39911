"""Computes the fingertip heights of one pick and place from the surface heights in the observation
o_t."""

from __future__ import annotations

from dataclasses import dataclass

from systems.hand_geometry import PALM_HEIGHT
from systems.pick_place_parameters import PickPlaceParameters
from systems.signals import SurfaceHeights

_THIN = 0.010
"""Below this height of an object, in m, the fingertips' clearance above the table is reduced in
proportion, so that the pads enclose the widest section of a thin round object."""
_LEAST_SHARE = 0.3
"""The least clearance of the fingertips above the table, as a share of `floor_clearance`."""
_PALM_ROOM = 0.0025
"""Distance that the palm keeps from surfaces below it, in m."""
_LEAST_DEPTH = 0.005
"""If the fingertips would be less far than this below the object's top, in m, the hand does not
grip higher for the palm's sake."""


@dataclass(frozen=True)
class MotionHeights:
    """Heights of the fingertips in the world, in metres."""

    grasp: float
    """Height of the fingertips at which the jaws close."""
    clear: float
    """Lowest height at which empty jaws clear everything."""
    travel: float
    """Lowest height at which the held object clears everything."""
    pick_hover: float
    """Height down to which the hand moves fast towards the pick."""
    place_hover: float
    """Height down to which the hand moves fast towards the place, with the held object."""


def motion_heights(heights: SurfaceHeights, parameters: PickPlaceParameters) -> MotionHeights:
    """Computes the heights of a motion.

    The fingertips go below the object's top by a share of its height, within limits, and stay above
    the table. They grip higher if the palm would touch something. At the pick, they are some
    distance above the surface on which the object stands. The carried object extends below them by
    this distance.

    Args:
        heights: the heights of the surfaces, as `read_surface_heights` returns them.
        parameters: the parameters of the motion primitive.
    """
    height = max(heights.pick_top - heights.support, 0.0)
    low = min(max(height / _THIN, _LEAST_SHARE), 1.0)
    floor = heights.table + low * parameters.floor_clearance
    share = parameters.grasp_depth_share * height
    depth = max(parameters.grasp_depth, min(share, parameters.max_grasp_depth))
    grasp = max(heights.pick_top - depth, floor)
    room = heights.below_palm + _PALM_ROOM - PALM_HEIGHT
    if room <= heights.pick_top - _LEAST_DEPTH:
        grasp = max(grasp, room)
    clear = heights.highest + parameters.travel_clearance
    hanging = max(grasp - heights.support, 0.0)
    return MotionHeights(
        grasp=grasp,
        clear=clear,
        travel=clear + hanging,
        pick_hover=max(heights.near_pick, heights.pick_top) + parameters.hover_clearance,
        place_hover=max(heights.near_place, heights.place_rim)
        + hanging
        + parameters.hover_clearance,
    )
