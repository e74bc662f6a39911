"""Converts depths to points in the base frame, and finds planes among these points."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from kitting_drake.real_camera.calibrations.calibration import BenchCamera, Calibration
from kitting_drake.real_camera.frames import Frame

Array = NDArray[np.float64]

FARTHEST = 0.15
"""Points at most this far above or below the table's height, in metres, may belong to the table."""
_TRIALS = 200
_TRIED = 2000
"""The number of points on which a trial plane is scored."""
_THIN = 1e-3
"""A plane is tried through three points. Seen from above, twice the area of their triangle must
exceed this, in square metres."""
_BAND = 0.004
"""The largest distance of inliers from a trial plane, in metres."""
_REFITS = 4
_LEAST = 100
"""The least number of points of a plane."""
_STEEP = 1.0
"""The largest slope of a plane that may be the table. If a camera's pose is wrong, the table looks
sloped."""


@dataclass(frozen=True)
class Plane:
    """The plane z = slope[0] x + slope[1] y + offset in the base frame, in metres."""

    slope: Array
    """The slope (2,) along x and y."""
    offset: float
    noise: float
    """A robust estimate of the standard deviation of the points' distance from the plane, in
    metres."""

    def height(self, xy: Array) -> Array:
        """Returns the heights (...) at positions (..., 2), in metres."""
        return np.asarray(xy @ self.slope + self.offset)

    @property
    def normal(self) -> Array:
        """The upward unit normal (3,)."""
        normal = np.array([-self.slope[0], -self.slope[1], 1.0])
        return normal / np.linalg.norm(normal)

    @property
    def tilt(self) -> Array:
        """The rotation vector (2,) about base x and y, in radians, from the base's xy plane to this
        plane."""
        axis = np.cross([0.0, 0.0, 1.0], self.normal)
        sine = np.linalg.norm(axis)
        return axis[:2] * (math.asin(min(float(sine), 1.0)) / sine if sine > 0 else 0.0)

    def levelling(self) -> Array:
        """Returns the smallest rotation (3, 3) that makes the plane horizontal."""
        return Rotation.from_rotvec([*-self.tilt, 0.0]).as_matrix()


def table_points(frame: Frame, camera: BenchCamera, X_BC: Array, calibration: Calibration) -> Array:
    """Returns the point (height, width, 3) of each pixel in the base frame, in metres.

    It is NaN for pixels without depth, outside the workspace's table, or far above or below the
    table.
    """
    rays, depth = camera.rays, frame.depth
    with np.errstate(invalid="ignore"):
        good = np.isfinite(depth) & (depth >= rays.min_depth) & (depth <= rays.max_depth)
    z = np.where(good, depth, np.nan).astype(float)
    p_C = np.stack([rays.u * z, rays.v * z, z], axis=-1)
    p_B = p_C @ X_BC[:3, :3].T + X_BC[:3, 3]
    with np.errstate(invalid="ignore"):
        inside = calibration.contains(p_B[..., :2])
        inside &= np.abs(p_B[..., 2] - calibration.table_height) < FARTHEST
    return np.where(inside[..., None], p_B, np.nan)


def fit_plane(points: Array, steepest: float = 0.3) -> Plane:
    """Fits a plane to most of the points by RANSAC, and refits it to its inliers.

    Args:
        points: (n, 3), at least a hundred.
        steepest: the largest slope of the plane.
    """
    random = np.random.default_rng(0)
    some = points[random.integers(0, len(points), min(_TRIED, len(points)))]
    triples = some[random.integers(0, len(some), (_TRIALS, 3))]
    designs = np.concatenate([triples[..., :2], np.ones((_TRIALS, 3, 1))], axis=-1)
    sound = np.abs(np.linalg.det(designs)) > _THIN
    planes = np.linalg.solve(designs[sound], triples[sound][..., 2:])[..., 0]
    planes = planes[np.hypot(planes[:, 0], planes[:, 1]) < steepest]
    best = np.array([0.0, 0.0, float(np.median(points[:, 2]))])
    if len(planes):
        heights = planes @ np.column_stack([some[:, :2], np.ones(len(some))]).T
        best = planes[(np.abs(heights - some[:, 2]) < _BAND).sum(axis=1).argmax()]
    design = np.column_stack([points[:, :2], np.ones(len(points))])
    noise = _BAND
    for _ in range(_REFITS):
        rest = points[:, 2] - design @ best
        near = np.abs(rest) < max(3.5 * noise, 0.0005)
        best = np.linalg.lstsq(design[near], points[near, 2], rcond=None)[0]
        rest = (points[:, 2] - design @ best)[near]
        noise = max(1.4826 * float(np.median(np.abs(rest - np.median(rest)))), 1e-6)
    return Plane(best[:2], float(best[2]), noise)


def find_planes(points: Array, most: int = 3) -> list[Plane]:
    """Finds the planes with most points, the largest first.

    The points of each plane are ignored in the search for the next.

    Args:
        points: (n, 3).
        most: the largest number of planes.
    """
    found = []
    left = points
    for _ in range(most):
        if len(left) < _LEAST:
            break
        plane = fit_plane(left, _STEEP)
        found.append(plane)
        left = left[np.abs(left[:, 2] - plane.height(left[:, :2])) > 3 * _BAND]
    return found


def refit(points: Array, plane: Array) -> Plane | None:
    """Refits a plane to the points near it; returns None if there are too few.

    Args:
        points: (n, 3), in metres.
        plane: (3,) the slopes along x and y, and the offset in metres, from which to start.
    """
    design = np.column_stack([points[:, :2], np.ones(len(points))])
    noise = _BAND
    for band in (0.02, 0.012, 0.008, 0.0, 0.0):
        rest = points[:, 2] - design @ plane
        near = np.abs(rest) < (band or max(3.5 * noise, 0.0005))
        if near.sum() < _LEAST:
            return None
        plane = np.linalg.lstsq(design[near], points[near, 2], rcond=None)[0]
        rest = (points[:, 2] - design @ plane)[near]
        noise = max(1.4826 * float(np.median(np.abs(rest - np.median(rest)))), 1e-6)
    return Plane(plane[:2], float(plane[2]), noise)
