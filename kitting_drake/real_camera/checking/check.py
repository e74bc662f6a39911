"""Finds errors of cameras from their views of an empty table, or of a block of known size on it."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from kitting_drake.common.errors import UserError
from kitting_drake.real_camera.calibrations.calibration import BenchCamera, Calibration, with_poses
from kitting_drake.real_camera.checking.kit_block import Block, SeenBlock, see_block
from kitting_drake.real_camera.checking.planes import FARTHEST, Plane, fit_plane, table_points
from kitting_drake.real_camera.checking.views import (
    check_frames,
    check_views,
    make_views,
    table_depth,
)
from kitting_drake.real_camera.frames import Frame
from systems.heightmap import project
from systems.signals import PixelGrid

Array = NDArray[np.float64]

_LEAST_POINTS = 500
_SHARED = 100
"""Two cameras are compared if they have at least this number of pixels of o_t in common."""


@dataclass(frozen=True)
class TableCheck:
    """The plane, noise and holes of the table, as seen by one camera or by all together."""

    tilt: Array
    """The apparent rotation (2,) of the table about base x and y, in radians."""
    bias: float
    """The apparent height of the table at the workspace's centre minus its true height, in
    metres."""
    noise: float
    """A robust estimate of the standard deviation of the heights, in metres."""
    holes: float
    """The share of the table without measured depth, from 0 to 1. For one camera, only the part of
    the table in its view counts."""

    @property
    def tilt_angle(self) -> float:
        """The size of the tilt, in radians."""
        return float(np.linalg.norm(self.tilt))


@dataclass(frozen=True)
class CameraCheck:
    """The check of one camera."""

    table: TableCheck
    distance: float
    """The distance from the camera to the centre of the visible part of the table, in metres."""
    depth_bias: float
    """The constant depth error that would explain the heights if the pose were right, in metres."""
    depth_bias_noise: float
    """A robust estimate of the standard deviation of the heights, in metres, if `depth_bias` is
    corrected."""
    block: SeenBlock | None


@dataclass(frozen=True)
class Check:
    """The errors of all cameras, and the poses that correct them."""

    cameras: dict[str, CameraCheck]
    together: TableCheck
    """The check of o_t, which contains the highest point in each pixel."""
    disagreements: dict[tuple[str, str], float]
    """For each pair of cameras, how much higher the first camera sees the table than the second, in
    metres."""
    block_shifts: dict[tuple[str, str], Array]
    """For each pair of cameras, the position (2,) of the block as seen by the first camera, minus
    the position as seen by the second, in metres."""
    block: Block | None
    corrected: Calibration
    heights: dict[str, NDArray[np.float32]]
    """The heights (rows, cols) above the table, by camera name, and for o_t under the name ""; NaN
    where unseen."""


def check_cameras(
    frames: Mapping[str, Frame], calibration: Calibration, block: Block | None = None
) -> Check:
    """Checks cameras by the table, which they should see level and at its height in the base frame.

    Each camera's pose is corrected by a rotation that makes the table level, and then by a vertical
    shift. With a block, the cameras are also shifted horizontally and rotated about the vertical,
    so that they agree on the block's pose. The block's pose is `block.pose`, or the mean of the
    poses that the cameras see if `block.pose` is None.

    Args:
        frames: a frame of each camera, by camera name, with nothing but the block on the table.
        calibration: the cameras' calibration.
        block: the block on the table, if any.

    Raises:
        UserError: a camera does not see the table or the block.
    """
    frames = check_frames(frames, calibration)
    check_views(frames, calibration)
    views = make_views(frames, calibration)
    grid = calibration.grid
    poses: dict[str, Array] = {}
    found: dict[str, CameraCheck] = {}
    maps: dict[str, NDArray[np.float32]] = {}
    for camera in calibration.cameras:
        frame = frames[camera.name]
        points = table_points(frame, camera, camera.X_BC, calibration)
        plane = _plane_of(points, camera)
        poses[camera.name] = levelled(camera.X_BC, plane, grid)
        seen = None
        if block is not None:
            level = table_points(frame, camera, poses[camera.name], calibration)
            seen = see_block(level, camera, poses[camera.name], block, grid.z_min, plane.noise)
        found[camera.name] = _check_camera(camera, points, plane, calibration, seen)
        maps[camera.name] = _height_map(points, grid)
    if block is not None:
        seen_by = {name: item.block for name, item in found.items() if item.block is not None}
        poses = _aligned(poses, seen_by, block)
    # Include heights below the table, which o_t itself would clip.
    deep = dataclasses.replace(grid, z_min=grid.z_min - FARTHEST)
    fused = project(views, deep, calibration.region)
    maps[""] = np.where(fused.valid, fused.height - FARTHEST, np.nan).astype(np.float32)
    return Check(
        cameras=found,
        together=_check_together(maps[""], calibration),
        disagreements=_disagreements(maps),
        block_shifts={
            (one, other): a.middle - b.middle
            for (one, a), (other, b) in itertools.combinations(
                [(name, item.block) for name, item in found.items()], 2
            )
            if a is not None and b is not None
        },
        block=block,
        corrected=dataclasses.replace(
            with_poses(calibration, poses), verified=calibration.verified or _is_verified(block)
        ),
        heights=maps,
    )


def _is_verified(block: Block | None) -> bool:
    """Whether the cameras have seen a block at a known pose."""
    return block is not None and block.pose is not None


def levelled(X_BC: Array, plane: Plane, grid: PixelGrid) -> Array:
    """Returns a camera's pose (4, 4), corrected so that the seen plane is level and as high as
    the table."""
    R = plane.levelling()
    corrected = X_BC.copy()
    corrected[:3, :3] = R @ X_BC[:3, :3]
    # The rotation about the camera moves the plane. Find the new height of the plane.
    point = np.array([*X_BC[:2, 3], float(plane.height(X_BC[:2, 3]))])
    height = (R @ (point - X_BC[:3, 3]) + X_BC[:3, 3])[2]
    corrected[2, 3] += grid.z_min - height
    return corrected


def middle_of(grid: PixelGrid) -> Array:
    """Returns the centre (2,) of the workspace in the base frame, in metres."""
    return np.array([(grid.x_min + grid.x_max) / 2, (grid.y_min + grid.y_max) / 2])


def _plane_of(points: Array, camera: BenchCamera) -> Plane:
    seen = points[np.isfinite(points[..., 2])]
    if len(seen) < _LEAST_POINTS:
        raise UserError(
            f"camera {camera.name} sees almost nothing within {1e3 * FARTHEST:.0f} mm of the "
            "table's height: check the camera's pose and table_height"
        )
    return fit_plane(seen)


def _check_camera(
    camera: BenchCamera,
    points: Array,
    plane: Plane,
    calibration: Calibration,
    block: SeenBlock | None,
) -> CameraCheck:
    grid = calibration.grid
    expected = table_depth(camera, calibration)
    towards = np.isfinite(expected)
    has_point = np.isfinite(points[..., 2])
    holes = 1 - (has_point & towards).sum() / max(towards.sum(), 1)
    z = points[..., 2]
    with np.errstate(invalid="ignore"):
        on_table = has_point & towards & (np.abs(z - plane.height(points[..., :2])) < 0.004)
    above = z[on_table] - grid.z_min
    # A depth error d lowers a point by d times the camera's height divided by the depth.
    falls = -(camera.X_BC[2, 3] - grid.z_min) / expected[on_table]
    depth_bias = float((falls * above).sum() / (falls * falls).sum())
    rest = above - falls * depth_bias
    return CameraCheck(
        table=TableCheck(
            tilt=plane.tilt,
            bias=float(plane.height(middle_of(grid))) - grid.z_min,
            noise=plane.noise,
            holes=float(np.clip(holes, 0.0, 1.0)),
        ),
        distance=float(np.linalg.norm(points[on_table].mean(axis=0) - camera.X_BC[:3, 3])),
        depth_bias=depth_bias,
        depth_bias_noise=1.4826 * float(np.median(np.abs(rest))),
        block=block,
    )


def _height_map(points: Array, grid: PixelGrid) -> NDArray[np.float32]:
    """Returns the mean height (rows, cols) of a camera's points above the table; NaN where
    unseen."""
    seen = points[np.isfinite(points[..., 2])]
    row, col = np.rint(grid.to_pixel(seen[:, :2])).astype(int).T
    inside = (row >= 0) & (row < grid.rows) & (col >= 0) & (col < grid.cols)
    cell = (row * grid.cols + col)[inside]
    size = grid.rows * grid.cols
    total = np.bincount(cell, seen[inside, 2] - grid.z_min, size)
    count = np.bincount(cell, minlength=size)
    mean = np.where(count > 0, total / np.maximum(count, 1), np.nan)
    return mean.reshape(grid.shape).astype(np.float32)


def _check_together(height: NDArray[np.float32], calibration: Calibration) -> TableCheck:
    grid, region = calibration.grid, calibration.region
    rows, cols = np.nonzero(np.isfinite(height))
    xy = grid.to_world(np.column_stack([rows, cols]))
    plane = fit_plane(np.column_stack([xy, height[rows, cols]]))
    seen = len(rows) / (height.size if region is None else int(region.sum()))
    return TableCheck(plane.tilt, float(plane.height(middle_of(grid))), plane.noise, 1 - seen)


def _disagreements(maps: Mapping[str, NDArray[np.float32]]) -> dict[tuple[str, str], float]:
    result = {}
    for one, other in itertools.combinations([name for name in maps if name], 2):
        rest = maps[one] - maps[other]
        rest = rest[np.isfinite(rest)]
        if len(rest) >= _SHARED:
            result[one, other] = float(np.median(rest))
    return result


def _aligned(
    poses: Mapping[str, Array], seen: Mapping[str, SeenBlock], block: Block
) -> dict[str, Array]:
    """Shifts poses and rotates them about the vertical, so that all cameras see the block at the
    same pose."""
    period = block.period
    if block.pose is None:
        first = next(iter(seen.values())).yaw
        yaw = first + float(
            np.mean([math.remainder(item.yaw - first, period) for item in seen.values()])
        )
        middle = np.mean([item.middle for item in seen.values()], axis=0)
    else:
        middle, yaw = np.array(block.pose[:2]), block.pose[2]
    result = {}
    for name, X_BC in poses.items():
        R = Rotation.from_euler("z", math.remainder(yaw - seen[name].yaw, period)).as_matrix()
        corrected = X_BC.copy()
        corrected[:3, :3] = R @ X_BC[:3, :3]
        corrected[:2, 3] = R[:2, :2] @ (X_BC[:2, 3] - seen[name].middle) + middle
        result[name] = corrected
    return result
