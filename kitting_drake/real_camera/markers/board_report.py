"""Writes files and prints a table about cameras that were calibrated by a board."""

from __future__ import annotations

import io
import math
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageDraw
from rich.console import Console
from rich.table import Table

from kitting_drake.common.errors import MachineError, UserError
from kitting_drake.common.files import write_atomically, write_json
from kitting_drake.real_camera.calibrations.calibration import BenchCamera, write_calibration
from kitting_drake.real_camera.frames.point_clouds import project_points
from kitting_drake.real_camera.markers.board_calibration import Calibrated, CalibratedCamera

_GOOD, _FAIR = 0.5, 1.5
"""The largest errors of corners, in pixels, that count as good and as fair."""
_TOLD = 0.01
"""The largest standard deviation at which a focal ratio is reported."""
_AXES = ((230, 40, 40), (40, 180, 40), (60, 90, 255))


def clear_earlier(folder: Path, source: Path) -> Path:
    """Removes the calibration of an earlier run, so that nobody uses it if this run fails.

    Args:
        folder: the folder of the files.
        source: the file of the intrinsics.

    Returns:
        The path of the new calibration.

    Raises:
        UserError: this path is the file of the intrinsics, or holds a file that is not from an
            earlier run.
        MachineError: a file cannot be removed.
    """
    path, record = folder / "calibration.yaml", folder / "calibrate.json"
    if path.resolve() == source.resolve():
        raise UserError(f"{path} is the file of the intrinsics: give another --output")
    if path.exists() and not record.exists():
        raise UserError(f"{path} was not written by --calibrate: give another --output")
    try:
        for item in (path, record):
            item.unlink(missing_ok=True)
    except OSError as error:
        raise MachineError(f"cannot remove {item}: {error.strerror}") from error
    return path


def save_calibrated(path: Path, calibrated: Calibrated) -> None:
    """Writes the calibration to a file, and `calibrate.json` and a picture of each camera beside
    it.

    Raises:
        MachineError: a file cannot be written.
    """
    cameras = {camera.name: camera for camera in calibrated.calibration.cameras}
    for result in calibrated.cameras:
        picture = _draw(result, cameras[result.name], calibrated)
        write_atomically(path.parent / f"calibrate_{result.name}.png", picture)
    write_json(path.parent / "calibrate.json", _record(calibrated))
    write_calibration(path, calibrated.calibration)


def print_calibrated(console: Console, calibrated: Calibrated) -> None:
    """Prints a line for each camera, and the height and tilt of the table."""
    table = Table()
    for title in ("camera", "images", "corners", "error px", "", "view deg", "focal ratio"):
        table.add_column(title, justify="left" if title in ("camera", "") else "right")
    for camera in calibrated.cameras:
        fit = camera.fit
        ratio = "not seen"
        if fit.focal_error <= _TOLD:
            ratio = f"{fit.focal_ratio:.4f} +- {fit.focal_error:.4f}"
        table.add_row(
            camera.name,
            str(camera.images),
            str(camera.corners),
            f"{fit.rms:.2f}",
            _rating(fit.rms),
            f"{math.degrees(fit.angle):.0f}",
            ratio,
        )
    console.print(table)
    board = calibrated.board
    console.print(
        f"table: {1e3 * board.table_height:.1f} mm high, tilted by "
        f"{math.degrees(board.tilt):.2f} degrees",
        highlight=False,
    )


def _rating(rms: float) -> str:
    if rms <= _GOOD:
        return "good"
    return "fair" if rms <= _FAIR else "poor: check the intrinsics"


def _record(calibrated: Calibrated) -> dict[str, Any]:
    board = calibrated.board
    cameras = {camera.name: camera for camera in calibrated.calibration.cameras}
    record: dict[str, Any] = {
        "units": "metres, degrees and pixels, in the base frame; docs/bench.md",
        "table": {"height": board.table_height, "tilt_deg": math.degrees(board.tilt)},
        "cameras": {},
    }
    for camera in calibrated.cameras:
        fit = camera.fit
        told = fit.focal_error <= _TOLD
        record["cameras"][camera.name] = {
            "images": camera.images,
            "corners": camera.corners,
            "markers": camera.seen.markers,
            "rms_px": round(fit.rms, 4),
            "rating": _rating(fit.rms),
            "view_deg": round(math.degrees(fit.angle), 2),
            "focal_ratio": round(fit.focal_ratio, 5) if told else None,
            "focal_ratio_deviation": round(fit.focal_error, 5) if told else None,
            "camera_to_base": np.asarray(cameras[camera.name].X_BC).tolist(),
        }
    return record


def _draw(result: CalibratedCamera, camera: BenchCamera, calibrated: Calibrated) -> bytes:
    """Draws the first image as a PNG.

    Circles mark the detected corners; crosses mark the corners that the pose predicts. The board's
    axes are drawn as well.
    """
    lens = camera.intrinsics if camera.color is None else camera.color.intrinsics
    X = result.fit.X_KM
    image = Image.fromarray(result.image)
    draw = ImageDraw.Draw(image)
    expected = np.stack(project_points(result.seen.points @ X[:3, :3].T + X[:3, 3], lens), axis=-1)
    for (x, y), (u, v) in zip(result.seen.pixels, expected, strict=True):
        draw.ellipse((x - 4, y - 4, x + 4, y + 4), outline=(255, 160, 0))
        draw.line((u - 3, v, u + 3, v), fill=(0, 200, 255))
        draw.line((u, v - 3, u, v + 3), fill=(0, 200, 255))
    length = 0.25 * min(calibrated.board.size)
    ends = np.vstack([np.zeros(3), length * np.eye(3)]) @ X[:3, :3].T + X[:3, 3]
    if (ends[:, 2] > 0).all():
        cols, rows = project_points(ends, lens)
        for axis, colour in enumerate(_AXES, start=1):
            draw.line((cols[0], rows[0], cols[axis], rows[axis]), fill=colour, width=3)
    file = io.BytesIO()
    image.save(file, "PNG")
    return file.getvalue()
