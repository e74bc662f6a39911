"""Segments o_t by height into table, fixture, loose objects and recesses.

It uses neither colour nor a network. The fixture is the largest plateau above the table. Anything
that rises beside the fixture is a loose object; anything below the fixture's top is a recess or a
part of a recess.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import ConvexHull, QhullError

from kitting_drake.policies.matching.visibility import Visibility
from systems.signals import Observation

Mask = NDArray[np.bool_]
Plane = NDArray[np.float64]
"""(3,): the height at (row, col) is `plane @ (row, col, 1)`, in metres."""

_Fixture = tuple[Mask, Plane]
"""The convex hull of a fixture (rows, cols), and the plane of its top."""

_MOST_FIXTURES = 4
"""The largest number of fixtures."""
_COMPARABLE = 0.3
"""The least area of a further fixture, as a share of the largest fixture's area."""
_PLANE_BAND = 0.004
"""The largest distance, in metres, from a plane at which a pixel belongs to it."""
_LEAST_FIXTURE_HEIGHT = 0.015
"""The least height of a fixture above the table, in metres."""
_LEAST_FIXTURE_AREA = 0.003
"""The least area of a fixture, in square metres. The limit is reduced for small pixels (see
`_AreaLimits`)."""
_OBJECT_HEIGHT = 0.003
"""The least height of an object above the table, in metres."""
_RECESS_DEPTH = 0.003
"""The least depth of a recess below the fixture's top, in metres."""
_PROTRUSION = 0.002
"""The largest height, in metres, by which a seated object rises above the fixture."""
_LEAST_AREA = 0.0004
"""The least area of a region, in square metres. Smaller regions are noise. The limit is reduced for
small pixels."""
_LEAST_CLEAN_AREA = 0.00008
"""The least area of an object on a table without noise, in square metres."""
_LEAST_PROTRUDING = 0.00012
"""The least area of a protruding object, in square metres. It is small, because an object may
protrude only at one end."""
_USUAL_PIXEL = 0.003125
"""The side of the pixels, in metres, for which the least areas are chosen. Noise affects a few
pixels of any size, so the least areas are reduced for smaller pixels."""
_CLOSING = 0.0094
"""Half the width, in metres, of the widest gap in a plateau that is closed."""
_FIXTURE_MARGIN = 0.006
"""No object is found within this distance, in metres, outside the fixture's outline, and no recess
within half this distance inside it."""
_CLEAN = 0.0005
"""The largest standard deviation of the noise, in metres, at which heights are not filtered."""
_CLEARLY = 2.0
"""A height is not noise if it differs from a plane by more standard deviations than this.

The few noisy pixels that differ by more are isolated. A larger value would cut off the flat ends of
an object, which are needed to tell its heading from the opposite heading.
"""
_OBJECT_SEEN = 0.5
"""The least share of an object's pixels that must be seen."""
_RECESS_SEEN = 0.3
"""The least share of a free recess's pixels that must be seen."""
_GAP = 1.5
"""Half the largest width, in pixels, of the gap between an object and its recess."""
_LEAST_GAP = 0.003
"""Half the largest width, in metres, of the gap between an object and its recess, where this is
more than `_GAP` pixels."""
_FLAT = 0.0006
"""The largest deviation, in metres, from a flat floor's median depth. If twice the noise is more,
it is used instead."""
_FLAT_SHARE = 0.7
"""The share of a flat floor that deviates by at most `_FLAT` is larger than this."""
_BELOW_TOP = 0.001
"""The least depth, in metres, of a surface that counts as below the fixture's top."""
_NOISY = 0.001
"""The standard deviation of the noise, in metres, above which an object in a recess cannot be
distinguished from the recess's floor."""
_LEVEL = math.tan(math.radians(0.7))
"""The slope below which a plateau counts as level."""
_TILT_ROUNDS = 3
"""The number of rounds in which a tilted plateau is extended along its slope."""
_NEIGHBOURS = np.ones((3, 3), bool)
_CROSS = ndimage.generate_binary_structure(2, 1)


@dataclass(frozen=True)
class _AreaLimits:
    """The least areas of regions that are not noise, in square metres."""

    fixture: float
    recess: float
    object: float
    protruding: float

    @classmethod
    def of(cls, resolution: float, noise: float = math.inf) -> _AreaLimits:
        """Returns the limits for pixels with the side `resolution` and heights with the standard
        deviation `noise`, both in metres."""
        scale = min(1.0, (resolution / _USUAL_PIXEL) ** 2)
        least = scale * _LEAST_AREA
        clean = noise <= _CLEAN
        return cls(
            fixture=scale * _LEAST_FIXTURE_AREA,
            recess=least,
            object=min(least, _LEAST_CLEAN_AREA) if clean else least,
            protruding=scale * _LEAST_PROTRUDING,
        )


@dataclass(frozen=True)
class Region:
    """A connected region of pixels: a loose object or a recess."""

    mask: Mask
    """(rows, cols) mask of the region."""
    height: float
    """The object's height above the table, or the recess's depth below the fixture's top, in
    metres: the 90th percentile over the region."""

    @property
    def pixels(self) -> NDArray[np.intp]:
        """(n, 2): row and column of each pixel of the region."""
        return np.argwhere(self.mask)


@dataclass(frozen=True)
class Segmentation:
    """The regions of an observation: fixture, recesses, objects."""

    fixture: Mask
    """(rows, cols) mask of the fixture; all False if there is none."""
    objects: tuple[Region, ...]
    """The objects that lie loose on the table."""
    recesses: tuple[Region, ...]
    """Regions below the fixture's top, including the visible fragments of filled recesses."""
    protruding: tuple[Region, ...]
    """The objects that protrude from the fixture, highest first. Their `height` is measured from
    the fixture's top."""
    relief: NDArray[np.float32]
    """(rows, cols): height above the table plane in metres; unseen pixels are filled in."""
    depth: NDArray[np.float32]
    """(rows, cols): depth below the plane of the fixture's top in metres; zero outside the
    fixture."""
    visibility: Visibility
    """The pixels of the observation that are seen."""
    noise: float = 0.0
    """The standard deviation of the table's heights, in metres."""

    @property
    def kit_seen(self) -> bool:
        """Whether o_t shows a kit: a fixture with recesses or protruding objects."""
        return bool(self.fixture.any()) and bool(self.recesses or self.protruding)

    @property
    def free_recesses(self) -> tuple[Region, ...]:
        """The recesses that contain no object.

        They are wide, are seen, and have a flat floor. In a filled recess either only the narrow
        gaps around the object are deep enough to be seen, or the object's surface is not flat, or
        most of it ends just below the fixture's top.
        """
        return tuple(
            item
            for item in self.recesses
            if self._is_wide(item) and self._is_flat(item) and not self._is_fragment(item)
        )

    @property
    def unfilled_recesses(self) -> tuple[Region, ...]:
        """The recesses into which an object might fit.

        These are the `free_recesses` and the narrow recesses. If there is noise, they are all
        recesses, because an object in a recess may then look like the recess's floor.
        """
        if self.noise > _CLEAN:
            return self.recesses
        return tuple(
            item
            for item in self.recesses
            if not self._is_fragment(item) and (self._is_flat(item) or not self._is_wide(item))
        )

    @property
    def occupied(self) -> Mask:
        """(rows, cols) mask of the pixels where no object can be laid down, because something is
        there or they are not seen.

        Single unseen pixels are ignored as noise.
        """
        taken = self.fixture | ~self.visibility.in_view
        taken |= ndimage.binary_opening(~self.visibility.seen, iterations=2)
        for region in self.objects:
            taken |= region.mask
        return np.asarray(taken)

    def _is_wide(self, recess: Region) -> bool:
        """Whether a recess is seen, and wider than the gap around an object."""
        return bool(
            _inner_radius(recess.mask) > max(_GAP, _LEAST_GAP / self.visibility.resolution)
            and self.visibility.seen[recess.mask].mean() > _RECESS_SEEN
        )

    @cached_property
    def _low(self) -> NDArray[np.int32]:
        """(rows, cols): labels of the connected parts of the fixture below its top."""
        return np.asarray(ndimage.label(self.depth > _BELOW_TOP, _NEIGHBOURS)[0])

    def _is_fragment(self, recess: Region) -> bool:
        """Whether a region is only a fragment of a filled recess.

        The larger part of the filled recess then shows the object's top, slightly below the
        fixture's top. In a free recess, only slots whose floor no camera sees look so shallow, and
        they are the smaller part.
        """
        if self.noise > _CLEAN:
            return False
        labels = np.unique(self._low[recess.mask])
        reach = max(2, round(_FIXTURE_MARGIN / self.visibility.resolution))
        near = ndimage.binary_dilation(recess.mask, _NEIGHBOURS, iterations=reach)
        beside = np.isin(self._low, labels[labels > 0]) & (self.depth < _RECESS_DEPTH) & ~near
        return bool(beside.sum() > recess.mask.sum())

    def _is_flat(self, recess: Region) -> bool:
        if self.noise > _NOISY:
            return True
        # Leave out the pixels at the walls, which show the wall or the floor. Use depths below the
        # fixture's top, so that the floor of a tilted fixture is also flat.
        core = ndimage.binary_erosion(recess.mask) & self.visibility.seen
        floor = self.depth[core if core.any() else recess.mask]
        away = np.abs(floor - np.median(floor))
        return bool((away < max(_FLAT, 2 * self.noise)).mean() > _FLAT_SHARE)


def segment(observation: Observation) -> Segmentation:
    """Segments an observation.

    Args:
        observation: the heightmap o_t.

    Returns:
        The segmentation. If there is no plateau, it has neither a fixture nor recesses. Several
        kits count as one fixture.
    """
    resolution = observation.grid.resolution
    height = observation.filled_height
    table = _fit_table(height)
    relief = (height - _plane_heights(table, height.shape)).astype(np.float32)
    fixtures = _find_fixtures(height, relief, resolution)
    noise = _noise_of(height, relief, fixtures)
    if noise > _CLEAN:
        # A median filter erases details one pixel wide, so use it only on noisy heights.
        height = ndimage.median_filter(height, footprint=_CROSS, mode="nearest")
        relief = ndimage.median_filter(relief, footprint=_CROSS, mode="nearest")
        fixtures = _find_fixtures(height, relief, resolution)
        noise = _noise_of(height, relief, fixtures)
    margin, areas = _FIXTURE_MARGIN / resolution, _AreaLimits.of(resolution, noise)
    fixture = np.zeros(relief.shape, bool)
    depth = np.zeros_like(relief)
    for mask, top in fixtures:
        depth[mask] = (_plane_heights(top, height.shape) - height)[mask]
        fixture |= mask
    least = max(_OBJECT_HEIGHT, _CLEARLY * noise)
    loose = relief > least
    rise = -depth
    hidden = np.zeros(relief.shape, bool)
    if fixtures:
        loose &= ndimage.distance_transform_edt(~fixture) > margin
        inside = ndimage.distance_transform_edt(fixture) > margin / 2
        depth[~inside] = 0
        # Add each unseen region to the recess that it touches.
        hidden = inside & ~observation.valid
    deep = depth > max(_RECESS_DEPTH, _CLEARLY * noise)
    return Segmentation(
        fixture=fixture,
        objects=tuple(
            item
            for item in _regions(loose, relief, resolution, areas.object)
            # Filling in unseen pixels around a few wrong depths, in the shadow of a block, can
            # create a region that looks like an object. Ignore such regions.
            if observation.valid[item.mask].mean() > _OBJECT_SEEN
            and not _is_corner(item, fixture, float(relief[fixture].max(initial=0)), resolution)
        ),
        recesses=_regions(deep | hidden, depth, resolution, areas.recess, core=deep),
        protruding=tuple(
            sorted(
                _regions(rise > max(_PROTRUSION, 4 * noise), rise, resolution, areas.protruding),
                key=lambda region: -region.height,
            )
        ),
        relief=relief,
        depth=depth,
        visibility=Visibility.of(observation),
        noise=_noise(relief),
    )


def _is_corner(item: Region, fixture: Mask, top: float, resolution: float) -> bool:
    """Whether a small region is a corner of the fixture that the fixture's convex hull does not
    include."""
    if item.mask.sum() * resolution**2 >= _LEAST_AREA or item.height < top - _PLANE_BAND:
        return False
    near = ndimage.binary_dilation(item.mask, iterations=round(2 * _FIXTURE_MARGIN / resolution))
    return bool((near & fixture).any())


def _inner_radius(mask: Mask) -> float:
    """Returns the largest distance, in pixels, from a pixel of a mask to the mask's edge."""
    return float(ndimage.distance_transform_edt(np.pad(mask, 1)).max())


def _noise_of(
    height: NDArray[np.float32], relief: NDArray[np.float32], fixtures: list[_Fixture]
) -> float:
    """Returns the largest of the standard deviations of the noise of the table and of each
    fixture's top, in metres.

    The table's noise alone may be underestimated, because heights below the grid are clipped.
    """
    tops = [
        _noise((height - _plane_heights(plane, height.shape))[mask]) for mask, plane in fixtures
    ]
    return max([_noise(relief), *tops])


def _noise(relief: NDArray[np.floating]) -> float:
    """Returns a robust estimate of the standard deviation of heights, in metres, from their
    distances to a plane on which most of them lie."""
    flat = np.abs(relief[np.abs(relief) < 3 * _PLANE_BAND])
    return 1.4826 * float(np.median(flat)) if flat.size else 0.0


def _plane_heights(plane: Plane, shape: tuple[int, ...]) -> NDArray[np.float64]:
    return plane[0] * np.arange(shape[0])[:, None] + plane[1] * np.arange(shape[1]) + plane[2]


def _fit_plane(height: NDArray[np.float32], start: float, where: Mask) -> Plane:
    """Fits a plane to most pixels of the mask `where`, by three rounds of least squares on inliers.
    The first round starts from a level plane at the height `start`, in metres."""
    plane = np.array([0.0, 0.0, start])
    rows, cols = np.nonzero(where)
    design = np.column_stack([rows, cols, np.ones(len(rows))])
    values = height[rows, cols]
    for band in (2 * _PLANE_BAND, _PLANE_BAND, _PLANE_BAND):
        near = np.abs(values - design @ plane) < band
        if near.sum() < 100:
            break
        plane = np.linalg.lstsq(design[near], values[near], rcond=None)[0]
    return plane


def _mode(values: NDArray[np.float32]) -> float:
    """Returns the most frequent height, in metres."""
    width = 0.001
    low = float(values.min())
    counts = np.bincount(((values - low) / width).astype(int))
    smooth = np.convolve(counts, np.ones(5), "same")
    return low + (int(smooth.argmax()) + 0.5) * width


def _fit_table(height: NDArray[np.float32]) -> Plane:
    low = height[height <= np.median(height)]
    return _fit_plane(height, _mode(low), np.ones(height.shape, bool))


def _find_fixtures(
    height: NDArray[np.float32], relief: NDArray[np.float32], resolution: float
) -> list[_Fixture]:
    """Finds the largest plateau, and other large plateaus if they have recesses."""
    high = relief > _LEAST_FIXTURE_HEIGHT
    found: list[_Fixture] = []
    largest = 0
    for _ in range(_MOST_FIXTURES):
        fixture = _find_fixture(height, relief, high, resolution)
        if fixture is None:
            break
        mask, plane = fixture
        size = int(mask.sum())
        if found:
            depth = _plane_heights(plane, height.shape) - height
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
    labels, count = ndimage.label(fixture & (depth > _RECESS_DEPTH), _NEIGHBOURS)
    sizes = np.bincount(labels.ravel(), minlength=count + 1)
    rim = fixture & ~ndimage.binary_erosion(fixture, iterations=2)
    sizes[np.unique(labels[rim])] = 0
    sizes[0] = 0
    return bool(sizes.max() * resolution**2 >= _AreaLimits.of(resolution).recess)


def _find_fixture(
    height: NDArray[np.float32], relief: NDArray[np.float32], high: Mask, resolution: float
) -> _Fixture | None:
    """Finds the largest plateau among the high pixels. Returns its convex hull and the plane of its
    top, or None."""
    least = _AreaLimits.of(resolution).fixture
    if high.sum() * resolution**2 < least:
        return None
    level = _mode(relief[high])
    plateau = ndimage.binary_opening(high & (np.abs(relief - level) < _PLANE_BAND), _NEIGHBOURS)
    # Close gaps, so that a recess from rim to rim does not cut the plateau in two.
    closed = ndimage.binary_closing(plateau, _NEIGHBOURS, max(1, round(_CLOSING / resolution)))
    labels, count = ndimage.label(closed, _NEIGHBOURS)
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
    start = float(np.median(height[plateau]))
    return fixture, _fit_plane(height, start, plateau)


def _along_tilt(plateau: Mask, height: NDArray[np.float32], high: Mask, resolution: float) -> Mask:
    """Extends a level band of a tilted plateau to the whole plateau. Returns a level plateau
    unchanged."""
    for _ in range(_TILT_ROUNDS):
        plane = _fit_plane(height, float(np.median(height[plateau])), plateau)
        if math.hypot(plane[0], plane[1]) < _LEVEL * resolution:
            return plateau
        near = high & (np.abs(height - _plane_heights(plane, height.shape)) < _PLANE_BAND)
        near = ndimage.binary_opening(near, _NEIGHBOURS)
        labels, count = ndimage.label(
            ndimage.binary_closing(near, _NEIGHBOURS, max(1, round(_CLOSING / resolution))),
            _NEIGHBOURS,
        )
        sizes = np.bincount(labels[near & plateau], minlength=count + 1)
        sizes[0] = 0
        if not sizes.any():
            return plateau
        plateau = near & (labels == sizes.argmax())
    return plateau


def _regions(
    mask: Mask,
    relief: NDArray[np.float32],
    resolution: float,
    least: float,
    core: Mask | None = None,
) -> tuple[Region, ...]:
    """Returns the connected regions of a mask that have enough area, largest first.

    Args:
        mask: (rows, cols) pixels that belong to regions.
        relief: (rows, cols) heights in metres. A region's height is measured within the core.
        resolution: the side of a pixel, in metres.
        least: the least area within the core, in square metres.
        core: the part of the mask in which area and height are measured; None for all of it.
    """
    core = mask if core is None else core
    labels, count = ndimage.label(mask, _NEIGHBOURS)
    sizes = np.bincount(labels[core], minlength=count + 1)
    sizes[0] = 0
    result = []
    for label in np.argsort(-sizes, kind="stable"):
        if sizes[label] * resolution**2 < least:
            break
        region = labels == label
        result.append(Region(region, float(np.percentile(relief[region & core], 90))))
    return tuple(result)
