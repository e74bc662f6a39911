"""The cameras of a bench: intrinsics and poses, read from and written to YAML."""

from __future__ import annotations

import dataclasses
import difflib
import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from kitting_drake.common.errors import UserError
from kitting_drake.common.files import write_atomically
from kitting_drake.real_camera.calibrations.layouts import (
    OWN_INTRINSICS,
    POSE_FIELDS,
    Intrinsics,
    has_intrinsics,
    read_intrinsics,
    read_pose,
)
from kitting_drake.real_camera.calibrations.yaml_values import number, read_yaml, whole_number
from systems.heightmap import DepthRays
from systems.signals import PixelGrid

Array = NDArray[np.float64]

_UNDISTORTED = 1e-4
"""The largest reprojection error of an undistorted ray, at depth 1."""
_HEIGHT = PixelGrid().z_max - PixelGrid().z_min
"""The default of `max_height`: points higher above the table are ignored, in metres."""
_MOST_PIXELS = 10_000_000
"""A workspace with more pixels has its resolution in a wrong unit."""
_DEPTH_FIELDS = ("depth_scale", "min_depth", "max_depth")
_BENCH_FIELDS = ("table_height", "workspace")
_GRID_FIELDS = ("x_min", "y_min", "resolution", "rows", "cols", "max_height")


@dataclass(frozen=True)
class BenchCamera:
    """An RGB-D camera. Depth is registered to colour, so one lens describes both."""

    name: str
    intrinsics: Intrinsics
    X_BC: Array
    """(4, 4): the optical frame C (x right, y down, z forward) in the robot's base frame B."""
    depth_scale: float = 0.001
    """Metres per step of a 16-bit depth image."""
    min_depth: float = 0.01
    max_depth: float = 10.0
    """Depths outside these limits are ignored, in metres."""

    @cached_property
    def rays(self) -> DepthRays:
        """The pixels' rays.

        Raises:
            UserError: the distortion cannot be inverted.
        """
        lens = self.intrinsics
        # Shift the origin from the first pixel's centre to the corner of the image.
        plain = DepthRays.from_pinhole(
            size=lens.size,
            focal=lens.focal,
            centre=(lens.centre[0] + 0.5, lens.centre[1] + 0.5),
            depth_range=(self.min_depth, self.max_depth),
        )
        if not lens.distortion:
            return plain
        u, v = (np.broadcast_to(item, plain.shape).astype(float) for item in (plain.u, plain.v))
        x, y = _undistort(u, v, lens.distortion, self.name)
        return plain._replace(u=x.astype(np.float32), v=y.astype(np.float32))


@dataclass(frozen=True)
class Calibration:
    """All cameras of a bench and their workspace."""

    cameras: tuple[BenchCamera, ...]
    grid: PixelGrid
    """The pixels of o_t; `z_min` is the height of the table in the base frame."""

    @property
    def table_height(self) -> float:
        """The height of the table in the base frame, in metres."""
        return self.grid.z_min


def read_calibration(path: Path, *, table_height: float | None = None) -> Calibration:
    """Reads a calibration; `docs/bench.md` describes the layouts.

    Args:
        path: the file.
        table_height: of the table in the base frame, in metres; None for the file's, or zero.

    Raises:
        UserError: a field is missing or invalid; names the file and the field.
    """
    content = read_yaml(path)
    if "cameras" in content:
        _check_fields(content, ("cameras", *_BENCH_FIELDS), f"{path}")
        entries = content["cameras"]
        if not isinstance(entries, dict) or not entries:
            raise UserError(f"{path}: cameras must be a mapping from names to cameras")
        for name, node in entries.items():
            for key in _BENCH_FIELDS:
                if isinstance(node, dict) and key in node:
                    raise UserError(
                        f"{path}: camera {name} has the field '{key}', which all cameras share: "
                        "move it beside 'cameras'"
                    )
        beside: tuple[str, ...] = ()
    else:
        entries = {str(content.get("camera_name", "camera")): content}
        # A file of one camera has the bench's fields at the same level.
        beside = (*_BENCH_FIELDS, "camera_name")
    cameras = tuple(_read_camera(path, str(name), node, beside) for name, node in entries.items())
    if table_height is None:
        height = number(content.get("table_height", 0.0), f"{path}: table_height")
    else:
        height = number(table_height, "table_height")
    return Calibration(cameras, _read_grid(path, content.get("workspace", {}), height))


def _read_camera(path: Path, name: str, node: Any, beside: Sequence[str]) -> BenchCamera:
    where = f"{path}: camera {name}"
    if not isinstance(node, dict):
        raise UserError(f"{where} must be a mapping of fields")
    lens, known = node, (*POSE_FIELDS, *_DEPTH_FIELDS, *beside)
    if "camera_info" in node:
        _check_fields(node, ("camera_info", *known), where)
        file = path.parent / str(node["camera_info"])
        lens = read_yaml(file)
        if not has_intrinsics(lens):
            raise UserError(f"{where}: {file} has neither camera_matrix nor k")
        _check_distortion(lens, f"{where}: {file}")
    elif not has_intrinsics(node):
        # Suggest the fields that could hold the intrinsics.
        lenses = ("cameras", "camera_info", "camera_matrix", "fx")
        _check_misspelt(node, lenses, (*known, "camera_name"), where, likeness=0.6)
    limits = {key: number(node[key], f"{where}: {key}") for key in _DEPTH_FIELDS if key in node}
    if any(value <= 0 for value in limits.values()):
        raise UserError(f"{where}: depth_scale, min_depth and max_depth must be positive")
    intrinsics, X_BC = read_intrinsics(lens, where), read_pose(node, where)
    if "fx" not in node:
        # OpenCV and ROS write other fields, such as image_height, which are ignored.
        _check_distortion(node, where)
        _check_misspelt(node, (*known, *_BENCH_FIELDS), known, where, likeness=0.85)
    else:
        _check_fields(node, (*OWN_INTRINSICS, *known, "camera_name"), where)
    camera = BenchCamera(name, intrinsics, X_BC, **limits)
    if camera.min_depth >= camera.max_depth:
        raise UserError(
            f"{where}: min_depth {camera.min_depth:g} must be less than max_depth "
            f"{camera.max_depth:g}, both in metres"
        )
    return camera


def _check_distortion(node: dict[str, Any], where: str) -> None:
    """Raises UserError for misspelt distortion coefficients, which would be ignored.

    OpenCV and ROS write no other fields that begin with "dist".
    """
    for key in node:
        if str(key).lower().startswith("dist") and key not in OWN_INTRINSICS:
            raise UserError(
                f"{where} has the unknown field '{key}': the lens's coefficients are called "
                "distortion_coefficients, or d in ROS"
            )


def _check_fields(node: dict[str, Any], known: Sequence[str], where: str) -> None:
    """Raises UserError for an unknown field, which would be ignored."""
    for key in node:
        if key not in known:
            close = difflib.get_close_matches(str(key), known, n=1)
            advice = f"did you mean '{close[0]}'?" if close else "remove it"
            raise UserError(f"{where} has the unknown field '{key}': {advice}")


def _check_misspelt(
    node: dict[str, Any], meant: Sequence[str], known: Sequence[str], where: str, likeness: float
) -> None:
    """Raises UserError for an unknown field that resembles an expected one.

    Args:
        node: the fields.
        meant: the expected fields.
        known: fields that are allowed.
        where: the beginning of the error.
        likeness: the least similarity, from 0 to 1.
    """
    for key in node:
        close = difflib.get_close_matches(str(key), meant, cutoff=likeness)
        if close and key not in known:
            raise UserError(f"{where} has the unknown field '{key}': did you mean '{close[0]}'?")


def _read_grid(path: Path, node: Any, table_height: float) -> PixelGrid:
    if not isinstance(node, dict) or not set(node) <= set(_GRID_FIELDS):
        fields = ", ".join(_GRID_FIELDS)
        raise UserError(f"{path}: workspace may only have the fields {fields}")
    values: dict[str, Any] = {}
    for key, value in node.items():
        read = whole_number if key in ("rows", "cols") else number
        values[key] = read(value, f"{path}: workspace.{key}")
    if values.get("rows", 1) * values.get("cols", 1) > _MOST_PIXELS:
        raise UserError(
            f"{path}: workspace has {values['rows']} x {values['cols']} pixels, more than "
            f"{_MOST_PIXELS:.0e}: give the resolution in metres"
        )
    top = table_height + values.pop("max_height", _HEIGHT)
    try:
        return PixelGrid(**values, z_min=table_height, z_max=top)
    except ValueError as error:
        raise UserError(f"{path}: workspace: {error}") from error


def calibration_record(calibration: Calibration) -> dict[str, Any]:
    """A calibration in our own layout as YAML and JSON values, without rounding."""
    grid = calibration.grid
    content: dict[str, Any] = {
        "table_height": float(grid.z_min),
        "workspace": {
            **{key: getattr(grid, key) for key in ("x_min", "y_min", "resolution", "rows", "cols")},
            "max_height": float(grid.z_max - grid.z_min),
        },
        "cameras": {},
    }
    for camera in calibration.cameras:
        lens = camera.intrinsics
        content["cameras"][camera.name] = {
            **dict(zip(("width", "height"), lens.size, strict=True)),
            **dict(zip(("fx", "fy"), map(float, lens.focal), strict=True)),
            **dict(zip(("cx", "cy"), map(float, lens.centre), strict=True)),
            "distortion": list(lens.distortion),
            "depth_scale": camera.depth_scale,
            "min_depth": camera.min_depth,
            "max_depth": camera.max_depth,
            "camera_to_base": np.asarray(camera.X_BC).tolist(),
        }
    return content


def calibration_digest(calibration: Calibration) -> str:
    """A digest that is equal for equal calibrations in any layout.

    Numbers are rounded to nine decimals, because the same rotation as a quaternion and as a matrix
    may differ in the last bit.
    """
    text = json.dumps(_rounded(calibration_record(calibration)), sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def _rounded(value: Any) -> Any:
    """A record with rounded numbers and without negative zeros."""
    if isinstance(value, dict):
        return {key: _rounded(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_rounded(item) for item in value]
    return round(value, 9) + 0.0 if isinstance(value, float) else value


def write_calibration(path: Path, calibration: Calibration) -> None:
    """Writes a calibration in our own layout, without rounding.

    Raises:
        UserError: the file cannot be written.
    """
    content = calibration_record(calibration)
    write_atomically(path, yaml.safe_dump(content, sort_keys=False, default_flow_style=None))


def with_poses(calibration: Calibration, poses: dict[str, Array]) -> Calibration:
    """A calibration with new poses for some cameras."""
    cameras = tuple(
        dataclasses.replace(camera, X_BC=poses.get(camera.name, camera.X_BC))
        for camera in calibration.cameras
    )
    return dataclasses.replace(calibration, cameras=cameras)


def _undistort(u: Array, v: Array, distortion: tuple[float, ...], name: str) -> tuple[Array, Array]:
    """The rays at depth 1 that the lens images at (u, v), as by cv2.undistortPoints."""
    k1, k2, p1, p2, k3, k4, k5, k6 = (*distortion, *(0.0,) * (8 - len(distortion)))

    def factors(x: Array, y: Array) -> tuple[Array, Array, Array]:
        square = x * x + y * y
        radial = (1 + square * (k1 + square * (k2 + square * k3))) / (
            1 + square * (k4 + square * (k5 + square * k6))
        )
        along = 2 * p1 * x * y + p2 * (square + 2 * x * x)
        return radial, along, p1 * (square + 2 * y * y) + 2 * p2 * x * y

    x, y = u.copy(), v.copy()
    with np.errstate(all="ignore"):
        for _ in range(30):
            radial, shift_x, shift_y = factors(x, y)
            x, y = (u - shift_x) / radial, (v - shift_y) / radial
        radial, shift_x, shift_y = factors(x, y)
        missed = np.hypot(x * radial + shift_x - u, y * radial + shift_y - v)
    if not (missed < _UNDISTORTED).all():
        raise UserError(
            f"camera {name}: its distortion cannot be undone over the whole image: check the order "
            "k1, k2, p1, p2, k3, or rectify the images"
        )
    return x, y
