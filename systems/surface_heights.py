"""Reads off o_t the surface heights that limit the motion of a pick and place."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from systems.signals import Observation, PlanarPose, SurfaceHeights, fill_unseen

_PICK_REACH = 1
"""Radius around the pick that is searched for the object's top, in pixels."""
_RIM_REACH = 0.025
"""Radius around the place that is searched for a rim, in metres."""
_FLOOR_REACH = 2
"""Radius around the place that is searched for its floor, in pixels."""
_PICK_CLEARANCE_REACH = 0.07
"""Radius around the pick that the open jaws sweep, in metres."""
_PLACE_CLEARANCE_REACH = 0.125
"""Radius around the place that the held object sweeps, in metres."""
_SUPPORT_REACH = 0.08
"""Radius around the pick that is searched for the object's support, in metres."""
_SUPPORT_SHARE = 10.0
"""Percentile of the heights around a pick that estimates the support's height."""
_TABLE_SHARE = 5.0
"""Percentile of all heights that estimates the table's height."""
_CLEAN = 0.0003
"""A smaller standard deviation counts as no noise, in metres."""
_SMOOTHED = 9
"""Noise is the deviation from the mean over a square of so many pixels."""
_FLAT = 0.012
"""Squares with a larger range of heights contain edges and are not flat, in metres."""
_NOISY_RIM_SHARE, _NOISY_RIM_BIAS = 90.0, 1.0
"""Percentile of the heights around a place that estimates its rim's height, and its bias in
standard deviations. About two thirds of these pixels belong to the rim."""
_NOISY_FLOOR_SHARE, _NOISY_FLOOR_BIAS = 25.0, -0.67
"""Percentile of the heights at a place that estimates its floor's height, and its bias in standard
deviations."""
_TABLE_BAND = 0.008
"""Pixels within this height difference may belong to the table, if tilted, in metres."""
_LEAST_TABLE, _FITS = 500, 3
_LEVEL = 0.0003
"""A table with smaller deviations counts as level, in metres."""
_MOST_OFF = 0.008
"""A larger offset is the table's true height, not a calibration error. In metres."""
_TILT_DOUBT, _MOST_DOUBT = 0.3, 0.0025
"""Uncertainty after levelling: this share of the table's deviation, and its maximum in metres."""


def read_surface_heights(
    observation: Observation, pick: PlanarPose, place: PlanarPose
) -> SurfaceHeights:
    """The surface heights around a pick and a place, from o_t alone.

    - Unseen pixels are filled from their neighbours (`fill_unseen`).
    - An object's support is a low percentile of the heights around it. An object in the middle of
      others is thus assumed to stand on the same surface.
    - Tops are maxima over a few pixels; the floor of a place is the minimum over the seen ones. If
      o_t is noisy, they are medians and percentiles instead, corrected for their bias.
    - The table is assumed to be level and at the bottom of the grid. A small tilt or offset in o_t
      is a calibration error and is subtracted.

    Args:
        observation: o_t.
        pick: of the gripper, in the world.
        place: of the gripper, in the world. Off the grid, its heights are zero.
    """
    grid = observation.grid
    reach = {
        name: max(1, round(metres / grid.resolution))
        for name, metres in (
            ("rim", _RIM_REACH),
            ("support", _SUPPORT_REACH),
            ("near_pick", _PICK_CLEARANCE_REACH),
            ("near_place", _PLACE_CLEARANCE_REACH),
        )
    }
    height, noise, doubt = _level(fill_unseen(observation.height, observation.valid))
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
    return SurfaceHeights(
        pick_top=grid.z_min + pick_top,
        support=grid.z_min + support,
        place_rim=grid.z_min + place_rim,
        place_floor=grid.z_min + place_floor,
        near_pick=grid.z_min + float(_around(height, at_pick, reach["near_pick"]).max(initial=0.0)),
        near_place=grid.z_min
        + float(_around(height, at_place, reach["near_place"]).max(initial=0.0)),
        highest=grid.z_min + float(height.max(initial=0.0)),
        table=grid.z_min + max(table, 0.0),
        doubt=doubt,
    )


def _percentile(values: NDArray[np.float32], share: float) -> float:
    return float(np.percentile(values, share)) if values.size else 0.0


def _level(height: NDArray[np.float32]) -> tuple[NDArray[np.float32], float, float]:
    """Heights (rows, cols) above the levelled table, standard deviation of their noise, and their
    remaining uncertainty."""
    noise = _noise(height)
    table = _table(height, noise)
    largest = float(np.abs(table).max())
    if largest < _LEVEL:
        return height, noise, min(noise, _MOST_DOUBT)
    doubt = min(noise + _TILT_DOUBT * largest, _MOST_DOUBT)
    return (height - table).astype(np.float32), noise, doubt


def _noise(height: NDArray[np.float32]) -> float:
    """The standard deviation of the noise of heights (rows, cols); 0 if there is none."""
    # Import SciPy lazily.
    from scipy import ndimage

    away = np.abs(height - ndimage.uniform_filter(height, _SMOOTHED, mode="nearest"))
    highest = ndimage.maximum_filter(height, _SMOOTHED, mode="nearest")
    flat = highest - ndimage.minimum_filter(height, _SMOOTHED, mode="nearest") < _FLAT
    # Flat squares are the least noisy ones, so they only decide whether there is noise at all.
    if flat.sum() >= _LEAST_TABLE and 1.4826 * np.median(away[flat]) < _CLEAN:
        return 0.0
    noise = 1.4826 * float(np.median(away))
    return noise if noise >= _CLEAN else 0.0


def _table(height: NDArray[np.float32], noise: float) -> NDArray[np.float64]:
    """(rows, cols) the table's plane in o_t; zero if no table is found near zero."""
    start = np.percentile(height, _TABLE_SHARE) + noise
    rows, cols = (axis - axis.mean() for axis in np.indices(height.shape, np.float64))
    tilt = np.zeros(height.shape)
    near = np.abs(height - start) < _TABLE_BAND + 3 * noise
    for _ in range(_FITS):
        if near.sum() < _LEAST_TABLE:
            return np.zeros(height.shape)
        design = np.column_stack([rows[near], cols[near], np.ones(near.sum())])
        plane = np.linalg.lstsq(design, height[near], rcond=None)[0]
        tilt = rows * plane[0] + cols * plane[1]
        near = np.abs(height - tilt - plane[2]) < _TABLE_BAND / 2 + 2 * noise
    level = float(np.median((height - tilt)[near])) if near.any() else 0.0
    # A large offset means that the grid begins below the table: calibration errors are smaller.
    return tilt + level if level < _MOST_OFF else tilt


def _around(values: NDArray[Any], pixel: NDArray[np.float64], reach: int) -> NDArray[Any]:
    """The values (rows, cols) in a square of `reach` pixels around a position (row, col)."""
    row, col = np.rint(pixel).astype(int)
    rows = slice(max(row - reach, 0), max(row + reach + 1, 0))
    cols = slice(max(col - reach, 0), max(col + reach + 1, 0))
    return values[rows, cols]
