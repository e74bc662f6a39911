"""The images of a camera at one time, and checks of them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kitting_drake.common.errors import UserError
from kitting_drake.real_camera.calibrations.calibration import BenchCamera
from kitting_drake.real_camera.calibrations.layouts import Intrinsics


@dataclass(frozen=True)
class Frame:
    """The images of a camera at one time, with depth registered to colour."""

    color: NDArray[np.uint8]
    """Colours (height, width, 3) in red, green, blue."""
    depth: NDArray[np.float32]
    """Depths (height, width) along the optical axis, in metres; 0, infinity and NaN mean no
    depth."""


def check_frame(frame: Frame, camera: BenchCamera) -> Frame:
    """Checks the sizes and types of a frame, and returns it with contiguous depths.

    Raises:
        UserError: a size or type is wrong.
    """
    for what, image in (("colour", frame.color), ("depth", frame.depth)):
        check_size(
            image.shape, camera.intrinsics, camera, f"the {what} image of camera {camera.name}"
        )
    if frame.depth.ndim != 2:
        raise UserError(
            f"depth of camera {camera.name} must have the shape (height, width), not "
            f"{frame.depth.shape}"
        )
    if frame.color.ndim != 3 or frame.color.shape[2] < 3 or frame.color.dtype != np.uint8:
        raise UserError(
            f"colour of camera {camera.name} must be bytes of the shape (height, width, 3)"
        )
    if not np.issubdtype(frame.depth.dtype, np.floating):
        raise UserError(f"depth of camera {camera.name} must be floating-point numbers in metres")
    return Frame(frame.color, np.ascontiguousarray(frame.depth, np.float32))


def check_size(
    shape: tuple[int, ...], lens: Intrinsics, camera: BenchCamera, what: str, advice: str = ""
) -> None:
    """Raises UserError if an image does not have the calibrated size.

    Args:
        shape: (height, width, ...) of the image.
        lens: the image's lens.
        camera: the camera, which the message names.
        what: the name of the image in the message.
        advice: the end of the message.
    """
    width, height = lens.size
    if shape[:2] != (height, width):
        found = f"{shape[1]}x{shape[0]}" if len(shape) > 1 else f"{shape}"
        raise UserError(
            f"{what} is {found} pixels, but camera {camera.name} was calibrated at "
            f"{width}x{height}{advice}"
        )
