"""Checks in every decision that no camera sees through what another camera sees.

A table shows no error of a pose's x, y and yaw, and no mirrored image. But if such an error makes
the objects appear at a wrong place, another camera sees the table behind them.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping
from itertools import combinations, permutations

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from kitting_drake.real_camera.calibrations.calibration import BenchCamera, Calibration
from kitting_drake.real_camera.calibrations.lens_distortion import distort
from kitting_drake.real_camera.checking.planes import refit
from kitting_drake.real_camera.checking.views import CalibrationError
from kitting_drake.real_camera.frames import Frame

Array = NDArray[np.float64]
Shares = dict[tuple[str, str], float]
"""For each pair of cameras (a, b): the share of the points seen by a through which b sees."""

_REFUSED = 0.08
"""The robot does not act if a camera sees through more than this share of another one's points."""
_WARNED = 0.04
"""The user is warned if a camera sees through more than this share of another one's points."""
_HIGH = 0.012
"""Only points that are higher above the table than this are compared, in metres."""
_BEHIND = 0.012
"""A camera sees through a point if it measures more than this behind the point, in metres."""
_CLEARLY = 4.0
"""If there is more noise, `_HIGH` and `_BEHIND` are this many standard deviations of it."""
_BESIDE = 0.004
"""A camera does not see through a point if it sees something in front of it or at its depth within
this distance, in metres."""
_STEP = 4
"""Only the points of every `_STEP`th row and column of an image are compared."""
_LEAST = 50
"""Fewer points than this are not compared."""


def check_agreement(frames: Mapping[str, Frame], calibration: Calibration) -> list[str]:
    """Checks that no camera sees through what another one sees.

    Args:
        frames: the frames that `check_frames` returns.
        calibration: the cameras' calibration.

    Returns:
        Warnings, a sentence each.

    Raises:
        CalibrationError: a camera sees through more than 8 % of another camera's points.
    """
    shares = seen_through(frames, calibration)
    worst = max(shares.values(), default=0.0)
    if worst <= _WARNED:
        return []
    said = _said(shares)
    if worst <= _REFUSED:
        return [f"{said}: check their poses"]
    raise CalibrationError(f"{said}: {_hint(frames, calibration, shares)}")


def seen_through(frames: Mapping[str, Frame], calibration: Calibration) -> Shares:
    """Returns the share of each camera's points above the table through which each other camera
    sees. Pairs with too few common points are missing.

    The arguments are those of `check_agreement`.
    """
    cameras = calibration.cameras
    if len(cameras) < 2:
        return {}
    points, noise, nearest = {}, {}, {}
    for camera in cameras:
        depth = frames[camera.name].depth
        points[camera.name], noise[camera.name] = _points(camera, depth, calibration)
        nearest[camera.name] = _nearest(camera, depth)
    shares = {}
    for one, other in permutations(cameras, 2):
        behind = _behind(points[one.name], other, nearest[other.name])
        if len(behind) >= _LEAST:
            least = max(_BEHIND, _CLEARLY * noise[other.name])
            shares[one.name, other.name] = float((behind > least).mean())
    return shares


def _points(
    camera: BenchCamera, depth: NDArray[np.float32], calibration: Calibration
) -> tuple[Array, float]:
    """Returns a camera's points (n, 3) in the base frame that are in the workspace and above the
    table; and the standard deviation of the noise on the table. All are in metres."""
    rays, grid = camera.rays, calibration.grid
    u, v = (item[::_STEP, ::_STEP] for item in np.broadcast_arrays(rays.u, rays.v))
    z = depth[::_STEP, ::_STEP].astype(float)
    with np.errstate(invalid="ignore"):
        good = (z >= rays.min_depth) & (z <= rays.max_depth)
    z = z[good]
    points = np.stack([u[good] * z, v[good] * z, z], axis=-1)
    points = points @ camera.X_BC[:3, :3].T + camera.X_BC[:3, 3]
    points = points[calibration.contains(points[:, :2])]
    table = refit(points, np.array([0.0, 0.0, grid.z_min]))
    noise = 0.0 if table is None else table.noise
    bottom = grid.z_min if table is None else table.height(points[:, :2])
    high = points[:, 2] - bottom > max(_HIGH, _CLEARLY * noise)
    return np.asarray(points[high & (points[:, 2] < grid.z_max)]), noise


def _nearest(camera: BenchCamera, depth: NDArray[np.float32]) -> NDArray[np.float32]:
    """Returns, for each pixel (height, width), the least depth within `_BESIDE`, in metres. It is
    zero where depths are missing."""
    with np.errstate(invalid="ignore"):
        good = (depth >= camera.min_depth) & (depth <= camera.max_depth)
    known = np.where(good, depth, np.float32(0))
    if not good.any():
        return known
    reach = _BESIDE * camera.intrinsics.focal[0] / float(np.median(depth[good]))
    return np.asarray(ndimage.minimum_filter(known, 2 * max(1, round(reach)) + 1))


def _behind(points: Array, camera: BenchCamera, nearest: NDArray[np.float32]) -> Array:
    """Returns how far behind each point (n, 3) a camera sees, in metres; negative if it sees
    something in front of it. Points that the camera does not look at are left out."""
    lens, rays = camera.intrinsics, camera.rays
    local = (points - camera.X_BC[:3, 3]) @ camera.X_BC[:3, :3]
    local = local[local[:, 2] > camera.min_depth]
    x, y = local[:, 0] / local[:, 2], local[:, 1] / local[:, 2]
    inside = (x > rays.u.min()) & (x < rays.u.max()) & (y > rays.v.min()) & (y < rays.v.max())
    x, y, z = x[inside], y[inside], local[inside, 2]
    if lens.distortion:
        x, y = distort(x, y, lens.model, lens.distortion)
    col = np.rint(x * lens.focal[0] + lens.centre[0]).astype(int)
    row = np.rint(y * lens.focal[1] + lens.centre[1]).astype(int)
    height, width = nearest.shape
    inside = (row >= 0) & (row < height) & (col >= 0) & (col < width)
    seen = nearest[row[inside], col[inside]]
    return np.asarray((seen - z[inside])[seen > 0], dtype=float)


def _said(shares: Shares) -> str:
    (one, other), share = max(shares.items(), key=lambda item: item[1])
    return (
        f"cameras {one} and {other} contradict each other: {other} sees through "
        f"{100 * share:.0f} % of what {one} sees above the table"
    )


def _hint(frames: Mapping[str, Frame], calibration: Calibration, shares: Shares) -> str:
    """Returns a hint for the user: which changes would make the cameras agree."""
    agreeing = [
        text
        for text, changed in _suppositions(frames, calibration)
        if max(seen_through(changed, calibration).values(), default=1.0) <= _WARNED
    ]
    if agreeing:
        return " or ".join(["they would agree if " + agreeing[0], *agreeing[1:]])
    name = _suspect(shares)
    suspect = "one of their poses" if name is None else f"the pose of {name}"
    return (
        f"{suspect} is wrong in x, y or yaw, or something moved between the images; correct it "
        "with --check and a block, or with --calibrate"
    )


def _suspect(shares: Shares) -> str | None:
    """Returns the camera without which the others agree; None if there is no such camera."""
    for name in sorted({name for pair in shares for name in pair}):
        others = [share for pair, share in shares.items() if name not in pair]
        if others and max(others) <= _WARNED:
            return name
    return None


def _suppositions(
    frames: Mapping[str, Frame], calibration: Calibration
) -> Iterator[tuple[str, dict[str, Frame]]]:
    """Yields (description, frames) for each frequent mistake, with the mistake corrected."""
    mirrored = {
        name: dataclasses.replace(frame, depth=np.ascontiguousarray(frame.depth[:, ::-1]))
        for name, frame in frames.items()
    }
    yield "all images were mirrored left to right", mirrored
    for name in frames:
        changed = dict(frames) | {name: mirrored[name]}
        yield f"the image of {name} were mirrored left to right", changed
    for one, other in combinations(calibration.cameras, 2):
        if one.intrinsics.size == other.intrinsics.size:
            swapped = {one.name: frames[other.name], other.name: frames[one.name]}
            yield (
                f"the images of {one.name} and {other.name} were swapped",
                dict(frames) | swapped,
            )
