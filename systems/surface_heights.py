"""Reads the surface heights that limit the motion of a pick and place from an observation o_t."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from systems.jaw_room import heights_below_palm, object_width
from systems.signals import Observation, PlanarPose, SurfaceHeights

_PICK_REACH = 1
"""The object's top is measured within this distance of the pick, in pixels."""
_RIM_REACH = 0.025
"""A rim is searched for within this distance of the place, in metres."""
_FLOOR_REACH = 2
"""The floor is measured within this distance of the place, in pixels."""
_PICK_CLEARANCE_REACH = 0.07
"""The open jaws stay within this distance of the pick, in metres."""
_PLACE_CLEARANCE_REACH = 0.125
"""The held object stays within this distance of the place, in metres."""
WRIST_REACH = 0.2
"""An arm's wrist stays within this distance of the hand, in metres."""
_SUPPORT_REACH = 0.08
"""The object's support is searched for within this distance of the pick, in metres."""
_SUPPORT_SHARE = 10.0
"""The support's height is estimated by this percentile of the heights around the pick."""
_TABLE_SHARE = 5.0
"""The table's height is estimated by this percentile of all heights."""
_CLEAN = 0.0003
"""A standard deviation below this, in metres, counts as no noise."""
_LEAST_FLAT = 500
"""Least number of flat squares that is enough to decide whether there is noise."""
_SMOOTHED = 9
"""Side, in pixels, of the squares over which heights are averaged; noise is the deviation from this
average."""
_FLAT = 0.012
"""Squares whose heights range over more than this, in metres, contain edges and are not flat."""
_NOISY_RIM_SHARE, _NOISY_RIM_BIAS = 90.0, 1.0
"""With noise, the rim's height is estimated as this percentile of the heights around the place,
minus this many standard deviations of the noise. About two thirds of the heights belong to the
rim."""
_NOISY_FLOOR_SHARE, _NOISY_FLOOR_BIAS = 25.0, -0.67
"""With noise, the floor's height is estimated as this percentile of the heights at the place, minus
this many standard deviations of the noise."""
_NOISY_PALM_SHARE = 98.0
"""With noise, the highest surface below the palm is this percentile of the heights there."""
_SUNK = 0.003
"""A table that looks lower than expected by more than this, in metres, is taken to be really lower.
Any other deviation counts as a calibration error."""
_LONE, _NEIGHBOURS = 0.02, 4
"""A pixel shows a surface only if at least `_NEIGHBOURS` of its neighbours are higher than it, or
lower by at most `_LONE`, in metres."""
_SPIKE = 0.06
"""Nothing so thin stands higher than this above its neighbours, in metres."""
_TILT_DOUBT, _MOST_DOUBT = 0.3, 0.0025
"""The uncertainty of heights is the noise plus `_TILT_DOUBT` times the table's deviation before
levelling. This sum is limited to `_MOST_DOUBT`, in metres."""


def read_surface_heights(
    observation: Observation, pick: PlanarPose, place: PlanarPose
) -> SurfaceHeights:
    """Reads from o_t the surface heights around a pick and a place.

    - Unseen pixels are filled in (`fill_unseen`).
    - An object's support is a low percentile of the heights around it. An object in the middle of
      others is thus assumed to stand on the same surface as the others.
    - Tops are maxima over a few pixels. The floor of a place is the minimum over the seen pixels.
      If o_t is noisy, medians and percentiles are used instead, corrected for their bias.
    - The highest surfaces, near a pose or anywhere, are found without lone peaks.
    - The table is assumed to be level and at the bottom of the grid. If it looks tilted or shifted
      in o_t, this counts as a calibration error, and `project` has subtracted it.
    - A table that looks more than 3 mm lower than expected is an exception: it is assumed to be
      lower. A motion that aims too low stops at the contact, but one that aims too high ends above
      the surface.

    Args:
        observation: the observation o_t.
        pick: the gripper's pose at the pick, in the world.
        place: the gripper's pose at the place, in the world. Off the grid, heights are zero.
    """
    grid = observation.grid
    reach = {
        name: max(1, round(metres / grid.resolution))
        for name, metres in (
            ("rim", _RIM_REACH),
            ("support", _SUPPORT_REACH),
            ("near_pick", _PICK_CLEARANCE_REACH),
            ("near_place", _PLACE_CLEARANCE_REACH),
            ("wrist", WRIST_REACH),
        )
    }
    height = observation.filled_height
    noise = _noise(height)
    doubt = min(noise + _TILT_DOUBT * _deviation(observation), _MOST_DOUBT)
    at_pick, at_place = (grid.to_pixel((pose.x, pose.y)) for pose in (pick, place))
    around_pick = _around(height, at_pick, reach["support"])
    top, rim = _around(height, at_pick, _PICK_REACH), _around(height, at_place, reach["rim"])
    seen = _around(observation.valid, at_pick, _PICK_REACH)
    top = top[seen] if seen.any() else top
    support = _percentile(around_pick, _SUPPORT_SHARE)
    table = _percentile(height, _TABLE_SHARE)
    # If no pixel of the floor is seen, assume the table's height.
    seen = _around(observation.valid, at_place, _FLOOR_REACH)
    floor = _around(height, at_place, _FLOOR_REACH)[seen] if seen.any() else np.zeros(1, np.float32)
    if noise:
        pick_top = _percentile(top, 50.0)
        place_rim = _percentile(rim, _NOISY_RIM_SHARE) - _NOISY_RIM_BIAS * noise
        place_floor = _percentile(floor, _NOISY_FLOOR_SHARE) - _NOISY_FLOOR_BIAS * noise
    else:
        pick_top, place_rim = float(top.max(initial=0.0)), float(rim.max(initial=0.0))
        place_floor = float(floor.min())
    solid = _without_lone_peaks(height)
    palm = heights_below_palm(solid, at_pick[None], np.array([pick.theta]), grid.resolution)
    around = [grid.z_min + _highest(solid, it, reach["wrist"]) for it in (at_pick, at_place)]
    sunk = [_sunk(observation, pixel) for pixel in (at_pick, at_place)]
    pick_z, place_z = (grid.z_min + value for value in sunk)
    return SurfaceHeights(
        pick_top=pick_z + pick_top,
        support=pick_z + support,
        place_rim=place_z + place_rim,
        place_floor=place_z + place_floor,
        near_pick=pick_z + _highest(solid, at_pick, reach["near_pick"]),
        below_palm=pick_z + _percentile(palm, _NOISY_PALM_SHARE if noise else 100.0),
        near_place=place_z + _highest(solid, at_place, reach["near_place"]),
        highest=grid.z_min + float(solid.max(initial=0.0)),
        around_pick=around[0],
        around_place=around[1],
        table=min(pick_z, place_z) + max(table, 0.0),
        doubt=doubt,
        width=object_width(height, grid, pick, support, pick_top),
    )


def _without_lone_peaks(height: NDArray[np.float32]) -> NDArray[np.float32]:
    """Heights (rows, cols) in which no pixel is higher than its `_NEIGHBOURS`-highest neighbour by
    more than `_LONE`. A pixel that is higher by more than `_SPIKE` gets that neighbour's height.

    Depth cameras put such pixels between the silhouette of a near body, such as an arm, and what
    lies behind it."""
    from scipy import ndimage

    around = np.ones((3, 3), bool)
    around[1, 1] = False
    support = ndimage.rank_filter(height, -_NEIGHBOURS, footprint=around, mode="nearest")
    is_spike = height > support + np.float32(_SPIKE)
    return np.where(is_spike, support, np.minimum(height, support + np.float32(_LONE)))


def _deviation(observation: Observation) -> float:
    """The largest distance between the table before levelling and the bottom of the grid, in m."""
    row, col, offset = observation.table
    rows, cols = observation.grid.shape
    return max(abs(row * i + col * j + offset) for i in (0, rows) for j in (0, cols))


def _sunk(observation: Observation, pixel: NDArray[np.float64]) -> float:
    """Height of the table relative to the bottom of the grid at a (row, col), in metres. It is
    negative if the table is lower by more than `_SUNK`; otherwise it is 0."""
    level = float(np.array(observation.table) @ np.append(pixel, 1.0))
    return level if level < -_SUNK else 0.0


def _percentile(values: NDArray[np.float32], share: float) -> float:
    return float(np.percentile(values, share)) if values.size else 0.0


def _noise(height: NDArray[np.float32]) -> float:
    """The standard deviation of the noise of heights (rows, cols); 0 if there is none."""
    # Import SciPy lazily.
    from scipy import ndimage

    away = np.abs(height - ndimage.uniform_filter(height, _SMOOTHED, mode="nearest"))
    highest = ndimage.maximum_filter(height, _SMOOTHED, mode="nearest")
    flat = highest - ndimage.minimum_filter(height, _SMOOTHED, mode="nearest") < _FLAT
    # Flat squares have less noise than average, so use them only to decide whether there is noise.
    if flat.sum() >= _LEAST_FLAT and 1.4826 * np.median(away[flat]) < _CLEAN:
        return 0.0
    noise = 1.4826 * float(np.median(away))
    return noise if noise >= _CLEAN else 0.0


def _highest(height: NDArray[np.float32], pixel: NDArray[np.float64], reach: int) -> float:
    """The greatest height at most `reach` rows and columns away from a position (row, col)."""
    return float(_around(height, pixel, reach).max(initial=0.0))


def _around(values: NDArray[Any], pixel: NDArray[np.float64], reach: int) -> NDArray[Any]:
    """The values (rows, cols) at most `reach` rows and columns away from a position (row, col)."""
    row, col = np.rint(pixel).astype(int)
    rows = slice(max(row - reach, 0), max(row + reach + 1, 0))
    cols = slice(max(col - reach, 0), max(col + reach + 1, 0))
    return values[rows, cols]
