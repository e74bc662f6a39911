"""Finds the recess over which a placed object would lie, and what of the object would lie outside.

A small object that touches a large one may be taken for a part of it. Its outline then lies outside
the recess of the large object, and jaws that close on it do not hold the large object.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from kitting_drake.policies.data.images import moved_pixels
from kitting_drake.policies.matching.regions.segmentation import Mask, Region, Segmentation

Array = NDArray[np.float64]

MOST_OUTSIDE = 0.25
"""A grasp is avoided if more than this share of what it holds would lie outside the recess."""
_HELD = 0.010
"""The jaws hold what is within this distance of the pick, in metres."""


def placed_mask(region: Region, pick: Array, rotation: float, place: Array) -> Mask:
    """Returns a mask (rows, cols) of the pixels on which a placed object would lie.

    Args:
        region: the object.
        pick: (row, col) at which the object is gripped.
        rotation: the rotation of the object, in radians.
        place: (row, col) to which the gripped point goes.
    """
    there = moved_pixels(region.pixels, pick, rotation, place)
    mask = np.zeros_like(region.mask)
    mask[tuple(there[_is_inside(there, mask)].T)] = True
    # A rotation leaves gaps between pixels.
    return ndimage.binary_closing(mask, iterations=2) | mask


def recess_under(segmentation: Segmentation, placed: Mask) -> Region | None:
    """Returns the recess that has the most pixels in common with a placed object; None if no recess
    has any."""
    overlaps = [int((item.mask & placed).sum()) for item in segmentation.recesses]
    if not overlaps or not max(overlaps):
        return None
    return segmentation.recesses[int(np.argmax(overlaps))]


def held_outside(
    region: Region, recess: Region, pick: Array, rotation: float, place: Array, resolution: float
) -> NDArray[np.float32]:
    """Returns, for a grasp at each pixel (rows, cols), the share of what the jaws hold of an object
    that would lie outside a recess, from 0 to 1. Where the jaws hold nothing it is 1.

    The motion of the object is given by `pick`, `rotation` and `place`, as in `placed_mask`. The
    side of a pixel is `resolution`, in metres.
    """
    there = moved_pixels(region.pixels, pick, rotation, place)
    inside = _is_inside(there, recess.mask)
    inside[inside] = ndimage.binary_dilation(recess.mask)[tuple(there[inside].T)]
    outside = np.zeros_like(region.mask)
    outside[tuple(region.pixels[~inside].T)] = True
    reach = _HELD / resolution
    steps = np.arange(-np.floor(reach), np.floor(reach) + 1)
    disc = (np.hypot(steps[:, None], steps) <= reach).astype(np.float32)
    held, wrong = (
        ndimage.convolve(mask.astype(np.float32), disc, mode="constant")
        for mask in (region.mask, outside)
    )
    return np.where(held > 0.5, wrong / np.maximum(held, 1), 1.0).astype(np.float32)


def at_pixel(values: NDArray[np.float32], pixel: Array) -> float:
    """Returns the value of an array (rows, cols) at the pixel nearest to a position (row, col)."""
    row, col = np.clip(np.rint(pixel).astype(int), 0, np.array(values.shape) - 1)
    return float(values[row, col])


def _is_inside(pixels: NDArray[np.intp], mask: Mask) -> NDArray[np.bool_]:
    """(n,) whether each of n pixels (n, 2) lies in the image."""
    return np.asarray(((pixels >= 0) & (pixels < mask.shape)).all(axis=1))
