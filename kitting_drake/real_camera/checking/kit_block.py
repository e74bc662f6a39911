"""Measures a block of known size on the table, in the image of one camera."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import ConvexHull

from kitting_drake.common.errors import UserError
from kitting_drake.real_camera.calibrations.calibration import BenchCamera

Array = NDArray[np.float64]

_LEAST_PIXELS = 400
_CLEAN = 0.0005
"""The noise of heights, in metres, above which the heights are filtered."""
_LEAST_BAND = 0.001
"""Points within this distance of the top's height, in metres, belong to the top. Three times the
noise is used if that is larger."""


@dataclass(frozen=True)
class Block:
    """A block with dimensions that were measured with a ruler."""

    size: tuple[float, float, float]
    """The length, width and height, in metres."""
    pose: tuple[float, float, float] | None = None
    """The x and y of the block's centre in the base frame, in metres, and the yaw of its length, in
    radians; None if unknown."""

    @property
    def period(self) -> float:
        """The rotation under which the block looks the same, in radians.

        It is a quarter turn if length and width are nearly equal, and a half turn otherwise.
        """
        length, width, _ = self.size
        return math.pi / 2 if math.isclose(length, width, rel_tol=0.05) else math.pi


@dataclass(frozen=True)
class SeenBlock:
    """A block as seen by one camera."""

    middle: Array
    """The position (2,) of the block's centre in the base frame, in metres."""
    yaw: float
    """The yaw of the block's length in the base frame, in radians, modulo `Block.period`."""
    size: tuple[float, float, float]
    """The length, width and height, in metres."""
    corner: float
    """The angle between the block's sides, in radians; a right angle if the calibration is
    correct."""


def see_block(
    points: Array, camera: BenchCamera, X_BC: Array, block: Block, table: float, noise: float
) -> SeenBlock:
    """Measures a block of known size in a camera's image.

    Depth serves only to select the pixels of the block's top. Their rays are intersected with the
    plane of the top, and each pixel covers an area on it. The moments of these areas give the
    centre, the direction and the sides of the top without bias.

    Some of the selected pixels may show a side wall just below the top. They widen the top by a
    strip, whose width is computed and subtracted. Recesses inside the top's outline do no harm, but
    notches in the outline do.

    Args:
        points: (height, width, 3) in the base frame, from `table_points`.
        camera: the camera.
        X_BC: (4, 4) the camera's pose.
        block: the block to find.
        table: the height of the table, in metres.
        noise: the standard deviation of the heights, in metres.

    Raises:
        UserError: the camera does not see the block, or it sees a block of another size.
    """
    z = np.where(np.isfinite(points[..., 2]), points[..., 2] - table, -1.0)
    if noise > _CLEAN:
        z = ndimage.median_filter(z, 5)
    near = (z > block.size[2] / 2) & (z < 1.5 * block.size[2] + 0.005)
    if near.sum() < _LEAST_PIXELS:
        raise UserError(
            f"camera {camera.name} sees no block {1e3 * block.size[2]:g} mm high: check the height "
            "of the block, and that it is in view"
        )
    values = z[near]
    # Use bins of a millimetre. The margin is for the case that all heights are equal.
    low, high = values.min() - 0.002, values.max() + 0.002
    counts, edges = np.histogram(values, math.ceil((high - low) / 0.001), (low, high))
    mode = edges[counts.argmax()] + (edges[1] - edges[0]) / 2
    band = max(_LEAST_BAND, 3 * noise)
    top = float(np.median(values[np.abs(values - mode) < max(2 * band, 0.002)]))
    mask = _filled(np.abs(z - top) < band, camera)
    hit, area = _on_plane(camera, X_BC, table + top)
    q, weights = hit[mask], area[mask]
    middle = np.average(q, axis=0, weights=weights)
    border = hit[mask & ~ndimage.binary_erosion(mask)] - middle
    axes = _least_rectangle(border)
    for _ in range(2):
        turned, other = _side_angles(border @ axes)
        axes = axes @ _rotation((turned + other) / 2)
    variances = np.average(((q - middle) @ axes) ** 2, axis=0, weights=weights)
    sides = np.sqrt(12 * variances)
    if (sides[0] < sides[1]) != (block.size[0] < block.size[1]):
        axes, sides = np.column_stack([axes[:, 1], -axes[:, 0]]), sides[::-1]
    towards = (X_BC[:2, 3] - middle) @ axes / (X_BC[2, 3] - table - top)
    strips = band * np.maximum(np.abs(towards) - sides / 2 / (X_BC[2, 3] - table - top), 0.0)
    middle = middle - axes @ (np.sign(towards) * strips / 2)
    length, width = sides - strips
    if not (0.5 < length / block.size[0] < 2 and 0.5 < width / block.size[1] < 2):
        raise UserError(
            f"camera {camera.name} sees a block of {1e3 * length:.0f} x {1e3 * width:.0f} x "
            f"{1e3 * top:.0f} mm: give its true size, and remove other objects of that height"
        )
    turned, other = _side_angles(border @ axes)
    yaw = math.atan2(axes[1, 0], axes[0, 0])
    return SeenBlock(middle, yaw, (length, width, top), math.pi / 2 + other - turned)


def _filled(mask: NDArray[np.bool_], camera: BenchCamera) -> NDArray[np.bool_]:
    """Returns the largest part of a mask, with its holes filled.

    A convex hull is not used, because it follows the outermost points of a noisy outline.
    """
    mask = ndimage.binary_fill_holes(ndimage.binary_closing(mask, iterations=2))
    mask = ndimage.binary_opening(mask, iterations=3)
    labels, count = ndimage.label(mask)
    if not count:
        raise UserError(
            f"camera {camera.name} sees no block with a flat top: check that nothing lies on it"
        )
    part = labels == np.bincount(labels.ravel())[1:].argmax() + 1
    if part[0].any() or part[-1].any() or part[:, 0].any() or part[:, -1].any():
        raise UserError(
            f"camera {camera.name} does not see the whole block: move it to the middle of the image"
        )
    return part


def _on_plane(camera: BenchCamera, X_BC: Array, height: float) -> tuple[Array, Array]:
    """Intersects each pixel's ray with a horizontal plane.

    Returns:
        The points (height, width, 2) in metres, and the areas (height, width) that the pixels cover
        on the plane, up to a constant factor.
    """
    u, v = (item.astype(float) for item in np.broadcast_arrays(camera.rays.u, camera.rays.v))
    directions = np.stack([u, v, np.ones_like(u)], axis=-1) @ X_BC[:3, :3].T
    # The area of a pixel at depth 1 varies only with the distortion.
    (u_row, u_col), (v_row, v_col) = np.gradient(u), np.gradient(v)
    covered = np.abs(u_col * v_row - u_row * v_col)
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = (height - X_BC[2, 3]) / directions[..., 2]
        hit = X_BC[:2, 3] + depth[..., None] * directions[..., :2]
        return hit, covered * np.abs(depth) ** 3


def _rotation(angle: float) -> Array:
    return np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])


def _least_rectangle(points: Array) -> Array:
    """Returns the directions of the sides of the smallest rectangle around points (n, 2).

    They are the columns of a matrix (2, 2).
    """
    corners = points[ConvexHull(points).vertices]
    edges = np.diff(corners, axis=0, append=corners[:1])
    candidates = [_rotation(angle) for angle in np.arctan2(edges[:, 1], edges[:, 0])]
    return min(candidates, key=lambda axes: float(np.prod(np.ptp(corners @ axes, axis=0))))


def _side_angles(local: Array) -> tuple[float, float]:
    """Measures by how much a rectangle's sides are rotated from the axes.

    Args:
        local: (n, 2) the rectangle's outline, centred on the origin.

    Returns:
        The angle of the sides along x, counter-clockwise in radians.
        The angle of the sides along y.
    """
    half = np.abs(local).max(axis=0)
    angles = []
    for along in (0, 1):
        across = 1 - along
        slopes = []
        for side in (-1, 1):
            # Exclude the corners, because each belongs to two sides.
            own = (side * local[:, across] > half[across] - 0.2 * half.min()) & (
                np.abs(local[:, along]) < 0.8 * half[along]
            )
            if own.sum() > 10:
                slopes.append(np.polyfit(local[own, along], local[own, across], 1)[0])
        angles.append(math.atan(float(np.mean(slopes))) if slopes else 0.0)
    return angles[0], -angles[1]
