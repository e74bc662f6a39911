"""Measures geometric facts about a pick and place in o_t, from which `confidence` estimates the
probability of success."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from kitting_drake.policies.data.images import rotation_matrix
from kitting_drake.policies.matching.refinement import nearest_region
from kitting_drake.policies.matching.regions.placed_object import (
    at_pixel,
    held_outside,
    placed_mask,
    recess_under,
)
from kitting_drake.policies.matching.regions.segmentation import Region, Segmentation
from kitting_drake.policies.matching.registration import (
    ROBUST,
    Outline,
    Registration,
    coarse_costs,
    outline_of,
    recess_distances,
    residual_slopes,
    reverse_distances,
)

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
    *("asymmetry", "offset", "offset_off", "too_high", "height_off"),
    *("held_outside", "recess_seen"),
)
"""All of these facts are zero if no object is under the pick. Those of the last three rows are
also zero if no recess is under the place."""
_USUAL_TOO_HIGH = -0.0007
"""A cavity is as deep as its tool is high, if tools do not stand out of the kit. The measured
heights of tool and recess then differ by this, in metres: the median of the right decisions."""
_GROWTH = 1.12
"""In o_t, objects look larger and recesses smaller than they are, together by up to about this many
pixels. With a clearance, `FitQuality.offset` is smaller by the clearance."""
_WIDEST_CLEARANCE = 4.0
"""The largest clearance, in mm, at which a recess does not seem too large for its object."""
_FAR = 20.0
"""Upper limit of the distance from other objects, in mm."""
_MOST_OUTSIDE = 0.5
"""Upper limit of `held_outside`, as a share."""
_SAME_ROTATION = math.radians(8)
"""Rotations closer than this angle count as the same."""
_OTHER_ROTATION = math.radians(25)
"""Rotations farther apart than this angle are clearly different."""
_AGREES = 0.0015
"""Outlines agree at a point if their signed distances differ by less than this, in metres."""
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
    offset, without_clearance = 1e3 * quality.offset, 1e3 * resolution * _GROWTH
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
        "offset": offset,
        "offset_off": max(
            offset - without_clearance, without_clearance - _WIDEST_CLEARANCE - offset, 0.0
        ),
        "too_high": 1e3 * float(np.clip(too_high, -0.03, 0.03)),
        "height_off": 1e3 * min(abs(too_high - _USUAL_TOO_HIGH), 0.008),
        "held_outside": min(at_pixel(outside, pick), _MOST_OUTSIDE),
        "recess_seen": float(segmentation.visibility.seen[recess.mask].mean()),
    }


def _ring(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    return ndimage.binary_dilation(mask, iterations=_RING) & ~mask


@dataclass(frozen=True)
class FitQuality:
    """How well an object's outline, moved to a place, fits the recess there."""

    cost: float
    """The mean distance of the object's points from the recess's outline, in metres."""
    reverse: float
    """The mean distance of the recess's points from the object's outline, in metres."""
    agreement: float
    """The share of the object's points at which the outlines agree (see `_AGREES`)."""
    reverse_agreement: float
    """The share of the recess's points at which the outlines agree."""
    spread: float
    """The standard deviation, in pixels, of the fitted positions of the object's points. It is
    computed as if the errors of the distances were independent."""
    rival: float
    """The coarse cost of the best clearly different rotation, minus the coarse cost of this
    rotation, in metres. It is small for objects with rotational symmetry."""
    asymmetry: float
    """How much the object's outline differs from itself if it is rotated by the difference of those
    two rotations, in metres. If it is small, both rotations are right."""
    offset: float
    """How much smaller the recess is than the object on every side, in metres; negative if the
    recess is larger."""


def fit_quality(outline: Outline, recess: Outline, fit: Registration) -> FitQuality:
    """Measures how well an object fits a recess at the place to which a registration moves it.

    Args:
        outline: the outline of the object, with closed notches.
        recess: the outline of the recess.
        fit: the rotation and shift of the object. Its other fields are not used.
    """
    there, offset = recess_distances(outline, recess, fit)
    away = there - offset - outline.values
    back = reverse_distances(outline, recess, fit)
    costs, angles = coarse_costs(outline, recess)
    apart = np.abs((angles - fit.rotation + math.pi) % math.tau - math.pi)
    here = costs[apart < _SAME_ROTATION].min()
    rival = np.where(apart > _OTHER_ROTATION, costs, math.inf).argmin()
    own, turns = coarse_costs(outline, outline)
    return FitQuality(
        cost=float(np.abs(away).mean()),
        reverse=float(back.mean()),
        agreement=float((np.abs(away) < _AGREES).mean()),
        reverse_agreement=float((back < _AGREES).mean()),
        spread=_spread(outline, recess, fit, away),
        rival=float(costs[rival] - here),
        asymmetry=float(own[np.cos(turns - angles[rival] + fit.rotation).argmax()]),
        offset=offset,
    )


def _spread(outline: Outline, recess: Outline, fit: Registration, away: Array) -> float:
    """Computes `FitQuality.spread` by linear error propagation from the distances `away` (p,)."""
    turned = (outline.points - outline.middle) @ rotation_matrix(fit.rotation).T
    jacobian = residual_slopes(recess, turned, fit.moved(outline.middle) + turned)
    weighted = jacobian / np.maximum(1, np.abs(away) / ROBUST)[:, None]
    normal = weighted.T @ jacobian
    normal += np.diag(1e-4 * np.diag(normal) + 1e-12)
    variances = np.diag(np.linalg.inv(normal)) * np.minimum(away**2, ROBUST**2).mean()
    arms = np.square(turned).sum(axis=1).mean()
    return float(np.sqrt(variances[0] * arms + variances[1] + variances[2]))
