"""Assigns loose objects to recesses by their outlines."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment

from kitting_drake.policies.matching.half_turn import better_half_turn
from kitting_drake.policies.matching.regions.segmentation import Region, Segmentation
from kitting_drake.policies.matching.registration import (
    Registration,
    coarse_cost,
    is_covered,
    mismatch,
    outline_of,
    register,
)

_WORST_COST = 0.0019
"""An object fits into a recess only if their mismatch is less than this, in metres."""
_GOOD = 0.0005
"""An object whose mismatch with its recess is less than this, in metres, does not count as
reversed."""
_CLEARLY_BETTER = 0.75
"""An object counts as reversed only if its mirror image's mismatch with the recess is less than
this share of the object's own mismatch."""
_SYMMETRIC = 0.0012
"""An object cannot be reversed if its outline differs from its mirror image by less than this, in
metres. Without noise, pixels alone make them differ by up to 0.0012."""
_PROMISING = 2.0
"""An object's outline is registered only to recesses whose `coarse_cost` is at most this many times
the object's lowest `coarse_cost`."""


@dataclass(frozen=True)
class Pair:
    """An object and the recess into which it fits."""

    item: int
    """The index of the object in `Segmentation.objects`."""
    recess: int
    """The index of the recess in `Segmentation.recesses`."""
    fit: Registration
    """The registration of the object's outline to the recess's."""
    mismatch: float
    """The mismatch of object and recess, see `registration.mismatch`, in metres."""


def match(segmentation: Segmentation, unfilled: Sequence[Region], resolution: float) -> list[Pair]:
    """Returns pairs of a loose object and the recess into which it fits, best fit first. Each
    object and each recess occurs at most once.

    Args:
        segmentation: the segmentation of an observation.
        unfilled: the recesses of the segmentation into which objects may go.
        resolution: the side of a pixel, in metres.
    """
    objects = segmentation.objects
    if not objects or not unfilled:
        return []
    outlines = [outline_of(item, resolution, close=True) for item in objects]
    recesses = [outline_of(item, resolution) for item in unfilled]
    coarse = np.array([[coarse_cost(o, c) for c in recesses] for o in outlines])
    fits: dict[tuple[int, int], Registration] = {}
    costs = np.full(coarse.shape, 10 * _WORST_COST)
    for i, j in np.argwhere(coarse <= _PROMISING * coarse.min(axis=1, keepdims=True)).tolist():
        fits[i, j] = register(outlines[i], recesses[j])
        if is_covered(outlines[i], recesses[j], fits[i, j]):
            costs[i, j] = mismatch(fits[i, j], objects[i], unfilled[j])
    # Clip the costs, so that one hopeless pair does not outweigh all others.
    rows, cols = linear_sum_assignment(np.minimum(costs, _WORST_COST))
    index = {id(item): index for index, item in enumerate(segmentation.recesses)}
    pairs = []
    for i, j in zip(rows.tolist(), cols.tolist(), strict=True):
        if costs[i, j] < _WORST_COST:
            known = segmentation.depth, objects[i], unfilled[j], (outlines[i], recesses[j])
            fit = better_half_turn(*known, fits[i, j])
            pairs.append(Pair(i, index[id(unfilled[j])], fit, float(costs[i, j])))
    return sorted(pairs, key=lambda pair: pair.mismatch)


def reversed_objects(
    segmentation: Segmentation,
    pairs: Sequence[Pair],
    unfilled: Sequence[Region],
    resolution: float,
) -> tuple[int, ...]:
    """Finds the objects that lie upside down: the mirror images of their outlines fit free
    recesses. An object whose outline is nearly its own mirror image is never one of them.

    Args:
        segmentation: the segmentation of an observation.
        pairs: the result of `match`. A paired object's mirror image must fit clearly better than
            the object as seen.
        unfilled: the recesses of the segmentation into which objects may go.
        resolution: the side of a pixel, in metres.

    Returns:
        Indices of these objects in `Segmentation.objects`.
    """
    objects, regions = segmentation.objects, segmentation.recesses
    known = {pair.item: pair for pair in pairs}
    filled = {pair.recess for pair in pairs}
    flat = {id(item) for item in segmentation.free_recesses} & {id(item) for item in unfilled}
    free = [j for j, item in enumerate(regions) if id(item) in flat]
    traced = {j: outline_of(regions[j], resolution) for j in free}
    found = []
    for i, item in enumerate(objects):
        pair = known.get(i)
        own = _WORST_COST if pair is None else pair.mismatch
        choices = [j for j in free if j not in filled or (pair is not None and j == pair.recess)]
        if own < _GOOD or not choices:
            continue
        mirrored = Region(item.mask[:, ::-1], item.height)
        outline = outline_of(mirrored, resolution, close=True)
        coarse = {j: coarse_cost(outline, traced[j]) for j in choices}
        j = min(choices, key=lambda choice: coarse[choice])
        fit = register(outline, traced[j])
        better = mismatch(fit, mirrored, regions[j]) < _CLEARLY_BETTER * own
        if better and is_covered(outline, traced[j], fit):
            seen = outline_of(item, resolution, close=True)
            if not is_covered(outline, seen, register(outline, seen), _SYMMETRIC):
                found.append(i)
    return tuple(found)
