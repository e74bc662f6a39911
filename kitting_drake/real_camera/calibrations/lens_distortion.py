"""Lens distortion: OpenCV's Brown-Conrady model, its inverse, and the equidistant (fisheye)
model."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from kitting_drake.common.errors import UserError

Array = NDArray[np.float64]

BROWN = ""
"""OpenCV's model: k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4."""
INVERSE_BROWN = "inverse_brown_conrady"
"""Librealsense's model, whose polynomial maps distorted rays to undistorted ones: k1, k2, p1, p2,
k3."""
EQUIDISTANT = "equidistant"
"""The model of Kalibr, ROS and cv2.fisheye: k1, k2, k3, k4 of the angle from the optical axis."""
_MODELS = {
    **dict.fromkeys(("", "plumb_bob", "rational_polynomial", "radtan", "none"), BROWN),
    **dict.fromkeys(("brown_conrady", "brown", "opencv"), BROWN),
    INVERSE_BROWN: INVERSE_BROWN,
    **dict.fromkeys(("equidistant", "equi", "fisheye", "kannala_brandt4"), EQUIDISTANT),
}
_COUNTS = {BROWN: (0, 4, 5, 8, 12, 14), INVERSE_BROWN: (0, 5), EQUIDISTANT: (4,)}
_THIN_PRISM = 8
"""The number of coefficients in OpenCV's list before those of a thin prism."""
_TILT = 12
"""The number of coefficients in OpenCV's list before those of a tilted sensor."""
_UNDONE = 1e-4
"""The largest accepted error, at depth 1, of a ray that is undistorted and then distorted again."""
_WIDEST = np.deg2rad(85)
"""The largest angle between the optical axis and an undistorted ray, in radians."""


def known_model(name: object, where: str) -> str:
    """Returns the distortion model that has a given name in ROS, kalibr or OpenCV.

    Raises:
        UserError: this module has no model of that name.
    """
    key = str(name or "").strip().lower().replace(" ", "_").replace("-", "_")
    if key not in _MODELS:
        raise UserError(
            f"{where}: distortion_model {name} is not supported: rectify the images, and give "
            "distortion: [] and no distortion_model"
        )
    return _MODELS[key]


def checked_coefficients(model: str, values: tuple[float, ...], where: str) -> tuple[float, ...]:
    """Returns the coefficients. Drops those of a thin prism or a tilted sensor if they are zero.

    If all coefficients are zero, all are dropped. The equidistant model keeps its zeros.

    Args:
        model: one of this module's models.
        values: the coefficients.
        where: the beginning of the error message.

    Raises:
        UserError: the number of coefficients is wrong, or they describe a tilted sensor.
    """
    if model != EQUIDISTANT and not any(values):
        return ()
    if len(values) not in _COUNTS[model]:
        counts = [str(count) for count in _COUNTS[model]]
        told = " or ".join([", ".join(counts[:-1]), counts[-1]] if counts[1:] else counts)
        raise UserError(f"{where} must hold {told} numbers, not {len(values)}")
    if any(values[_TILT:]):
        raise UserError(
            f"{where} has a tilted sensor (numbers 13 and 14), which is not modelled: calibrate "
            "without CALIB_TILTED_MODEL, or rectify the images and give distortion: []"
        )
    if len(values) > _THIN_PRISM:
        values = values[: _TILT if any(values[_THIN_PRISM:]) else _THIN_PRISM]
    return values


def distort(x: Array, y: Array, model: str, values: tuple[float, ...]) -> tuple[Array, Array]:
    """Applies a lens's distortion to undistorted rays (x, y, 1); returns the new x and y at depth
    1."""
    if model == EQUIDISTANT:
        radius = np.hypot(x, y)
        angle = np.arctan(radius)
        scale = np.where(radius > 0, _bent(angle, values) / np.where(radius > 0, radius, 1), 1)
        return x * scale, y * scale
    if model == INVERSE_BROWN:
        return _undo_brown(x, y, values)[:2]
    return _brown(x, y, values)


def undistort(
    u: Array, v: Array, model: str, values: tuple[float, ...], name: str
) -> tuple[Array, Array]:
    """Returns x and y of the undistorted rays (x, y, 1) whose distorted rays are (u, v, 1).

    Raises:
        UserError: the distortion cannot be inverted at some point. The message names the camera.
    """
    if model == INVERSE_BROWN:
        return _brown(u, v, values)
    if model == EQUIDISTANT:
        x, y, missed = _undo_equidistant(u, v, values)
    else:
        x, y, missed = _undo_brown(u, v, values)
    if not (missed < _UNDONE).all():
        order = "k1, k2, k3, k4" if model == EQUIDISTANT else "k1, k2, p1, p2, k3"
        raise UserError(
            f"the distortion of camera {name} cannot be inverted over the whole image: check the "
            f"order of its coefficients ({order}), or rectify the images"
        )
    return x, y


def _brown(x: Array, y: Array, values: tuple[float, ...]) -> tuple[Array, Array]:
    radial, along, down = _factors(x, y, values)
    return x * radial + along, y * radial + down


def _factors(x: Array, y: Array, values: tuple[float, ...]) -> tuple[Array, Array, Array]:
    k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4 = (*values, *(0.0,) * (12 - len(values)))
    square = x * x + y * y
    radial = (1 + square * (k1 + square * (k2 + square * k3))) / (
        1 + square * (k4 + square * (k5 + square * k6))
    )
    along = 2 * p1 * x * y + p2 * (square + 2 * x * x) + square * (s1 + square * s2)
    down = p1 * (square + 2 * y * y) + 2 * p2 * x * y + square * (s3 + square * s4)
    return radial, along, down


def _undo_brown(u: Array, v: Array, values: tuple[float, ...]) -> tuple[Array, Array, Array]:
    """Returns the undistorted rays x, y and their errors, by the iteration of
    cv2.undistortPoints."""
    x, y = u.copy(), v.copy()
    with np.errstate(all="ignore"):
        for _ in range(30):
            radial, along, down = _factors(x, y, values)
            x, y = (u - along) / radial, (v - down) / radial
        again_x, again_y = _brown(x, y, values)
        missed = np.hypot(again_x - u, again_y - v)
    return x, y, missed


def _bent(angle: Array, values: tuple[float, ...]) -> Array:
    k1, k2, k3, k4 = values
    square = angle * angle
    return angle * (1 + square * (k1 + square * (k2 + square * (k3 + square * k4))))


def _undo_equidistant(u: Array, v: Array, values: tuple[float, ...]) -> tuple[Array, Array, Array]:
    """Returns the undistorted rays x, y and their errors.

    Newton's method finds the angle from the optical axis.
    """
    k1, k2, k3, k4 = values
    bent = np.hypot(u, v)
    angle = bent.copy()
    with np.errstate(all="ignore"):
        for _ in range(30):
            square = angle * angle
            slope = 1 + square * (3 * k1 + square * (5 * k2 + square * (7 * k3 + square * 9 * k4)))
            angle = angle - (_bent(angle, values) - bent) / slope
        missed = np.abs(_bent(angle, values) - bent)
        missed = np.where((angle >= 0) & (angle < _WIDEST), missed, np.inf)
        scale = np.where(bent > 0, np.tan(angle) / np.where(bent > 0, bent, 1), 1)
    return u * scale, v * scale, missed
