"""Measures how well an object's outline, moved to a place, fits the recess there."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kitting_drake.policies.data.images import rotation_matrix
from kitting_drake.policies.matching.registration import (
    ROBUST,
    Outline,
    Registration,
    coarse_costs,
    recess_distances,
    residual_slopes,
    reverse_distances,
)

Array = NDArray[np.float64]

_SAME_ROTATION = math.radians(8)
"""Rotations closer than this angle count as the same."""
_OTHER_ROTATION = math.radians(25)
"""Rotations farther apart than this angle are clearly different."""
_AGREES = 0.0015
"""Outlines agree at a point if their signed distances differ by less than this, in metres."""


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
