"""Makes colour and depth images from point clouds (PLY and PCD)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray

from kitting_drake.common.errors import UserError
from kitting_drake.real_camera.calibrations.calibration import BenchCamera
from kitting_drake.real_camera.calibrations.layouts import Intrinsics
from kitting_drake.real_camera.calibrations.lens_distortion import distort
from kitting_drake.real_camera.frames.pcd_files import read_pcd

Array = NDArray[np.float64]

CLOUD_ENDINGS = (".ply", ".pcd")
_OFF = 2.0
"""If the median distance between the points of an organised cloud and their pixels exceeds this, in
pixels, the cloud belongs to another lens."""
_METRES = 50.0
"""If the median depth exceeds this, in metres, the cloud is probably in millimetres."""


def read_cloud(
    path: Path, camera: BenchCamera
) -> tuple[NDArray[np.uint8] | None, NDArray[np.float32]]:
    """Reads a point cloud as images: colour (height, width, 3) and depth (height, width) in metres.

    The colour is None if the cloud has no colours.

    The points must be in the camera's optical frame (x right, y down, z forward), in metres. If a
    cloud has one point for each pixel, in rows, its points become the pixels. The points of any
    other cloud are projected through the camera's lens; in each pixel the nearest point counts.

    Raises:
        UserError: the file is damaged, or its points are not in the camera's frame.
    """
    width, height = camera.intrinsics.size
    if path.suffix.lower() == ".pcd":
        points, colors, organised = read_pcd(path)
        if organised[1] > 1 and organised != (width, height):
            raise UserError(
                f"{path} has {organised[0]}x{organised[1]} points, but camera {camera.name} was "
                f"calibrated at {width}x{height}"
            )
    else:
        points, colors = _read_ply(path)
    with np.errstate(invalid="ignore"):
        seen = np.isfinite(points).all(axis=1) & (points[:, 2] > 0)
        behind = float((points[:, 2] < 0).mean()) if len(points) else 0.0
    if behind > 0.5:
        raise UserError(
            f"{path} has most points behind the camera: save them in its optical frame, x right, y "
            "down, z forward"
        )
    if not seen.any():
        raise UserError(f"{path} holds no point in front of the camera")
    middle = float(np.median(points[seen, 2]))
    if middle > _METRES:
        raise UserError(
            f"{path} has points with a median distance of {middle:.4g} m: save them in metres, "
            "not millimetres"
        )
    col, row = project_points(points[seen], camera.intrinsics)
    if len(points) == width * height:
        off = np.hypot(col - np.flatnonzero(seen) % width, row - np.flatnonzero(seen) // width)
        if np.median(off) > _OFF:
            raise UserError(
                f"{path} has a point for each pixel, but the points are {np.median(off):.0f} "
                f"pixels from where camera {camera.name} would see them: check its intrinsics, "
                "and that the cloud is in its optical frame"
            )
        depth = np.where(seen, points[:, 2], 0).reshape(height, width)
        image = None if colors is None else colors.reshape(height, width, 3)
        return image, depth.astype(np.float32)
    return _rendered(points[seen], None if colors is None else colors[seen], col, row, camera)


def project_points(points: Array, lens: Intrinsics) -> tuple[Array, Array]:
    """Projects points (n, 3) in front of a lens. Returns their columns (n,) and rows (n,) in the
    image, in pixels; pixel centres have whole numbers."""
    x, y = points[:, 0] / points[:, 2], points[:, 1] / points[:, 2]
    if lens.distortion:
        x, y = distort(x, y, lens.model, lens.distortion)
    return lens.focal[0] * x + lens.centre[0], lens.focal[1] * y + lens.centre[1]


def _rendered(
    points: Array, colors: NDArray[np.uint8] | None, col: Array, row: Array, camera: BenchCamera
) -> tuple[NDArray[np.uint8] | None, NDArray[np.float32]]:
    width, height = camera.intrinsics.size
    depth = np.zeros((height, width), np.float32)
    image = None if colors is None else np.zeros((height, width, 3), np.uint8)
    with np.errstate(invalid="ignore"):
        inside = (np.abs(col - width / 2 + 0.5) < width / 2) & (
            np.abs(row - height / 2 + 0.5) < height / 2
        )
    if not inside.any():
        raise UserError(
            f"no point of the cloud of camera {camera.name} is in its view: save the cloud in the "
            "camera's optical frame, and check the intrinsics"
        )
    cells = np.rint(row[inside]).astype(int), np.rint(col[inside]).astype(int)
    # In each pixel the last assignment counts, which is that of the nearest point.
    order = np.argsort(-points[inside, 2], kind="stable")
    cells = cells[0][order], cells[1][order]
    depth[cells] = points[inside, 2][order]
    if image is not None and colors is not None:
        image[cells] = colors[inside][order]
    return image, depth


def _read_ply(path: Path) -> tuple[Array, NDArray[np.uint8] | None]:
    try:
        with path.open("rb") as file:
            fields: dict[str, Any] = trimesh.exchange.ply.load_ply(file, skip_materials=True)
        points = np.asarray(fields["vertices"], float).reshape(-1, 3)
        colors = fields.get("vertex_colors", fields.get("colors"))
        if colors is None:
            return points, None
        colors = np.asarray(colors)[:, :3]
        if colors.dtype.kind == "f":
            colors = np.rint(255 * np.clip(colors, 0, 1))
        return points, colors.astype(np.uint8).reshape(len(points), 3)
    except OSError as error:
        raise UserError(f"cannot read {path}: {error.strerror}") from error
    except (ValueError, KeyError, IndexError, TypeError, AttributeError) as error:
        raise UserError(f"cannot read {path}: it is not a complete PLY file") from error
