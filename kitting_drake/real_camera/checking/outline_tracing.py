"""Approximates the outline of a mask by a polygon with few corners."""

from __future__ import annotations

from itertools import count

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from kitting_drake.real_camera.calibrations.table_outline import Polygon
from systems.signals import PixelGrid

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_MOST = 12
"""The largest number of corners of a polygon."""
_INSIDE = 0.010
"""How far inside the mask the polygon is drawn, in metres."""


def disc(radius: float) -> Mask:
    """Returns a disc (n, n) for morphology, with a given radius in cells."""
    reach = max(1, int(np.ceil(radius)))
    rows, cols = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    return np.asarray(rows**2 + cols**2 <= max(radius, 1.0) ** 2)


def largest_part(mask: Mask) -> Mask:
    """Returns the largest connected part of a mask (rows, cols); the mask must not be empty."""
    labels, found = ndimage.label(mask)
    if found <= 1:
        return mask
    return np.asarray(labels == np.bincount(labels.ravel())[1:].argmax() + 1)


def trace(mask: Mask, grid: PixelGrid) -> Polygon:
    """Returns the outline of a mask, slightly inside it, with at most 12 corners in the base frame.

    Args:
        mask: (rows, cols) one connected part without holes, which must not touch the border.
        grid: the cells of the mask.
    """
    inner = ndimage.binary_erosion(mask, disc(_INSIDE / grid.resolution))
    # Remove narrow spikes, for instance between two objects at the table's edge, because no tool
    # fits there.
    smooth = ndimage.binary_opening(inner, disc(2 * _INSIDE / grid.resolution))
    for candidate in (smooth, inner, mask):
        if candidate.any():
            corners = _few(_border(largest_part(candidate)))
            if len(corners) >= 3:
                break
    xy = grid.to_world(corners)
    return tuple((round(float(x), 4), round(float(y), 4)) for x, y in xy)


def _border(mask: Mask) -> Array:
    """Returns the corners (n, 2) of the cells along the outer border, in order, as (row, col)."""
    # Pad the mask, and walk along the sides of its cells, with the mask on the right.
    padded = np.pad(mask, 1)
    row, col = np.argwhere(padded)[0]
    start = position = (int(row), int(col))
    ahead = (0, 1)
    corners = []
    while True:
        corners.append(position)
        position = (position[0] + ahead[0], position[1] + ahead[1])
        if position == start:
            break
        left, right = (_cell_beside(padded, position, ahead, side) for side in (-1, 1))
        if left:
            ahead = (-ahead[1], ahead[0])
        elif not right:
            ahead = (ahead[1], -ahead[0])
    # Subtract the padding. Corner (r, c) lies half a cell before the centre of cell (r, c).
    return np.array(corners, float) - 1.5


def _cell_beside(mask: Mask, position: tuple[int, int], ahead: tuple[int, int], side: int) -> bool:
    """Whether the cell ahead of a corner, to the left (-1) or to the right (1), is in the mask."""
    down, across = ahead
    # Turned to the right, the direction (down, across) becomes (across, -down).
    right = (side * across, -side * down)
    row = position[0] + (down + right[0] - 1) // 2
    col = position[1] + (across + right[1] - 1) // 2
    return bool(mask[row, col])


def _few(border: Array) -> Array:
    """Simplifies a border (n, 2) to at most `_MOST` corners, by the Douglas-Peucker algorithm."""
    first = int(np.hypot(*(border - border.mean(axis=0)).T).argmax())
    closed = np.roll(border, -first, axis=0)
    second = int(np.hypot(*(closed - closed[0]).T).argmax())
    halves = (closed[: second + 1], np.vstack([closed[second:], closed[:1]]))
    for number in count():
        tolerance = 1.2 * 1.25**number
        corners = np.vstack([_simplified(half, tolerance)[:-1] for half in halves])
        if len(corners) <= _MOST:
            return corners
    raise AssertionError


def _simplified(line: Array, tolerance: float) -> Array:
    """Returns those corners of a line (n, 2) that approximate it within a tolerance in cells."""
    kept = np.zeros(len(line), bool)
    kept[[0, -1]] = True
    spans = [(0, len(line) - 1)]
    while spans:
        first, last = spans.pop()
        if last - first < 2:
            continue
        ahead = line[last] - line[first]
        rest = line[first + 1 : last] - line[first]
        length = float(np.hypot(*ahead))
        if length > 0:
            off = np.abs(ahead[0] * rest[:, 1] - ahead[1] * rest[:, 0]) / length
        else:
            off = np.hypot(*rest.T)
        middle = first + 1 + int(off.argmax())
        if off.max() > tolerance:
            kept[middle] = True
            spans += [(first, middle), (middle, last)]
    return line[kept]
