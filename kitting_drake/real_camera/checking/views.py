"""Checks that cameras see the workspace and that their depths are plausible, and makes o_t."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from kitting_drake.common.errors import UserError
from kitting_drake.real_camera.calibrations.calibration import BenchCamera, Calibration
from kitting_drake.real_camera.frames import Frame, check_frame
from systems.heightmap import View, project
from systems.signals import Observation, PixelGrid

Array = NDArray[np.float64]

_LEAST_SEEN = 0.01
"""If a camera sees a smaller share of the workspace than this, its pose is wrong."""
_LEAST_DEPTH = 0.01
"""Of the pixels that look at the workspace, at least this share must have a depth."""
_NEAREST, _FARTHEST = 0.8, 1.25
"""The smallest and largest plausible median depth, as multiples of the table's depth. Beyond them
the unit or the pose is wrong."""
_STEP = 4
"""The step between the pixels that are checked."""
_OBLONG = 1.1
"""Pixels of depth cameras are square. If fx and fy differ by more than this factor, one of them is
wrong."""
_OFF_CENTRE = 0.05
"""The largest usual distance of the principal point from the image's middle, as a share of the
image's width or height."""
_OPTICAL = np.eye(4)
_OPTICAL[:3, :3] = Rotation.from_euler("xyz", [-90, 0, -90], degrees=True).as_matrix()
"""The pose (4, 4) of the optical frame in ROS's body frame of a camera (x forward, y left, z
up)."""


class CalibrationError(UserError):
    """Raised if the cameras' images contradict the calibration."""


def check_frames(frames: Mapping[str, Frame], calibration: Calibration) -> dict[str, Frame]:
    """Returns the checked frames of all cameras, with contiguous depths.

    Args:
        frames: each camera's frame by its name.
        calibration: the cameras' calibration.

    Raises:
        UserError: a camera has no frame, or its frame has a wrong size or type.
    """
    checked = {}
    for camera in calibration.cameras:
        frame = frames.get(camera.name)
        if frame is None:
            raise UserError(f"there is no frame of camera {camera.name}")
        checked[camera.name] = check_frame(frame, camera)
    return checked


def check_views(frames: Mapping[str, Frame], calibration: Calibration) -> None:
    """Checks that the cameras look at the workspace, and that their depths are in metres.

    Args:
        frames: the frames that `check_frames` returns.
        calibration: the cameras' calibration.

    Raises:
        CalibrationError: a camera does not look at the workspace, or its depths are implausible.
    """
    for camera in calibration.cameras:
        _check_pose(camera, calibration.grid)
        _check_depth(frames[camera.name], camera, calibration)


def check_lenses(calibration: Calibration) -> list[str]:
    """Checks that the cameras' intrinsics are plausible. Those of a verified calibration are not
    checked.

    Returns:
        Warnings, a sentence each.

    Raises:
        CalibrationError: a camera's pixels are not square.
    """
    warnings = []
    for camera in () if calibration.verified else calibration.cameras:
        lens = camera.intrinsics
        fx, fy = lens.focal
        if max(fx / fy, fy / fx) > _OBLONG:
            raise CalibrationError(
                f"camera {camera.name} has fx {fx:.0f} and fy {fy:.0f}, but pixels are square: are "
                "both of this resolution?"
            )
        for axis, name in enumerate(("cx", "cy")):
            size = lens.size[axis]
            if abs(lens.centre[axis] + 0.5 - size / 2) > _OFF_CENTRE * size:
                warnings.append(
                    f"camera {camera.name} has {name} {lens.centre[axis]:.0f}, but its images are "
                    f"{size} pixels long there: this is right only if they are cut off at one side"
                )
    return warnings


def observe(frames: Mapping[str, Frame], calibration: Calibration) -> Observation:
    """Makes the observation o_t, with the same kind of heightmap as in the simulated cell.

    Args:
        frames: the frames that `check_frames` returns.
        calibration: the cameras' calibration.
    """
    return project(make_views(frames, calibration), calibration.grid, calibration.region)


def make_views(frames: Mapping[str, Frame], calibration: Calibration) -> list[View]:
    """Returns the cameras' views; the arguments are those of `observe`."""
    views = []
    for camera in calibration.cameras:
        frame = frames[camera.name]
        views.append(View(frame.color, frame.depth, camera.X_BC, camera.rays))
    return views


def table_depth(
    camera: BenchCamera, calibration: Calibration, step: int = 1
) -> NDArray[np.float64]:
    """Predicts the table's depth from the camera's pose. Returns (height, width) depths in metres.

    A depth is NaN for pixels that do not look at the workspace's table. Only every `step`th row and
    column is computed.
    """
    X_BC, grid = camera.X_BC, calibration.grid
    rays = camera.rays
    u, v = (item[::step, ::step] for item in np.broadcast_arrays(rays.u, rays.v))
    directions = np.stack([u, v, np.ones_like(u)], axis=-1) @ X_BC[:3, :3].T
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = (grid.z_min - X_BC[2, 3]) / directions[..., 2]
        xy = X_BC[:2, 3] + depth[..., None] * directions[..., :2]
        seen = (depth > 0) & calibration.contains(xy)
    return np.where(seen, depth, np.nan)


def seen_share(observation: Observation) -> float:
    """Returns the share, from 0 to 1, of o_t's pixels in view that have a measured height."""
    seen = observation.valid[observation.in_view]
    return float(seen.mean()) if seen.size else 0.0


def _in_view(
    camera: BenchCamera, X_BC: Array, grid: PixelGrid, step: int = _STEP
) -> NDArray[np.bool_]:
    """For each pixel (n,) of o_t, whether its point at the table's height is in the camera's image.

    Only every `step`th row and column of o_t is computed.
    """
    rows, cols = np.meshgrid(
        np.arange(0, grid.rows, step), np.arange(0, grid.cols, step), indexing="ij"
    )
    xy = grid.to_world(np.stack([rows.ravel(), cols.ravel()], axis=-1))
    p_C = (np.column_stack([xy, np.full(len(xy), grid.z_min)]) - X_BC[:3, 3]) @ X_BC[:3, :3]
    lens, inside = camera.intrinsics, p_C[:, 2] > 0
    x, y = (p_C[inside, :2] / p_C[inside, 2:]).T * np.array(lens.focal)[:, None]
    inside[inside] = (np.abs(x + lens.centre[0] - lens.size[0] / 2) <= lens.size[0] / 2) & (
        np.abs(y + lens.centre[1] - lens.size[1] / 2) <= lens.size[1] / 2
    )
    return inside


def _check_pose(camera: BenchCamera, grid: PixelGrid) -> None:
    X_BC = camera.X_BC
    if _in_view(camera, X_BC, grid).mean() >= _LEAST_SEEN and X_BC[2, 3] > grid.z_min:
        return
    inverse: NDArray[np.float64] = np.asarray(np.linalg.inv(X_BC), dtype=float)
    others = {
        "the inverse of the pose would see it: is it the pose of the base in the camera?": inverse,
        "it would be seen if the pose were that of ROS's body frame (x forward): give that of the "
        "optical frame (z forward)": X_BC @ _OPTICAL,
        "it would be seen if the pose were in millimetres: give positions in metres": np.vstack(
            [np.column_stack([X_BC[:3, :3], X_BC[:3, 3] / 1e3]), X_BC[3:]]
        ),
    }
    hints = [
        text
        for text, X in others.items()
        if X[2, 3] > grid.z_min and _in_view(camera, X, grid).mean() >= 0.1
    ]
    if hints:
        hint = hints[0]
    elif X_BC[2, 3] <= grid.z_min:
        hint = f"it is {1e3 * (grid.z_min - X_BC[2, 3]):.0f} mm below the table"
    elif X_BC[2, 2] >= 0:
        hint = "it looks upwards"
    else:
        x, y, _ = X_BC[:3, 3] + X_BC[:3, 2] * (grid.z_min - X_BC[2, 3]) / X_BC[2, 2]
        hint = f"it looks at ({x:.2f}, {y:.2f}) m on the table"
    raise CalibrationError(
        f"at its calibrated pose, camera {camera.name} sees nothing of the workspace "
        f"({grid.x_min:g} to {grid.x_max:g}, {grid.y_min:g} to {grid.y_max:g} m): {hint}"
    )


def _check_depth(frame: Frame, camera: BenchCamera, calibration: Calibration) -> None:
    expected = table_depth(camera, calibration, _STEP)
    towards = np.isfinite(expected)
    if not towards.any():
        raise CalibrationError(
            f"camera {camera.name} sees almost no pixel of the workspace, because the workspace is "
            "too small: increase its rows and cols"
        )
    depth = frame.depth[::_STEP, ::_STEP][towards]
    with np.errstate(invalid="ignore"):
        returned = np.isfinite(depth) & (depth > 0)
    if returned.mean() < _LEAST_DEPTH:
        raise CalibrationError(
            f"depth of camera {camera.name} is zero or NaN almost everywhere on the workspace: "
            "check the depth image, and the camera's pose"
        )
    ratios = depth[returned] / expected[towards][returned]
    ratio = float(np.median(ratios))
    if _NEAREST <= ratio <= _FARTHEST:
        _check_limits(depth[returned], camera)
        return
    found = float(np.median(depth[returned]))
    told = (
        f"the median depth of camera {camera.name} is {found:.3g} m, but at its calibrated pose "
        "the table"
    )
    told += f" is {found / ratio:.3g} m away"
    if 500 < ratio < 2000:
        hint = (
            "the depths seem to be millimetres: a .npy file must hold metres, and depth_scale "
            "is metres per step"
        )
    elif 1 / 2000 < ratio < 1 / 500 or found < 1.5 * camera.depth_scale:
        hint = (
            "the depths seem to be metres: a 16-bit PNG must hold steps of depth_scale, which "
            "is 1 mm by default"
        )
    else:
        # Leave other errors to `check_table`, which explains them better.
        return
    raise CalibrationError(f"{told}: {hint}")


def _check_limits(depth: NDArray[np.float32], camera: BenchCamera) -> None:
    """Raises UserError if the camera's limits exclude almost all of its depths (n,), in metres."""
    low, high = camera.min_depth, camera.max_depth
    if ((depth >= low) & (depth <= high)).mean() < _LEAST_DEPTH:
        raise CalibrationError(
            f"the median depth of camera {camera.name} is {np.median(depth):.3g} m, and almost no "
            f"depth is between its min_depth {low:g} and max_depth {high:g}: give these in metres"
        )
