"""Reads off o_t the heights that a motion between pick and place must respect: the only place."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from systems.signals import Observation, PlanarPose, SurfaceHeights, fill_unseen

_PICK_REACH = 1
"""How far around the pick pixel its top is looked for, in pixels."""
_RIM_REACH = 0.025
"""How far around the place its rim is looked for, in metres."""
_FLOOR_REACH = 2
"""How far around the place pixel its floor is looked for, in pixels."""
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
_CLEAN = 0.0003
"""A standard deviation of less is no noise, in metres."""
_SMOOTHED = 9
"""Noise is what departs from the mean over so many pixels, along rows and columns."""
_FLAT = 0.012
"""Where the heights of these differ by more there are edges, which are no noise, in metres."""
_NOISY_RIM_SHARE, _NOISY_RIM_BIAS = 90.0, 1.0
"""Some two thirds of the pixels around a place are its rim: the percentile of all that is so many
standard deviations above the middle of these."""
_NOISY_FLOOR_SHARE, _NOISY_FLOOR_BIAS = 25.0, -0.67
"""The percentile of the heights at a place that is taken for its floor's, and how many standard
deviations it is above their middle."""
_TABLE_BAND = 0.008
"""Pixels within this of the table's height belong to it, however it is tilted, in metres."""
_LEAST_TABLE, _FITS = 500, 3
_LEVEL = 0.0003
"""A table that is nowhere off by more than this is level, in metres."""
_MOST_OFF = 0.008
"""One that is off by more is where it is, in metres."""
_TILT_DOUBT, _MOST_DOUBT = 0.3, 0.0025
"""Heights may be off by this share of what the table was, and by at most this, in metres."""


def read_surface_heights(
    observation: Observation, pick: PlanarPose, place: PlanarPose
) -> SurfaceHeights:
    """The heights around a pick and a place, from o_t alone.

    What no camera sees is taken to be as high as what is around it (`fill_unseen`).

    The support of an object is the height that a tenth of the pixels around it do not exceed; so
    an object in the middle of others is taken to stand on what they stand on.

    Tops are the highest of some pixels, and the floor of a place is the lowest of those that are
    seen. Where o_t is noisy that would be the noise: then they are medians and percentiles,
    corrected by what these are off in such noise. The table is level and at the bottom of the grid:
    that it is tilted or higher in o_t is an error of calibration, and is taken away. Neither is
    done where there is nothing to correct.

    Args:
        observation: o_t.
        pick: of the gripper, in the world.
        place: of the gripper, in the world. One off the grid has heights of zero.
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
    # Where nothing is seen of it, the floor is the table's.
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
    """Heights (rows, cols) above the table as it is, the standard deviation of their noise, and
    what they may still be off; the same heights and zeros where there is nothing to correct."""
    noise = _noise(height)
    table = _table(height, noise)
    largest = float(np.abs(table).max())
    if largest < _LEVEL:
        return height, noise, min(noise, _MOST_DOUBT)
    doubt = min(noise + _TILT_DOUBT * largest, _MOST_DOUBT)
    return (height - table).astype(np.float32), noise, doubt


def _noise(height: NDArray[np.float32]) -> float:
    """The standard deviation of the noise of heights (rows, cols); 0 where there is none."""
    # Import SciPy lazily.
    from scipy import ndimage

    away = np.abs(height - ndimage.uniform_filter(height, _SMOOTHED, mode="nearest"))
    highest = ndimage.maximum_filter(height, _SMOOTHED, mode="nearest")
    flat = highest - ndimage.minimum_filter(height, _SMOOTHED, mode="nearest") < _FLAT
    # Of flat places alone the calmest would be taken: they tell only whether there is noise.
    if flat.sum() >= _LEAST_TABLE and 1.4826 * np.median(away[flat]) < _CLEAN:
        return 0.0
    noise = 1.4826 * float(np.median(away))
    return noise if noise >= _CLEAN else 0.0


def _table(height: NDArray[np.float32], noise: float) -> NDArray[np.float64]:
    """(rows, cols): the plane of the table, as o_t shows it; zero if it shows none near zero."""
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
    # A grid that begins well below the table is no error of calibration.
    return tilt + level if level < _MOST_OFF else tilt


def _around(values: NDArray[Any], pixel: NDArray[np.float64], reach: int) -> NDArray[Any]:
    """The values (rows, cols) within `reach` pixels, along both, of a position (row, col)."""
    row, col = np.rint(pixel).astype(int)
    rows = slice(max(row - reach, 0), max(row + reach + 1, 0))
    cols = slice(max(col - reach, 0), max(col + reach + 1, 0))
    return values[rows, cols]
