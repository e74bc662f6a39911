"""Reads off o_t the heights that a motion between pick and place must respect: the only place."""

import numpy as np
from numpy.typing import NDArray

from systems.signals import Observation, PlanarPose, SurfaceHeights

_PICK_REACH = 1
"""How far around the pick pixel its top is looked for, in pixels."""
_RIM_REACH = 0.025
"""How far around the place its rim is looked for, in metres."""
_PICK_CLEARANCE_REACH = 0.07
"""How far around the pick the open jaws must clear what is there, in metres."""
_PLACE_CLEARANCE_REACH = 0.125
"""How far around the place what is held must clear what is there, in metres."""
_SUPPORT_REACH = 0.08
"""How far around the pick what it stands on is looked for, in metres."""
_SUPPORT_SHARE = 10.0
"""The percentile of the heights around a pick that is taken for its support's."""
_TABLE_SHARE = 5.0
"""The percentile of all heights that is taken for the table's."""


def read_surface_heights(
    observation: Observation, pick: PlanarPose, place: PlanarPose
) -> SurfaceHeights:
    """The heights around a pick and a place, from o_t alone.

    The support of an object is the height that a tenth of the pixels around it do not exceed; so
    an object in the middle of others is taken to stand on what they stand on.

    Args:
        observation: o_t.
        pick: of the gripper, in the world.
        place: of the gripper, in the world. One off the grid has heights of zero.
    """
    height, grid = observation.height, observation.grid
    reach = {
        name: max(1, round(metres / grid.resolution))
        for name, metres in (
            ("rim", _RIM_REACH),
            ("support", _SUPPORT_REACH),
            ("near_pick", _PICK_CLEARANCE_REACH),
            ("near_place", _PLACE_CLEARANCE_REACH),
        )
    }
    at_pick, at_place = (grid.to_pixel((pose.x, pose.y)) for pose in (pick, place))
    around_pick = _around(height, at_pick, reach["support"])
    support = float(np.percentile(around_pick, _SUPPORT_SHARE)) if around_pick.size else 0.0
    return SurfaceHeights(
        pick_top=grid.z_min + float(_around(height, at_pick, _PICK_REACH).max(initial=0.0)),
        support=grid.z_min + support,
        place_rim=grid.z_min + float(_around(height, at_place, reach["rim"]).max(initial=0.0)),
        near_pick=grid.z_min + float(_around(height, at_pick, reach["near_pick"]).max(initial=0.0)),
        near_place=grid.z_min
        + float(_around(height, at_place, reach["near_place"]).max(initial=0.0)),
        highest=grid.z_min + float(height.max(initial=0.0)),
        table=grid.z_min + float(np.percentile(height, _TABLE_SHARE)),
    )


def _around(
    height: NDArray[np.float32], pixel: NDArray[np.float64], reach: int
) -> NDArray[np.float32]:
    """The heights within `reach` pixels, along rows and columns, of a position (row, col)."""
    row, col = np.rint(pixel).astype(int)
    rows = slice(max(row - reach, 0), max(row + reach + 1, 0))
    cols = slice(max(col - reach, 0), max(col + reach + 1, 0))
    return height[rows, cols]
