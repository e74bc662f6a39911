"""Computes o_t, the orthographic heightmap, from the images of RGB-D cameras.

This module does not need pydrake. `HeightmapProjector` uses it in simulation and
`kitting_drake.real_camera` on recorded frames.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from systems.signals import Observation, PixelGrid
from systems.surface_edges import surface_edges
from systems.table_plane import level, plane_heights

_DEEPEST = 0.05
"""Points more than this below `grid.z_min`, in metres, are ignored."""
_ROUNDING = 1e-5
"""Upper limit of the rounding error of a height, in metres."""
SAME_SURFACE = 0.01
"""Heights that differ by less than this, in metres, belong to one surface."""


class DepthRays(NamedTuple):
    """The rays of a depth camera's pixels.

    A pixel sees the point `depth * (u, v, 1)` in the camera's optical frame D: x points right in
    the image, y down, z forward.
    """

    u: NDArray[np.float32]
    """(1, width), or (height, width) with lens distortion: x of each pixel's ray at depth 1."""
    v: NDArray[np.float32]
    """(height, 1), or (height, width): y of each pixel's ray at depth 1."""
    min_depth: float
    """Smallest valid depth, in metres."""
    max_depth: float
    """Largest valid depth, in metres."""

    @staticmethod
    def from_pinhole(
        *,
        size: tuple[int, int],
        focal: tuple[float, float],
        centre: tuple[float, float],
        depth_range: tuple[float, float],
    ) -> DepthRays:
        """The rays of a camera without distortion.

        Args:
            size: (width, height) in pixels.
            focal: (fx, fy) in pixels.
            centre: (cx, cy) in pixels, where image pixel (u, v) covers [u, u+1) x [v, v+1). OpenCV,
                ROS and RealSense measure from the centre of pixel (0, 0): add 0.5 to their cx, cy.
            depth_range: least and largest depth, in metres.
        """
        u = (np.arange(size[0]) + 0.5 - centre[0]) / focal[0]
        v = (np.arange(size[1]) + 0.5 - centre[1]) / focal[1]
        return DepthRays(
            u.astype(np.float32)[None],
            v.astype(np.float32)[:, None],
            depth_range[0],
            depth_range[1],
        )

    @property
    def shape(self) -> tuple[int, int]:
        """(height, width) of the images."""
        return self.v.shape[0], self.u.shape[1]


class View(NamedTuple):
    """The images of one camera and the pose from which they were taken."""

    color: NDArray[np.uint8] | None
    """(height, width, 3 or more) red, green and blue from 0 to 255. None stands for a black
    image."""
    depth: NDArray[np.float32]
    """(height, width) depths along the optical axis, in metres; 0, infinity and NaN are invalid."""
    X_WD: NDArray[np.float64]
    """(4, 4) pose of the camera's optical frame in the world."""
    rays: DepthRays


def project(
    views: Sequence[View], grid: PixelGrid, region: NDArray[np.bool_] | None = None
) -> Observation:
    """Computes o_t with the method that the docstring of `HeightmapProjector` describes.

    Args:
        views: one for each camera, at least one.
        grid: the pixels of the heightmap.
        region: (rows, cols) mask of the pixels to compute; None for all. Pixels outside the mask
            count as out of view.
    """
    in_view = np.any([looks_at(view, grid) for view in views], axis=0)
    images, edges = zip(*(_see(view, grid) for view in views), strict=True)
    image, valid = _fuse(np.stack(images))
    if region is not None:
        in_view &= region
        valid &= region
    image[3], table = level(image[3], valid & in_view, grid.resolution)
    edge_height = np.max(edges, axis=0)
    edge_height -= plane_heights(table, grid.shape)
    np.maximum(edge_height, 0, out=edge_height)
    image[:3, ~valid] = 0
    image[3] = np.where(valid, np.maximum(image[3], 0), 0)
    _bridge_gaps(image, valid)
    if region is not None:
        image[:, ~region] = 0
        valid &= region
        edge_height[~region] = 0
    for array in (image, valid, in_view, edge_height):
        array.flags.writeable = False
    return Observation(image, grid, valid, in_view, edge_height, table)


def looks_at(view: View, grid: PixelGrid) -> NDArray[np.bool_]:
    """(rows, cols) mask of the grid pixels whose point at height `z_min` lies in a camera's
    image."""
    rays, X_WD = view.rays, view.X_WD
    corner = grid.to_world((0, 0))
    steps = grid.resolution * np.arange(max(grid.shape))
    # A grid pixel's position in the camera's frame is a constant plus one term for its row and one
    # for its column.
    offset = X_WD[:3, :3].T @ (np.array([*corner, grid.z_min]) - X_WD[:3, 3])
    x, y, z = (
        offset[k] + X_WD[0, k] * steps[: grid.rows, None] + X_WD[1, k] * steps[None, : grid.cols]
        for k in range(3)
    )
    inside = z > 0
    for value, limits in ((x, rays.u), (y, rays.v)):
        inside &= (value >= float(limits.min()) * z) & (value <= float(limits.max()) * z)
    return inside


def _see(view: View, grid: PixelGrid) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """One camera's heightmap, (4, rows, cols): red, green, blue, and the height above `grid.z_min`;
    and the heights of the edges of surfaces (rows, cols), see `surface_edges`.

    Heights are -inf where nothing is seen.

    The rigid transform and `PixelGrid.to_pixel` are affine. They are applied once, to the camera's
    centre and axes; the grid coordinates of a pixel are then linear in its depth.
    """
    rays = view.rays
    in_range = (view.depth >= rays.min_depth) & (view.depth <= rays.max_depth)
    depth = np.where(in_range, view.depth, np.float32(np.nan))
    p_WD = view.X_WD[:3, 3]
    # World points one metre from the camera along each axis of D.
    ends = view.X_WD[:3, :3].T + p_WD
    origin = np.append(grid.to_pixel(p_WD[:2]), p_WD[2] - grid.z_min)
    axes = np.column_stack([grid.to_pixel(ends[:, :2]), ends[:, 2] - grid.z_min]) - origin
    origin[:2] += 0.5  # After this shift, truncation finds the nearest pixel centre.

    def coordinate(k: int) -> NDArray[np.float32]:
        a, b, c = (np.float32(value) for value in axes[:, k])
        direction = (b * rays.v + c) + a * rays.u
        direction *= depth
        direction += np.float32(origin[k])
        return direction

    X_GD = np.column_stack([axes.T, origin])
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        row, col, z = coordinate(0), coordinate(1), coordinate(2)
        edge_row, edge_col, edge_z = surface_edges(depth, z, (rays.u, rays.v), X_GD).T
    at_edge, cell = _cells(edge_row, edge_col, edge_z, grid)
    edges = np.full(grid.rows * grid.cols, -np.inf, np.float32)
    np.maximum.at(edges, cell, edge_z[at_edge].astype(np.float32))

    point, cell = _cells(row, col, z, grid)
    z = z.ravel()[point]

    # Rounding may put points of the table slightly below it. They get height 0, so that all points
    # of the table are equally high, and the last of them gives the colour. Adding 0 turns -0 into
    # +0.
    z = np.where((z < 0) & (z > -_ROUNDING), 0, z) + np.float32(0)
    # `_sortable` gives integers in the order of the heights. They become the upper bits of a key,
    # and the point's index becomes the lower bits. The maximum key then has the highest point's
    # colour.
    key = (_sortable(z).astype(np.int64) << 32) | point
    unseen = np.iinfo(np.int64).min
    highest = np.full(grid.rows * grid.cols, unseen, np.int64)
    np.maximum.at(highest, cell, key)

    seen_image = np.zeros((4, highest.size), np.float32)
    seen_image[3] = -np.inf
    seen = np.flatnonzero(highest > unseen)
    if view.color is not None:
        color = view.color.reshape(-1, view.color.shape[-1])
        seen_image[:3, seen] = color[highest[seen] & 0xFFFFFFFF, :3].T / np.float32(255)
    bits = _sortable((highest[seen] >> 32).astype(np.int32).view(np.float32))
    seen_image[3, seen] = bits.view(np.float32)
    return seen_image.reshape(4, *grid.shape), edges.reshape(grid.shape)


def _cells(
    row: NDArray[np.floating], col: NDArray[np.floating], z: NDArray[np.floating], grid: PixelGrid
) -> tuple[NDArray[np.intp], NDArray[np.int64]]:
    """Returns the (flat) indices of the points on the grid, and for each of these the number of its
    grid pixel."""
    point = np.flatnonzero(
        (row >= 0)
        & (row < grid.rows)
        & (col >= 0)
        & (col < grid.cols)
        & (z <= grid.z_max - grid.z_min)
        & (z >= -_DEEPEST)
    )
    row, col = row.ravel()[point], col.ravel()[point]
    return point, row.astype(np.int64) * grid.cols + col.astype(np.int64)


def _sortable(values: NDArray[np.float32]) -> NDArray[np.int32]:
    """Maps float32 numbers to int32 numbers that have the same order. The function is its own
    inverse: applied to its result, viewed as float32, it returns the bits of the original."""
    bits = values.view(np.int32)
    return np.where(bits < 0, bits ^ np.int32(0x7FFFFFFF), bits)


def _fuse(views: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Fuses the heightmaps of n cameras (n, 4, rows, cols) to one (4, rows, cols), with its mask of
    valid pixels.

    Heights are relative to `grid.z_min`.
    """
    height = views[:, 3].max(axis=0)
    seen = height > -np.inf
    # Clamp points below the table to its surface.
    heights = np.maximum(views[:, 3], 0)
    on_top = (views[:, 3] > -np.inf) & (heights >= heights.max(axis=0) - np.float32(SAME_SURFACE))
    image = np.empty_like(views[0])
    image[:3] = (views[:, :3] * on_top[:, None]).sum(axis=0) / np.maximum(on_top.sum(axis=0), 1)
    image[3] = height
    return image, seen


def _bridge_gaps(image: NDArray[np.float32], seen: NDArray[np.bool_]) -> None:
    """Fills, in place, single unseen pixels between two pixels of the same surface."""
    row, col = np.nonzero(~seen)
    padded_image = np.pad(image, ((0, 0), (1, 1), (1, 1)))
    padded_seen = np.pad(seen, 1)
    fill = np.zeros((4, row.size), np.float32)
    fill_height = np.full(row.size, -np.inf, np.float32)
    for along_row, along_col in ((1, 0), (0, 1)):
        before = (row + 1 - along_row, col + 1 - along_col)
        after = (row + 1 + along_row, col + 1 + along_col)
        one, other = padded_image[:, *before], padded_image[:, *after]
        mean = (one + other) / 2
        bridge = padded_seen[before] & padded_seen[after]
        bridge &= np.abs(one[3] - other[3]) <= SAME_SURFACE
        bridge &= mean[3] > fill_height
        fill = np.where(bridge, mean, fill)
        fill_height = np.where(bridge, mean[3], fill_height)
    image[:, row, col] = fill
    seen[row, col] = fill_height > -np.inf
