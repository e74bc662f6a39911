"""Segmentation of o_t by height alone: table, fixture, loose objects, recesses.

No colour is used, and no network. The fixture is the largest plateau above the table; what rises
beside it is a loose object; what lies below its top is a recess, or what is left of one.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import ConvexHull, QhullError

from systems.signals import Observation, fill_unseen

Mask = NDArray[np.bool_]
Plane = NDArray[np.float64]
"""(3,): the height at (row, col) is `plane @ (row, col, 1)`, in metres."""

_PLANE_BAND = 0.004
"""Pixels within this of a plane belong to it, in metres."""
_LEAST_FIXTURE_HEIGHT = 0.015
"""A plateau lower than this above the table is no fixture, in metres."""
_LEAST_FIXTURE_AREA = 0.003
"""The same for its area, in square metres."""
_OBJECT_HEIGHT = 0.003
"""Anything that rises by more than this above the table is an object, in metres."""
_RECESS_DEPTH = 0.003
"""Anything deeper than this below the top of the fixture is a recess, in metres."""
_PROTRUSION = 0.002
"""Anything that rises by more than this above the fixture is not seated, in metres."""
_LEAST_AREA = 0.0004
"""Smaller regions are noise, in square metres."""
_LEAST_PROTRUDING = 0.00012
"""The same for what protrudes: perhaps one end of an object."""
_FIXTURE_MARGIN = 0.006
"""Closer to the fixture's outline than this is neither table nor recess, in metres."""
_CLEAN = 0.0005
"""Heights with less noise than this are taken as they are, in metres."""
_CLEARLY = 2.0
"""A height that differs by more standard deviations of the noise than this is no noise: few pixels
of it do, and apart. More would cut off flat ends, by which a tool is told from the same
tool a half turn away."""
_NEIGHBOURS = np.ones((3, 3), bool)
_CROSS = ndimage.generate_binary_structure(2, 1)


@dataclass(frozen=True)
class Region:
    """A connected region of pixels: a loose object or a recess."""

    mask: Mask
    """(rows, cols)."""
    height: float
    """By how much the object rises above the table, or the recess's floor lies below the top of the
    fixture: the 90th percentile, in metres."""

    @property
    def pixels(self) -> NDArray[np.intp]:
        """(n, 2): row and column of each."""
        return np.argwhere(self.mask)


@dataclass(frozen=True)
class Segmentation:
    """The regions of an observation: fixture, recesses, objects."""

    fixture: Mask
    """(rows, cols) the fixture; nowhere if there is none."""
    objects: tuple[Region, ...]
    """Loose, on the table."""
    recesses: tuple[Region, ...]
    """Regions below the top of the fixture. One that a seated object fills leaves fragments, which
    are among them."""
    protruding: tuple[Region, ...]
    """The objects that protrude from the fixture, the highest first. Their height is that above
    its top."""
    relief: NDArray[np.float32]
    """(rows, cols) height above the table plane, in metres, with what was not seen filled in."""


def segment(observation: Observation) -> Segmentation:
    """Segments an observation.

    Args:
        observation: o_t.

    Returns:
        The segmentation. Where no plateau stands out there is no fixture and there are no recesses.
    """
    resolution = observation.grid.resolution
    height = fill_unseen(observation.height, observation.valid)
    table = _fit_table(height)
    relief = (height - _plane_heights(table, height.shape)).astype(np.float32)
    fixture, top = _find_fixture(height, relief, resolution)
    noise = _noise_of(height, relief, fixture, top)
    if noise > _CLEAN:
        # A median erases what is one pixel wide: only where it must be.
        height = ndimage.median_filter(height, footprint=_CROSS, mode="nearest")
        relief = ndimage.median_filter(relief, footprint=_CROSS, mode="nearest")
        fixture, top = _find_fixture(height, relief, resolution)
        noise = _noise_of(height, relief, fixture, top)
    margin = _FIXTURE_MARGIN / resolution
    outside = ndimage.distance_transform_edt(~fixture) if fixture.any() else None
    least = max(_OBJECT_HEIGHT, _CLEARLY * noise)
    loose = relief > least
    if outside is not None:
        loose &= outside > margin
    depth = np.zeros_like(relief)
    rise = np.zeros_like(relief)
    hidden = np.zeros(relief.shape, bool)
    if fixture.any():
        depth = (_plane_heights(top, height.shape) - height).astype(np.float32)
        inside = ndimage.distance_transform_edt(fixture) > margin / 2
        depth[~inside] = 0
        # What no camera sees into is the bottom of a recess, where it is part of one.
        hidden = inside & ~observation.valid
        rise[fixture] = -depth[fixture]
    deep = depth > max(_RECESS_DEPTH, _CLEARLY * noise)
    return Segmentation(
        fixture=fixture,
        objects=_regions(loose, relief, resolution),
        recesses=_regions(deep | hidden, depth, resolution, core=deep),
        protruding=tuple(
            sorted(
                _regions(rise > max(_PROTRUSION, 4 * noise), rise, resolution, _LEAST_PROTRUDING),
                key=lambda region: -region.height,
            )
        ),
        relief=relief,
    )


def _noise_of(
    height: NDArray[np.float32], relief: NDArray[np.float32], fixture: Mask, top: Plane
) -> float:
    """The standard deviation of the noise of the table and, as what lies lower than the grid reads
    as flat, of the fixture's top too."""
    return max(_noise(relief), _noise((height - _plane_heights(top, height.shape))[fixture]))


def _noise(relief: NDArray[np.floating]) -> float:
    """The standard deviation of heights above a plane that most of them belong to, robustly."""
    flat = np.abs(relief[np.abs(relief) < 3 * _PLANE_BAND])
    return 1.4826 * float(np.median(flat)) if flat.size else 0.0


def _plane_heights(plane: Plane, shape: tuple[int, ...]) -> NDArray[np.float64]:
    return plane[0] * np.arange(shape[0])[:, None] + plane[1] * np.arange(shape[1]) + plane[2]


def _fit_plane(height: NDArray[np.float32], start: float, where: Mask) -> Plane:
    """A plane through most of some pixels, by least squares on those near it, three times."""
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
    """The height about which most values lie."""
    width = 0.001
    low = float(values.min())
    counts = np.bincount(((values - low) / width).astype(int))
    smooth = np.convolve(counts, np.ones(5), "same")
    return low + (int(smooth.argmax()) + 0.5) * width


def _fit_table(height: NDArray[np.float32]) -> Plane:
    low = height[height <= np.median(height)]
    return _fit_plane(height, _mode(low), np.ones(height.shape, bool))


def _find_fixture(
    height: NDArray[np.float32], relief: NDArray[np.float32], resolution: float
) -> tuple[Mask, Plane]:
    """The convex hull of the largest plateau, and the plane of its top."""
    none = np.zeros(height.shape, bool), np.zeros(3)
    high = relief > _LEAST_FIXTURE_HEIGHT
    if high.sum() * resolution**2 < _LEAST_FIXTURE_AREA:
        return none
    level = _mode(relief[high])
    plateau = ndimage.binary_opening(np.abs(relief - level) < _PLANE_BAND, _NEIGHBOURS)
    # A recess from rim to rim must not cut it in two.
    labels, count = ndimage.label(ndimage.binary_closing(plateau, _NEIGHBOURS, 3), _NEIGHBOURS)
    if not count:
        return none
    sizes = np.bincount(labels[plateau], minlength=count + 1)
    sizes[0] = 0
    plateau &= labels == sizes.argmax()
    if plateau.sum() * resolution**2 < _LEAST_FIXTURE_AREA:
        return none
    try:
        hull = ConvexHull(np.argwhere(plateau))
    except QhullError:
        return none
    rows, cols = np.indices(height.shape)
    fixture = np.ones(height.shape, bool)
    for a, b, offset in hull.equations:
        fixture &= a * rows + b * cols + offset <= 0.5
    start = float(np.median(height[plateau]))
    return fixture, _fit_plane(height, start, plateau)


def _regions(
    mask: Mask,
    relief: NDArray[np.float32],
    resolution: float,
    least: float = _LEAST_AREA,
    core: Mask | None = None,
) -> tuple[Region, ...]:
    """The connected regions of a mask that are large enough, the largest first.

    Args:
        mask: (rows, cols).
        relief: by which their heights are measured, within the core.
        resolution: of a pixel, in metres.
        least: area of a region within the core, in square metres.
        core: the part of the mask that counts; all of it if None.
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
