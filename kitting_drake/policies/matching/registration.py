"""Registers an object's outline to a recess's outline, with an error of less than a pixel.

Each outline is stored as signed distances on a grid that is finer than that of o_t. A recess has
the outline of its object, but without narrow notches, and wider by a clearance (see
`kitting_drake.hkd.kits.layout`). So narrow notches of the object's outline are closed first. The
outlines then differ by a constant offset, which is fitted as well. It is about one pixel minus the
clearance, because a view from above makes objects wider and recesses narrower.

At points near the object's outline, the signed distances from the two outlines are compared. The
cost is the mean of a robust function of their differences. Gauss-Newton minimizes it over
(rotation, row, col, offset), starting from the best of many rotations.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from kitting_drake.policies.data.images import rotation_matrix
from kitting_drake.policies.matching.regions.segmentation import Mask, Region

Array = NDArray[np.float64]

_SUBSAMPLING = 3
"""Number of fine pixels per pixel of o_t, along each axis."""
_CLOSING_RADIUS = 0.008
"""A recess does not follow notches of its object that are narrower than twice this, in metres."""
_BAND = 0.006
"""The cost is computed at points within this distance, in metres, of the object's outline."""
_FARTHEST = 0.012
"""Signed distances are clipped to plus or minus this many metres."""
ROBUST = 0.002
"""In the cost, residuals are capped at this many metres. Larger ones come from hidden or touching
parts."""
_WORST_REVERSE = 0.0025
"""An object fills a recess if the recess's outline is nearer than this to the object's outline on
average, in metres."""
_LARGEST_OFFSET = 0.004
"""The offset of the outlines is clipped to plus or minus this many metres."""
_OFFSET_WITHIN = 0.0025
"""When one object is sought within the outline of several, the offset is clipped to plus or minus
this many metres. A larger offset could hide a wrong pose."""
_HEIGHT_WEIGHT = 0.1
"""The weight, in a mismatch, of the difference between the object's height and the recess's
depth."""
_POINTS, _COARSE_POINTS = 700, 160
_ROTATIONS = 72
_STARTS = 3
_ITERATIONS = 15


@dataclass(frozen=True)
class Outline:
    """The outline of a region as signed distances in metres, negative inside."""

    distance: NDArray[np.float32]
    """(m, n) signed distances on the fine grid."""
    gradient: tuple[NDArray[np.float32], NDArray[np.float32]]
    """The derivatives of `distance` along rows and columns, per fine pixel."""
    origin: Array
    """(row, col) of the centre of fine pixel (0, 0), in pixels of o_t."""
    middle: Array
    """(row, col) of the region's centroid."""
    points: Array
    """(p, 2): evenly spread positions (row, col) near the outline, in pixels of o_t."""
    values: Array
    """(p,): the signed distances at `points`."""

    @cached_property
    def compared(self) -> list[tuple[Outline, tuple[Array, Array]]]:
        """The outlines with which this one was compared, and the results (see `coarse_costs`)."""
        return []

    def sample(self, field: NDArray[np.float32], positions: Array, outside: float) -> Array:
        """Returns the values (n,) of `distance` or of a `gradient` at positions (n, 2) in pixels of
        o_t. Off the grid the value is `outside`."""
        fine = ((positions - self.origin) * _SUBSAMPLING).T
        return ndimage.map_coordinates(field, fine, order=1, mode="constant", cval=outside)


@dataclass(frozen=True)
class Registration:
    """The fit of an object's outline to that of a recess. It moves a point p to R(rotation) p +
    shift."""

    rotation: float
    """The rotation, counter-clockwise, in radians."""
    shift: Array
    """The shift along rows and columns, in pixels."""
    cost: float
    """The mean robust difference of the outlines, in metres."""
    offset: float = 0.0
    """How much smaller the recess is than the object on every side, in metres; negative if the
    recess is larger."""

    def moved(self, pixel: Array) -> Array:
        """Returns the new position of a point (row, col) of the object."""
        return rotation_matrix(self.rotation) @ pixel + self.shift


def outline_of(region: Region, resolution: float, *, close: bool = False) -> Outline:
    """Returns the outline of a region (see `trace_outline`), which is computed only once."""
    key = resolution, close
    if key not in region.outlines:
        region.outlines[key] = trace_outline(region.mask, resolution, close=close)
    outline: Outline = region.outlines[key]
    return outline


def trace_outline(mask: Mask, resolution: float, *, close: bool = False) -> Outline:
    """Computes the outline of a region.

    Args:
        mask: (rows, cols) with at least one True pixel.
        resolution: the side of a pixel, in metres.
        close: whether to close narrow notches, which the object's recess does not have.
    """
    margin = math.ceil((_FARTHEST + _CLOSING_RADIUS) / resolution) + 1
    rows, cols = np.nonzero(mask)
    corner = np.array([rows.min(), cols.min()]) - margin
    size = np.array([rows.max(), cols.max()]) + margin + 1 - corner
    crop = np.zeros(size, np.float32)
    crop[rows - corner[0], cols - corner[1]] = 1
    fine = ndimage.zoom(crop, _SUBSAMPLING, order=1, mode="nearest", grid_mode=True) > 0.5
    step = resolution / _SUBSAMPLING
    if close:
        fine = closed(fine, step)
    outside = ndimage.distance_transform_edt(~fine)
    distance = (outside - ndimage.distance_transform_edt(fine)) * step
    # The outline lies midway between a pixel inside and a pixel outside.
    distance = np.clip(distance - np.sign(distance) * step / 2, -_FARTHEST, _FARTHEST)
    distance = ndimage.gaussian_filter(distance, 1.0).astype(np.float32)
    # The centre of fine pixel (0, 0), the first one in the coarse pixel at `corner`.
    origin = corner - 0.5 + 0.5 / _SUBSAMPLING
    near = np.argwhere(np.abs(distance) < _BAND)
    chosen = near[:: max(1, len(near) // _POINTS)]
    along_row, along_col = np.gradient(distance)
    return Outline(
        distance=distance,
        gradient=(along_row, along_col),
        origin=origin,
        middle=np.argwhere(fine).mean(axis=0) / _SUBSAMPLING + origin,
        points=chosen / _SUBSAMPLING + origin,
        values=distance[tuple(chosen.T)].astype(float),
    )


def closed(mask: Mask, resolution: float) -> Mask:
    """Fills narrow notches and all holes of a mask, because the object's recess has none of them.

    The mask must have a margin of False pixels.
    """
    grown = ndimage.distance_transform_edt(~mask) * resolution <= _CLOSING_RADIUS
    whole = ndimage.distance_transform_edt(grown) * resolution > _CLOSING_RADIUS
    return np.asarray(ndimage.binary_fill_holes(whole))


def register(
    outline: Outline,
    recess: Outline,
    *,
    starts: tuple[tuple[float, Array], ...] = (),
    within: bool = False,
) -> Registration:
    """Finds the best fit of an object's outline to that of a recess.

    Args:
        outline: the outline of the object, with closed notches.
        recess: the outline of the recess.
        starts: initial rotations in radians and shifts in pixels. If there are none, the best of
            many rotations about the centroids are refined.
        within: whether `recess` is in fact the outline of several touching objects, and `outline`
            is the outline of one of them. Parts of `outline` then have no counterpart and get
            little weight, and the offset is at most `_OFFSET_WITHIN`.
    """
    begins = starts or _coarse_starts(outline, recess)
    found = [_refine(outline, recess, rotation, shift, within) for rotation, shift in begins]
    return min(found, key=lambda item: item.cost)


def coarse_cost(outline: Outline, recess: Outline) -> float:
    """Returns a quick estimate of the cost of the best fit that `register` would find, in
    metres."""
    return float(coarse_costs(outline, recess)[0].min())


def half_turn_ratio(outline: Outline, recess: Outline, rotation: float) -> float:
    """Returns the `coarse_cost` of the rotation that differs by half a turn, as a multiple of that
    of a rotation (in radians)."""
    costs, angles = coarse_costs(outline, recess)
    here, turned = (
        costs[np.cos(angles - angle).argmax()] for angle in (rotation, rotation + math.pi)
    )
    return float(turned / max(here, 1e-9))


def preference(
    outline: Outline, recess: Outline, first: Registration, second: Registration
) -> float:
    """Returns how much better the first fit is than the second, in metres; negative if it is worse.

    If a tool is rotated by half a turn, most of its outline looks the same, and the mean costs of
    the two fits differ only by noise. So each point is weighted by the difference of the two fits
    at that point.
    """
    there, away = zip(
        *(_compare_outlines(outline, recess, fit) for fit in (first, second)), strict=True
    )
    telling = np.abs(there[0] - there[1])
    total = float(telling.sum())
    return float((telling * (np.abs(away[1]) - np.abs(away[0]))).sum()) / total if total else 0.0


def _compare_outlines(outline: Outline, recess: Outline, fit: Registration) -> tuple[Array, Array]:
    """Compares an object's outline, fitted to a recess, with that recess.

    Returns:
        (p,): the signed distances, in metres, of the fitted points from the recess's outline, minus
            the offset between the outlines.
        (p,): the first array minus the signed distances of the points from the object's own
            outline.
    """
    there, offset = recess_distances(outline, recess, fit)
    return there - offset, there - offset - outline.values


def recess_distances(outline: Outline, recess: Outline, fit: Registration) -> tuple[Array, float]:
    """Moves an object's points by a fit. Returns their signed distances (p,) from the recess's
    outline, and the offset between the outlines, both in metres."""
    positions = outline.points @ rotation_matrix(fit.rotation).T + fit.shift
    there = recess.sample(recess.distance, positions, _FARTHEST)
    offset = float(np.median(there - outline.values))
    return there, float(np.clip(offset, -_LARGEST_OFFSET, _LARGEST_OFFSET))


def residuals(outline: Outline, recess: Outline, fit: Registration) -> Array:
    """Returns the differences (p,) of the outlines' signed distances at the fitted points, minus
    the fit's offset, in metres."""
    positions = outline.points @ rotation_matrix(fit.rotation).T + fit.shift
    return recess.sample(recess.distance, positions, _FARTHEST) - outline.values - fit.offset


def is_covered(
    outline: Outline, recess: Outline, fit: Registration, within: float = _WORST_REVERSE
) -> bool:
    """Whether, after a fit, all of the recess's outline lies near the object's outline.

    `register` measures distances only from points of the object's outline, and clips them. So a
    box seems to fit into a longer cavity, or onto the visible remainder of a filled recess. The
    distances of the recess's points from the object's outline show that such fits are poor. "Near"
    means that their mean is less than `within`, in metres.
    """
    return bool(reverse_distances(outline, recess, fit).mean() < within)


def reverse_distances(outline: Outline, recess: Outline, fit: Registration) -> Array:
    """The differences (p,) of the outlines' signed distances at the recess's points, without their
    sign, in metres."""
    back = (recess.points - fit.shift) @ rotation_matrix(fit.rotation)
    _, offset = recess_distances(outline, recess, fit)
    reverse = outline.sample(outline.distance, back, _FARTHEST) - recess.values + offset
    return np.abs(reverse)


def mismatch(fit: Registration, item: Region, recess: Region) -> float:
    """Returns how much an object and a recess differ in outline and height, in metres."""
    return fit.cost + _HEIGHT_WEIGHT * abs(item.height - recess.height)


def coarse_costs(outline: Outline, recess: Outline) -> tuple[Array, Array]:
    """Returns the costs of evenly spaced rotations about the centroids, in metres, and these
    rotations in radians. They are computed once for each pair of outlines."""
    for other, found in outline.compared:
        if other is recess:
            return found
    costs = _compare_coarsely(outline, recess)
    outline.compared.append((recess, costs))
    return costs


def _compare_coarsely(outline: Outline, recess: Outline) -> tuple[Array, Array]:
    step = max(1, len(outline.points) // _COARSE_POINTS)
    offsets = outline.points[::step] - outline.middle
    angles = np.arange(_ROTATIONS) * math.tau / _ROTATIONS
    cos, sin = np.cos(angles)[:, None], np.sin(angles)[:, None]
    rows = cos * offsets[:, 0] - sin * offsets[:, 1] + recess.middle[0]
    cols = sin * offsets[:, 0] + cos * offsets[:, 1] + recess.middle[1]
    positions = np.stack([rows, cols], axis=-1).reshape(-1, 2)
    there = recess.sample(recess.distance, positions, _FARTHEST).reshape(rows.shape)
    difference = there - outline.values[::step]
    difference -= np.clip(
        np.median(difference, axis=1, keepdims=True), -_LARGEST_OFFSET, _LARGEST_OFFSET
    )
    return np.abs(difference).mean(axis=1), angles


def _coarse_starts(outline: Outline, recess: Outline) -> list[tuple[float, Array]]:
    costs, angles = coarse_costs(outline, recess)
    lowest = (costs <= np.roll(costs, 1)) & (costs < np.roll(costs, -1))
    candidates = np.flatnonzero(lowest)
    if not len(candidates):
        # All costs are equal if the object does not overlap the recess, for example a small object
        # at the centroid of an L-shaped recess.
        candidates = np.array([costs.argmin()])
    best = candidates[np.argsort(costs[candidates])][:_STARTS]
    return [
        (float(angle), recess.middle - rotation_matrix(float(angle)) @ outline.middle)
        for angle in angles[best]
    ]


def _refine(
    outline: Outline, recess: Outline, rotation: float, shift: Array, within: bool
) -> Registration:
    """Refines a fit by Gauss-Newton with robust weights, over (rotation about the object's
    centroid, row, col, offset)."""
    arms = outline.points - outline.middle
    place = rotation_matrix(rotation) @ outline.middle + shift
    offset, cost = 0.0, math.inf
    largest = _OFFSET_WITHIN if within else _LARGEST_OFFSET
    best = (rotation, place, offset)
    for _ in range(_ITERATIONS):
        turned = arms @ rotation_matrix(rotation).T
        positions = turned + place
        there = recess.sample(recess.distance, positions, _FARTHEST)
        residual = there - outline.values
        if not np.isfinite(cost):
            offset = float(np.clip(np.median(residual), -largest, largest))
        residual = residual - offset
        weight = 1 / np.maximum(1, np.abs(residual) / ROBUST)
        if within:
            weight **= 2
        now = float((weight * np.abs(residual)).mean())
        if now < cost:
            improved = cost - now
            cost, best = now, (rotation, place, offset)
            if improved < 1e-6:
                break
        jacobian = residual_slopes(recess, turned, positions)
        weighted = jacobian * weight[:, None]
        normal = weighted.T @ jacobian
        normal += np.diag(1e-4 * np.diag(normal) + 1e-12)
        step = np.linalg.solve(normal, -weighted.T @ residual)
        rotation += float(np.clip(step[0], -0.1, 0.1))
        place = place + np.clip(step[1:3], -3, 3)
        offset = float(np.clip(offset + step[3], -largest, largest))
    rotation, place, offset = best
    shift = place - rotation_matrix(rotation) @ outline.middle
    return Registration(rotation, shift, cost, offset)


def residual_slopes(recess: Outline, turned: Array, positions: Array) -> Array:
    """(p, 4): the derivatives of the residuals with respect to rotation, row, col and offset.

    Args:
        recess: the outline of the recess.
        turned: (p, 2) the points of the object relative to its centroid, after its rotation.
        positions: (p, 2) the points at the object's place.
    """
    by_row = recess.sample(recess.gradient[0], positions, 0.0) * _SUBSAMPLING
    by_col = recess.sample(recess.gradient[1], positions, 0.0) * _SUBSAMPLING
    by_rotation = by_col * turned[:, 0] - by_row * turned[:, 1]
    return np.column_stack([by_rotation, by_row, by_col, -np.ones(len(turned))])
