"""Grasps of tools without two parallel faces: by a corner, or by a taper.

A soft pad yields to a corner. If a face is opposite the corner, the closing pads turn the tool
until this face lies flat on its pad. If a notch is opposite the corner, the two ends of the notch
touch the pad. Where the tool tapers along the pads, the ends of the pads hold the tool, and
friction keeps it from slipping out.
"""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

LEAST_WIDTH = 0.008
"""The smallest width to hold at a corner, in metres; a thinner tool would turn."""

# The depth to which a corner sinks into a pad, in metres.
_SOFT = 0.0008
# The pads can hold a corner opposite a face if the face touches its pad over at least
# `_CORNER_MARGIN` (m) on both sides of the corner. They can hold two opposite corners if these are
# offset along the pads by at most `_CORNER_OFFSET` (m).
_CORNER_MARGIN, _CORNER_OFFSET = 0.002, 0.0005
# The pads can hold a taper if its faces slope along the pads by at most `_TAPER`. The slope is
# measured over `_TAPER_LENGTH` (m).
_TAPER, _TAPER_LENGTH = float(np.tan(np.radians(24.0))), 0.004
# A corner opposite a face costs `_CORNER_COST`, plus up to `_NOT_FLAT_COST` if the face touches
# only part of its pad. A taper costs `_TAPER_COST`, plus up to `_SLOPE_COST` for its slope. Two
# opposite corners, between which the tool may turn, cost `_TWO_CORNERS_COST`.
_CORNER_COST, _NOT_FLAT_COST = 0.5, 2.0
_TAPER_COST, _SLOPE_COST = 0.8, 0.5
_TWO_CORNERS_COST = 2.5


def corner_cost(left: Array, right: Array, column: float, touch: float) -> float | None:
    """Returns the cost of holding a corner or a taper; None if the tool would turn or slip out of
    the pads.

    The tool does not turn if the corner lies between the ends of the opposite contact: the forces
    of the pads then act along one line.

    Args:
        left: (columns, levels) the coordinate, along the closing direction, of the surface under
            the left pad, in metres.
        right: (columns, levels) the same coordinate of the surface under the right pad.
        column: the length of a column, in metres.
        touch: a pad touches the parts of a face that are at most this far behind the face's
            foremost point, in metres.
    """
    behind = [(left.max() - left).min(axis=1), (right - right.min()).min(axis=1)]
    spans = [column * np.flatnonzero(depth <= _SOFT) for depth in behind]
    narrow, wide = sorted(spans, key=np.ptp)
    corner = (narrow[0] + narrow[-1]) / 2
    if min(corner - wide[0], wide[-1] - corner) >= _CORNER_MARGIN:
        between = max(float(np.ptp(np.flatnonzero(depth <= touch))) for depth in behind)
        return _CORNER_COST + _NOT_FLAT_COST * (1 - between / (len(left) - 1))
    inward = round(_TAPER_LENGTH / column)
    for from_end in (behind, [depth[::-1] for depth in behind]):
        slope = max(float(depth[inward]) for depth in from_end) / _TAPER_LENGTH
        if max(depth[0] for depth in from_end) <= touch and slope <= _TAPER:
            return _TAPER_COST + _SLOPE_COST * slope / _TAPER
    offset = abs(corner - (wide[0] + wide[-1]) / 2)
    inside = _CORNER_MARGIN <= corner <= column * (len(left) - 1) - _CORNER_MARGIN
    return _TWO_CORNERS_COST if inside and offset <= _CORNER_OFFSET else None
