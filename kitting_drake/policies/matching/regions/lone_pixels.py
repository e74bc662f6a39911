"""Replaces heights that no neighbour shares.

At the edge of an object, a depth camera may measure a depth between that of the object and that of
the surface behind it ("flying pixels"). Such a pixel makes the object look wider.
"""

from __future__ import annotations

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

_ALIKE = 0.0025
"""Neighbouring pixels show the same surface if their heights differ by less than this, in
metres."""
_LEAST_ALIKE = 2
"""A pixel is lone if fewer than this many of its eight neighbours show the same surface."""


def without_lone_pixels(height: NDArray[np.float32]) -> NDArray[np.float32]:
    """Returns heights (rows, cols) in metres, in which each lone pixel has the median height of
    itself and its eight neighbours."""
    rows, cols = height.shape
    padded = np.pad(height, 1, mode="edge")
    alike = np.zeros(height.shape, np.uint8)
    for row, col in np.ndindex(3, 3):
        if (row, col) != (1, 1):
            alike += np.abs(padded[row : row + rows, col : col + cols] - height) < _ALIKE
    lone = alike < _LEAST_ALIKE
    if not lone.any():
        return height
    cleaned = height.copy()
    cleaned[lone] = np.median(sliding_window_view(padded, (3, 3))[lone], axis=(1, 2))
    return cleaned
