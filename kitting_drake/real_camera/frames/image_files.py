"""Reads colour and depth from images (PNG, JPEG, TIFF, EXR) and from NumPy's arrays."""

from __future__ import annotations

import zipfile
import zlib
from pathlib import Path
from tokenize import TokenError
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from kitting_drake.common.errors import UserError
from kitting_drake.common.extras import import_extra

COLOUR_NAMES = ("color", "colour", "rgb")
COLOUR_ENDINGS = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff")
DEPTH_ENDINGS = (".npy", ".png", ".tif", ".tiff", ".exr")
_ALWAYS_DEPTH = (".npy", ".exr")
_DEPTH_MODES = ("I;16", "I;16B", "I", "F")
_DAMAGED = (OSError, SyntaxError, ValueError)
"""Pillow's exceptions for a damaged file. SyntaxError is raised for a PNG with a broken chunk."""
_NOT_AN_IMAGE = (*_DAMAGED, TypeError, KeyError, Image.DecompressionBombError)
_NOT_NUMPY = (
    *(OSError, ValueError, EOFError, SyntaxError, TokenError, KeyError, TypeError),
    *(zipfile.BadZipFile, zlib.error, NotImplementedError, MemoryError),
)
"""NumPy's exceptions for a damaged file."""
_DEPTH_CHANNELS = ("z", "depth", "v", "y")
"""The possible names of an EXR's depth channel, after the last dot. Blender writes Depth.V or
Depth.Z."""


def is_depth(path: Path) -> bool:
    """Whether an image is of depth: floats, or more than 8 bits.

    Raises:
        UserError: the file is not an image.
    """
    if path.suffix.lower() in _ALWAYS_DEPTH:
        return True
    with _open(path) as image:
        return image.mode in _DEPTH_MODES


def read_color(path: Path) -> NDArray[np.uint8]:
    """Reads the colours (height, width, 3) of an image: red, green, blue.

    Raises:
        UserError: the file is damaged, or does not have 8 bits per channel.
    """
    with _open(path) as image:
        if image.mode in _DEPTH_MODES:
            bits = "32" if image.mode == "F" else "16"
            raise UserError(
                f"{path} has {bits} bits per channel, but colour has 8: is this the depth?"
            )
        try:
            return np.asarray(image.convert("RGB"))
        except _DAMAGED as error:
            raise UserError(f"{path} is damaged: {error}") from error


def read_depth(path: Path, depth_scale: float) -> NDArray[np.float32]:
    """Reads depths (height, width), in metres.

    Args:
        path: the file of the image or array.
        depth_scale: the metres per step of an image or array of whole numbers.

    Raises:
        UserError: the file is damaged, or does not hold depths.
        MachineError: a library is missing.
    """
    ending = path.suffix.lower()
    if ending == ".npy":
        data = _load(path)
        if not isinstance(data, np.ndarray):
            raise UserError(f"{path} is an archive of arrays (.npz): save the depth alone as .npy")
    elif ending == ".exr":
        data = _read_exr(path)
    else:
        data = _read_depth_image(path)
    return depth_of_array(data, depth_scale, str(path))


def read_npz(path: Path, depth_scale: float) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    """Reads an archive with the arrays `color` (or `colour`, or `rgb`) and `depth`.

    Raises:
        UserError: an array is missing, damaged, or of a wrong type.
    """
    archive = _load(path)
    if isinstance(archive, np.ndarray):
        raise UserError(f"{path} is a single array: rename it to .npy")
    with archive:
        names = [name for name in COLOUR_NAMES if name in archive.files]
        if len(names) != 1 or "depth" not in archive.files:
            held = ", ".join(archive.files) or "nothing"
            raise UserError(f"{path} must hold the arrays color and depth, not {held}")
        try:
            color, depth = archive[names[0]], archive["depth"]
        except _NOT_NUMPY as error:
            raise UserError(f"{path} is damaged: {error}") from error
    if color.dtype != np.uint8 or color.ndim != 3 or color.shape[2] not in (3, 4):
        raise UserError(
            f"{path}: {names[0]} must be bytes of shape (height, width, 3), not {color.shape} of "
            f"{color.dtype}"
        )
    color = np.ascontiguousarray(color[:, :, :3])
    return color, depth_of_array(depth, depth_scale, f"{path}: depth")


def depth_of_array(data: NDArray[Any], depth_scale: float, what: str) -> NDArray[np.float32]:
    """Converts floats in metres, or integers in units of `depth_scale`, to depths (height, width)
    in metres.

    Raises:
        UserError: the array has another shape or type.
    """
    if data.ndim == 3 and data.shape[2] == 1:
        data = data[:, :, 0]
    if data.ndim == 3:
        raise UserError(f"{what} must have one channel, not {data.shape[2]}")
    if data.ndim != 2:
        raise UserError(f"{what} must have rows and columns, not the shape {data.shape}")
    if np.issubdtype(data.dtype, np.integer):
        return (data * depth_scale).astype(np.float32)
    if not np.issubdtype(data.dtype, np.floating):
        raise UserError(f"{what} must hold numbers, not {data.dtype}")
    return np.ascontiguousarray(data, np.float32)


def _open(path: Path) -> Image.Image:
    try:
        image = Image.open(path)
        count = getattr(image, "n_frames", 1)
    except _NOT_AN_IMAGE as error:
        reason = getattr(error, "strerror", None) or "it is not an image"
        if path.suffix.lower() in (".tif", ".tiff") and reason == "it is not an image":
            reason += " of 8 or 16 bits, or of 32-bit floats"
        raise UserError(f"cannot read {path}: {reason}") from error
    if count > 1:
        image.close()
        raise UserError(f"{path} holds {count} images: save a single image")
    return image


def _load(path: Path) -> Any:
    try:
        return np.load(path, allow_pickle=False)
    except _NOT_NUMPY as error:
        what = f"a complete {path.suffix} file of numbers"
        raise UserError(f"cannot read {path}: it is not {what}") from error


def _read_depth_image(path: Path) -> NDArray[Any]:
    with _open(path) as image:
        if image.mode not in _DEPTH_MODES:
            raise UserError(
                f"{path} is not a depth image: give one channel of 16 bits or of 32-bit floats"
            )
        try:
            return np.asarray(image)
        except _DAMAGED as error:
            raise UserError(f"{path} is damaged: {error}") from error


def _read_exr(path: Path) -> NDArray[Any]:
    """Reads the depth channel of an EXR image."""
    purpose = "reading EXR images"
    openexr = import_extra("OpenEXR", purpose=purpose, extra="camera")
    if not path.is_file():
        raise UserError(f"cannot read {path}: there is no such file")
    try:
        channels = {
            name: np.asarray(channel.pixels)
            for name, channel in openexr.File(str(path), separate_channels=True).channels().items()
        }
    except (RuntimeError, ValueError, OSError) as error:
        raise UserError(f"cannot read {path}: it is not a complete EXR image") from error
    named = [name for name in channels if name.lower().rpartition(".")[2] in _DEPTH_CHANNELS]
    if len(channels) == 1:
        named = list(channels)
    elif not named and {"R", "G", "B"} <= set(channels):
        # Some programs write a grey image in three equal channels.
        equal = all(np.array_equal(channels["R"], channels[c], equal_nan=True) for c in "GB")
        named = ["R"] if equal else []
    if len(named) != 1:
        raise UserError(
            f"{path} has the channels {', '.join(channels)}: write depth alone, in the channel Z"
        )
    return channels[named[0]]
