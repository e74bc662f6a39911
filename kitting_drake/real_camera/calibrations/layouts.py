"""Reads intrinsics of cameras from mappings: OpenCV's layout, ROS's CameraInfo, and our own."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from kitting_drake.common.errors import UserError
from kitting_drake.real_camera.calibrations.lens_distortion import (
    BROWN,
    EQUIDISTANT,
    checked_coefficients,
    known_model,
)
from kitting_drake.real_camera.calibrations.yaml_values import matrix, number, numbers, whole_number

_SKEW = 1e-3
"""The largest skew, in pixels, that counts as rounding."""
_MATRICES = ("camera_matrix", "k", "K", "Camera_Matrix")
_WIDTHS = ("width", "image_width", "image_Width")
_HEIGHTS = ("height", "image_height", "image_Height")
_DISTORTIONS = (
    *("distortion", "distortion_coefficients", "dist_coeffs", "d", "D"),
    "Distortion_Coefficients",
)
OWN_INTRINSICS = (
    *("fx", "fy", "cx", "cy", "image_size", *_WIDTHS, *_HEIGHTS),
    *("distortion_model", *_DISTORTIONS),
)
"""The fields of intrinsics in our own layout. Other fields of OpenCV and ROS are ignored."""


@dataclass(frozen=True)
class Intrinsics:
    """The intrinsics of a lens; pixel centres have whole-number image coordinates."""

    size: tuple[int, int]
    """The (width, height) of the images, in pixels."""
    focal: tuple[float, float]
    """The focal lengths (fx, fy), in pixels."""
    centre: tuple[float, float]
    """The principal point (cx, cy), in pixels."""
    distortion: tuple[float, ...] = ()
    """The distortion coefficients. For the default model they are k1, k2, p1, p2, k3, k4, k5, k6,
    s1, s2, s3, s4, in the order of OpenCV and ROS, or the first few of these."""
    model: str = BROWN
    """The distortion model, one of those in `lens_distortion.py`."""


def has_intrinsics(node: dict[str, Any]) -> bool:
    """Whether a mapping holds intrinsics in the layout of OpenCV, of ROS, or our own."""
    return any(key in node for key in ("fx", *_MATRICES))


def read_intrinsics(node: dict[str, Any], where: str) -> Intrinsics:
    """Reads the intrinsics in a mapping, in the layout of OpenCV, of ROS, or our own.

    Raises:
        UserError: a field is missing or invalid. The message names the field.
    """
    fx, fy, cx, cy = _read_pinhole(node, where)
    if "image_size" in node:
        refuse_two(node, ("image_size", *_WIDTHS, *_HEIGHTS), where)
        width, height = matrix(node["image_size"], 1, 2, f"{where}: image_size")[0].tolist()
    else:
        across, down = refuse_two(node, _WIDTHS, where), refuse_two(node, _HEIGHTS, where)
        if across is None or down is None:
            raise UserError(f"{where} has no image size: give width and height, in pixels")
        width, height = node[across], node[down]
    if fx <= 0 or fy <= 0:
        raise UserError(f"{where}: focal lengths must be positive, not {fx:g} and {fy:g}")
    size = whole_number(width, f"{where}: width"), whole_number(height, f"{where}: height")
    if not (0 <= cx <= size[0] and 0 <= cy <= size[1]):
        raise UserError(
            f"{where}: the principal point ({cx:g}, {cy:g}) is outside the image of "
            f"{size[0]}x{size[1]} pixels: are the intrinsics those of another resolution?"
        )
    _check_cropped(node, size, where)
    return Intrinsics(size, (fx, fy), (cx, cy), *_read_distortion(node, where))


def _read_pinhole(node: dict[str, Any], where: str) -> tuple[float, float, float, float]:
    """Returns fx, fy, cx, cy, in pixels."""
    if "fx" in node:
        fx, fy, cx, cy = (
            number(get(node, key, where), f"{where}: {key}") for key in ("fx", "fy", "cx", "cy")
        )
        return fx, fy, cx, cy
    key = refuse_two(node, _MATRICES, where)
    if key is None:
        raise UserError(f"{where} has no intrinsics: give fx, fy, cx, cy, or camera_matrix, or k")
    K = matrix(node[key], 3, 3, f"{where}: {key}")
    if K[1, 0] != 0 or not np.allclose(K[2], [0, 0, 1]):
        raise UserError(
            f"{where}: {key} must be fx 0 cx, 0 fy cy, 0 0 1: is it transposed, as MATLAB writes "
            "it?"
        )
    if abs(K[0, 1]) > _SKEW:
        raise UserError(
            f"{where}: the second number of {key} is a skew of {K[0, 1]:g} pixels, which is not "
            "modelled: calibrate without skew, or rectify the images"
        )
    return float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2])


def _check_cropped(node: dict[str, Any], size: tuple[int, int], where: str) -> None:
    """Raises UserError for a CameraInfo of binned or cropped images.

    The width, height and k in such a CameraInfo are those of the full image.
    """
    for key in ("binning_x", "binning_y"):
        if number(node.get(key, 0), f"{where}: {key}") > 1:
            raise UserError(
                f"{where}: {key} is {node[key]}, so the images are smaller than k assumes: give "
                "the intrinsics of the images as they arrive, without binning"
            )
    roi = node.get("roi")
    if not isinstance(roi, dict):
        return
    values = [
        number(roi.get(key, 0), f"{where}: roi.{key}")
        for key in ("x_offset", "y_offset", "width", "height")
    ]
    if any(values) and values != [0, 0, *size]:
        raise UserError(
            f"{where}: roi is {values[2]:g}x{values[3]:g} pixels at ({values[0]:g}, "
            f"{values[1]:g}), so the images are cropped: subtract the offset of roi from cx and "
            "cy, give its width and height, and remove roi"
        )


def _read_distortion(node: dict[str, Any], where: str) -> tuple[tuple[float, ...], str]:
    """Returns the distortion coefficients and their model."""
    model = known_model(node.get("distortion_model"), where)
    key = refuse_two(node, _DISTORTIONS, where)
    if key is None:
        if model == EQUIDISTANT:
            raise UserError(
                f"{where}: distortion_model equidistant needs four numbers in distortion"
            )
        return (), BROWN
    values = tuple(numbers(node[key], f"{where}: {key}").tolist())
    values = checked_coefficients(model, values, f"{where}: {key}")
    return values, model if values else BROWN


def get(node: dict[str, Any], key: str, where: str) -> Any:
    """Returns a field of a mapping; raises UserError if it is missing."""
    if key not in node:
        raise UserError(f"{where} lacks '{key}'")
    return node[key]


def refuse_two(node: dict[str, Any], keys: tuple[str, ...], where: str) -> str | None:
    """Returns which of several fields is given; None if none is. Raises UserError if several are
    given."""
    given = [key for key in keys if key in node]
    if len(given) > 1:
        raise UserError(f"{where} has {' and '.join(given)}: give one of them")
    return given[0] if given else None


def refuse_unknown(node: dict[str, Any], keys: tuple[str, ...], where: str) -> None:
    """Raises UserError for a field that is not among the known ones."""
    for key in node:
        if key not in keys:
            raise UserError(f"{where} has the unknown field '{key}': remove it")
