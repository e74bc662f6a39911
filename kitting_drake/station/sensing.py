"""Adds cameras, sensor noise and the heightmap projector to the station."""

from pydrake.geometry import ColorRenderCamera, SceneGraph
from pydrake.systems.framework import DiagramBuilder, LeafSystem
from pydrake.systems.sensors import RgbdSensor

from kitting_drake.common.errors import UserError
from kitting_drake.common.rendering import (
    add_observation_renderer,
)
from kitting_drake.scenario.cameras import camera_pose, depth_camera
from kitting_drake.scenario.schema import Scenario
from kitting_drake.station.paint import lights_of
from systems.heightmap_projector import HeightmapProjector
from systems.sensor_noise import SensorNoise
from systems.signals import PixelGrid

_IMAGES = {
    "color_image": "color_image",
    "depth_image_32f": "depth_image",
    "body_pose_in_world": "body_pose_in_world",
}
"""For each output port of a camera, the prefix of the projector's input port."""
_EXPORTED = {
    "color_image": "color_image",
    "depth_image_32f": "depth_image",
    "body_pose_in_world": "camera_pose",
}
"""For each output port of a camera, the prefix of the station's output port."""


def add_cameras(
    builder: DiagramBuilder,
    scenario: Scenario,
    scene_graph: SceneGraph,
    grid: PixelGrid,
    seed: int,
) -> HeightmapProjector:
    """Adds a scenario's cameras, their noise, and the projector of their images.

    Args:
        builder: the builder of the station.
        scenario: the scenario, which configures cameras, appearance and sensor noise.
        scene_graph: the scene graph that the cameras see.
        grid: the pixel grid of the observation.
        seed: the seed of lights and noise.

    Returns:
        The projector, whose port `observation` is o_t.

    Raises:
        UserError: there are no cameras.
        MachineError: this machine cannot render.
    """
    if not scenario.cameras:
        raise UserError("cameras is empty: the heightmap needs at least one camera")
    lights = lights_of(scenario.appearance, seed)
    renderer = add_observation_renderer(scene_graph, lights)
    cameras = {name: depth_camera(config, renderer) for name, config in scenario.cameras.items()}
    projector = builder.AddNamedSystem(
        "heightmap_projector", HeightmapProjector(cameras=cameras, grid=grid)
    )
    for number, (name, config) in enumerate(scenario.cameras.items()):
        sensor = builder.AddNamedSystem(
            f"camera_{name}",
            RgbdSensor(
                parent_id=scene_graph.world_frame_id(),
                X_PB=camera_pose(config),
                color_camera=ColorRenderCamera(cameras[name].core()),
                depth_camera=cameras[name],
            ),
        )
        builder.Connect(scene_graph.get_query_output_port(), sensor.query_object_input_port())
        source: LeafSystem = sensor
        use_labels = bool(scenario.appearance.sheen)
        if use_labels or not scenario.sensor_noise.is_none:
            source = builder.AddNamedSystem(
                f"sensor_noise_{name}",
                SensorNoise(
                    parameters=scenario.sensor_noise,
                    camera=cameras[name],
                    seed=seed,
                    number=number,
                    workspace_middle=((grid.x_min + grid.x_max) / 2, (grid.y_min + grid.y_max) / 2),
                    use_labels=use_labels,
                ),
            )
            for port in (*_IMAGES, *(["label_image"] if use_labels else [])):
                builder.Connect(sensor.GetOutputPort(port), source.GetInputPort(port))
        for output, port in _IMAGES.items():
            builder.Connect(source.GetOutputPort(output), projector.GetInputPort(f"{port}_{name}"))
        for output, port in _EXPORTED.items():
            builder.ExportOutput(source.GetOutputPort(output), f"{port}_{name}")
    return projector
