"""Says which part of the workspace is the table: polygons in the base frame, and an image mask."""

from __future__ import annotations

import base64
import binascii
import hashlib
import io
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from kitting_drake.common.errors import UserError
from kitting_drake.real_camera.calibrations.yaml_values import number
from systems.signals import PixelGrid

Polygon = tuple[tuple[float, float], ...]
"""The corners (x, y) of a polygon in the base frame, in metres."""

OUTLINE_FIELDS = ("region", "ignore", "region_mask")
_INLINE = "data:image/png;base64,"
"""The prefix of an image that is embedded in the YAML, as `write_calibration` writes it."""
_NOT_AN_IMAGE = (OSError, SyntaxError, ValueError, TypeError, Image.DecompressionBombError)


@dataclass(frozen=True)
class TableOutline:
    """The part of the workspace where the table is. Other parts may be the robot's base or the
    floor."""

    region: Polygon = ()
    """A polygon around the table; empty if there is none."""
    ignore: tuple[Polygon, ...] = ()
    """Polygons in which there is no table."""
    mask: tuple[bytes, ...] = ()
    """One string of bytes for each row of the workspace: 1 for a pixel of the table, 0 for any
    other. Empty if there is no mask."""

    def inside(self, grid: PixelGrid) -> NDArray[np.bool_] | None:
        """Returns a mask (rows, cols) of the pixels whose centres are on the table; None if there
        is no outline.

        Args:
            grid: the pixels of the workspace.

        Raises:
            UserError: an outline misses the workspace, or no pixel is left.
        """
        if not (self.region or self.ignore or self.mask):
            return None
        rows, cols = np.indices(grid.shape)
        xy = grid.to_world(np.stack([rows, cols], axis=-1))
        inside = np.ones(grid.shape, bool)
        if self.mask:
            inside &= _unpacked(self.mask, grid)
        if self.region:
            inside &= _covered(self.region, xy, grid, "region")
        for count, polygon in enumerate(self.ignore):
            inside &= ~_covered(polygon, xy, grid, f"ignore[{count}]")
        if not inside.any():
            raise UserError(
                "region, ignore and region_mask together leave no pixel of the workspace"
            )
        inside.flags.writeable = False
        return inside

    def record(self) -> dict[str, Any]:
        """Returns the outline as fields of a calibration, without empty fields."""
        content: dict[str, Any] = {}
        if self.region:
            content["region"] = [list(corner) for corner in self.region]
        if self.ignore:
            content["ignore"] = [[list(corner) for corner in polygon] for polygon in self.ignore]
        if self.mask:
            values = np.array([list(row) for row in self.mask], np.uint8)
            buffer = io.BytesIO()
            Image.fromarray(255 * values).convert("1").save(buffer, "PNG")
            content["region_mask"] = _INLINE + base64.b64encode(buffer.getvalue()).decode()
        return content

    def mask_digest(self) -> str:
        """Returns a digest of the mask's pixels.

        A digest of the PNG would depend on the version of the library that wrote it.
        """
        return hashlib.sha256(b"\n".join(self.mask)).hexdigest()[:16]


def inside_polygon(xy: NDArray[np.float64], polygon: Sequence[Sequence[float]]) -> NDArray[Any]:
    """Returns a mask (...) of the points (..., 2) inside a polygon, by the even-odd rule."""
    x, y = xy[..., 0], xy[..., 1]
    inside = np.zeros(x.shape, bool)
    for (x0, y0), (x1, y1) in zip(polygon, [*polygon[1:], polygon[0]], strict=True):
        if y0 == y1:
            continue
        crossed = (y < y0) != (y < y1)
        inside ^= crossed & (x < x0 + (y - y0) * (x1 - x0) / (y1 - y0))
    return inside


def read_outline(node: dict[str, Any], path: Path, grid: PixelGrid) -> TableOutline:
    """Reads the outline of the table in a calibration.

    Args:
        node: the calibration's fields.
        path: the calibration's file; a mask's path is relative to its folder.
        grid: the pixels of the workspace.

    Raises:
        UserError: a field is invalid, a polygon misses the workspace, or no pixel is left. The
            message names the file and the fields.
    """
    region: Polygon = ()
    ignore: tuple[Polygon, ...] = ()
    mask: tuple[bytes, ...] = ()
    if "region" in node:
        region = _read_polygon(node["region"], f"{path}: region")
    if "ignore" in node:
        if not isinstance(node["ignore"], list):
            raise UserError(f"{path}: ignore must be a list of polygons [[[x, y], ...], ...]")
        ignore = tuple(
            _read_polygon(item, f"{path}: ignore[{count}]")
            for count, item in enumerate(node["ignore"])
        )
    if "region_mask" in node:
        mask = _read_mask(node["region_mask"], path, grid)
    outline = TableOutline(region, ignore, mask)
    try:
        outline.inside(grid)
    except UserError as error:
        raise UserError(f"{path}: {error}") from error
    return outline


def _read_polygon(value: Any, where: str) -> Polygon:
    if not isinstance(value, list) or not all(isinstance(item, list | tuple) for item in value):
        raise UserError(f"{where} must be a polygon [[x, y], [x, y], ...], in metres")
    if len(value) < 3:
        raise UserError(f"{where} has {len(value)} corners, but a polygon has at least 3")
    corners = []
    for count, item in enumerate(value):
        if len(item) != 2:
            raise UserError(f"{where}[{count}] must be a corner [x, y], not {item!r}")
        corners.append(tuple(number(one, f"{where}[{count}]") for one in item))
    return tuple((x, y) for x, y in corners)


def _read_mask(value: Any, path: Path, grid: PixelGrid) -> tuple[bytes, ...]:
    """Reads a mask from a file, or from an image in the YAML.

    Returns:
        One string of bytes for each row of the workspace.
    """
    if not isinstance(value, str):
        raise UserError(f"{path}: region_mask must be the name of an image, not {value!r}")
    inline = value.startswith(_INLINE)
    where = "the image in it" if inline else str(path.parent / value)
    try:
        if inline:
            source: Any = io.BytesIO(base64.b64decode(value.removeprefix(_INLINE), validate=True))
        else:
            source = path.parent / value
        with Image.open(source) as image:
            white = np.asarray(image.convert("L")) >= 128
    except (*_NOT_AN_IMAGE, binascii.Error) as error:
        reason = getattr(error, "strerror", None) or "it is not an image"
        raise UserError(f"{path}: region_mask: cannot read {where}: {reason}") from error
    if white.shape != grid.shape:
        raise UserError(
            f"{path}: region_mask: {where} has {white.shape[0]} rows and {white.shape[1]} "
            f"columns, but the workspace has {grid.rows} rows and {grid.cols} columns"
        )
    return tuple(row.astype(np.uint8).tobytes() for row in white)


def _unpacked(mask: Sequence[bytes], grid: PixelGrid) -> NDArray[np.bool_]:
    found = np.array([list(row) for row in mask], bool)
    if found.shape != grid.shape:
        raise UserError(
            f"region_mask has {found.shape[0]} rows and {found.shape[1]} columns, but the "
            f"workspace has {grid.rows} rows and {grid.cols} columns"
        )
    return found


def _covered(
    polygon: Polygon, xy: NDArray[np.float64], grid: PixelGrid, what: str
) -> NDArray[np.bool_]:
    """Returns a mask (rows, cols) of the pixels inside a polygon; raises UserError if there are
    none."""
    covered = inside_polygon(xy, polygon)
    if covered.any():
        return np.asarray(covered)
    sizes = [max(map(abs, corner)) for corner in polygon]
    advice = "give metres" if math.isfinite(max(sizes)) and max(sizes) > 10 else "correct it"
    raise UserError(
        f"{what} covers no pixel of the workspace ({grid.x_min:g} to {grid.x_max:g}, "
        f"{grid.y_min:g} to {grid.y_max:g} m): {advice}, or remove it"
    )
