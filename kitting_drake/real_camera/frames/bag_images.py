"""Converts ROS messages to images."""

from __future__ import annotations

import io
import sys
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from kitting_drake.common.errors import UserError

_COLOURS = {"rgb8": "RGB", "rgba8": "RGB", "bgr8": "BGR", "bgra8": "BGR", "8UC3": "", "mono8": "L"}
_DEPTHS: dict[str, np.dtype[Any]] = {
    "16UC1": np.dtype("u2"),
    "mono16": np.dtype("u2"),
    "32FC1": np.dtype("f4"),
}
_PNG = b"\x89PNG"


def color_of_message(body: Any, where: str) -> NDArray[np.uint8]:
    """Returns an image (height, width, 3) in red, green, blue, from an Image or a CompressedImage.

    Raises:
        UserError: the encoding cannot be read. The message begins with `where`.
    """
    if hasattr(body, "format"):
        with _decoded(bytes(body.data), where) as image:
            return np.asarray(image.convert("RGB"))
    order = _COLOURS.get(body.encoding)
    if not order:
        raise UserError(
            f"{where} has the encoding {body.encoding}: convert it to rgb8, e.g. by image_proc"
        )
    channels = 4 if "a" in body.encoding else len(order)
    data = _pixels(body, np.dtype("u1"), channels, where)[:, :, : len(order)]
    if order == "BGR":
        data = data[:, :, ::-1]
    return np.ascontiguousarray(np.broadcast_to(data, (*data.shape[:2], 3)))


def depth_of_message(body: Any, where: str) -> NDArray[Any]:
    """Returns depth (height, width), as floats in metres or as integers in steps of `depth_scale`.

    Raises:
        UserError: the encoding cannot be read. The message begins with `where`.
    """
    if not hasattr(body, "format"):
        if body.encoding not in _DEPTHS:
            raise UserError(
                f"{where} has the encoding {body.encoding}: depth must be 16UC1 or 32FC1"
            )
        return _pixels(body, np.dtype(_DEPTHS[body.encoding]), 1, where)[:, :, 0]
    data = bytes(body.data)
    if "32FC1" in body.format:
        raise UserError(
            f"{where} has floats that were rounded by compression: record the Image instead"
        )
    # A compressed depth image has a header of twelve bytes before the PNG.
    start = data.find(_PNG, 0, 16)
    if start < 0:
        raise UserError(f"{where} is compressed as {body.format}: depth must be a PNG of 16UC1")
    with _decoded(data[start:], where) as image:
        if not image.mode.startswith("I"):
            raise UserError(f"{where} is compressed to 8 bits: depth must have 16 bits")
        return np.asarray(image)


def _pixels(body: Any, kind: np.dtype[Any], channels: int, where: str) -> NDArray[Any]:
    """Returns the pixels (height, width, channels) in the bytes of an Image."""
    big = bool(body.is_bigendian)
    kind = kind.newbyteorder(">" if big else "<")
    height, width, step = int(body.height), int(body.width), int(body.step)
    data, row = bytes(body.data), width * channels * kind.itemsize
    if height < 1 or step < row or len(data) < height * step:
        raise UserError(
            f"{where} is not complete: it has {len(data)} bytes for {width}x{height} pixels"
        )
    rows = np.frombuffer(data, np.uint8, height * step).reshape(height, step)[:, :row]
    pixels = np.ascontiguousarray(rows).view(kind).reshape(height, width, channels)
    native = kind.newbyteorder("<" if sys.byteorder == "little" else ">")
    return pixels.astype(native)


def _decoded(data: bytes, where: str) -> Image.Image:
    try:
        image = Image.open(io.BytesIO(data))
        image.load()
    except (OSError, SyntaxError, ValueError) as error:
        raise UserError(f"{where} is not a complete JPEG or PNG") from error
    return image
