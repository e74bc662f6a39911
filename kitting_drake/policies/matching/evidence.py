"""Measures geometric facts about a pick and place in o_t, from which `confidence` estimates the
probability of success."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from kitting_drake.policies.data.images import rotation_matrix
from kitting_drake.policies.matching.refinement import nearest_region
from kitting_drake.policies.matching.regions.segmentation import Segmentation

Array = NDArray[np.float64]

Evidence = dict[str, float]
"""Named facts about a decision; the same names for all decisions of a policy."""

_RING = 3
"""How far the surroundings of an object extend from it, in pixels."""
_HOLE = 0.003
"""The least depth of a hole below its rim, in metres."""
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
    """
    fits, grasped = fit_cost is not None, grasp_cost is not None
    evidence = {
        "outlines_fit": float(fits),
        "fit": 1e3 * min(fit_cost, _WORST_FIT) if fit_cost is not None else 0.0,
        "jaws_have_room": float(grasped),
        "grasp": min(grasp_cost, _WORST_GRASP) if grasp_cost is not None else 0.0,
        "is_object": 0.0,
        "object_seen": 0.0,
        "place_seen": 0.0,
        "depth": 0.0,
        "hole": 0.0,
    }
    region = nearest_region(segmentation.objects, pick)
    if region is None:
        return evidence
    seen, relief = segmentation.visibility.seen, segmentation.relief
    rows, cols = seen.shape
    there = np.rint(place + (region.pixels - pick) @ rotation_matrix(rotation).T).astype(int)
    inside = ((there >= 0) & (there < (rows, cols))).all(axis=1)
    target = np.zeros_like(seen)
    target[tuple(there[inside].T)] = True
    target = ndimage.binary_closing(target, iterations=2) | target
    around = _ring(target)
    rim = float(np.percentile(relief[around], 75)) if around.any() else 0.0
    low = relief[target] < rim - _HOLE if target.any() else np.zeros(1, bool)
    floor = float(np.percentile(relief[target], 25)) if target.any() else 0.0
    return evidence | {
        "is_object": 1.0,
        "object_seen": float(seen[_ring(region.mask)].mean()),
        "place_seen": float(seen[around].mean()) if around.any() else 0.0,
        "depth": float(np.clip(1e3 * (rim - floor), -10.0, 30.0)),
        "hole": float(low.mean()),
    }


def _ring(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    return ndimage.binary_dilation(mask, iterations=_RING) & ~mask
