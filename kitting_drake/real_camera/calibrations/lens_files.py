"""Reads intrinsics from files of kalibr, Open3D and RealSense, as mappings in our own layout."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np

from kitting_drake.common.errors import UserError
from kitting_drake.real_camera.calibrations.layouts import get, has_intrinsics
from kitting_drake.real_camera.calibrations.pose_files import open3d_pose
from kitting_drake.real_camera.calibrations.yaml_values import (
    matrix,
    numbers,
    parse_yaml,
    read_text,
)
from kitting_drake.real_camera.recordings.recording import camera_info_of, is_recording

_REALSENSE = re.compile(r'Intrinsic of "([^"]+)"\s*/?\s*(\d+)x(\d+)')
_REALSENSE_FIELDS = ("Width", "Height", "PPX", "PPY", "Fx", "Fy", "Distortion", "Coeffs")
_PRINTED = re.compile(
    r"\[\s*(\d+)x(\d+)\s+p\[([^\]]+)\]\s+f\[([^\]]+)\]\s+([A-Za-z ]+?)\s*\[([^\]]*)\]\s*\]"
)
"""The text form of pyrealsense2.intrinsics."""
_PYREALSENSE = {**{key: key for key in ("width", "height", "fx", "fy")}, "cx": "ppx", "cy": "ppy"}
_PLUMB_BOB = ("none", "brown conrady", "")


def read_lens_file(path: Path, stream: str, resolution: tuple[int, int] | None) -> dict[str, Any]:
    """Reads the intrinsics in a file, as fields that `read_intrinsics` knows.

    Args:
        path: the file, or a recording with a CameraInfo.
        stream: the lens to take if there are several, for example kalibr's cam1, RealSense's Color,
            or a topic. The camera's name may also be given; it is used only if it matches a lens.
        resolution: the (width, height) of a RealSense stream, in pixels; None if the file has the
            stream in only one resolution.

    Raises:
        UserError: the file is unreadable, or holds no such lens.
    """
    if is_recording(path):
        return camera_info_of(path, stream)
    text = read_text(path)
    if _REALSENSE.search(text):
        return _realsense_text(text, path, stream, resolution)
    printed = _PRINTED.search(text)
    if printed:
        width, height, centre, focal, model, coefficients = printed.groups()
        (cx, cy), (fx, fy) = centre.split(), focal.split()
        lens = {"width": width, "height": height, "cx": cx, "cy": cy, "fx": fx, "fy": fy}
        return {**lens, **_librealsense(model, coefficients.split(), str(path))}
    return lens_of_mapping(parse_yaml(text, path), str(path), stream)


def lens_of_mapping(content: dict[str, Any], where: str, stream: str = "") -> dict[str, Any]:
    """Converts the intrinsics in a mapping to fields that `read_intrinsics` knows.

    A mapping that is not in the layout of another tool is returned unchanged.

    Raises:
        UserError: `stream` does not select one of several lenses, or the lens is not a pinhole, or
            a field is missing or invalid.
    """
    if kalibr_cameras(content):
        return _kalibr(content, where, stream)
    if content.get("class_name") == "PinholeCameraTrajectory":
        parameters = content.get("parameters")
        if not isinstance(parameters, list) or len(parameters) != 1:
            raise UserError(
                f"{where} must have the parameters of exactly one view: save a single view"
            )
        content = parameters[0]
    if "intrinsic" in content or "intrinsic_matrix" in content:
        return _open3d(content, where)
    if "ppx" in content:
        lens = {name: get(content, key, where) for name, key in _PYREALSENSE.items()}
        values = numbers(content.get("coeffs", []), f"{where}: coeffs").tolist()
        return {**lens, **_librealsense(str(content.get("model", "")), values, where)}
    if "CalibrationInformation" in content:
        raise UserError(
            f"{where} is the raw calibration of an Azure Kinect, which is for another resolution "
            "than that of its images: give the CameraInfo, or the intrinsic.json that Open3D "
            "writes"
        )
    return content


def kalibr_cameras(content: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """Returns the cameras of kalibr's camchain by name; none if the content is not a camchain."""
    return {
        str(name): node
        for name, node in content.items()
        if re.fullmatch(r"cam\d+", str(name))
        and isinstance(node, dict)
        and {"intrinsics", "camera_model"} & set(node)
    }


def kalibr_stream(cameras: dict[str, dict[str, Any]], where: str, stream: str) -> str:
    """Returns the kalibr camera whose name is `stream`, or whose topic contains `stream`.

    If there is only one camera, it is returned in any case.

    Raises:
        UserError: there are several cameras, and none or more than one of them matches.
    """
    if stream in cameras:
        return stream
    parts = {name: str(node.get("rostopic", "")).split("/") for name, node in cameras.items()}
    named = [name for name, topic in parts.items() if stream and stream in topic]
    found = named or list(cameras)
    if len(found) != 1:
        raise UserError(
            f"{where} has the cameras {', '.join(cameras)}: choose one, for example with "
            f"`stream: {next(iter(cameras))}`"
        )
    return found[0]


def _kalibr(content: dict[str, Any], where: str, stream: str) -> dict[str, Any]:
    cameras = kalibr_cameras(content)
    name = kalibr_stream(cameras, where, stream)
    node, label = cameras[name], f"{where}: {name}"
    if node.get("camera_model") != "pinhole":
        raise UserError(
            f"{label}: camera_model is {node.get('camera_model')}: only pinhole can be read; "
            "calibrate with pinhole-radtan or pinhole-equi"
        )
    values = matrix(get(node, "intrinsics", label), 1, 4, f"{label}: intrinsics")[0]
    return {
        **dict(zip(("fx", "fy", "cx", "cy"), map(float, values), strict=True)),
        "image_size": get(node, "resolution", label),
        "distortion_model": get(node, "distortion_model", label),
        "distortion": get(node, "distortion_coeffs", label),
    }


def _open3d(content: dict[str, Any], where: str) -> dict[str, Any]:
    """Converts the intrinsics of Open3D to our own layout.

    They come from a PinholeCameraIntrinsic, a PinholeCameraParameters or one of Open3D's recorders.
    """
    inner = content.get("intrinsic", content)
    if not isinstance(inner, dict):
        raise UserError(f"{where}: intrinsic must have width, height and intrinsic_matrix")
    value, label = get(inner, "intrinsic_matrix", where), f"{where}: intrinsic_matrix"
    if isinstance(value, list) and any(isinstance(item, list) for item in value):
        raise UserError(f"{label} must be a flat list, column by column, as Open3D writes it")
    K = matrix(value, 3, 3, label).T
    if K[0, 2] == 0 and K[1, 2] == 0:
        raise UserError(f"{label} must be fx 0 0, 0 fy 0, cx cy 1: Open3D writes it by columns")
    lens = {"k": K.tolist(), **{key: get(inner, key, where) for key in ("width", "height")}}
    if "extrinsic" in content:
        lens["camera_to_base"] = open3d_pose(content, where).tolist()
    return lens


def _realsense_text(
    text: str, path: Path, stream: str, resolution: tuple[int, int] | None
) -> dict[str, Any]:
    """Reads the text of `rs-enumerate-devices -c`, which has a block for each stream and
    resolution."""
    heads = list(_REALSENSE.finditer(text))
    names = {head.group(1) for head in heads}
    wanted = stream if stream in names else "Color"
    lenses: dict[str, dict[str, Any]] = {}
    ends = [*(head.start() for head in heads[1:]), len(text)]
    for head, end in zip(heads, ends, strict=True):
        name, width, height = head.groups()
        if name == wanted and resolution in (None, (int(width), int(height))):
            block = _realsense_block(text[head.end() : end], f"{path}: {name} {width}x{height}")
            lenses[f"{width}x{height} {block}"] = block
    if len(lenses) != 1:
        size = "" if resolution is None else f" of {resolution[0]}x{resolution[1]} pixels"
        sizes = sorted({key.partition(" ")[0] for key in lenses})
        if not lenses:
            raise UserError(
                f"{path} has no intrinsics of the stream {wanted}{size}: give another stream or "
                "resolution"
            )
        raise UserError(
            f"{path} has {len(lenses)} intrinsics of the stream {wanted}{size}, for the sizes "
            f"{', '.join(sizes)}: give resolution: [WIDTH, HEIGHT]"
        )
    return next(iter(lenses.values()))


def _realsense_block(text: str, where: str) -> dict[str, Any]:
    values: dict[str, str] = {}
    for field in _REALSENSE_FIELDS:
        found = re.search(rf"^\s*{field}:[ \t]*(.*?)[ \t]*$", text, re.MULTILINE)
        if found is None:
            raise UserError(f"{where} lacks {field}: the text is not complete")
        values[field] = found.group(1)
    lens: dict[str, Any] = {
        own: values[field]
        for own, field in zip(
            ("width", "height", "cx", "cy", "fx", "fy"), _REALSENSE_FIELDS, strict=False
        )
    }
    return {**lens, **_librealsense(values["Distortion"], values["Coeffs"].split(), where)}


def _librealsense(model: str, values: list[Any], where: str) -> dict[str, Any]:
    """Converts distortion coefficients whose model is given by librealsense's name, such as
    distortion.brown_conrady."""
    name = model.rpartition(".")[2].replace("_", " ").lower()
    coefficients = numbers(values, f"{where}: coefficients")
    if not np.any(coefficients):
        return {"distortion": []}
    if name in _PLUMB_BOB:
        return {"distortion": coefficients.tolist(), "distortion_model": "plumb_bob"}
    if name.startswith("kannala"):
        coefficients = coefficients[:4]
    return {"distortion": coefficients.tolist(), "distortion_model": name}


def check_lens(lens: dict[str, Any], path: Path) -> None:
    """Raises UserError if the content of a lens file has no intrinsics."""
    if not has_intrinsics(lens):
        raise UserError(
            f"{path} has neither camera_matrix nor k: it must be a CameraInfo, a calibration of "
            "OpenCV or kalibr, Open3D's intrinsics, or the text that rs-enumerate-devices -c "
            "prints"
        )
