"""Calibrates cameras by a board of markers that lies on the table."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from kitting_drake.common.errors import UserError
from kitting_drake.real_camera.calibrations.calibration import (
    BenchCamera,
    Calibration,
    with_poses,
)
from kitting_drake.real_camera.frames.frame import check_size
from kitting_drake.real_camera.frames.frame_reading import find_color
from kitting_drake.real_camera.frames.image_files import read_color
from kitting_drake.real_camera.markers.board_poses import BoardFit, fit_board
from kitting_drake.real_camera.markers.boards import Board, SeenBoard, find_corners

_MOVED = 0.5
"""The board or the camera moved if the corners' error with one pose for all images exceeds their
error with a separate pose for each image by more than this, in pixels."""


@dataclass(frozen=True)
class CalibratedCamera:
    """A camera's images of the board, and the pose computed from them."""

    name: str
    image: NDArray[np.uint8]
    """The first image (height, width, 3)."""
    seen: SeenBoard
    """The corners in the first image."""
    images: int
    corners: int
    """The sum of the numbers of corners in the images."""
    fit: BoardFit


@dataclass(frozen=True)
class Calibrated:
    """All cameras after their calibration by a board."""

    board: Board
    cameras: tuple[CalibratedCamera, ...]
    calibration: Calibration
    """The calibration with the new poses, and with the table's height measured by the board."""


def calibrate_cameras(board: Board, paths: Sequence[Path], lenses: Calibration) -> Calibrated:
    """Computes the poses of cameras that see a board, and the height of the table below the board.

    Args:
        board: the board, at the same place in all images.
        paths: folders with colour images of the cameras, as for `read_frames`; or colour images of
            a single camera.
        lenses: the cameras' intrinsics; their poses are ignored.

    Raises:
        UserError: an image is missing, shows too little of the board or shows it too obliquely, or
            the camera's pose is ambiguous.
    """
    results, poses = [], {}
    for camera in lenses.cameras:
        result = _calibrate_camera(board, _images(paths, camera, lenses), camera)
        results.append(result)
        X_BK = board.X_BM @ np.linalg.inv(result.fit.X_KM)
        X_KC = np.eye(4) if camera.color is None else camera.color.X_KC
        poses[camera.name] = X_BK @ X_KC
    calibration = with_poses(lenses, poses)
    grid = calibration.grid
    height = grid.z_max - grid.z_min
    grid = dataclasses.replace(grid, z_min=board.table_height, z_max=board.table_height + height)
    return Calibrated(
        board, tuple(results), dataclasses.replace(calibration, grid=grid, verified=True)
    )


def _images(paths: Sequence[Path], camera: BenchCamera, lenses: Calibration) -> list[Path]:
    """Returns the colour images of a camera."""
    alone = len(lenses.cameras) == 1
    for path in paths:
        if not path.exists():
            raise UserError(f"there is no file or folder {path}")
    files = [path for path in paths if not path.is_dir()]
    if files and not alone:
        raise UserError(
            f"{files[0]} is an image of one camera, but the calibration has {len(lenses.cameras)} "
            "cameras: give folders with NAME_color.png"
        )
    return [find_color([path], camera.name, alone) if path.is_dir() else path for path in paths]


def _calibrate_camera(board: Board, paths: Sequence[Path], camera: BenchCamera) -> CalibratedCamera:
    lens = camera.intrinsics if camera.color is None else camera.color.intrinsics
    images, seen = [], []
    for path in paths:
        image = read_color(path)
        check_size(image.shape, lens, camera, str(path))
        images.append(image)
        seen.append(find_corners(board, image, str(path)))
    where = f"camera {camera.name}"
    singles = [
        fit_board(item.points, item.pixels, lens, str(path))
        for item, path in zip(seen, paths, strict=True)
    ]
    fit = singles[0]
    if len(paths) > 1:
        points = np.concatenate([item.points for item in seen])
        pixels = np.concatenate([item.pixels for item in seen])
        fit = fit_board(points, pixels, lens, where)
        alone = max(item.rms for item in singles)
        if fit.rms > alone + _MOVED:
            raise UserError(
                f"{where}: the error is {fit.rms:.2f} pixels with one pose for all images, but at "
                f"most {alone:.2f} with a pose for each image: did the board or the camera move "
                "between the images?"
            )
    corners = sum(len(item.points) for item in seen)
    return CalibratedCamera(camera.name, images[0], seen[0], len(paths), corners, fit)
