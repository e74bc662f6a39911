"""Visualization: Meshcat, videos, and drawings of a Diagram."""

import itertools
import shutil
import subprocess
from pathlib import Path
from typing import TYPE_CHECKING

from pydrake.geometry import (
    Box,
    ColorRenderCamera,
    Cylinder,
    DepthRange,
    DepthRenderCamera,
    Meshcat,
    MeshcatParams,
    MeshcatVisualizer,
    MeshcatVisualizerParams,
    Rgba,
    Role,
)
from pydrake.math import RigidTransform
from pydrake.systems.framework import Diagram, DiagramBuilder
from pydrake.systems.sensors import RgbdSensor

from kitting_drake.common.errors import UserError
from kitting_drake.common.files import write_atomically
from kitting_drake.common.rendering import add_film_renderer, picture_camera
from kitting_drake.station.station import KittingStation

if TYPE_CHECKING:
    from pydrake.visualization import VideoWriter

MESHCAT_PERIOD = 1 / 32
"""Simulated time between two pictures in Meshcat, in s."""
_FIELD_OF_VIEW_DEG = 34.0
"""Vertical field of view with which Meshcat starts."""


def start_meshcat(parameters: MeshcatParams) -> Meshcat:
    """Starts Meshcat with a view of the table.

    Args:
        parameters: the parameters of a scenario.

    Raises:
        UserError: no port is free.
    """
    try:
        meshcat = Meshcat(parameters)
    except RuntimeError as error:
        raise UserError(
            "no port from 7000 to 7099 is free for Meshcat: close viewers, or pass --no-meshcat"
        ) from error
    meshcat.SetProperty("/Background", "top_color", [0.86, 0.91, 0.96])
    meshcat.SetProperty("/Background", "bottom_color", [0.96, 0.97, 0.98])
    meshcat.SetProperty("/Grid", "visible", False)
    meshcat.SetProperty("/Axes", "visible", False)
    _add_room(meshcat)
    # A narrow field of view from farther away shows the workspace large and with little distortion.
    meshcat.SetProperty("/Cameras/default/rotated/<object>", "fov", _FIELD_OF_VIEW_DEG)
    meshcat.SetCameraPose(camera_in_world=[1.55, -0.42, 0.98], target_in_world=[0.47, -0.02, 0.09])
    return meshcat


def _add_room(meshcat: Meshcat) -> None:
    """Adds a floor, and legs to the table. They are only in Meshcat, so no simulated camera sees
    them."""
    top, floor = -0.07, -0.75
    meshcat.SetObject("/room/floor", Cylinder(5.0, 0.02), Rgba(0.80, 0.72, 0.62))
    meshcat.SetTransform("/room/floor", RigidTransform([0.5, 0.0, floor - 0.01]))
    for x, y in itertools.product((0, 1), (0, 1)):
        leg = f"/room/leg_{x}{y}"
        meshcat.SetObject(leg, Box(0.05, 0.05, top - floor), Rgba(0.62, 0.52, 0.40))
        p_WLeg = [0.06 + 0.88 * x, -0.69 + 1.38 * y, (top + floor) / 2]
        meshcat.SetTransform(leg, RigidTransform(p_WLeg))


def add_meshcat(builder: DiagramBuilder, station: KittingStation, meshcat: Meshcat) -> None:
    """Shows the station in Meshcat, 32 times a second of simulated time."""
    parameters = MeshcatVisualizerParams(role=Role.kIllustration)
    parameters.publish_period = MESHCAT_PERIOD
    MeshcatVisualizer.AddToBuilder(
        builder, station.GetOutputPort("query_object"), meshcat, parameters
    )


def add_video(builder: DiagramBuilder, station: KittingStation, path: Path) -> "VideoWriter":
    """Adds a camera that sees the whole station, and a writer of its video.

    Args:
        builder: the builder that contains the station. No context may exist yet.
        station: the station to record.
        path: path of a .gif or .webp file, which the writer's `Save()` writes.

    Raises:
        MachineError: this machine cannot render.
    """
    # Import matplotlib lazily.
    from pydrake.visualization import VideoWriter

    core = picture_camera(add_film_renderer(station.scene_graph), width=640, height=400)
    sensor = builder.AddNamedSystem(
        "film_camera",
        RgbdSensor(
            parent_id=station.scene_graph.world_frame_id(),
            X_PB=station.X_WOverview,
            color_camera=ColorRenderCamera(core),
            depth_camera=DepthRenderCamera(core, DepthRange(0.05, 10.0)),
        ),
    )
    builder.Connect(station.GetOutputPort("query_object"), sensor.query_object_input_port())
    writer = builder.AddNamedSystem("video_writer", VideoWriter(filename=str(path), fps=16.0))
    writer.ConnectRgbdSensor(builder=builder, sensor=sensor)
    return writer


def draw_diagram(diagram: Diagram, path: Path) -> None:
    """Draws a Diagram with Graphviz.

    Raises:
        UserError: the file's suffix is not .svg, .png, .pdf or .dot, or Graphviz is missing or
            fails.
    """
    source = diagram.GetGraphvizString(max_depth=2)
    if path.suffix == ".dot":
        write_atomically(path, source)
        return
    if path.suffix not in (".svg", ".png", ".pdf"):
        raise UserError(f"--graphviz writes .svg, .png, .pdf and .dot files, not '{path}'")
    if shutil.which("dot") is None:
        raise UserError(
            "--graphviz needs the program dot: install it (Debian and Ubuntu: apt-get install "
            "graphviz), or write a .dot file"
        )
    drawn = subprocess.run(
        ["dot", f"-T{path.suffix[1:]}"], input=source.encode(), capture_output=True
    )
    if drawn.returncode:
        reason = drawn.stderr.decode(errors="replace").strip().splitlines()[-1:]
        raise UserError(f"--graphviz: dot cannot write {path}: {' '.join(reason)}")
    write_atomically(path, drawn.stdout)
