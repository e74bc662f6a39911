"""Separates touching objects by finding the outlines of free recesses within their region.

Objects that touch are one region of o_t, whose outline fits no recess. But each recess shows the
outline of one object. This outline is moved to its best pose within the region, at which it lies
inside the region and coincides with much of the region's outline. The object is then cut out there.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import fft, ndimage

from kitting_drake.policies.data.images import rotation_matrix
from kitting_drake.policies.matching.assignment import Pair
from kitting_drake.policies.matching.regions.segmentation import Mask, Region, Segmentation
from kitting_drake.policies.matching.registration import (
    Outline,
    Registration,
    closed,
    outline_of,
    register,
    residuals,
    trace_outline,
)

Array = NDArray[np.float64]

_ANGLES = 72
_STARTS = 5
"""The number of initial poses that are refined for each recess."""
_OUTSIDE = 3.0
"""In the search for poses, a pixel of the recess scores 1 if it is inside the region; otherwise it
scores minus `_OUTSIDE`."""
_NOTCH = 0.3
"""In the search for poses, the score of a pixel of the recess that lies in a narrow notch of the
region."""
_RIM = 1.5
"""In the search for poses, the weight of the agreement between the outlines, relative to the mean
score of the recess's pixels."""
_INSIDE = 0.94
"""At least this share of a recess's area must lie within the region."""
_NEAR = 0.0025
"""A point of an object's outline coincides with the region's outline if the two are less than this
apart, in metres."""
_SHARED = 0.45
"""At least this fraction of an object's outline must coincide with the region's outline."""
_COST = 0.0010
"""The coinciding points must be this near to the region's outline on average, in metres."""
_UNEXPLAINED = 0.15
"""If the objects found in a region leave more than this share of its area uncovered, they must all
agree clearly with the region's outline (`_CLEARLY`)."""
_CLEARLY = 0.65
"""An object's outline agrees clearly with the region's outline if at least this fraction of the
object's outline coincides with it."""
_LEAST_PART = 0.35
"""A region can contain the object of a recess only if the region's area exceeds this share of the
recess's area."""
_HIGHER = 0.006
"""Pixels that are higher than an object's median height by more than this, in metres, belong to
something that lies on the object."""
_ACROSS = 6
"""A higher part of a region lies across an object's outline if at least this many of the part's
pixels are inside the outline, and at least this many are outside."""
_SLIVER = 1
"""After objects are cut out of a region, the remainder is eroded by this many pixels, to drop
slivers."""
_LEAST_REST = 0.0002
"""A connected part of the remainder is an object if its area is at least this, in square metres."""


@dataclass(frozen=True)
class _Found:
    """An object found within a region by the outline of a recess."""

    recess: int
    """The index of the recess."""
    mask: Mask
    """(rows, cols) mask of the object."""
    shared: float
    """The share of the object's outline that coincides with the region's."""
    cost: float
    """The mean distance of the coinciding points from the region's outline, in metres."""


def split_touching(
    segmentation: Segmentation, pairs: Sequence[Pair], resolution: float
) -> Segmentation:
    """Splits regions of touching objects, if outlines of free recesses show where one object ends.

    Args:
        segmentation: the segmentation of o_t.
        pairs: the regions that fit into a recess without a split; see `match`.
        resolution: the side of a pixel, in metres.

    Returns:
        The new segmentation; the given segmentation if nothing is split.
    """
    objects = segmentation.objects
    matched = {pair.item for pair in pairs}
    filled = {id(segmentation.recesses[pair.recess]) for pair in pairs}
    recesses = [item for item in segmentation.free_recesses if id(item) not in filled]
    if len(matched) == len(objects) or not recesses:
        return segmentation
    result: list[Region] = []
    taken: set[int] = set()
    for index, region in enumerate(objects):
        if index in matched:
            result.append(region)
            continue
        result += _split(region, recesses, taken, segmentation.relief, resolution)
    if len(result) == len(objects):
        return segmentation
    result.sort(key=lambda item: -int(item.mask.sum()))
    return replace(segmentation, objects=tuple(result))


def _split(
    region: Region,
    recesses: Sequence[Region],
    taken: set[int],
    relief: NDArray[np.float32],
    resolution: float,
) -> list[Region]:
    """Returns the objects of a region, or the region itself if it cannot be split. Adds the
    recesses of the objects to `taken`."""
    parts: list[_Found] = []
    rest = region.mask
    while rest.any():
        around = trace_outline(rest, resolution, close=True)
        tried = [
            _find(index, recess, rest, relief, around, resolution)
            for index, recess in enumerate(recesses)
            if index not in taken and rest.sum() > _LEAST_PART * recess.mask.sum()
        ]
        found = [item for item in tried if item is not None]
        if not found:
            break
        best = max(found, key=lambda item: item.shared - 100 * item.cost)
        taken.add(best.recess)
        parts.append(best)
        rest = rest & ~best.mask
    unexplained = rest.sum() > _UNEXPLAINED * region.mask.sum()
    if unexplained and any(item.shared < _CLEARLY for item in parts):
        # Reject the split. The region may be a large box, into which the outlines of many recesses
        # fit.
        taken -= {item.recess for item in parts}
        parts = []
    if not parts:
        return [region]
    return [_region(item.mask, relief) for item in parts] + _rest(rest, relief, resolution)


def _rest(rest: Mask, relief: NDArray[np.float32], resolution: float) -> list[Region]:
    """Returns the objects in `rest`, the remainder of a region after objects are cut out. Slivers
    are dropped."""
    core = ndimage.binary_erosion(rest, iterations=_SLIVER)
    labels, count = ndimage.label(ndimage.binary_propagation(core, mask=rest))
    regions = (labels == number for number in range(1, count + 1))
    return [_region(mask, relief) for mask in regions if mask.sum() * resolution**2 >= _LEAST_REST]


def _region(mask: Mask, relief: NDArray[np.float32]) -> Region:
    return Region(mask, float(np.percentile(relief[mask], 90)))


def _find(
    number: int,
    recess: Region,
    region: Mask,
    relief: NDArray[np.float32],
    around: Outline,
    resolution: float,
) -> _Found | None:
    """Fits a recess's outline within a region, and returns the object at the best fit; None if
    the outline fits nowhere."""
    template = outline_of(recess, resolution)
    best: _Found | None = None
    for start in _starts(recess.mask, region, template, resolution):
        fit = register(template, around, starts=(start,), within=True)
        found = _judge(number, template, around, fit, region, relief, resolution)
        if found is not None and (best is None or found.shared > best.shared):
            best = found
    return best


def _judge(
    number: int,
    template: Outline,
    around: Outline,
    fit: Registration,
    region: Mask,
    relief: NDArray[np.float32],
    resolution: float,
) -> _Found | None:
    """Cuts an object out of a region, along a recess's outline that was fitted to the region's
    outline. Returns None if the two outlines do not agree well enough, or if something lies across
    the cut."""
    rows, cols = np.indices(region.shape)
    positions = np.stack([rows, cols], axis=-1).reshape(-1, 2)
    back = (positions - fit.shift) @ rotation_matrix(fit.rotation)
    distance = template.sample(template.distance, back, math.inf).reshape(region.shape)
    covered = distance < -fit.offset
    # Close the notches of the region, because recesses have none.
    filled = closed(region, resolution)
    if not covered.any() or filled[covered].mean() < _INSIDE:
        return None
    near = np.abs(template.values) < resolution
    away = np.abs(residuals(template, around, fit)[near])
    shared = away < _NEAR
    if shared.mean() < _SHARED or away[shared].mean() > _COST:
        return None
    mask = region & (distance < resolution / 2 - fit.offset)
    if _is_under_another(mask, region, relief):
        return None
    return _Found(number, mask, float(shared.mean()), float(away[shared].mean()))


def _is_under_another(mask: Mask, region: Mask, relief: NDArray[np.float32]) -> bool:
    """Whether something higher reaches across an object's outline."""
    high = region & (relief > np.median(relief[mask]) + _HIGHER)
    inside, outside = ndimage.binary_erosion(mask), ~ndimage.binary_dilation(mask)
    labels, count = ndimage.label(high)
    parts = (labels == number for number in range(1, count + 1))
    return any(
        (part & inside).sum() >= _ACROSS and (part & outside).sum() >= _ACROSS for part in parts
    )


def _starts(
    recess: Mask, region: Mask, template: Outline, resolution: float
) -> list[tuple[float, Array]]:
    """Finds rotations in radians and shifts in pixels at which most of a recess lies within a
    region, by correlation."""
    shape = _crop(recess)
    rows, cols = np.nonzero(region)
    half = math.ceil(math.hypot(*shape.shape) / 2) + 1
    low = np.array([rows.min(), cols.min()]) - half
    high = np.array([rows.max(), cols.max()]) + half + 1
    own = np.zeros(high - low, bool)
    own[rows - low[0], cols - low[1]] = True
    field = np.where(own, 1.0, np.where(closed(own, resolution), _NOTCH, -_OUTSIDE))
    edge = ndimage.gaussian_filter(_edge(own).astype(np.float32), 1.0)
    # The Fourier transform is cyclic. The values that wrap around are cut off below.
    size = tuple(fft.next_fast_len(n, real=True) for n in field.shape)
    # Score the inside with `field` and the outline with `edge`; one inverse transform serves both.
    inside = fft.rfft2((field / shape.sum()).astype(np.float32), size)
    outline = fft.rfft2(edge, size)
    middle = (np.array(shape.shape) - 1) / 2
    centre = np.argwhere(recess).min(axis=0) + middle
    found: list[tuple[float, float, Array]] = []
    for angle in np.arange(_ANGLES) * math.tau / _ANGLES:
        turn = rotation_matrix(float(angle))
        kernel = ndimage.affine_transform(
            shape.astype(np.float32),
            turn.T,
            offset=middle - turn.T @ (half, half),
            output_shape=(2 * half + 1, 2 * half + 1),
            order=1,
        )
        rim = _edge(kernel > 0.5)
        product = inside * np.conj(fft.rfft2(kernel, size))
        weight = np.float32(_RIM / max(int(rim.sum()), 1))
        product += outline * np.conj(fft.rfft2(rim.astype(np.float32), size)) * weight
        scores = fft.irfft2(product, size)
        scores = scores[: field.shape[0] - 2 * half, : field.shape[1] - 2 * half]
        row, col = np.unravel_index(int(scores.argmax()), scores.shape)
        there = low + (row, col) + half
        found.append((float(scores[row, col]), float(angle), there - turn @ centre))
    found.sort(key=lambda item: -item[0])
    return [(angle, shift) for _, angle, shift in _distinct(found)]


def _distinct(found: list[tuple[float, float, Array]]) -> list[tuple[float, float, Array]]:
    """Returns the best initial poses whose rotations differ clearly."""
    kept: list[tuple[float, float, Array]] = []
    for item in found:
        if all(abs(math.remainder(item[1] - other[1], math.tau)) > 0.2 for other in kept):
            kept.append(item)
    return kept[:_STARTS]


def _edge(mask: Mask) -> Mask:
    return mask & ~ndimage.binary_erosion(mask)


def _crop(mask: Mask) -> Mask:
    rows, cols = np.nonzero(mask)
    return mask[rows.min() : rows.max() + 1, cols.min() : cols.max() + 1]
