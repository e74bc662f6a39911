"""Frames of real cameras from files: colour as PNG, depth as 16-bit PNG or .npy."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from tokenize import TokenError

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from kitting_drake.common.errors import UserError
from kitting_drake.real_camera.calibrations.calibration import BenchCamera, Calibration

_COLOUR_NAMES = ("color", "colour", "rgb")
_COLOUR_ENDINGS = (".png", ".jpg", ".jpeg")
_DEPTH_ENDINGS = (".npy", ".png")
_SIXTEEN_BIT = ("I;16", "I;16B", "I")
_DAMAGED = (OSError, SyntaxError)
"""Pillow's exceptions for a damaged file; SyntaxError is for a PNG with a broken chunk."""


@dataclass(frozen=True)
class Frame:
    """The images of a camera at one time, with depth registered to colour."""

    color: NDArray[np.uint8]
    """(height, width, 3): red, green, blue."""
    depth: NDArray[np.float32]
    """(height, width) along the optical axis, in metres; 0, infinity and NaN mean no depth."""


def read_frames(paths: Sequence[Path], calibration: Calibration) -> dict[str, Frame]:
    """The frames of all cameras, by name.

    Args:
        paths: folders, or pairs of a colour and a depth file, one per camera in the order of the
            calibration. For a camera NAME, a folder holds `NAME_color.png` and `NAME_depth.png` (or
            `.npy`), or a folder NAME with `color.png` and `depth.png`. A single camera may also
            have just `color.png` and `depth.png`.
        calibration: of the cameras.

    Raises:
        UserError: a file is missing, unreadable, or not of the calibration's size.
    """
    for path in paths:
        if not path.exists():
            raise UserError(f"there is no frame {path}")
    folders = [path for path in paths if path.is_dir()]
    pairs = list(_pairs([path for path in paths if not path.is_dir()]))
    names = [camera.name for camera in calibration.cameras]
    if pairs and (folders or len(pairs) != len(names)):
        raise UserError(
            f"the calibration has {len(names)} cameras ({', '.join(names)}): give a pair of colour "
            "and depth for each, in this order, or a folder"
        )
    frames = {}
    for number, camera in enumerate(calibration.cameras):
        color, depth = pairs[number] if pairs else _find(folders, camera.name, len(names) == 1)
        frames[camera.name] = Frame(_read_color(color, camera), _read_depth(depth, camera))
    return frames


def check_frame(frame: Frame, camera: BenchCamera) -> Frame:
    """Checks the sizes and types of a frame that did not come from files.

    Raises:
        UserError: one is wrong.
    """
    for what, image in (("colour", frame.color), ("depth", frame.depth)):
        _check_size(image.shape, camera, f"the {what} image of camera {camera.name}")
    if frame.depth.ndim != 2:
        raise UserError(
            f"depth of camera {camera.name} must be (height, width), not {frame.depth.shape}"
        )
    if frame.color.ndim != 3 or frame.color.shape[2] < 3 or frame.color.dtype != np.uint8:
        raise UserError(f"colour of camera {camera.name} must be (height, width, 3) of bytes")
    if not np.issubdtype(frame.depth.dtype, np.floating):
        raise UserError(f"depth of camera {camera.name} must be metres in floating point")
    return Frame(frame.color, np.ascontiguousarray(frame.depth, np.float32))


def _pairs(files: Sequence[Path]) -> Iterator[tuple[Path, Path]]:
    """(colour, depth) from files that come in pairs, in either order."""
    if len(files) % 2:
        raise UserError("frames that are files come in pairs: a colour image and a depth image")
    for first, second in zip(files[::2], files[1::2], strict=True):
        depths = [_is_depth(path) for path in (first, second)]
        if depths == [False, True]:
            yield first, second
        elif depths == [True, False]:
            yield second, first
        else:
            both = "depth" if all(depths) else "colour"
            raise UserError(f"{first} and {second} are both {both}: give colour and depth in pairs")


def _is_depth(path: Path) -> bool:
    if path.suffix == ".npy":
        return True
    with _open(path) as image:
        return image.mode in _SIXTEEN_BIT


def _find(folders: Sequence[Path], name: str, alone: bool) -> tuple[Path, Path]:
    """The files of a camera in folders: (colour, depth)."""
    stems = [f"{name}_", f"{name}/", *([""] if alone else [])]
    found: list[Path] = []
    for wanted, endings in ((_COLOUR_NAMES, _COLOUR_ENDINGS), (("depth",), _DEPTH_ENDINGS)):
        candidates = [
            folder / f"{stem}{word}{ending}"
            for folder in folders
            for stem in stems
            for word in wanted
            for ending in endings
        ]
        existing = [path for path in candidates if path.is_file()]
        if len(existing) != 1:
            shown = f"{name}_{wanted[0]}{endings[0]}"
            reason = (
                f"both {existing[0].name} and {existing[1].name}"
                if existing
                else f"neither {shown} nor {name}/{wanted[0]}{endings[0]}"
            )
            places = ", ".join(map(str, folders))
            raise UserError(f"camera {name}: {places} holds {reason}: there must be one image")
        found.append(existing[0])
    return found[0], found[1]


def _open(path: Path) -> Image.Image:
    try:
        return Image.open(path)
    except OSError as error:
        reason = error.strerror or "it is not an image"
        raise UserError(f"cannot read {path}: {reason}") from error


def _read_color(path: Path, camera: BenchCamera) -> NDArray[np.uint8]:
    with _open(path) as image:
        if image.mode in _SIXTEEN_BIT:
            raise UserError(f"{path} has 16 bits per pixel, but colour has 8: is this the depth?")
        try:
            data = np.asarray(image.convert("RGB"))
        except _DAMAGED as error:
            raise UserError(f"{path} is damaged: {error}") from error
    _check_size(data.shape, camera, str(path))
    return data


def _read_depth(path: Path, camera: BenchCamera) -> NDArray[np.float32]:
    if path.suffix == ".npy":
        try:
            data = np.load(path, allow_pickle=False)
        except (OSError, ValueError, EOFError, SyntaxError, TokenError) as error:
            raise UserError(
                f"cannot read {path}: it is not a complete .npy file of numbers"
            ) from error
    else:
        with _open(path) as image:
            if image.mode not in _SIXTEEN_BIT:
                raise UserError(f"{path} is not a depth image, with one channel of 16 bits")
            try:
                data = np.asarray(image)
            except _DAMAGED as error:
                raise UserError(f"{path} is damaged: {error}") from error
    if not isinstance(data, np.ndarray):
        raise UserError(f"{path} is an archive of arrays (.npz): save the depth alone as .npy")
    if data.ndim == 3 and data.shape[2] == 1:
        data = data[:, :, 0]
    _check_size(data.shape, camera, str(path))
    if data.ndim != 2:
        raise UserError(f"{path} must have one channel, not {data.shape[2]}")
    if np.issubdtype(data.dtype, np.integer):
        return (data * camera.depth_scale).astype(np.float32)
    if not np.issubdtype(data.dtype, np.floating):
        raise UserError(f"{path} must hold numbers, not {data.dtype}")
    return np.ascontiguousarray(data, np.float32)


def _check_size(shape: tuple[int, ...], camera: BenchCamera, what: str) -> None:
    width, height = camera.intrinsics.size
    if shape[:2] != (height, width):
        found = f"{shape[1]}x{shape[0]}" if len(shape) > 1 else f"{shape}"
        raise UserError(
            f"{what} is {found} pixels, but camera {camera.name} was calibrated at {width}x{height}"
        )
