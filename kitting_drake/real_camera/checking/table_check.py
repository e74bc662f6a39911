"""Checks in every decision that the cameras see the table where the calibration says it is."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from kitting_drake.real_camera.calibrations.calibration import BenchCamera, Calibration
from kitting_drake.real_camera.checking.planes import Plane, find_planes, refit
from kitting_drake.real_camera.checking.views import CalibrationError
from kitting_drake.real_camera.frames import Frame
from systems.signals import PixelGrid

Array = NDArray[np.float64]

UNVERIFIED = (
    "a bare table does not show errors of x, y and yaw, or a mirrored image: check these once with "
    "a block (--check --kit_size_mm --kit_pose) or markers (--calibrate); either writes "
    "verified: true"
)
"""The warning for a calibration that was not verified."""
_REFUSED_OFF = 0.010
"""The robot does not act if the error of the table's height exceeds this, in metres."""
_REFUSED_TILT = math.radians(1.3)
"""The robot does not act if the table's tilt exceeds this, in radians."""
_WARNED_OFF = 0.005
"""The user is warned if the error of the table's height exceeds this, in metres."""
_WARNED_TILT = math.radians(0.65)
"""The user is warned if the table's tilt exceeds this, in radians."""
_STEP = 4
"""Only every `_STEP`th row and column of an image is used."""
_FARTHEST = 0.35
"""Planes are searched for within this distance of the table's height, in metres."""
_LEAST = 150
"""Planes with fewer used pixels than this are ignored."""
_BELOW = 0.5
"""The plane at the calibrated height counts as the table if its weight (`TableFit.weight`) is at
least this fraction of that of every plane below it. Otherwise the plane with the largest weight
counts."""
_ABOVE = 0.08
"""The weight of the plane at the calibrated height must also be at least this fraction of that of
each plane above it. The fraction is small, because objects may hide most of a table."""
_SHARP = 0.004
"""Planes with less noise than this are equally credible, in metres. A noisier one counts for less,
because a thick layer around a plane contains many points of other surfaces."""
_CURVED = 0.5
"""The depths are taken for distances from the camera if `_as_depth` reduces the table's noise to
less than this fraction."""
_FLAT = 0.0005
"""The noise below which a table counts as flat, in metres."""


@dataclass(frozen=True)
class TableFit:
    """The table as a camera sees it."""

    off: float
    """The measured height at the middle of the table's visible part minus the calibrated height, in
    metres."""
    tilt: float
    """The table's angle with the base's xy plane, in radians."""
    plane: Plane
    support: int
    """The number of used pixels on the table."""

    @property
    def weight(self) -> float:
        """How much speaks for this plane: `support`, reduced for a noisy plane (see `_SHARP`)."""
        return self.support * _SHARP / max(self.plane.noise, _SHARP)

    @property
    def is_refused(self) -> bool:
        """Whether the table's height or tilt is so wrong that no pick can be trusted."""
        return abs(self.off) > _REFUSED_OFF or self.tilt > _REFUSED_TILT

    @property
    def is_doubtful(self) -> bool:
        """Whether the table's height or tilt calls for a warning."""
        return abs(self.off) > _WARNED_OFF or self.tilt > _WARNED_TILT


def check_table(frames: Mapping[str, Frame], calibration: Calibration) -> list[str]:
    """Checks that every camera sees the table level and at its height.

    Args:
        frames: the frames that `check_frames` returns.
        calibration: the cameras' calibration.

    Returns:
        Warnings, a sentence each.

    Raises:
        CalibrationError: a camera sees no table, or sees it more than 10 mm off or tilted by more
            than 1.3 degrees. The message says which change of the calibration would agree with the
            frame.
    """
    warnings = [] if calibration.verified else [UNVERIFIED]
    for camera in calibration.cameras:
        depth = frames[camera.name].depth
        fit = _fit(camera, camera.X_BC, depth, calibration)
        if fit is None or fit.is_refused:
            hint = _hint(camera, depth, calibration, fit)
            raise CalibrationError(f"camera {camera.name} {_said(fit, calibration.grid)}: {hint}")
        if _is_range(camera, depth, calibration, fit):
            raise CalibrationError(
                f"camera {camera.name} sees a curved table: its depths are distances from the "
                "camera; give depths along the optical axis"
            )
        if fit.is_doubtful:
            warnings.append(
                f"camera {camera.name} {_said(fit, calibration.grid)}: check it with --check"
            )
    return warnings


def _said(fit: TableFit | None, grid: PixelGrid) -> str:
    if fit is None:
        return "sees no table in the workspace"
    parts = []
    if abs(fit.off) > _WARNED_OFF:
        side = "higher" if fit.off > 0 else "lower"
        parts.append(f"{1e3 * abs(fit.off):.0f} mm {side} than {grid.z_min:g} m")
    if fit.tilt > _WARNED_TILT:
        parts.append(f"tilted by {math.degrees(fit.tilt):.1f} degrees")
    return "sees the table " + " and ".join(parts)


def _fit(
    camera: BenchCamera, X_BC: Array, depth: NDArray[np.float32], calibration: Calibration
) -> TableFit | None:
    """Returns the plane that is most probably the table; None if there is none."""
    grid = calibration.grid
    points = _points(camera, X_BC, depth, calibration)
    expected = refit(points, np.array([0.0, 0.0, grid.z_min]))
    local = None if expected is None else _measured(expected, points, grid)
    if local is not None and (local.is_refused or local.support < _LEAST):
        local = None
    if local is not None and local.weight >= len(points) / 2:
        return local
    planes = [_measured(plane, points, grid) for plane in find_planes(points)]
    if local is not None:
        others = [fit for fit in planes if abs(fit.off - local.off) > _REFUSED_OFF]
        below = max((fit.weight for fit in others if fit.off < local.off), default=0.0)
        above = max((fit.weight for fit in others if fit.off > local.off), default=0.0)
        if local.weight >= max(_BELOW * below, _ABOVE * above):
            return local
    planes = [fit for fit in planes if fit.support >= _LEAST]
    return max(planes, key=lambda fit: fit.weight, default=None)


def _measured(plane: Plane, points: Array, grid: PixelGrid) -> TableFit:
    near = np.abs(points[:, 2] - plane.height(points[:, :2])) < max(0.004, 3 * plane.noise)
    middle = points[near, :2].mean(axis=0) if near.any() else np.zeros(2)
    off = float(plane.height(middle)) - grid.z_min
    return TableFit(off, float(np.linalg.norm(plane.tilt)), plane, int(near.sum()))


def _points(
    camera: BenchCamera, X_BC: Array, depth: NDArray[np.float32], calibration: Calibration
) -> Array:
    """Returns a camera's points (n, 3) in the base frame that are over the workspace's table and
    within `_FARTHEST` of its height."""
    rays = camera.rays
    u, v = (item[::_STEP, ::_STEP] for item in np.broadcast_arrays(rays.u, rays.v))
    z = depth[::_STEP, ::_STEP].astype(float)
    with np.errstate(invalid="ignore"):
        good = np.isfinite(z) & (z >= rays.min_depth) & (z <= rays.max_depth)
    z = z[good]
    p_C = np.stack([u[good] * z, v[good] * z, z], axis=-1)
    p_B = p_C @ X_BC[:3, :3].T + X_BC[:3, 3]
    near = np.abs(p_B[:, 2] - calibration.table_height) < _FARTHEST
    inside = calibration.contains(p_B[:, :2]) & near
    return np.asarray(p_B[inside])


def _is_range(
    camera: BenchCamera, depth: NDArray[np.float32], calibration: Calibration, fit: TableFit
) -> bool:
    """Whether the depths are probably distances from the camera. If they are, their conversion by
    `_as_depth` makes the table much flatter."""
    if fit.plane.noise < _FLAT:
        return False
    points = _points(camera, camera.X_BC, _as_depth(camera, depth), calibration)
    other = refit(points, np.array([0.0, 0.0, calibration.table_height])) or next(
        iter(find_planes(points, 1)), None
    )
    return other is not None and other.noise < _CURVED * fit.plane.noise


def _as_depth(camera: BenchCamera, distance: NDArray[np.float32]) -> NDArray[np.float32]:
    """Converts distances from the camera (height, width) to depths along the optical axis."""
    rays = camera.rays
    return (distance / np.sqrt(1 + rays.u**2 + rays.v**2)).astype(np.float32)


def _hint(
    camera: BenchCamera, depth: NDArray[np.float32], calibration: Calibration, fit: TableFit | None
) -> str:
    """Returns a hint for the user: which change of the calibration would agree with the frame."""
    for text, other, X_BC, image in _suppositions(camera, depth):
        found = _fit(other, X_BC, image, calibration)
        if found is not None and not found.is_doubtful:
            return text
    if fit is None:
        return "check the pose and table_height"
    if fit.tilt <= _REFUSED_TILT:
        height = calibration.table_height + fit.off
        return f"table_height: {height:.3f} would agree, or correct the camera's pose"
    about_x, about_y = np.degrees(fit.plane.tilt)
    return (
        f"the rotation of the pose is wrong by {about_x:.1f} degrees about base x and "
        f"{about_y:.1f} about base y, or the image is rotated or belongs to other intrinsics; "
        "--check on an empty table writes a corrected calibration"
    )


def _suppositions(
    camera: BenchCamera, depth: NDArray[np.float32]
) -> Iterator[tuple[str, BenchCamera, Array, NDArray[np.float32]]]:
    """Yields (hint, camera, pose, depth) for each frequent mistake, with the mistake corrected."""
    X = camera.X_BC
    yield (
        "these depths are distances from the camera: give depths along the optical axis",
        camera,
        X,
        _as_depth(camera, depth),
    )
    yield (
        "the inverse of the pose would agree: is it the pose of the base in the camera?",
        camera,
        np.asarray(np.linalg.inv(X)),
        depth,
    )
    body = np.eye(4)
    body[:3, :3] = Rotation.from_euler("xyz", [-90, 0, -90], degrees=True).as_matrix()
    yield (
        "the pose would agree if it were that of ROS's body frame (x forward): give that of the "
        "optical frame (z forward)",
        camera,
        X @ body,
        depth,
    )
    yield (
        "the image upside down would agree: is it rotated by 180 degrees?",
        camera,
        X,
        depth[::-1, ::-1],
    )
    yield "the mirrored image would agree: is it flipped left to right?", camera, X, depth[:, ::-1]
    yield "the mirrored image would agree: is it flipped top to bottom?", camera, X, depth[::-1]
    for factor in (2.0, 0.5):
        lens = camera.intrinsics
        focal = (factor * lens.focal[0], factor * lens.focal[1])
        other = dataclasses.replace(camera, intrinsics=dataclasses.replace(lens, focal=focal))
        yield (
            f"fx {focal[0]:.0f} and fy {focal[1]:.0f} would agree: are they of another resolution?",
            other,
            X,
            depth,
        )
    for factor in (0.1, 10.0, 0.25, 4.0, 0.5, 2.0):
        yield (
            f"depth_scale: {factor * camera.depth_scale:g} would agree",
            camera,
            X,
            (factor * depth).astype(np.float32),
        )
    for axis, name in ((0, "x"), (1, "y")):
        turned = X.copy()
        turned[:3, :3] = np.diag([-1.0 if k != axis else 1.0 for k in range(3)]) @ X[:3, :3]
        yield (
            f"the pose rotated by half a turn about base {name} would agree",
            camera,
            turned,
            depth,
        )
