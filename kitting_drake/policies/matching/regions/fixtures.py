"""Finds the table and the fixtures in o_t by height."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import ConvexHull, QhullError

from systems.table_plane import plane_heights

Mask = NDArray[np.bool_]
Plane = NDArray[np.float64]
"""(3,): the height at (row, col) is `plane @ (row, col, 1)`, in metres."""

Fixture = tuple[Mask, Plane]
"""The mask (rows, cols) of a fixture's convex hull, and the plane of the fixture's top."""

_MOST_FIXTURES = 4
"""The largest number of fixtures."""
_COMPARABLE = 0.3
"""Every further fixture has at least this share of the largest fixture's area."""
PLANE_BAND = 0.004
"""A pixel belongs to a plane if their heights differ by less than this, in metres."""
_LEAST_FIXTURE_HEIGHT = 0.015
"""The least height of a fixture above the table, in metres."""
_LEAST_FIXTURE_AREA = 0.003
"""The least area of a fixture, in square metres. The limit is reduced for small pixels (see
`AreaLimits`)."""
RECESS_DEPTH = 0.003
"""The least depth of a recess below the fixture's top, in metres."""
LEAST_AREA = 0.0004
"""The least area of a region, in square metres. Smaller regions are noise. The limit is reduced for
small pixels."""
_LEAST_CLEAN_AREA = 0.00008
"""The least area of an object on a table without noise, in square metres."""
_LEAST_PROTRUDING = 0.00012
"""The least area of a protruding object, in square metres. It is small, because an object may
protrude only at one end."""
_USUAL_PIXEL = 0.003125
"""The least areas are chosen for pixels with this side, in metres. They are reduced for smaller
pixels, because noise affects a few pixels, whatever their size."""
_CLOSING = 0.0094
"""Gaps in a plateau are closed if they are narrower than twice this, in metres."""
CLEAN = 0.0005
"""Heights are filtered only if the standard deviation of their noise exceeds this, in metres."""
_LEVEL = math.tan(math.radians(0.7))
"""The slope below which a plateau counts as level."""
_REWEIGHTED, _SAME_HEIGHT = 8, 0.0003
"""The number of reweighted fits of a fixture's top, and the deviation, in metres, below which a
pixel's weight no longer grows."""
_TILT_ROUNDS = 3
"""The number of rounds in which a tilted plateau is extended along its slope."""
NEIGHBOURS = np.ones((3, 3), bool)


@dataclass(frozen=True)
class AreaLimits:
    """The least areas of regions that are not noise, in square metres."""

    fixture: float
    recess: float
    object: float
    protruding: float

    @classmethod
    def of(cls, resolution: float, noise: float = math.inf) -> AreaLimits:
        """Returns the limits for pixels with the side `resolution` and heights with the standard
        deviation `noise`, both in metres."""
        scale = min(1.0, (resolution / _USUAL_PIXEL) ** 2)
        least = scale * LEAST_AREA
        clean = noise <= CLEAN
        return cls(
            fixture=scale * _LEAST_FIXTURE_AREA,
            recess=least,
            object=min(least, _LEAST_CLEAN_AREA) if clean else least,
            protruding=scale * _LEAST_PROTRUDING,
        )


def _fit_plane(height: NDArray[np.float32], start: float, where: Mask) -> Plane:
    """Fits a plane to most pixels of the mask `where`, by three rounds of least squares on inliers.
    The first round starts from a level plane at the height `start`, in metres."""
    plane = np.array([0.0, 0.0, start])
    rows, cols = np.nonzero(where)
    design = np.column_stack([rows, cols, np.ones(len(rows))])
    values = height[rows, cols]
    for band in (2 * PLANE_BAND, PLANE_BAND, PLANE_BAND):
        near = np.abs(values - design @ plane) < band
        if near.sum() < 100:
            break
        plane = np.linalg.lstsq(design[near], values[near], rcond=None)[0]
    return plane


def _fit_top(height: NDArray[np.float32], plateau: Mask) -> Plane:
    """Fits a plane to a fixture's top. Shallow recesses and the tops of seated objects may lie
    within `PLANE_BAND` of it, so the fit minimizes absolute deviations."""
    plane = _fit_plane(height, float(np.median(height[plateau])), plateau)
    rows, cols = np.nonzero(plateau)
    design = np.column_stack([rows, cols, np.ones(len(rows))])
    values = height[rows, cols].astype(float)
    for _ in range(_REWEIGHTED):
        away = np.abs(values - design @ plane)
        weights = (away < PLANE_BAND) / np.maximum(away, _SAME_HEIGHT)
        weighted = design * weights[:, None]
        plane = np.linalg.lstsq(weighted.T @ design, weighted.T @ values, rcond=None)[0]
    return plane


def _mode(values: NDArray[np.float32]) -> float:
    """Returns the most frequent height, in metres."""
    width = 0.001
    low = float(values.min())
    counts = np.bincount(((values - low) / width).astype(int))
    smooth = np.convolve(counts, np.ones(5), "same")
    return low + (int(smooth.argmax()) + 0.5) * width


def fit_table(height: NDArray[np.float32]) -> Plane:
    """Fits the plane of the table to heights (rows, cols), in metres."""
    low = height[height <= np.median(height)]
    return _fit_plane(height, _mode(low), np.ones(height.shape, bool))


def find_fixtures(
    height: NDArray[np.float32], relief: NDArray[np.float32], resolution: float
) -> list[Fixture]:
    """Returns the fixtures: the largest plateau, and other large plateaus if they have recesses."""
    high = relief > _LEAST_FIXTURE_HEIGHT
    found: list[Fixture] = []
    largest = 0
    for _ in range(_MOST_FIXTURES):
        fixture = _find_fixture(height, relief, high, resolution)
        if fixture is None:
            break
        mask, plane = fixture
        size = int(mask.sum())
        if found:
            depth = plane_heights(plane, height.shape) - height
            if size < _COMPARABLE * largest or not _has_recess(mask, depth, resolution):
                break
        largest = max(largest, size)
        found.append(fixture)
        high = high & ~ndimage.binary_dilation(mask, iterations=2)
    return found


def _has_recess(fixture: Mask, depth: NDArray[np.float64], resolution: float) -> bool:
    """Whether a fixture encloses a recess on all sides.

    A low area within the convex hull of a tool is no recess: it is open on a side.
    """
    labels, count = ndimage.label(fixture & (depth > RECESS_DEPTH), NEIGHBOURS)
    sizes = np.bincount(labels.ravel(), minlength=count + 1)
    rim = fixture & ~ndimage.binary_erosion(fixture, iterations=2)
    sizes[np.unique(labels[rim])] = 0
    sizes[0] = 0
    return bool(sizes.max() * resolution**2 >= AreaLimits.of(resolution).recess)


def _find_fixture(
    height: NDArray[np.float32], relief: NDArray[np.float32], high: Mask, resolution: float
) -> Fixture | None:
    """Finds the largest plateau among the pixels of the mask `high`. Returns its convex hull and
    the plane of its top; None if there is no plateau."""
    least = AreaLimits.of(resolution).fixture
    if high.sum() * resolution**2 < least:
        return None
    level = _mode(relief[high])
    plateau = ndimage.binary_opening(high & (np.abs(relief - level) < PLANE_BAND), NEIGHBOURS)
    # Close gaps, so that a recess from rim to rim does not cut the plateau in two.
    closed = ndimage.binary_closing(plateau, NEIGHBOURS, max(1, round(_CLOSING / resolution)))
    labels, count = ndimage.label(closed, NEIGHBOURS)
    if not count:
        return None
    sizes = np.bincount(labels[plateau], minlength=count + 1)
    sizes[0] = 0
    plateau &= labels == sizes.argmax()
    if plateau.sum() * resolution**2 < least:
        return None
    plateau = _along_tilt(plateau, height, high, resolution)
    try:
        hull = ConvexHull(np.argwhere(plateau))
    except QhullError:
        return None
    rows, cols = np.indices(height.shape)
    fixture = np.ones(height.shape, bool)
    for a, b, offset in hull.equations:
        fixture &= a * rows + b * cols + offset <= 0.5
    return fixture, _fit_top(height, plateau)


def _along_tilt(plateau: Mask, height: NDArray[np.float32], high: Mask, resolution: float) -> Mask:
    """Extends a level band of a tilted plateau to the whole plateau. Returns a level plateau
    unchanged."""
    for _ in range(_TILT_ROUNDS):
        plane = _fit_top(height, plateau)
        if math.hypot(plane[0], plane[1]) < _LEVEL * resolution:
            return plateau
        near = high & (np.abs(height - plane_heights(plane, height.shape)) < PLANE_BAND)
        near = ndimage.binary_opening(near, NEIGHBOURS)
        labels, count = ndimage.label(
            ndimage.binary_closing(near, NEIGHBOURS, max(1, round(_CLOSING / resolution))),
            NEIGHBOURS,
        )
        sizes = np.bincount(labels[near & plateau], minlength=count + 1)
        sizes[0] = 0
        if not sizes.any():
            return plateau
        plateau = near & (labels == sizes.argmax())
    return plateau
