"""Cameras and render engines: from their descriptions in a scenario to Drake's."""

import ctypes
import io
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from pydrake.geometry import (
    ClippingRange,
    ColorRenderCamera,
    DepthRange,
    DepthRenderCamera,
    LightParameter,
    MakeRenderEngineVtk,
    RenderCameraCore,
    RenderEngineVtkParams,
    SceneGraph,
)
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from pydrake.systems.framework import Context
from pydrake.systems.sensors import CameraInfo

from kitting_drake.errors import UserError
from kitting_drake.files import write_whole
from kitting_drake.scenario import LookAt, Pinhole

OVERVIEW = LookAt(position=[1.55, -0.85, 1.0], target=[0.46, -0.02, 0.14])
"""From where pictures and films show the whole cell."""

_OBSERVATION, _PICTURE = "observation", "picture"


def require_rendering() -> None:
    """Makes sure that images can be rendered here.

    Raises:
        UserError: the system library is missing; names the package.
    """
    try:
        ctypes.CDLL("libEGL.so.1")
    except OSError as error:
        raise UserError(
            "rendering needs the system library libEGL: install it "
            "(Debian and Ubuntu: apt-get install libegl1 libgl1-mesa-dri)"
        ) from error


def add_observation_renderer(scene_graph: SceneGraph) -> str:
    """Adds the engine that the policy sees by, plain and quick; returns its name.

    Raises:
        UserError: images cannot be rendered here.
    """
    require_rendering()
    scene_graph.AddRenderer(_OBSERVATION, MakeRenderEngineVtk(RenderEngineVtkParams()))
    return _OBSERVATION


def add_picture_renderer(scene_graph: SceneGraph, context: Context | None = None) -> str:
    """Adds, once, the engine that people see by, to a scene or its context; returns its name.

    Three lights, one of which casts shadows to speak of, before a light background.

    Raises:
        UserError: images cannot be rendered here.
    """
    target = () if context is None else (context,)
    if not scene_graph.HasRenderer(*target, _PICTURE):
        require_rendering()
        parameters = RenderEngineVtkParams(
            default_clear_color=np.array([0.90, 0.92, 0.94]),
            lights=[
                _light([-0.45, 0.35, -0.9], 1.0),
                _light([0.6, -0.5, -0.6], 0.45),
                _light([0.1, 0.9, -0.4], 0.25),
            ],
            cast_shadows=True,
            shadow_map_size=2048,
        )
        scene_graph.AddRenderer(*target, _PICTURE, MakeRenderEngineVtk(parameters))
    return _PICTURE


def _light(direction: list[float], intensity: float) -> LightParameter:
    return LightParameter(
        type="directional", frame="world", direction=direction, intensity=intensity
    )


def camera_pose(config: Pinhole | LookAt) -> RigidTransform:
    """X_WC of a camera: z looks, x points right in the image, y down."""
    if isinstance(config, Pinhole):
        return RigidTransform(RollPitchYaw(np.deg2rad(config.rpy_deg)), config.position)
    z = np.subtract(config.target, config.position)
    x = np.cross(z, [0.0, 0.0, 1.0])
    R_WC = RotationMatrix(np.column_stack([v / np.linalg.norm(v) for v in (x, np.cross(z, x), z)]))
    return RigidTransform(R_WC, config.position)


def depth_camera(config: Pinhole | LookAt, renderer: str) -> DepthRenderCamera:
    """Drake's description of a camera; colour and depth are seen from the same point."""
    info = CameraInfo(
        width=config.width,
        height=config.height,
        focal_x=config.focal_length,
        focal_y=config.focal_length,
        center_x=config.width / 2,
        center_y=config.height / 2,
    )
    core = RenderCameraCore(renderer, info, ClippingRange(0.01, 10.0), RigidTransform())
    return DepthRenderCamera(core, DepthRange(0.01, 10.0))


def picture_camera(
    renderer: str, *, width: int = 1280, height: int = 800, fov_y: float = 0.5
) -> RenderCameraCore:
    """A camera for people's eyes: size in pixels, vertical field of view in radians."""
    return RenderCameraCore(
        renderer,
        CameraInfo(width=width, height=height, fov_y=fov_y),
        ClippingRange(0.05, 10.0),
        RigidTransform(),
    )


def render_picture(
    scene_graph: SceneGraph, context: Context, view: Pinhole | LookAt = OVERVIEW
) -> NDArray[np.uint8]:
    """(800, 1280, 3) what a scene graph's own, connected context shows from a camera's place.

    Raises:
        UserError: images cannot be rendered here.
    """
    camera = ColorRenderCamera(picture_camera(add_picture_renderer(scene_graph, context)))
    query = scene_graph.get_query_output_port().Eval(context)
    image = query.RenderColorImage(camera, scene_graph.world_frame_id(), camera_pose(view))
    return np.array(image.data[:, :, :3])


def save_png(pixels: NDArray[np.uint8], path: Path) -> None:
    """Writes an image (height, width, 3) to a PNG file, whole or not at all.

    Raises:
        UserError: the file cannot be written.
    """
    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, "PNG")
    write_whole(path, buffer.getvalue())
