"""Finds the plane of the table in a heightmap."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

_STEP = 2
"""Only every second row and every second column is used, to save time."""
_LEAST = 200
"""At least this many of the used pixels must lie on the table."""
_LEAST_SHARE = 0.15
"""At least this share of the used pixels must lie on the table."""
_BIN = 0.001
"""Width of the bins of the histogram of heights, in metres."""
_FAR = 0.03
"""The table is sought up to this distance above and below the bottom of the grid, in metres."""
_BAND = 0.004
"""A pixel belongs to a plane if their distance is less than this, in metres, or less than three
times the noise."""
_FITS = 8
"""Number of fits of the plane. In the first half of the fits, the area grows from the middle of the
grid to the whole grid, and the limit of `_BAND` is doubled."""
_LEVEL = 0.0003
"""A table whose deviations are smaller than this, in metres, counts as level."""
_MOST_OFF, _STEEPEST = 0.010, 0.035
"""A larger offset (in metres) or slope cannot be an error of calibration, and is not corrected."""


def level(
    height: NDArray[np.float32], seen: NDArray[np.bool_], resolution: float
) -> tuple[NDArray[np.float32], tuple[float, float, float]]:
    """Subtracts the table's plane from a heightmap.

    Args:
        height: (rows, cols) heights in metres above the bottom of the grid; may be negative.
        seen: (rows, cols) mask of the pixels that may belong to the table.
        resolution: the side of a pixel, in metres.

    Returns:
        (rows, cols) heights above the table, and the plane that was subtracted (see `find_table`).
    """
    table = find_table(height, seen, resolution)
    if not any(table):
        return height, table
    return (height - plane_heights(table, height.shape)).astype(np.float32), table


def plane_heights(
    plane: NDArray[np.float64] | tuple[float, float, float], shape: tuple[int, ...]
) -> NDArray[np.float64]:
    """Returns the heights (rows, cols) of a plane, whose height at (row, col) is `plane @ (row,
    col, 1)`."""
    rows, cols = np.indices(shape, sparse=True)
    return np.asarray(plane[0] * rows + plane[1] * cols + plane[2])


def find_table(
    height: NDArray[np.float32], seen: NDArray[np.bool_], resolution: float
) -> tuple[float, float, float]:
    """Finds the table's plane in a heightmap. The table's height at (row, col) is `plane @
    (row, col, 1)`.

    The search starts with a level plane at the lowest peak of the histogram of heights, and refits
    the plane to the pixels near it. The result is (0, 0, 0) if no plane is found, or if the plane
    deviates by less than 0.3 mm from the bottom of the grid, or by more than a calibration error
    can explain.

    Args:
        height: (rows, cols) heights in metres above the bottom of the grid; may be negative.
        seen: (rows, cols) mask of the pixels to use.
        resolution: the side of a pixel, in metres.
    """
    none = (0.0, 0.0, 0.0)
    some = seen[::_STEP, ::_STEP]
    rows, cols = np.nonzero(some)
    values = height[::_STEP, ::_STEP][some].astype(float)
    near = np.abs(values) < _FAR
    if near.sum() < max(_LEAST, _LEAST_SHARE * len(values)):
        return none
    middle = np.array(height.shape) / 2
    design = np.column_stack(
        [rows * _STEP - middle[0], cols * _STEP - middle[1], np.ones(len(rows))]
    )
    plane = np.array([0.0, 0.0, _lowest_mode(values[near])])
    # Begin with the pixels in the middle, where a tilt changes the height least.
    reach = np.abs(design[:, :2]).max(axis=1)
    noise = 0.0
    for number in range(_FITS):
        rest = values - design @ plane
        band = max(_BAND, 3 * noise) * (2 if number < _FITS // 2 else 1)
        inlying = (np.abs(rest) < band) & (reach <= middle.max() * (number + 1) / (_FITS // 2))
        if inlying.sum() < _LEAST:
            continue
        plane = np.linalg.lstsq(design[inlying], values[inlying], rcond=None)[0]
        rest = (values - design @ plane)[inlying]
        noise = min(1.4826 * float(np.median(np.abs(rest))), _BAND)
    inlying = np.abs(values - design @ plane) < max(_BAND, 3 * noise)
    if inlying.sum() < max(_LEAST, _LEAST_SHARE * len(values)):
        return none
    if np.hypot(*plane[:2]) > _STEEPEST * resolution or abs(plane[2]) > _MOST_OFF:
        return none
    corners = np.abs(plane[:2]) @ middle + abs(plane[2])
    if corners < _LEVEL:
        return none
    plane[2] -= plane[:2] @ middle
    return float(plane[0]), float(plane[1]), float(plane[2])


def _lowest_mode(values: NDArray[np.float64]) -> float:
    """The position of the lowest peak in the histogram of heights, in metres."""
    counts = np.bincount(((values + _FAR) / _BIN).astype(int), minlength=int(2 * _FAR / _BIN) + 1)
    smooth = np.convolve(counts, np.ones(5), "same")
    first = int(np.flatnonzero(smooth >= 0.5 * smooth.max())[0])
    # The maximum of a peak is at most one kernel width above the point where the peak begins.
    highest = first + int(smooth[first : first + 5].argmax())
    return (highest + 0.5) * _BIN - _FAR
