"""Computes the pose of a camera above a board, from the board's corners in its images."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from kitting_drake.common.errors import UserError
from kitting_drake.common.extras import import_extra
from kitting_drake.real_camera.calibrations.layouts import Intrinsics
from kitting_drake.real_camera.calibrations.lens_distortion import undistort
from kitting_drake.real_camera.calibrations.pose_values import assembled
from kitting_drake.real_camera.frames.point_clouds import project_points

Array = NDArray[np.float64]

_STEEPEST = math.radians(70)
"""The largest angle, in radians, between a board's normal and the line of sight; beyond it the
corners are poor."""
_SAME = math.radians(1)
"""The angle in radians below which two poses count as the same."""
_CLEARER = 16.0
"""The sums of the corners' squared errors of two poses must differ by at least this multiple of the
error variance of one corner. Otherwise the pose is ambiguous."""
_LIKELY = 0.2
"""The test for ambiguous poses assumes that the corners' error is at least this, in pixels."""
_NOISE = 0.05
"""`BoardFit.focal_error` assumes that the corners' error is at least this, in pixels."""
_WORST = 3.0
"""If the error of the corners exceeds this, in pixels, the intrinsics are probably of another lens,
or the board moved."""


@dataclass(frozen=True)
class BoardFit:
    """A camera's pose computed from a board, and how well it explains the corners."""

    X_KM: Array
    """The pose (4, 4) of the board's frame M in the optical frame K."""
    rms: float
    """The root mean square error of the corners, in pixels."""
    angle: float
    """The angle between the board's normal and the line of sight to its middle, in radians."""
    focal_ratio: float
    """The corners fit best if the focal length is multiplied by this."""
    focal_error: float
    """The standard deviation of `focal_ratio`."""


def fit_board(points: Array, pixels: Array, lens: Intrinsics, where: str) -> BoardFit:
    """Fits the pose of a board to its corners.

    Args:
        points: (n, 3) the corners in the board's frame, in metres.
        pixels: (n, 2) the columns and rows of the corners; pixel centres have whole numbers.
        lens: the image's lens.
        where: the beginning of error messages.

    Raises:
        UserError: the corners do not fit, lie on a line or are seen too obliquely, or two poses
            explain them equally well.
    """
    starts = _starts(points, pixels, lens, where)
    fits = sorted(
        (_refined(start, points, pixels, lens) for start in starts), key=lambda fit: fit[1]
    )
    X, rms = fits[0]
    if rms > _WORST:
        raise UserError(
            f"{where}: the corners have a root mean square error of {rms:.1f} pixels: check the "
            "intrinsics, the board's sizes, and that neither board nor camera moved"
        )
    for other, other_rms in fits[1:]:
        turned = Rotation.from_matrix(other[:3, :3].T @ X[:3, :3]).magnitude()
        excess = len(points) * (other_rms**2 - rms**2)
        if turned > _SAME and excess < _CLEARER * max(rms, _LIKELY) ** 2:
            raise UserError(
                f"{where}: two poses of the board, {math.degrees(turned):.0f} degrees apart, "
                "explain the image equally well: move the board closer, use a larger one, or view "
                "it more from the side"
            )
    middle = X[:3, :3] @ points.mean(axis=0) + X[:3, 3]
    # Change the sign, because the board's z points up and the line of sight points down.
    cosine = -(middle @ X[:3, 2]) / np.linalg.norm(middle)
    angle = float(np.arccos(np.clip(cosine, -1, 1)))
    if angle > _STEEPEST:
        raise UserError(
            f"{where}: the board is seen at {math.degrees(angle):.0f} degrees from its normal: "
            f"view it at no more than {math.degrees(_STEEPEST):.0f} degrees"
        )
    return BoardFit(X, rms, angle, *_focal_ratio(X, points, pixels, lens))


def _starts(points: Array, pixels: Array, lens: Intrinsics, where: str) -> list[Array]:
    """Returns the two poses that may explain the image of a plane."""
    cv2 = import_extra("cv2", purpose="--calibrate", extra="camera")
    u, v = ((pixels - lens.centre) / lens.focal).T
    if lens.distortion:
        u, v = undistort(u.copy(), v.copy(), lens.model, lens.distortion, where)
    rays = np.ascontiguousarray(np.stack([u, v], axis=-1))
    try:
        _, turns, shifts, _ = cv2.solvePnPGeneric(
            points, rays, np.eye(3), None, flags=cv2.SOLVEPNP_IPPE
        )
    except cv2.error as error:
        raise UserError(f"{where}: the corners lie on a line: show more of the board") from error
    return [
        assembled(Rotation.from_rotvec(turn.ravel()).as_matrix(), shift.ravel())
        for turn, shift in zip(turns, shifts, strict=True)
    ]


def _refined(start: Array, points: Array, pixels: Array, lens: Intrinsics) -> tuple[Array, float]:
    """Returns the pose (4, 4) that minimizes the corners' error, and its root mean square error in
    pixels. The search begins at the pose `start`."""
    first = np.concatenate([Rotation.from_matrix(start[:3, :3]).as_rotvec(), start[:3, 3]])
    found = least_squares(_errors, first, args=(points, pixels, lens), method="lm", x_scale="jac")
    X = assembled(Rotation.from_rotvec(found.x[:3]).as_matrix(), found.x[3:6])
    return X, float(np.sqrt(2 * found.cost / len(points)))


def _errors(values: Array, points: Array, pixels: Array, lens: Intrinsics) -> Array:
    """Returns the errors (2 n,) of the corners in pixels, for a pose.

    The values are a rotation vector in radians, a position in metres, and optionally the logarithm
    of the focal ratio.
    """
    seen = points @ Rotation.from_rotvec(values[:3]).as_matrix().T + values[3:6]
    seen[:, 2] = np.maximum(seen[:, 2], 1e-3)
    found = np.stack(project_points(seen, lens), axis=-1)
    if len(values) > 6:
        found = (found - lens.centre) * np.exp(values[6]) + lens.centre
    return np.asarray(found - pixels, dtype=float).ravel()


def _focal_ratio(X: Array, points: Array, pixels: Array, lens: Intrinsics) -> tuple[float, float]:
    """Returns the factor by which the focal length must be multiplied to fit the corners best, and
    the factor's standard deviation."""
    first = np.concatenate([Rotation.from_matrix(X[:3, :3]).as_rotvec(), X[:3, 3], [0.0]])
    if 2 * len(points) <= len(first):
        return 1.0, math.inf
    found = least_squares(_errors, first, args=(points, pixels, lens), method="lm", x_scale="jac")
    noise = max(2 * found.cost / (2 * len(points) - len(first)), _NOISE**2)
    try:
        deviation = math.sqrt(noise * np.linalg.inv(found.jac.T @ found.jac)[6, 6])
    except (np.linalg.LinAlgError, ValueError):
        return 1.0, math.inf
    return float(np.exp(found.x[6])), deviation
