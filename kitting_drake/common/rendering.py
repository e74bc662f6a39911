"""Rendering without a display: engines, pictures for people, and PNG files."""

import contextlib
import ctypes
import importlib.util
import io
import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from pydrake.geometry import (
    ClippingRange,
    ColorRenderCamera,
    LightParameter,
    MakeRenderEngineVtk,
    RenderCameraCore,
    RenderEngineVtkParams,
    SceneGraph,
    SsaoParameter,
)
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.systems.framework import Context
from pydrake.systems.sensors import CameraInfo

from kitting_drake.common.errors import MachineError
from kitting_drake.common.files import write_atomically

_rendering_process: int | None = None
"""The process in which engines were made; a fork inherits it."""


def can_render() -> bool:
    """Whether the system library that rendering needs is there."""
    try:
        ctypes.CDLL("libEGL.so.1")
    except OSError:
        return False
    return True


def require_rendering() -> None:
    """Makes sure that images can be rendered here; to be called before an engine is made.

    Raises:
        MachineError: the system library is missing, or the process was forked from one that has
            rendered; says what would do.
    """
    global _rendering_process
    if not can_render():
        raise MachineError(
            "rendering needs the system library libEGL: install it "
            "(Debian and Ubuntu: apt-get install libegl1 libgl1-mesa-dri)"
        )
    if _rendering_process not in (None, os.getpid()):
        raise MachineError(
            "this process was forked from one that has rendered, which OpenGL does not survive: "
            "start it by spawn, as in multiprocessing.get_context('spawn')"
        )
    _rendering_process = os.getpid()
    _load_triton()


def _load_triton() -> None:
    """Loads Triton, which PyTorch imports with its first optimizer where it is built for CUDA.

    It brings an LLVM of its own. Where Mesa's was loaded before, as by rendering without a graphics
    card, that import ends in a segmentation fault; in this order both work.
    """
    package = importlib.util.find_spec("triton")
    for folder in (package and package.submodule_search_locations) or ():
        for library in Path(folder, "_C").glob("libtriton*.so"):
            # One that does not load cannot be imported later either.
            with contextlib.suppress(OSError):
                ctypes.CDLL(str(library))


def add_observation_renderer(scene_graph: SceneGraph, lights: Sequence[LightParameter] = ()) -> str:
    """Adds the engine that the policy sees by, plain and quick; returns its name.

    Args:
        scene_graph: to add it to.
        lights: none: one at each camera.

    Raises:
        MachineError: images cannot be rendered here.
    """
    require_rendering()
    parameters = RenderEngineVtkParams(lights=list(lights))
    scene_graph.AddRenderer("observation", MakeRenderEngineVtk(parameters))
    return "observation"


def add_picture_renderer(scene_graph: SceneGraph) -> str:
    """Adds the engine that pictures are made with; returns its name.

    Soft light from three sides, and ambient occlusion, which tells what stands on what. To be added
    before a context is made: one that comes later is not told where things are.

    Raises:
        MachineError: images cannot be rendered here.
    """
    return _add_studio(scene_graph, "picture", SsaoParameter(radius=0.08))


def add_film_renderer(scene_graph: SceneGraph) -> str:
    """Adds the engine that films are made with, lit as pictures are, but quick; returns its name.

    Raises:
        MachineError: images cannot be rendered here.
    """
    return _add_studio(scene_graph, "film", None)


def _add_studio(scene_graph: SceneGraph, name: str, ssao: SsaoParameter | None) -> str:
    require_rendering()
    parameters = RenderEngineVtkParams(
        default_clear_color=np.array([0.90, 0.92, 0.94]),
        lights=[
            _light([-0.45, 0.35, -0.9], 0.9),
            _light([0.6, -0.5, -0.6], 0.45),
            _light([0.1, 0.9, -0.4], 0.25),
        ],
        ssao=ssao,
    )
    scene_graph.AddRenderer(name, MakeRenderEngineVtk(parameters))
    return name


def _light(direction: list[float], intensity: float) -> LightParameter:
    return LightParameter(
        type="directional", frame="world", direction=direction, intensity=intensity
    )


def look_at(position: Sequence[float], target: Sequence[float]) -> RigidTransform:
    """X_WC of an upright camera at `position` that looks at `target`, both in the world in metres.

    z looks, x points right in the image, y down. The two must not lie above one another.
    """
    z = np.subtract(target, position)
    x = np.cross(z, [0.0, 0.0, 1.0])
    R_WC = RotationMatrix(np.column_stack([v / np.linalg.norm(v) for v in (x, np.cross(z, x), z)]))
    return RigidTransform(R_WC, list(position))


X_WOVERVIEW = look_at([1.62, -0.95, 1.13], [0.48, -0.02, 0.06])
"""From where pictures and films show the whole cell."""


def picture_camera(
    renderer: str, *, width: int = 1280, height: int = 800, fov_y: float = 0.42
) -> RenderCameraCore:
    """A camera for people's eyes: size in pixels, vertical field of view in radians."""
    return RenderCameraCore(
        renderer,
        CameraInfo(width=width, height=height, fov_y=fov_y),
        ClippingRange(0.05, 10.0),
        RigidTransform(),
    )


def render_picture(
    scene_graph: SceneGraph, context: Context, X_WC: RigidTransform = X_WOVERVIEW
) -> NDArray[np.uint8]:
    """(800, 1280, 3) what a scene graph's own, connected context shows from a camera's place.

    The scene graph needs the engine of `add_picture_renderer`.
    """
    camera = ColorRenderCamera(picture_camera("picture"))
    query = scene_graph.get_query_output_port().Eval(context)
    image = query.RenderColorImage(camera, scene_graph.world_frame_id(), X_WC)
    return np.array(image.data[:, :, :3])


def save_png(pixels: NDArray[np.uint8], path: Path) -> None:
    """Writes an image (height, width, 3) to a PNG file, atomically.

    Raises:
        UserError: the file cannot be written.
    """
    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, "PNG")
    write_atomically(path, buffer.getvalue())
