"""Finds the files of frames and reads them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from kitting_drake.common.errors import UserError
from kitting_drake.real_camera.calibrations.calibration import BenchCamera, Calibration
from kitting_drake.real_camera.frames.bag_frames import read_bag_frames
from kitting_drake.real_camera.frames.color_registration import register_color
from kitting_drake.real_camera.frames.frame import Frame, check_size
from kitting_drake.real_camera.frames.image_files import (
    COLOUR_ENDINGS,
    COLOUR_NAMES,
    DEPTH_ENDINGS,
    is_depth,
    read_color,
    read_depth,
    read_npz,
)
from kitting_drake.real_camera.frames.point_clouds import CLOUD_ENDINGS, read_cloud
from kitting_drake.real_camera.recordings.recording import is_recording

_WHOLE_ENDINGS = (".npz", *CLOUD_ENDINGS)
"""The endings of files that hold colour and depth together."""
_CONVERSIONS = {
    ".raw": "save it by numpy.save, as (height, width)",
    ".bin": "save it by numpy.save, as (height, width)",
    ".klg": "write its frames as PNG, e.g. with klg2png",
    ".zdf": "save it as .ply by Zivid's Frame.save, or its depth by numpy.save",
    ".praw": "save it as .ply in PhoXi Control",
    ".mkv": "extract colour and depth by Open3D's azure_kinect_mkv_reader.py",
    ".svo": "export colour and depth by the ZED SDK's sample SVO export",
    ".svo2": "export colour and depth by the ZED SDK's sample SVO export",
    ".oni": "export colour and depth as PNG by NiViewer",
    ".r3d": "export it as EXR and JPEG in Record3D",
    ".mat": "save it by numpy.save after scipy.io.loadmat",
    ".h5": "save its arrays by numpy.savez, as color and depth",
    ".xyz": "save it as .ply or .pcd, with colours",
    ".e57": "save it as .ply, with colours",
    ".las": "save it as .ply, with colours",
}
"""How to convert files that cannot be read, by ending."""

_Sources = tuple[Path, ...]
"""The files of a camera: one for colour and one for depth, or one that holds both."""


def read_frames(
    paths: Sequence[Path], calibration: Calibration, *, time: float | None = None
) -> dict[str, Frame]:
    """Reads the frames of all cameras, by camera name.

    `paths` may be:

    - folders. For a camera NAME, one of them has `NAME_color.png` and `NAME_depth.png` (or other
    endings), or `NAME.npz`, or a folder NAME with `color.png` and `depth.png`. For a single camera,
    `color.png` and `depth.png` are enough.
    - files in the order of the calibration's cameras: for each camera a colour and a depth image,
    or one file that holds both.
    - one recording.

    Args:
        paths: the folders, files or recording.
        calibration: the cameras' calibration.
        time: the time after the start of a recording, in seconds; None for its first images.

    Raises:
        UserError: a file is missing, unreadable, or not of the calibration's size.
    """
    for path in paths:
        if not path.exists():
            raise UserError(f"there is no file or folder {path}")
    recordings = [path for path in paths if is_recording(path)]
    if recordings:
        if len(paths) > 1:
            raise UserError(f"{recordings[0]} is a recording: give no other files with it")
        images = read_bag_frames(recordings[0], calibration, time)
        return {
            camera.name: _frame(*images[camera.name], camera, [str(recordings[0])] * 2)
            for camera in calibration.cameras
        }
    if time is not None:
        raise UserError("--time needs a recording (.bag, .mcap, or a folder of ROS 2)")
    folders = [path for path in paths if path.is_dir()]
    files = list(_grouped([path for path in paths if not path.is_dir()]))
    names = [camera.name for camera in calibration.cameras]
    if files and (folders or len(files) != len(names)):
        raise UserError(
            f"the calibration has {len(names)} cameras ({', '.join(names)}): give a pair of colour "
            "and depth for each, in this order, or a folder"
        )
    frames = {}
    for number, camera in enumerate(calibration.cameras):
        sources = files[number] if files else _find(folders, camera.name, len(names) == 1)
        frames[camera.name] = _read(sources, camera)
    return frames


def find_color(folders: Sequence[Path], name: str, alone: bool) -> Path:
    """Returns the path of a camera's colour image.

    Args:
        folders: the folders to search.
        name: the camera's name.
        alone: whether the calibration has only this camera, so that the name of a file may lack the
            camera's name.

    Raises:
        UserError: there is no such image, or there are several.
    """
    return _only(_candidates(folders, name, alone, COLOUR_NAMES, COLOUR_ENDINGS), folders, name, 0)


def _read(sources: _Sources, camera: BenchCamera) -> Frame:
    if len(sources) == 1:
        (path,) = sources
        if path.suffix.lower() == ".npz":
            color, depth = read_npz(path, camera.depth_scale)
        else:
            seen, depth = read_cloud(path, camera)
            if seen is None:
                raise UserError(
                    f"{path} has no colours: save it with colours, or give a colour image with it"
                )
            # A cloud has a colour for each point, so its colours need no registration.
            return Frame(seen, depth)
        return _frame(color, depth, camera, [str(path)] * 2)
    color_path, depth_path = sources
    color = read_color(color_path)
    if depth_path.suffix.lower() in CLOUD_ENDINGS:
        depth = read_cloud(depth_path, camera)[1]
    else:
        depth = read_depth(depth_path, camera.depth_scale)
    return _frame(color, depth, camera, [str(color_path), str(depth_path)])


def _frame(
    color: NDArray[np.uint8], depth: NDArray[np.float32], camera: BenchCamera, named: Sequence[str]
) -> Frame:
    """Checks the sizes of colour and depth, and registers colour to depth."""
    if camera.color is None:
        advice = ": if colour has a lens of its own, describe it under 'color' in the calibration"
        check_size(color.shape, camera.intrinsics, camera, named[0], advice)
    else:
        check_size(color.shape, camera.color.intrinsics, camera, named[0])
    check_size(depth.shape, camera.intrinsics, camera, named[1])
    return Frame(register_color(color, depth, camera), depth)


def _grouped(files: Sequence[Path]) -> Iterator[_Sources]:
    """Yields the files of each camera: (file,) if one file holds colour and depth, else (colour,
    depth).

    The two files of a pair may be given in either order.
    """
    for path in files:
        _check_ending(path)
    if files and all(path.suffix.lower() in _WHOLE_ENDINGS for path in files):
        yield from ((path,) for path in files)
        return
    if len(files) % 2:
        raise UserError("frames in files must come in pairs: a colour image and a depth image")
    for first, second in zip(files[::2], files[1::2], strict=True):
        if ".npz" in (first.suffix.lower(), second.suffix.lower()):
            raise UserError(
                f"{first} and {second}: an .npz file holds colour and depth: give it alone"
            )
        depths = [
            path.suffix.lower() in CLOUD_ENDINGS or is_depth(path) for path in (first, second)
        ]
        if depths == [False, True]:
            yield first, second
        elif depths == [True, False]:
            yield second, first
        else:
            both = "depth" if all(depths) else "colour"
            raise UserError(f"{first} and {second} are both {both}: give colour and depth in pairs")


def _check_ending(path: Path) -> None:
    advice = _CONVERSIONS.get(path.suffix.lower())
    if advice is not None:
        raise UserError(f"{path} cannot be read: {advice}")


def _candidates(
    folders: Sequence[Path], name: str, alone: bool, words: Sequence[str], endings: Sequence[str]
) -> list[Path]:
    """Returns the existing files of a camera whose names have one of the words and one of the
    endings."""
    stems = [f"{name}_", f"{name}/", *([""] if alone else [])]
    candidates = [
        folder / f"{stem}{word}{ending}"
        for folder in folders
        for stem in stems
        for word in words
        for ending in endings
    ]
    return [path for path in candidates if path.is_file()]


def _find(folders: Sequence[Path], name: str, alone: bool) -> _Sources:
    """Returns the files of a camera in folders."""
    whole = [
        *_candidates(folders, name, alone, ("frame", "cloud"), _WHOLE_ENDINGS),
        *(
            path
            for folder in folders
            for ending in _WHOLE_ENDINGS
            if (path := folder / f"{name}{ending}").is_file()
        ),
    ]
    colors = _candidates(folders, name, alone, COLOUR_NAMES, COLOUR_ENDINGS)
    depths = _candidates(folders, name, alone, ("depth",), (*DEPTH_ENDINGS, *CLOUD_ENDINGS))
    if whole and not colors and not depths:
        return (_only(whole, folders, name, 0),)
    if whole:
        others = (*colors, *depths)
        raise UserError(
            f"camera {name}: {', '.join(map(str, folders))} has both {whole[0].name} and "
            f"{others[0].name}: keep only one of them"
        )
    if not depths:
        for path in _candidates(folders, name, alone, ("depth", "frame"), tuple(_CONVERSIONS)):
            _check_ending(path)
    return _only(colors, folders, name, 0), _only(depths, folders, name, 1)


def _only(existing: Sequence[Path], folders: Sequence[Path], name: str, number: int) -> Path:
    """Returns the only existing file of a camera; raises UserError if there are none or several.

    `number` is 0 for a colour file and 1 for a depth file. It is used only for the message.
    """
    if len(existing) != 1:
        word, ending = (("color", ".png"), ("depth", ".npy"))[number]
        reason = (
            f"both {existing[0].name} and {existing[1].name}"
            if existing
            else f"neither {name}_{word}{ending} nor {name}/{word}{ending}"
        )
        places = ", ".join(map(str, folders))
        raise UserError(f"camera {name}: {places} has {reason}: there must be exactly one image")
    return existing[0]
