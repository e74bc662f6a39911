"""Renders the observation o_t of meshes on a table, without physics."""

from collections.abc import Sequence

import numpy as np
from manifold3d import Manifold
from numpy.typing import NDArray
from pydrake.common import MemoryFile
from pydrake.geometry import (
    ColorRenderCamera,
    GeometryInstance,
    InMemoryMesh,
    Mesh,
    PerceptionProperties,
    RenderLabel,
    SceneGraph,
)
from pydrake.math import RigidTransform
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.sensors import RgbdSensor

from kitting_drake.common.rendering import add_observation_renderer
from kitting_drake.hkd.generation.random_tools import RandomTool
from kitting_drake.hkd.tools.meshes import flat_obj, vertices_and_faces
from kitting_drake.scenario.cameras import Camera, camera_pose, depth_camera
from systems.heightmap_projector import HeightmapProjector
from systems.sensor_noise import SensorNoise, SensorNoiseParameters
from systems.signals import Observation, PixelGrid

Body = tuple[str, RigidTransform]
"""A mesh as Wavefront text in metres, and its pose in the world."""


def render(
    bodies: Sequence[Body],
    grid: PixelGrid,
    noise: SensorNoiseParameters,
    seed: int,
    views: dict[str, Camera],
) -> Observation:
    """Renders the observation o_t of bodies on a table, with heights only; colours are black.

    Args:
        bodies: the bodies on the table, whose top is the plane z = 0.
        grid: the pixels of the observation.
        noise: the noise of the cameras.
        seed: the seed of the noise.
        views: the cameras by name.
    """
    builder = DiagramBuilder()
    scene_graph = builder.AddSystem(SceneGraph())
    source = scene_graph.RegisterSource("static")
    renderer = add_observation_renderer(scene_graph)
    corners = np.array([[-1, -2, 0], [2, -2, 0], [2, 2, 0], [-1, 2, 0]], float)
    table = (_obj(corners, np.array([[0, 1, 2], [0, 2, 3]])), RigidTransform())
    for number, (text, X) in enumerate([table, *bodies]):
        file = MemoryFile(text, ".obj", f"body_{number}")
        mesh = Mesh(InMemoryMesh(mesh_file=file))
        instance = GeometryInstance(X, mesh, f"body_{number}")
        properties = PerceptionProperties()
        properties.AddProperty("label", "id", RenderLabel(number))
        instance.set_perception_properties(properties)
        scene_graph.RegisterAnchoredGeometry(source, instance)
    cameras = {name: depth_camera(config, renderer) for name, config in views.items()}
    projector = builder.AddSystem(HeightmapProjector(cameras=cameras, grid=grid))
    for number, (name, config) in enumerate(views.items()):
        sensor = builder.AddSystem(
            RgbdSensor(
                parent_id=scene_graph.world_frame_id(),
                X_PB=camera_pose(config),
                color_camera=ColorRenderCamera(cameras[name].core()),
                depth_camera=cameras[name],
            )
        )
        imperfect = builder.AddSystem(
            SensorNoise(parameters=noise, camera=cameras[name], seed=seed, number=number)
        )
        builder.Connect(scene_graph.get_query_output_port(), sensor.query_object_input_port())
        for output, port in (
            ("depth_image_32f", "depth_image"),
            ("body_pose_in_world", "body_pose_in_world"),
        ):
            builder.Connect(sensor.GetOutputPort(output), imperfect.GetInputPort(output))
            builder.Connect(
                imperfect.GetOutputPort(output), projector.GetInputPort(f"{port}_{name}")
            )
    builder.ExportOutput(projector.GetOutputPort("heights"), "heights")
    diagram = builder.Build()
    return diagram.GetOutputPort("heights").Eval(diagram.CreateDefaultContext())


def block_text(size: tuple[float, float, float]) -> str:
    """Returns a box as Wavefront text. Its origin is in the middle of its bottom."""
    return solid_text(Manifold.cube(size, True).translate((0, 0, size[2] / 2)))


def tool_text(tool: RandomTool) -> str:
    corners = tool.triangles.reshape(-1, 3)
    return _obj(corners, np.arange(len(corners)).reshape(-1, 3))


def solid_text(solid: Manifold) -> str:
    return _obj(*vertices_and_faces(solid))


def _obj(vertices: NDArray[np.float64], faces: NDArray[np.int64]) -> str:
    """Returns a mesh as Wavefront text with face normals, which the renderer needs."""
    return flat_obj(vertices, faces, digits=6, normal_digits=3)
