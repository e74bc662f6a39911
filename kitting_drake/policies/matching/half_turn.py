"""Decides between two fits of an object to a recess that differ by half a turn.

If a tool is rotated by half a turn, most of its outline looks the same. With noise, a slot that is
only a pixel wide is missing in the recess's outline, but in the mean its pixels are still lower
than the fixture's top. So the depth below the object is compared as well as the outlines.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from kitting_drake.policies.data.images import rotation_matrix
from kitting_drake.policies.matching.regions.segmentation import Region
from kitting_drake.policies.matching.registration import (
    Outline,
    Registration,
    half_turn_ratio,
    preference,
    register,
)

_PER_METRE = 10.0
"""A `preference` of one metre counts as much as this share of the recess's depth."""
_UNLIKE = 1.5
"""The two ends of an object are clearly different if its `half_turn_ratio` is above this."""
_LARGEST = 0.001
"""The largest `preference` that counts, in metres."""


def advantage(
    depth: NDArray[np.float32],
    item: Region,
    recess: Region,
    outlines: tuple[Outline, Outline],
    first: Registration,
    second: Registration,
) -> float:
    """Returns how much better the first of two fits is than the second; negative if it is worse.

    It is the difference of the mean depths below the object, as a share of the recess's depth, plus
    the `preference` of the outlines.

    Args:
        depth: (rows, cols) the depth below the fixture's top (`Segmentation.depth`), in metres.
        item: the object.
        recess: the recess.
        outlines: the outlines of the object and of the recess.
        first: a fit of the object's outline to the recess's.
        second: another fit.
    """
    better = preference(*outlines, first, second)
    telling = _PER_METRE * min(max(better, -_LARGEST), _LARGEST)
    return _sunk(depth, item, recess, first) - _sunk(depth, item, recess, second) + telling


def better_half_turn(
    depth: NDArray[np.float32],
    item: Region,
    recess: Region,
    outlines: tuple[Outline, Outline],
    fit: Registration,
) -> Registration:
    """Returns a fit, or the fit that differs from it by half a turn if that is better.

    The arguments are those of `advantage`.
    """
    outline, target = outlines
    if half_turn_ratio(outline, target, fit.rotation) > _UNLIKE:
        return fit
    angle = fit.rotation + math.pi
    start = angle, target.middle - rotation_matrix(angle) @ outline.middle
    other = register(outline, target, starts=(start,))
    is_better = advantage(depth, item, recess, outlines, other, fit) > 0
    return other if is_better else fit


def _sunk(depth: NDArray[np.float32], item: Region, recess: Region, fit: Registration) -> float:
    """The mean depth below an object after a fit, as a share of the recess's median depth."""
    bottom = float(np.median(depth[recess.mask]))
    places = item.pixels @ rotation_matrix(fit.rotation).T + fit.shift
    below = ndimage.map_coordinates(np.clip(depth, 0, bottom), places.T, order=1)
    return float(below.mean()) / bottom
