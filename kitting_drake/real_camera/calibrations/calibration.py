"""The cameras of a bench: intrinsics and poses, read from and written to YAML."""

from __future__ import annotations

import dataclasses
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
from kitting_drake.real_camera.calibrations.field_checks import (
    check_distortion,
    check_fields,
    check_misspelt,
)
from kitting_drake.real_camera.calibrations.layouts import (
    OWN_INTRINSICS,
    Intrinsics,
    has_intrinsics,
    read_intrinsics,
)
from kitting_drake.real_camera.calibrations.lens_chains import with_chained_poses
from kitting_drake.real_camera.calibrations.lens_distortion import undistort
from kitting_drake.real_camera.calibrations.lens_files import (
    check_lens,
    lens_of_mapping,
    read_lens_file,
)
from kitting_drake.real_camera.calibrations.pose_values import pose_of_value
from kitting_drake.real_camera.calibrations.poses import POSE_FIELDS, has_pose, read_pose
from kitting_drake.real_camera.calibrations.table_outline import (
    OUTLINE_FIELDS,
    TableOutline,
    read_outline,
)
from kitting_drake.real_camera.calibrations.yaml_values import (
    matrix,
    number,
    read_yaml,
    whole_number,
)
from systems.heightmap import DepthRays
from systems.signals import PixelGrid

Array = NDArray[np.float64]

_HEIGHT = PixelGrid().z_max - PixelGrid().z_min
"""The default of `max_height`, in metres: points higher above the table are ignored."""
_MOST_PIXELS = 10_000_000
"""If a workspace has more pixels than this, its resolution is probably in a wrong unit."""
_DEPTH_FIELDS = ("depth_scale", "min_depth", "max_depth")
_LENS_FILES = ("camera_info", "intrinsics")
"""The fields that name a file of intrinsics."""
_FILE_FIELDS = (*_LENS_FILES, "stream", "resolution")
_COLOR_FIELDS = (*_FILE_FIELDS, *OWN_INTRINSICS, "depth_to_color")
_BENCH_FIELDS = ("table_height", "workspace", "verified", *OUTLINE_FIELDS)
_GRID_FIELDS = ("x_min", "y_min", "resolution", "rows", "cols", "max_height")


@dataclass(frozen=True)
class ColorLens:
    """The lens of colour images that are not registered to depth."""

    intrinsics: Intrinsics
    X_KC: Array
    """A transform (4, 4) from the depth camera's optical frame C to the colour camera's optical
    frame K."""


@dataclass(frozen=True)
class BenchCamera:
    """An RGB-D camera.

    Depth is usually registered to colour, so that one lens describes both. Otherwise `color`
    describes the lens of the colour images.
    """

    name: str
    intrinsics: Intrinsics
    X_BC: Array
    """The pose (4, 4) of the optical frame C (x right, y down, z forward) in the robot's base frame
    B."""
    depth_scale: float = 0.001
    """Metres per step of a 16-bit depth image."""
    min_depth: float = 0.01
    max_depth: float = 10.0
    """The largest depth in metres; depths outside `min_depth` to `max_depth` are ignored."""
    color: ColorLens | None = None
    """The lens of the colour images; None if depth is registered to colour."""
    topics: tuple[str, str] | None = None
    """The topics of colour and depth in recordings; None to find them by their names."""

    @cached_property
    def rays(self) -> DepthRays:
        """The rays of the depth image's pixels.

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
        x, y = undistort(u, v, lens.model, lens.distortion, self.name)
        return plain._replace(u=x.astype(np.float32), v=y.astype(np.float32))


@dataclass(frozen=True)
class Calibration:
    """All cameras of a bench and their workspace."""

    cameras: tuple[BenchCamera, ...]
    grid: PixelGrid
    """The pixels of the observation o_t; `z_min` is the height of the table in the base frame."""
    outline: TableOutline = dataclasses.field(default_factory=TableOutline)
    """The part of the workspace where the table is."""
    verified: bool = False
    """Whether the poses' x, y and yaw, and the orientation of the images, were checked. Images of a
    bare table do not show errors in these."""

    @cached_property
    def region(self) -> NDArray[np.bool_] | None:
        """A mask (rows, cols) of the pixels of o_t that are on the table; None if all of them are.

        Raises:
            UserError: the outline misses the workspace.
        """
        return self.outline.inside(self.grid)

    def contains(self, xy: Array) -> NDArray[np.bool_]:
        """Returns a mask (...) of the points (..., 2) that are in the workspace and over the table.

        The points are (x, y) in the base frame, in metres.
        """
        inside = self.grid.contains(xy)
        if self.region is None:
            return inside
        inside = np.array(inside)
        row, col = np.moveaxis(np.rint(self.grid.to_pixel(xy[inside])).astype(int), -1, 0)
        row, col = np.clip(row, 0, self.grid.rows - 1), np.clip(col, 0, self.grid.cols - 1)
        inside[inside] = self.region[row, col]
        return inside

    @property
    def table_height(self) -> float:
        """The height of the table in the base frame, in metres."""
        return self.grid.z_min


def read_calibration(
    path: Path, *, table_height: float | None = None, poses: bool = True
) -> Calibration:
    """Reads a calibration from a file; `docs/bench.md` describes the layouts.

    Args:
        path: the file.
        table_height: the table's height in the base frame, in metres; None for the height in the
            file, or zero if the file gives none.
        poses: whether cameras must have poses. If not, a missing pose becomes the identity.

    Raises:
        UserError: a field is missing or invalid. The message names the file and the field.
    """
    content = read_yaml(path)
    if "cameras" in content:
        check_fields(content, ("cameras", *_BENCH_FIELDS), f"{path}")
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
        entries = with_chained_poses(entries, path)
    else:
        # The file may be one camera's intrinsics in the layout of another tool.
        content = lens_of_mapping(content, str(path))
        entries = {str(content.get("camera_name", "camera")): content}
        # A file with one camera mixes the camera's fields with those that all cameras share.
        beside = (*_BENCH_FIELDS, "camera_name")
    cameras = tuple(
        _read_camera(path, str(name), node, beside, poses) for name, node in entries.items()
    )
    if table_height is None:
        height = number(content.get("table_height", 0.0), f"{path}: table_height")
    else:
        height = number(table_height, "table_height")
    grid = _read_grid(path, content.get("workspace", {}), height)
    verified = content.get("verified", False)
    if not isinstance(verified, bool):
        raise UserError(f"{path}: verified must be true or false, not {verified!r}")
    return Calibration(cameras, grid, read_outline(content, path, grid), verified)


def _read_camera(
    path: Path, name: str, node: Any, beside: Sequence[str], poses: bool
) -> BenchCamera:
    where = f"{path}: camera {name}"
    if not isinstance(node, dict):
        raise UserError(f"{where} must be a mapping of fields, not {node!r}")
    known = (*POSE_FIELDS, *_DEPTH_FIELDS, "color", "topics", *beside)
    intrinsics = _read_lens(path, name, node, known, where)
    limits = {key: number(node[key], f"{where}: {key}") for key in _DEPTH_FIELDS if key in node}
    if any(value <= 0 for value in limits.values()):
        raise UserError(f"{where}: depth_scale, min_depth and max_depth must be positive")
    X_BC = read_pose(node, where, path.parent) if poses or has_pose(node) else np.eye(4)
    _check_entry(node, known, where)
    color = _read_color_lens(path, name, node["color"], where) if "color" in node else None
    topics = _read_topics(node["topics"], where) if "topics" in node else None
    camera = BenchCamera(name, intrinsics, X_BC, **limits, color=color, topics=topics)
    if camera.min_depth >= camera.max_depth:
        raise UserError(
            f"{where}: min_depth {camera.min_depth:g} must be less than max_depth "
            f"{camera.max_depth:g}, both in metres"
        )
    return camera


def _read_lens(
    path: Path, name: str, node: dict[str, Any], known: Sequence[str], where: str
) -> Intrinsics:
    """Returns the intrinsics in a camera's entry, or in the file that the entry names."""
    if any(key in node for key in _LENS_FILES):
        check_fields(node, (*_FILE_FIELDS, *known), where)
        return _read_lens_of_file(path, name, node, where)
    if not has_intrinsics(node):
        # Suggest fields that could hold the intrinsics.
        lenses = ("cameras", "camera_info", "camera_matrix", "fx")
        check_misspelt(node, lenses, (*known, "camera_name"), where, likeness=0.6)
    return read_intrinsics(node, where)


def _check_entry(node: dict[str, Any], known: Sequence[str], where: str) -> None:
    """Raises UserError for an unknown field of a camera's entry."""
    if "fx" in node:
        check_fields(node, (*OWN_INTRINSICS, *known, "camera_name"), where)
    elif not any(key in node for key in _LENS_FILES):
        # Ignore other fields that OpenCV and ROS write, such as image_height.
        check_distortion(node, where)
        check_misspelt(node, (*known, *_BENCH_FIELDS), known, where, likeness=0.85)


def _read_lens_of_file(path: Path, name: str, node: dict[str, Any], where: str) -> Intrinsics:
    given = [key for key in _LENS_FILES if key in node]
    if len(given) > 1:
        raise UserError(f"{where} has {' and '.join(given)}: give one of them")
    file, size = path.parent / str(node[given[0]]), None
    if "resolution" in node:
        across, down = matrix(node["resolution"], 1, 2, f"{where}: resolution")[0]
        size = whole_number(across, f"{where}: resolution"), whole_number(down, f"{where}")
    lens = read_lens_file(file, str(node.get("stream", name)), size)
    check_lens(lens, file)
    check_distortion(lens, f"{where}: {file}")
    intrinsics = read_intrinsics(lens, f"{where}: {file}")
    if size not in (None, intrinsics.size):
        wide, high = intrinsics.size
        raise UserError(
            f"{where}: resolution is {size}, but {file} is for images of {wide}x{high} pixels: "
            "give this resolution, or another file"
        )
    return intrinsics


def _read_topics(value: Any, where: str) -> tuple[str, str]:
    if not isinstance(value, dict) or set(value) != {"color", "depth"}:
        raise UserError(f"{where}: topics must have color and depth, and nothing else")
    return str(value["color"]), str(value["depth"])


def _read_color_lens(path: Path, name: str, node: Any, where: str) -> ColorLens:
    """Returns the lens of the colour images, from the field `color` of a camera's entry."""
    label = f"{where}: color"
    if not isinstance(node, dict):
        raise UserError(
            f"{label} must be a mapping with intrinsics and depth_to_color, not {node!r}"
        )
    if "depth_to_color" not in node:
        raise UserError(
            f"{label} lacks depth_to_color: give the transform from the depth's optical frame to "
            "the colour's, as 4 x 4 numbers or as a pose, in metres"
        )
    check_fields(node, _COLOR_FIELDS, label)
    if any(key in node for key in _LENS_FILES):
        intrinsics = _read_lens_of_file(path, name, node, label)
    else:
        intrinsics = read_intrinsics(node, label)
    return ColorLens(
        intrinsics, pose_of_value(node["depth_to_color"], f"{label}: depth_to_color").X
    )


def _read_grid(path: Path, node: Any, table_height: float) -> PixelGrid:
    if not isinstance(node, dict):
        fields = ", ".join(_GRID_FIELDS)
        raise UserError(f"{path}: workspace must be a mapping with {fields}, not {node!r}")
    check_fields(node, _GRID_FIELDS, f"{path}: workspace")
    values: dict[str, Any] = {}
    for key, value in node.items():
        read = whole_number if key in ("rows", "cols") else number
        values[key] = read(value, f"{path}: workspace.{key}")
    rows, cols = (values.get(key, getattr(PixelGrid(), key)) for key in ("rows", "cols"))
    if rows * cols > _MOST_PIXELS:
        raise UserError(
            f"{path}: workspace has {rows} x {cols} pixels, more than {_MOST_PIXELS}: give the "
            "resolution in metres, and fewer rows and cols"
        )
    top = table_height + values.pop("max_height", _HEIGHT)
    try:
        return PixelGrid(**values, z_min=table_height, z_max=top)
    except ValueError as error:
        raise UserError(f"{path}: workspace: {error}") from error


def calibration_record(calibration: Calibration) -> dict[str, Any]:
    """Returns a calibration in this project's own layout, as YAML and JSON values without
    rounding."""
    grid = calibration.grid
    content: dict[str, Any] = {
        "table_height": float(grid.z_min),
        "workspace": {
            **{key: getattr(grid, key) for key in ("x_min", "y_min", "resolution", "rows", "cols")},
            "max_height": float(grid.z_max - grid.z_min),
        },
        **calibration.outline.record(),
        **({"verified": True} if calibration.verified else {}),
        "cameras": {},
    }
    for camera in calibration.cameras:
        content["cameras"][camera.name] = {
            **_lens_record(camera.intrinsics),
            "depth_scale": camera.depth_scale,
            "min_depth": camera.min_depth,
            "max_depth": camera.max_depth,
            "camera_to_base": np.asarray(camera.X_BC).tolist(),
        }
        if camera.color is not None:
            content["cameras"][camera.name]["color"] = {
                **_lens_record(camera.color.intrinsics),
                "depth_to_color": np.asarray(camera.color.X_KC).tolist(),
            }
        if camera.topics is not None:
            topics = dict(zip(("color", "depth"), camera.topics, strict=True))
            content["cameras"][camera.name]["topics"] = topics
    return content


def _lens_record(lens: Intrinsics) -> dict[str, Any]:
    record: dict[str, Any] = {
        **dict(zip(("width", "height"), lens.size, strict=True)),
        **dict(zip(("fx", "fy"), map(float, lens.focal), strict=True)),
        **dict(zip(("cx", "cy"), map(float, lens.centre), strict=True)),
        "distortion": list(lens.distortion),
    }
    if lens.model:
        record["distortion_model"] = lens.model
    return record


def calibration_digest(calibration: Calibration) -> str:
    """Returns a digest that is equal for equal calibrations in any layout. Ignores `verified`.

    Numbers are rounded to nine decimals, because the same rotation, given as a quaternion or as a
    matrix, may differ in the last bit.
    """
    record = _rounded(calibration_record(dataclasses.replace(calibration, verified=False)))
    if calibration.outline.mask:
        record["region_mask"] = calibration.outline.mask_digest()
    text = json.dumps(record, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def _rounded(value: Any) -> Any:
    """Rounds the numbers in a record, and replaces negative zeros by zeros."""
    if isinstance(value, dict):
        return {key: _rounded(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_rounded(item) for item in value]
    return round(value, 9) + 0.0 if isinstance(value, float) else value


def write_calibration(path: Path, calibration: Calibration) -> None:
    """Writes a calibration in this project's own layout, without rounding.

    Raises:
        MachineError: the file cannot be written.
    """
    content = calibration_record(calibration)
    write_atomically(path, yaml.safe_dump(content, sort_keys=False, default_flow_style=None))


def with_poses(calibration: Calibration, poses: dict[str, Array]) -> Calibration:
    """Returns a calibration with new poses (4, 4) for some cameras, by name."""
    cameras = tuple(
        dataclasses.replace(camera, X_BC=poses.get(camera.name, camera.X_BC))
        for camera in calibration.cameras
    )
    return dataclasses.replace(calibration, cameras=cameras)
