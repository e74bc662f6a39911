"""Rendering without a display: render engines, pictures and PNG files."""

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
"""Id of the process that has made render engines. A forked child inherits the value and so detects
the fork."""


def can_render() -> bool:
    """Whether the system library for rendering is installed."""
    try:
        ctypes.CDLL("libEGL.so.1")
    except OSError:
        return False
    return True


def require_rendering() -> None:
    """Checks that this process can render. Call this function before making an engine.

    Raises:
        MachineError: the system library is missing, or the process was forked from one that has
            rendered.
    """
    global _rendering_process
    if not can_render():
        raise MachineError(
            "rendering needs the system library libEGL: install it "
            "(Debian and Ubuntu: apt-get install libegl1 libgl1-mesa-dri)"
        )
    if _rendering_process not in (None, os.getpid()):
        raise MachineError(
            "this process was forked from one that has rendered, which breaks OpenGL: use "
            "multiprocessing.get_context('spawn')"
        )
    _rendering_process = os.getpid()
    _load_triton()


def _load_triton() -> None:
    """Loads Triton before Mesa, if PyTorch is built for CUDA.

    Triton and Mesa each contain their own LLVM. PyTorch imports Triton with the first optimizer,
    and crashes if Mesa's LLVM (for software rendering) is loaded already. The reverse order works.
    """
    with contextlib.suppress(OSError):
        if b"libLLVM" in Path("/proc/self/maps").read_bytes():
            # Another renderer has already loaded Mesa's LLVM, so loading Triton would crash.
            return
    package = importlib.util.find_spec("triton")
    for folder in (package and package.submodule_search_locations) or ():
        for library in Path(folder, "_C").glob("libtriton*.so"):
            # If loading fails, PyTorch cannot import Triton either, so the error does not matter.
            with contextlib.suppress(OSError):
                ctypes.CDLL(str(library))


def add_observation_renderer(scene_graph: SceneGraph, lights: Sequence[LightParameter] = ()) -> str:
    """Adds the render engine of the policy's cameras, which is plain and fast. Returns its name.

    Args:
        scene_graph: the scene graph to which the engine is added.
        lights: the lights; if empty, there is a light at each camera.

    Raises:
        MachineError: this machine cannot render.
    """
    require_rendering()
    parameters = RenderEngineVtkParams(lights=list(lights))
    scene_graph.AddRenderer("observation", MakeRenderEngineVtk(parameters))
    return "observation"


def add_picture_renderer(scene_graph: SceneGraph) -> str:
    """Adds the render engine for still pictures, with soft light from three sides and ambient
    occlusion. Returns its name.

    Call this function before a context is made. An engine that is added later does not get the
    poses of the geometry.

    Raises:
        MachineError: this machine cannot render.
    """
    return _add_studio(scene_graph, "picture", SsaoParameter(radius=0.08))


def add_film_renderer(scene_graph: SceneGraph) -> str:
    """Adds the render engine for videos: it has the lights of `add_picture_renderer` but, to be
    fast, no ambient occlusion. Returns its name.

    Raises:
        MachineError: this machine cannot render.
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

    The camera's x axis points right in the image, y down, z forward. The view must not be vertical.
    """
    z = np.subtract(target, position)
    x = np.cross(z, [0.0, 0.0, 1.0])
    R_WC = RotationMatrix(np.column_stack([v / np.linalg.norm(v) for v in (x, np.cross(z, x), z)]))
    return RigidTransform(R_WC, list(position))


X_WOVERVIEW = look_at([1.62, -0.95, 1.13], [0.48, -0.02, 0.06])
"""Camera pose for pictures and videos of the whole cell with a floating hand."""
X_WARM_OVERVIEW = look_at([2.05, -1.35, 1.25], [0.36, 0.0, 0.34])
"""Camera pose for pictures and videos of the whole cell with an arm."""


def picture_camera(
    renderer: str, *, width: int = 1280, height: int = 800, fov_y: float = 0.42
) -> RenderCameraCore:
    """A camera for pictures. Width and height are in pixels, the vertical field of view `fov_y` in
    radians."""
    return RenderCameraCore(
        renderer,
        CameraInfo(width=width, height=height, fov_y=fov_y),
        ClippingRange(0.05, 10.0),
        RigidTransform(),
    )


def render_picture(
    scene_graph: SceneGraph, context: Context, X_WC: RigidTransform
) -> NDArray[np.uint8]:
    """Renders a picture (800, 1280, 3) of a scene graph in its context, from a camera pose.

    The scene graph must have the render engine of `add_picture_renderer`.
    """
    camera = ColorRenderCamera(picture_camera("picture"))
    query = scene_graph.get_query_output_port().Eval(context)
    image = query.RenderColorImage(camera, scene_graph.world_frame_id(), X_WC)
    return np.array(image.data[:, :, :3])


def png_bytes(pixels: NDArray[np.uint8]) -> bytes:
    """Encodes an image (height, width, 3) as PNG."""
    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, "PNG")
    return buffer.getvalue()


def save_png(pixels: NDArray[np.uint8], path: Path) -> None:
    """Writes an image (height, width, 3) to a PNG file, atomically.

    Raises:
        MachineError: writing fails.
    """
    write_atomically(path, png_bytes(pixels))
