"""Proposes the table's height, the workspace and the region of interest from one set of frames."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import ConvexHull

from kitting_drake.common.errors import UserError
from kitting_drake.real_camera.calibrations.calibration import Calibration
from kitting_drake.real_camera.calibrations.table_outline import Polygon, TableOutline
from kitting_drake.real_camera.checking.outline_tracing import disc, largest_part, trace
from kitting_drake.real_camera.checking.planes import Plane, find_planes
from kitting_drake.real_camera.checking.views import check_frames
from kitting_drake.real_camera.frames import Frame
from systems.signals import PixelGrid

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_RESOLUTION = 0.003125
"""The side of o_t's pixels, in metres. Networks are trained with this size."""
_CELL = 2 * _RESOLUTION
"""The side of the cells in which the table's extent is found, in metres."""
_SIDES = (160, 320)
"""The largest numbers of rows and columns of a proposed workspace, for 0.5 x 1.0 m."""
_MULTIPLE = 16
"""The numbers of rows and columns are multiples of this."""
_TILTED = math.radians(10)
"""The largest tilt, in radians, of a plane that may be the table. If a camera's pose is slightly
wrong, the table looks tilted."""
MOST_TILT = math.radians(1.3)
"""The largest tilt of a table, in radians, that `decide` accepts."""
_STEP = 2
"""Only the rows and columns of an image at multiples of this are used."""
_REACH = 2.0
"""Points farther than this from the robot's base along x or y, in metres, are ignored."""
_LEAST_SHARE = 0.1
"""The least share of the points that must lie on the table."""
_LEAST_POINTS = 500
"""The least number of points that must lie on the table."""
_ABOVE_FLOOR = 0.25
"""If a level plane is more than this above the largest plane, in metres, it is the table, and the
largest plane is the floor."""
_TABLE_SHARE = 0.1
"""The number of points on such a table, divided by that on the floor, must exceed this."""
_BAND = 0.006
"""Points within this distance of the plane, in metres, belong to it. Three times the noise is used
if that is larger."""
_LOW = 0.12
"""The largest height of an object on the table, in metres. Anything taller, such as the robot, is
not part of the table."""
_TALL = 1.2
"""Points that are higher above the table than this, in metres, are ignored."""
_CLOSED = 0.035
"""Half of the largest width, in metres, of a gap in the table that is closed. Such gaps come from
objects and shadows."""
_KIT = 0.03
"""Half of the least width, in metres, of an object at the table's edge that counts as part of the
table. Profiles along the edge are narrower and do not count."""
_LEAST_TALL = 0.02
"""Tall things narrower than this, in metres, count as noise."""
_AROUND = 0.02
"""The width of the margin around tall things, in metres. Tall things and their margins are
ignored."""
_TOO_NEAR = 0.25
"""An arm cannot pick within this distance of the middle of its base, in metres."""
_ENOUGH = 0.6
"""If a workspace beyond `_TOO_NEAR` holds more than this share of the table area that the fullest
workspace holds, all nearer workspaces are excluded."""
_NEARLY = 0.97
"""Workspaces count as equally good if they hold at least this share of the table area of the best
one. The one nearest to the base is chosen."""


@dataclass(frozen=True)
class FoundTable:
    """A proposed calibration, and how it was found."""

    calibration: Calibration
    """The calibration with the table height, workspace and outline that were found."""
    tilt: float
    """The table's angle with the base's xy plane, in radians."""
    share: float
    """The share of the cameras' points that lie on the table, from 0 to 1."""
    extent: tuple[float, float]
    """The size of the table in view along x and y, in metres."""
    chosen: str
    """How the workspace was chosen, as a part of a sentence."""
    around: PixelGrid
    """A larger grid around the visible table, for a picture."""


def find_table(frames: Mapping[str, Frame], calibration: Calibration) -> FoundTable:
    """Finds the table in frames, using the cameras' poses.

    The height, workspace and outline in the calibration are ignored.

    Args:
        frames: each camera's frame by its name. Kit and tools may stand on the table.
        calibration: the cameras' calibration.

    Raises:
        UserError: no level plane is seen.
    """
    checked = check_frames(frames, calibration)
    points = np.concatenate(
        [
            _points(checked[item.name], calibration, number)
            for number, item in enumerate(calibration.cameras)
        ]
    )
    plane, share = _table_plane(points)
    grid = _coarse_grid(points, plane)
    table, tall = _extent(points, plane, grid)
    rows, cols = np.nonzero(table)
    height = float(np.median(plane.height(grid.to_world(np.column_stack([rows, cols])))))
    thickness = calibration.grid.z_max - calibration.grid.z_min
    workspace, chosen = _workspace(table, grid)
    workspace = dataclasses.replace(
        workspace, z_min=round(height, 4), z_max=round(height, 4) + thickness
    )
    outline = TableOutline(trace(table, grid), _ignored(tall, grid, workspace))
    found = dataclasses.replace(calibration, grid=workspace, outline=outline)
    return FoundTable(
        calibration=found,
        tilt=float(np.linalg.norm(plane.tilt)),
        share=share,
        extent=(float(np.ptp(rows) + 1) * _CELL, float(np.ptp(cols) + 1) * _CELL),
        chosen=chosen,
        around=dataclasses.replace(
            _covering(grid, table, workspace), z_min=workspace.z_min, z_max=workspace.z_max
        ),
    )


def _points(frame: Frame, calibration: Calibration, number: int) -> Array:
    """Returns a camera's points (n, 3) in the base frame, within `_REACH` of the base."""
    camera = calibration.cameras[number]
    u, v = (item[::_STEP, ::_STEP] for item in np.broadcast_arrays(camera.rays.u, camera.rays.v))
    z = frame.depth[::_STEP, ::_STEP].astype(float)
    with np.errstate(invalid="ignore"):
        good = np.isfinite(z) & (z >= camera.min_depth) & (z <= camera.max_depth)
    z = z[good]
    p_B = np.column_stack([u[good] * z, v[good] * z, z]) @ camera.X_BC[:3, :3].T
    p_B += camera.X_BC[:3, 3]
    return np.asarray(p_B[(np.abs(p_B[:, :2]) < _REACH).all(axis=1)])


def _table_plane(points: Array) -> tuple[Plane, float]:
    """Returns the table's plane, and the share of the points that lie on it."""
    no_plane = (
        "no level plane is seen: remove most objects from the table, and check that z of the "
        "base points up in the cameras' poses"
    )
    if len(points) < _LEAST_POINTS:
        raise UserError(no_plane)
    few = points[:: max(1, len(points) // 40_000)]
    level = []
    for plane in find_planes(few, 4):
        near = np.abs(few[:, 2] - plane.height(few[:, :2])) < max(_BAND, 3 * plane.noise)
        if np.linalg.norm(plane.tilt) <= _TILTED and near.any():
            middle = float(np.median(few[near, 2]))
            level.append((int(near.sum()), middle, plane))
    if not level:
        raise UserError(no_plane)
    most, height, _ = max(level, key=lambda item: item[0])
    raised = [
        item for item in level if item[1] > height + _ABOVE_FLOOR and item[0] > _TABLE_SHARE * most
    ]
    count, _, plane = max(raised or level, key=lambda item: item[0])
    share = count / len(few)
    if share < _LEAST_SHARE or count * len(points) / len(few) < _LEAST_POINTS:
        raise UserError(no_plane)
    return plane, share


def _coarse_grid(points: Array, plane: Plane) -> PixelGrid:
    """Returns cells over the points near the plane, with a margin of unseen cells."""
    near = np.abs(points[:, 2] - plane.height(points[:, :2])) < max(_BAND, 3 * plane.noise)
    margin = 2 * _CLOSED
    low = np.floor((points[near, :2].min(axis=0) - margin) / _CELL) * _CELL
    count = np.ceil((points[near, :2].max(axis=0) + margin - low) / _CELL).astype(int)
    return PixelGrid(float(low[0]), float(low[1]), _CELL, int(count[0]), int(count[1]))


def _extent(points: Array, plane: Plane, grid: PixelGrid) -> tuple[Mask, Mask]:
    """Returns two masks (rows, cols): the table with its objects, and things too tall to be
    objects."""
    above = points[:, 2] - plane.height(points[:, :2])
    cells = np.rint(grid.to_pixel(points[:, :2])).astype(int)
    inside = ((cells >= 0) & (cells < grid.shape)).all(axis=1)
    band = max(_BAND, 3 * plane.noise)

    def holds(low: float, high: float) -> Mask:
        where = inside & (above >= low) & (above < high)
        found = np.zeros(grid.shape, bool)
        found[cells[where, 0], cells[where, 1]] = True
        return found

    # Close gaps, because neighbouring points of a camera may be more than a cell apart.
    near = ndimage.binary_closing(holds(-band, band), disc(2))
    low = ndimage.binary_closing(holds(band, _LOW), disc(2))
    tall = ndimage.binary_opening(
        ndimage.binary_closing(holds(_LOW, _TALL), disc(2)), disc(_cells(_LEAST_TALL) / 2)
    )
    thick = ndimage.binary_opening(ndimage.binary_fill_holes(low), disc(_cells(_KIT)))
    table = ndimage.binary_closing(near | thick, disc(_cells(_CLOSED)))
    table = ndimage.binary_fill_holes(largest_part(table))
    labels, count = ndimage.label(ndimage.binary_dilation(tall, disc(_cells(_AROUND))))
    # Keep only the tall things that stand on the table or at its edge.
    on_table = np.isin(np.arange(count + 1), labels[table])
    on_table[0] = False
    return largest_part(table), np.asarray(on_table[labels])


def _cells(metres: float) -> float:
    return metres / _CELL


def _ignored(tall: Mask, grid: PixelGrid, workspace: PixelGrid) -> tuple[Polygon, ...]:
    """Returns the hulls of tall things in the workspace, largest first."""
    labels, count = ndimage.label(tall)
    polygons = []
    for number in range(1, count + 1):
        xy = grid.to_world(np.argwhere(labels == number))
        if len(xy) < 9 or not workspace.contains(xy).any():
            continue
        hull = ConvexHull(xy)
        corners = tuple((round(float(x), 4), round(float(y), 4)) for x, y in xy[hull.vertices])
        polygons.append((hull.volume, corners))
    return tuple(corners for _, corners in sorted(polygons, reverse=True))


def _workspace(table: Mask, grid: PixelGrid) -> tuple[PixelGrid, str]:
    """Returns the proposed pixels of o_t, and how they were chosen."""
    low = grid.to_world(np.argwhere(table).min(axis=0)) - _CELL / 2
    high = grid.to_world(np.argwhere(table).max(axis=0)) + _CELL / 2
    step = _MULTIPLE * _RESOLUTION
    needed = np.maximum(np.ceil((high - low) / step - 1e-6), 1).astype(int) * _MULTIPLE
    shape = np.minimum(needed, _SIDES)
    centre = (low + high) / 2
    if (shape == needed).all():
        chosen = "the whole table in view"
    else:
        centre = _best_centre(table, grid, shape * _RESOLUTION, centre, shape == needed)
        chosen = (
            "the part of the visible table that is nearest to the robot's base, from "
            f"{_TOO_NEAR:g} m on, because the table is larger"
        )
    corner = np.round((centre - shape * _RESOLUTION / 2) / _RESOLUTION) * _RESOLUTION
    x, y = (round(float(value), 6) for value in corner)
    return PixelGrid(x, y, _RESOLUTION, int(shape[0]), int(shape[1])), chosen


def _best_centre(table: Mask, grid: PixelGrid, size: Array, centre: Array, fits: Mask) -> Array:
    """Returns the centre (2,) of the best window, in metres.

    The best window is the nearest to the base among those with nearly the largest table area. A
    window too near the base is chosen only if all others have much less table area. If the
    whole table fits into the window along an axis, `centre` is kept on this axis.

    Args:
        table: (rows, cols) the table.
        grid: the cells of the mask.
        size: (2,) the size of the window, in metres.
        centre: (2,) the centre of the table, in metres.
        fits: (2,) for each axis, whether the whole table fits into the window.
    """
    window = np.rint(size / _CELL).astype(int)
    sums = np.pad(table.astype(np.int64).cumsum(0).cumsum(1), ((1, 0), (1, 0)))
    counts = [max(grid.shape[k] - window[k], 0) + 1 for k in (0, 1)]
    starts = [
        np.array(
            [np.clip(round(float(grid.to_pixel(centre)[k] - window[k] / 2)), 0, counts[k] - 1)]
        )
        if fits[k]
        else np.arange(counts[k])
        for k in (0, 1)
    ]
    ends = [np.minimum(starts[k] + window[k], grid.shape[k]) for k in (0, 1)]
    held = (
        sums[np.ix_(ends[0], ends[1])]
        - sums[np.ix_(starts[0], ends[1])]
        - sums[np.ix_(ends[0], starts[1])]
        + sums[np.ix_(starts[0], starts[1])]
    )
    i, j = (item.ravel() for item in np.indices(held.shape))
    corner = grid.to_world(np.column_stack([starts[0][i], starts[1][j]]) - 0.5)
    # Compute the distance of the base from the nearest point of each window.
    beside = np.maximum(np.maximum(corner, -(corner + window * _CELL)), 0)
    apart = np.hypot(*beside.T) > _TOO_NEAR - 1e-6
    table_in = held.ravel()
    if apart.any() and table_in[apart].max() > _ENOUGH * table_in.max():
        table_in = np.where(apart, table_in, -1)
    good = table_in >= _NEARLY * table_in.max()
    centres = corner[good] + window * _CELL / 2
    best = centres[np.hypot(*centres.T).argmin()]
    return np.where(fits, centre, best)


def _covering(grid: PixelGrid, table: Mask, workspace: PixelGrid) -> PixelGrid:
    """Returns cells over the visible table and the workspace, with a margin."""
    xy = grid.to_world(np.argwhere(table))
    low = np.minimum(xy.min(axis=0), (workspace.x_min, workspace.y_min)) - 0.06
    high = np.maximum(xy.max(axis=0), (workspace.x_max, workspace.y_max)) + 0.06
    count = np.ceil((high - low) / _CELL).astype(int)
    return PixelGrid(float(low[0]), float(low[1]), _CELL, int(count[0]), int(count[1]))
