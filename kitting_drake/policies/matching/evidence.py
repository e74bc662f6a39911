"""Measures geometric facts about a pick and place in o_t, from which `confidence` estimates the
probability of success."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from kitting_drake.policies.data.images import rotation_matrix
from kitting_drake.policies.matching.fit_quality import fit_quality
from kitting_drake.policies.matching.refinement import nearest_region
from kitting_drake.policies.matching.regions.placed_object import (
    at_pixel,
    held_outside,
    placed_mask,
    recess_under,
)
from kitting_drake.policies.matching.regions.segmentation import Region, Segmentation
from kitting_drake.policies.matching.registration import Registration, outline_of

Array = NDArray[np.float64]

Evidence = dict[str, float]
"""Named facts about a decision; the same names for all decisions of a policy."""

_RING = 3
"""How far the surroundings of an object extend from it, in pixels."""
_HOLE = 0.003
"""Pixels that are lower than the rim by more than this, in metres, count as a hole."""
_REGION_FACTS = (
    *("is_object", "object_seen", "depth", "hole", "size", "apart"),
    *("over_recess", "cost", "reverse", "agreement", "reverse_agreement", "spread", "rival"),
    *("asymmetry", "offset", "too_high", "height_off", "held_outside", "recess_seen"),
)
"""All of these facts are zero if no object is under the pick. Those of the last two rows are also
zero if no recess is under the place."""
_USUAL_TOO_HIGH = -0.0007
"""A cavity is as deep as its tool is high, if tools do not stand out of the kit. The measured
heights of tool and recess then differ by this, in metres: the median of the right decisions."""
_FAR = 20.0
"""Upper limit of the distance from other objects, in mm."""
_MOST_OUTSIDE = 0.5
"""Upper limit of `held_outside`. More does not make an action less likely to succeed."""
_WORST_FIT = 0.002
_WORST_GRASP = 5.0


def geometric_evidence(
    segmentation: Segmentation,
    pick: Array,
    rotation: float,
    place: Array,
    fit_cost: float | None,
    grasp_cost: float | None,
) -> Evidence:
    """Measures facts about a pick and place in o_t.

    Args:
        segmentation: the segmentation of o_t.
        pick: (row, col) at which the object is gripped.
        rotation: the rotation of the object, in radians.
        place: (row, col) to which the gripped point goes.
        fit_cost: the mean difference of the outlines of object and recess, in metres; None if they
            do not fit.
        grasp_cost: the cost of the grasp, see `JawGrasp.cost`; None if there is no feasible grasp.

    Returns:
        The facts by name. Lengths are in mm, shares are from 0 to 1.
    """
    seen, relief = segmentation.visibility.seen, segmentation.relief
    fits, grasped = fit_cost is not None, grasp_cost is not None
    evidence = dict.fromkeys(_REGION_FACTS, 0.0) | {
        "outlines_fit": float(fits),
        "fit": 1e3 * min(fit_cost, _WORST_FIT) if fit_cost is not None else 0.0,
        "jaws_have_room": float(grasped),
        "grasp": min(grasp_cost, _WORST_GRASP) if grasp_cost is not None else 0.0,
        "noise": 1e3 * min(segmentation.noise, 0.003),
    }
    region = nearest_region(segmentation.objects, pick)
    if region is None:
        return evidence
    target = placed_mask(region, pick, rotation, place)
    around = _ring(target)
    rim = float(np.percentile(relief[around], 75)) if around.any() else 0.0
    low = relief[target] < rim - _HOLE if target.any() else np.zeros(1, bool)
    floor = float(np.percentile(relief[target], 25)) if target.any() else 0.0
    return evidence | {
        "is_object": 1.0,
        "object_seen": float(seen[_ring(region.mask)].mean()),
        "depth": float(np.clip(1e3 * (rim - floor), -10.0, 30.0)),
        "hole": float(low.mean()),
        "size": math.log(len(region.pixels)),
        "apart": _apart(segmentation, region),
        **_fit_facts(segmentation, region, target, pick, rotation, place),
    }


def _apart(segmentation: Segmentation, region: Region) -> float:
    """The distance of an object from the nearest other one, at most `_FAR`, in mm."""
    others = np.ones(region.mask.shape, bool)
    for item in segmentation.objects:
        if item is not region:
            others &= ~item.mask
    if others.all():
        return _FAR
    away = ndimage.distance_transform_edt(others)[region.mask].min()
    return float(min(1e3 * away * segmentation.visibility.resolution, _FAR))


def _fit_facts(
    segmentation: Segmentation,
    region: Region,
    target: NDArray[np.bool_],
    pick: Array,
    rotation: float,
    place: Array,
) -> Evidence:
    """Returns facts about the fit of a placed object to the recess under it; empty if no recess is
    there."""
    recess = recess_under(segmentation, target)
    if recess is None:
        return {}
    resolution = segmentation.visibility.resolution
    quality = fit_quality(
        outline_of(region, resolution, close=True),
        outline_of(recess, resolution),
        Registration(rotation, place - rotation_matrix(rotation) @ pick, 0.0),
    )
    too_high = region.height - recess.height
    outside = held_outside(region, recess, pick, rotation, place, resolution)
    return {
        "over_recess": 1.0,
        "cost": 1e3 * min(quality.cost, 0.005),
        "reverse": 1e3 * min(quality.reverse, 0.008),
        "agreement": quality.agreement,
        "reverse_agreement": quality.reverse_agreement,
        "spread": 1e3 * resolution * min(quality.spread, 1.0),
        "rival": 1e3 * float(np.clip(quality.rival, -0.003, 0.006)),
        "asymmetry": 1e3 * min(quality.asymmetry, 0.006),
        "offset": 1e3 * quality.offset,
        "too_high": 1e3 * float(np.clip(too_high, -0.03, 0.03)),
        "height_off": 1e3 * min(abs(too_high - _USUAL_TOO_HIGH), 0.008),
        "held_outside": min(at_pixel(outside, pick), _MOST_OUTSIDE),
        "recess_seen": float(segmentation.visibility.seen[recess.mask].mean()),
    }


def _ring(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    return ndimage.binary_dilation(mask, iterations=_RING) & ~mask
