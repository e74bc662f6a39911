"""The heights of one pick and place: from what o_t shows to where the fingertips go."""

from __future__ import annotations

from dataclasses import dataclass

from systems.pick_place_parameters import PickPlaceParameters
from systems.signals import SurfaceHeights


@dataclass(frozen=True)
class MotionHeights:
    """Heights of the fingertips in the world, in metres."""

    grasp: float
    """Where the jaws close."""
    clear: float
    """Empty jaws clear everything from here on."""
    travel: float
    """The held object clears everything when the fingertips are here or higher."""
    pick_hover: float
    """Down to here the hand may come fast over the pick."""
    place_hover: float
    """The same over the place, with what is held."""


def motion_heights(heights: SurfaceHeights, parameters: PickPlaceParameters) -> MotionHeights:
    """The heights of a motion.

    The fingertips grip a share of the object's height below its top, within limits, and stay above
    the table. What is held hangs below them by as much as they are above its support.

    Args:
        heights: of the surfaces, as `read_surface_heights` reads them off o_t.
        parameters: of the motion primitive.
    """
    floor = heights.table + parameters.floor_clearance
    share = parameters.grasp_depth_share * (heights.pick_top - heights.support)
    depth = max(parameters.grasp_depth, min(share, parameters.max_grasp_depth))
    grasp = max(heights.pick_top - depth, floor)
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
