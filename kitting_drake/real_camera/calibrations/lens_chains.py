"""Computes poses of cameras that kalibr calibrated together, from the pose of one of them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kitting_drake.common.errors import UserError
from kitting_drake.real_camera.calibrations.lens_files import kalibr_cameras, kalibr_stream
from kitting_drake.real_camera.calibrations.pose_values import pose_of_value
from kitting_drake.real_camera.calibrations.poses import has_pose, read_pose
from kitting_drake.real_camera.calibrations.yaml_values import read_yaml

Array = NDArray[np.float64]

_LENS_FILES = ("camera_info", "intrinsics")


def with_chained_poses(entries: dict[str, Any], path: Path) -> dict[str, Any]:
    """Adds poses to the entries of a calibration.

    A camera without a pose gets `camera_to_base` if another camera of the same kalibr camchain has
    a pose.

    Args:
        entries: the cameras' entries by name.
        path: the calibration's file.

    Raises:
        UserError: a camera of the chain lacks its transform from the previous camera, or several
            cameras of the chain have poses, which could contradict each other.
    """
    lacking = [
        name
        for name, node in entries.items()
        if isinstance(node, dict) and not has_pose(node) and _chain(node, path)
    ]
    result = dict(entries)
    for name in lacking:
        node = entries[name]
        chain = _chain(node, path)
        others = {
            other: entry
            for other, entry in entries.items()
            if isinstance(entry, dict) and has_pose(entry) and _chain(entry, path) == chain
        }
        if not others:
            continue
        if len(others) > 1:
            raise UserError(
                f"{path}: camera {name} has no pose, but more than one other camera of its "
                f"camchain has one ({', '.join(others)}): keep one pose; the others follow from it"
            )
        ((other, entry),) = others.items()
        X_BO = read_pose(entry, f"{path}: camera {other}", path.parent)
        X_O0, X_C0 = (
            _from_first(item, label, path) for item, label in ((entry, other), (node, name))
        )
        X_BC = X_BO @ X_O0 @ np.linalg.inv(X_C0)
        result[name] = {**node, "camera_to_base": X_BC.tolist()}
    return result


def _chain(node: dict[str, Any], path: Path) -> Path | None:
    """Returns the camchain file that an entry names, or None."""
    names = [str(node[key]) for key in _LENS_FILES if key in node]
    if len(names) != 1 or not names[0].endswith((".yaml", ".yml")):
        return None
    file = path.parent / names[0]
    return file if file.is_file() and kalibr_cameras(read_yaml(file)) else None


def _from_first(node: dict[str, Any], name: str, path: Path) -> Array:
    """Returns the transform (4, 4) from the chain's first camera to the camera of an entry."""
    file = _chain(node, path)
    assert file is not None
    cameras = kalibr_cameras(read_yaml(file))
    ordered = sorted(cameras, key=lambda item: int(item.removeprefix("cam")))
    last = kalibr_stream(cameras, str(file), str(node.get("stream", name)))
    X = np.eye(4)
    for item in ordered[1 : ordered.index(last) + 1]:
        if "T_cn_cnm1" not in cameras[item]:
            raise UserError(
                f"{file}: {item} lacks T_cn_cnm1, the transform from the previous camera"
            )
        # T_cn_cnm1 maps points from the previous camera to this one.
        X = pose_of_value(cameras[item]["T_cn_cnm1"], f"{file}: {item}: T_cn_cnm1").X @ X
    return X
