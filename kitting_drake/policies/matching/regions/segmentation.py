"""Segments o_t by height into table, fixture, loose objects and recesses.

It uses neither colour nor a network. The fixture is the largest plateau above the table. Anything
that rises beside the fixture is a loose object; anything below the fixture's top is a recess or a
part of a recess.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from kitting_drake.policies.matching.regions.fixtures import (
    CLEAN,
    LEAST_AREA,
    NEIGHBOURS,
    PLANE_BAND,
    RECESS_DEPTH,
    AreaLimits,
    Fixture,
    Mask,
    find_fixtures,
    fit_table,
)
from kitting_drake.policies.matching.regions.lone_pixels import without_lone_pixels
from kitting_drake.policies.matching.regions.visibility import Visibility
from systems.signals import Observation
from systems.table_plane import plane_heights

_OBJECT_HEIGHT = 0.003
"""The least height of an object above the table, in metres."""
_PROTRUSION = 0.002
"""The largest height, in metres, by which a seated object rises above the fixture."""
_FIXTURE_MARGIN = 0.006
"""Outside a fixture, objects are found only beyond this distance from its outline, in metres.
Inside, recesses are found only beyond half this distance."""
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
"""Half the largest width of the gap between an object and its recess, in pixels."""
_LEAST_GAP = 0.003
"""Half the largest width of this gap in metres. The larger of `_GAP` and `_LEAST_GAP` applies."""
_FLAT = 0.0006
"""A pixel agrees with a flat floor if its depth differs from the floor's median depth by less than
this, in metres, or by less than twice the noise."""
_FLAT_SHARE = 0.7
"""A floor is flat if more than this share of its pixels agrees (see `_FLAT`)."""
_BELOW_TOP = 0.001
"""The least depth, in metres, of a surface that counts as below the fixture's top."""
_NOISY = 0.001
"""The standard deviation of the noise, in metres, above which an object in a recess cannot be
distinguished from the recess's floor."""
_CROSS = ndimage.generate_binary_structure(2, 1)


@dataclass(frozen=True)
class Region:
    """A connected region of pixels: a loose object or a recess."""

    mask: Mask
    """(rows, cols) mask of the region."""
    height: float
    """The object's height above the table, or the recess's depth below the fixture's top, in
    metres: the 90th percentile over the region."""

    @cached_property
    def pixels(self) -> NDArray[np.intp]:
        """(n, 2): row and column of each pixel of the region."""
        return np.argwhere(self.mask)

    @cached_property
    def box(self) -> tuple[slice, slice]:
        """The rows and columns of the region's bounding box."""
        low, high = self.pixels.min(axis=0), self.pixels.max(axis=0) + 1
        return slice(low[0], high[0]), slice(low[1], high[1])

    @cached_property
    def inner_radius(self) -> float:
        """The largest distance, in pixels, from a pixel of the region to the region's edge."""
        return float(ndimage.distance_transform_edt(np.pad(self.mask[self.box], 1)).max())

    @cached_property
    def reach(self) -> float:
        """The largest distance of the region's pixels from their mean, in pixels."""
        away = self.pixels - self.pixels.mean(axis=0)
        return float(np.linalg.norm(away, axis=1).max())

    @cached_property
    def outlines(self) -> dict[tuple[float, bool], Any]:
        """The outlines that `outline_of` has computed, by its arguments."""
        return {}


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
    """(rows, cols): depth below the plane of the fixture's top in metres; zero outside the fixture
    and within 3 mm of its outline."""
    visibility: Visibility
    """The pixels of the observation that are seen."""
    unseen: tuple[Region, ...] = ()
    """The parts of the fixture's top, beside the recesses, that no camera sees. Seen from the side,
    a slender recess may be one of them."""
    noise: float = 0.0
    """The standard deviation of the table's heights, in metres."""

    @property
    def kit_seen(self) -> bool:
        """Whether o_t shows a kit: a fixture with recesses or protruding objects."""
        return bool(self.fixture.any()) and bool(self.recesses or self.protruding)

    @cached_property
    def free_recesses(self) -> tuple[Region, ...]:
        """The recesses that contain no object.

        They are wide, are seen, and have a flat floor. A filled recess shows narrow gaps around the
        object, a surface that is not flat, or a surface mostly just below the fixture's top.
        """
        return tuple(
            item
            for item in self.recesses
            if self._is_wide(item) and self._is_flat(item) and not self._is_fragment(item)
        )

    @cached_property
    def unfilled_recesses(self) -> tuple[Region, ...]:
        """The recesses into which an object might fit.

        These are the `free_recesses` and the narrow recesses. If there is noise, all recesses are
        included, because an object in a recess may then look like the recess's floor.
        """
        if self.noise > CLEAN:
            return self.recesses
        return tuple(
            item
            for item in self.recesses
            if not self._is_fragment(item) and (self._is_flat(item) or not self._is_wide(item))
        )

    @property
    def occupied(self) -> Mask:
        """(rows, cols) mask of the pixels where no object can be laid down, because something is
        there or because no camera sees them.

        Single unseen pixels are ignored as noise.
        """
        taken = self.fixture | ~self.visibility.in_view
        taken |= ndimage.binary_opening(~self.visibility.seen, iterations=2)
        for region in self.objects:
            taken |= region.mask
        return np.asarray(taken)

    @cached_property
    def hidden_recesses(self) -> tuple[Region, ...]:
        """The recesses that are wider than the gap around an object, but of which too little is
        seen to tell whether they contain an object. Some of them may be no recess."""
        every = (*self.recesses, *self.unseen)
        wide = (item for item in every if self._is_wider_than_gaps(item))
        return tuple(item for item in wide if not self._is_wide(item))

    def _is_wide(self, recess: Region) -> bool:
        """Whether a recess is seen, and wider than the gap around an object."""
        seen = self.visibility.seen[recess.mask].mean() > _RECESS_SEEN
        return bool(seen) and self._is_wider_than_gaps(recess)

    def _is_wider_than_gaps(self, recess: Region) -> bool:
        return recess.inner_radius > max(_GAP, _LEAST_GAP / self.visibility.resolution)

    @cached_property
    def _low(self) -> NDArray[np.int32]:
        """(rows, cols): labels of the connected parts of the fixture below its top."""
        return np.asarray(ndimage.label(self.depth > _BELOW_TOP, NEIGHBOURS)[0])

    def _is_fragment(self, recess: Region) -> bool:
        """Whether a region is only a fragment of a filled recess.

        Beside such a fragment, the top of the object in the recess is visible. It lies slightly
        below the fixture's top and is larger than the region. A free recess looks so shallow only
        in narrow slots, whose floor no camera sees. These slots are smaller than the region.
        """
        if self.noise > CLEAN:
            return False
        labels = np.unique(self._low[recess.mask])
        reach = max(2, round(_FIXTURE_MARGIN / self.visibility.resolution))
        near = ndimage.binary_dilation(recess.mask, NEIGHBOURS, iterations=reach)
        beside = np.isin(self._low, labels[labels > 0]) & (self.depth < RECESS_DEPTH) & ~near
        return bool(beside.sum() > recess.mask.sum())

    def _is_flat(self, recess: Region) -> bool:
        if self.noise > _NOISY:
            return True
        # Leave out the pixels at the walls, which show the wall or the floor. Use depths below the
        # fixture's top, so that the floor of a tilted fixture is also flat.
        mask = recess.mask[recess.box]
        core = ndimage.binary_erosion(mask) & self.visibility.seen[recess.box]
        floor = self.depth[recess.box][core if core.any() else mask]
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
    height = without_lone_pixels(observation.outline_height)
    table = fit_table(height)
    relief = (height - plane_heights(table, height.shape)).astype(np.float32)
    fixtures = find_fixtures(height, relief, resolution)
    noise = _noise_of(height, relief, fixtures)
    if noise > CLEAN:
        # A median filter erases details one pixel wide, so use it only on noisy heights.
        height = ndimage.median_filter(height, footprint=_CROSS, mode="nearest")
        relief = ndimage.median_filter(relief, footprint=_CROSS, mode="nearest")
        fixtures = find_fixtures(height, relief, resolution)
        noise = _noise_of(height, relief, fixtures)
    margin, areas = _FIXTURE_MARGIN / resolution, AreaLimits.of(resolution, noise)
    fixture = np.zeros(relief.shape, bool)
    depth = np.zeros_like(relief)
    for mask, top in fixtures:
        depth[mask] = (plane_heights(top, height.shape) - height)[mask]
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
        hidden = inside & ~observation.outline_valid
    # With noise, the highest pixel is no measure of the top.
    highest = float(np.percentile(relief[fixture], 75)) if fixture.any() else 0.0
    deep = depth > max(RECESS_DEPTH, _CLEARLY * noise)
    recesses = _regions(deep | hidden, depth, resolution, areas.recess, core=deep)
    for region in recesses:
        hidden &= ~region.mask
    return Segmentation(
        fixture=fixture,
        objects=tuple(
            item
            for item in _regions(loose, relief, resolution, areas.object)
            # Ignore regions of mostly unseen pixels: in the shadow of a block, a few wrong depths
            # can make the filled-in heights look like an object.
            if observation.outline_valid[item.mask].mean() > _OBJECT_SEEN
            and not _is_corner(item, fixture, relief, highest, resolution)
        ),
        recesses=recesses,
        protruding=tuple(
            sorted(
                _regions(rise > max(_PROTRUSION, 4 * noise), rise, resolution, areas.protruding),
                key=lambda region: -region.height,
            )
        ),
        relief=relief,
        depth=depth,
        visibility=Visibility.of(observation),
        unseen=_regions(hidden, depth, resolution, areas.recess),
        noise=_noise(relief),
    )


def _is_corner(
    item: Region, fixture: Mask, relief: NDArray[np.float32], top: float, resolution: float
) -> bool:
    """Whether a region that is small, or lies at the image's border, is a part of the fixture that
    the mask `fixture` misses. It is as high as the fixture; a tool that leans on it is not."""
    border = item.mask.copy()
    border[1:-1, 1:-1] = False
    if item.mask.sum() * resolution**2 >= LEAST_AREA and not border.any():
        return False
    if np.median(relief[item.mask]) < top - PLANE_BAND:
        return False
    near = ndimage.binary_dilation(item.mask, iterations=round(2 * _FIXTURE_MARGIN / resolution))
    return bool((near & fixture).any())


def _noise_of(
    height: NDArray[np.float32], relief: NDArray[np.float32], fixtures: list[Fixture]
) -> float:
    """Returns the standard deviation of the noise, in metres: the largest of those on the table and
    on each fixture's top.

    The table's noise alone may be underestimated, because heights below the grid are clipped.
    """
    tops = [_noise((height - plane_heights(plane, height.shape))[mask]) for mask, plane in fixtures]
    return max([_noise(relief), *tops])


def _noise(relief: NDArray[np.floating]) -> float:
    """Returns a robust estimate of the standard deviation of heights, in metres.

    `relief` holds the distances of the heights from a plane. Most of them lie on this plane.
    """
    flat = np.abs(relief[np.abs(relief) < 3 * PLANE_BAND])
    return 1.4826 * float(np.median(flat)) if flat.size else 0.0


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
    labels, count = ndimage.label(mask, NEIGHBOURS)
    sizes = np.bincount(labels[core], minlength=count + 1)
    sizes[0] = 0
    result = []
    for label in np.argsort(-sizes, kind="stable"):
        if sizes[label] * resolution**2 < least:
            break
        region = labels == label
        result.append(Region(region, float(np.percentile(relief[region & core], 90))))
    return tuple(result)
