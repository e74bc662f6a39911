"""Reads a photo and the EXIF data on its lens."""

import math
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import ExifTags, Image, ImageOps

from kitting_drake.common.errors import UserError

_DIAGONAL_35MM = math.hypot(36, 24)
ASSUMED_FOCAL_35MM = 26.0
"""The assumed 35 mm equivalent focal length of a phone; most main lenses have 24 to 28 mm."""
_LEAST_SIDE = 500
_MOST_PIXELS = 110_000_000


@dataclass(frozen=True)
class Photo:
    """A photo, turned upright."""

    path: Path
    pixels: NDArray[np.uint8]
    """The RGB pixels (rows, columns, 3)."""
    focal_35mm: float | None
    """The 35 mm equivalent focal length in the EXIF data, in mm; None if there is none."""
    cropped: bool = False
    """Whether the photo's aspect ratio differs from the one in the EXIF data."""

    @property
    def size(self) -> tuple[int, int]:
        """The width and height in pixels."""
        return self.pixels.shape[1], self.pixels.shape[0]

    @property
    def center(self) -> NDArray[np.float64]:
        """The middle of the photo in pixels, where whole numbers are pixel centres."""
        return (np.array(self.size) - 1) / 2

    def focal_px(self, focal_35mm: float) -> float:
        """Converts a 35 mm equivalent focal length to pixels, by the image's diagonal (CIPA
        DCG-001)."""
        return focal_35mm / _DIAGONAL_35MM * math.hypot(*self.size)


def read_photo(path: Path) -> Photo:
    """Reads a photo, turned upright as its EXIF says.

    Raises:
        UserError: there is no such file, it is not a picture, or it is too small.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            with Image.open(path) as opened:
                if opened.width * opened.height > _MOST_PIXELS:
                    raise UserError(
                        f"{path} has {opened.width} x {opened.height} pixels, more than "
                        f"{_MOST_PIXELS / 1000000.0:.0f} million: reduce its size"
                    )
                inner = dict(opened.getexif().get_ifd(ExifTags.IFD.Exif))
                upright = ImageOps.exif_transpose(opened)
                stored = (opened.width, opened.height)
                pixels = np.asarray(_rgb(upright))
    except UserError:
        raise
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        if not path.exists():
            raise UserError(f"there is no file {path}: give a photo (JPEG or PNG)") from error
        raise UserError(
            f"{path} cannot be read as a photo: give a JPEG or a PNG (convert a HEIC first)"
        ) from error
    if min(pixels.shape[:2]) < _LEAST_SIDE:
        raise UserError(
            f"{path} has {pixels.shape[1]} x {pixels.shape[0]} pixels: give a photo with at least "
            f"{_LEAST_SIDE} pixels on each side"
        )
    tags = ExifTags.Base
    focal = _number(inner.get(tags.FocalLengthIn35mmFilm))
    taken = (_number(inner.get(tags.ExifImageWidth)), _number(inner.get(tags.ExifImageHeight)))
    cropped = False
    if taken[0] and taken[1]:
        cropped = abs(math.log(taken[0] / taken[1] * stored[1] / stored[0])) > 0.01
    return Photo(path, pixels, focal if focal and 5 <= focal <= 400 else None, cropped)


def _rgb(picture: Image.Image) -> Image.Image:
    """Converts a picture to RGB with 8 bits; transparent pixels become white."""
    if picture.mode.startswith("I"):
        # Pillow would clip gray values of 16 bits instead of scaling them.
        picture = Image.fromarray((np.asarray(picture) >> 8).clip(0, 255).astype(np.uint8))
    if picture.has_transparency_data:
        clear = picture.convert("RGBA")
        picture = Image.alpha_composite(Image.new("RGBA", clear.size, "white"), clear)
    return picture.convert("RGB")


def _number(value: Any) -> float | None:
    try:
        number = float(value)
    except (TypeError, ValueError, ZeroDivisionError):
        return None
    return number if math.isfinite(number) and number > 0 else None


def linear(pixels: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Converts sRGB pixels of 8 bits to linear light from 0 to 1."""
    codes = np.arange(256, dtype=np.float32) / 255
    table = np.where(codes <= 0.04045, codes / 12.92, ((codes + 0.055) / 1.055) ** 2.4)
    return table.astype(np.float32)[pixels]
