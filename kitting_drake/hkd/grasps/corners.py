"""Grasps without two flat faces: of a corner, and of a taper.

A soft pad yields to a corner. Opposite a face, the pads hold the tool where its width is least, so
that squeezing turns it flat onto the pad. Opposite a notch, the two ends of the pad hold it. Where
the tool tapers along the pads, it is held at their ends, and friction keeps it from slipping out.
"""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

LEAST_WIDTH = 0.008
"""The smallest width to hold at a corner, in metres: a thinner tool would turn."""

# How far a corner sinks into a pad, in metres.
_SOFT = 0.0008
# A corner is held steadily opposite a face that supports the pad this far to either side of it.
# Opposite another corner it may be off by the second length.
_CORNER_MARGIN, _CORNER_OFFSET = 0.002, 0.0005
# A taper is held if its faces lean by at most this slope, measured over this length.
_TAPER, _TAPER_LENGTH = float(np.tan(np.radians(24.0))), 0.004
# The costs of holding a corner against a face, with an addition if it touches only part of a pad;
# a taper, with an addition for the slope; and a corner against another, where the tool may turn.
_CORNER_COST, _NOT_FLAT_COST = 0.5, 2.0
_TAPER_COST, _SLOPE_COST = 0.8, 0.5
_TWO_CORNERS_COST = 2.5


def corner_cost(left: Array, right: Array, column: float, touch: float) -> float | None:
    """The cost of holding a corner or a taper; None if the tool would turn or slip out of the pads.

    The pads push along one line only if the corner is between the ends of the other pad's contact.

    Args:
        left: (columns, levels) the surface under the left pad.
        right: the same for the right one.
        column: the length of a column, in metres.
        touch: a flat face touches where it lies less than this behind the foremost point.
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
