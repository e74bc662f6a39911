"""Pictures of tools, rendered without a display by Drake's VTK engine."""

from pathlib import Path

import numpy as np
from pydrake.geometry import (
    Box,
    ClippingRange,
    ColorRenderCamera,
    GeometryInstance,
    LightParameter,
    MakeRenderEngineVtk,
    PerceptionProperties,
    RenderCameraCore,
    RenderEngineVtkParams,
    Rgba,
    SceneGraph,
)
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.sensors import CameraInfo

_BACKGROUND = (0.97, 0.97, 0.96)
# A key light that throws the shadows, and a fill from the camera, whose shadows cannot be seen.
_LIGHTS = [
    LightParameter(
        type="directional",
        color=Rgba(1, 1, 1),
        intensity=0.80,
        frame="world",
        direction=[-0.3, 0.5, -1.0],
    ),
    LightParameter(
        type="directional",
        color=Rgba(0.97, 0.98, 1.0),
        intensity=0.40,
        frame="camera",
        direction=[0.25, 0.15, 1.0],
    ),
]


def camera_pose(
    target: np.ndarray, azimuth_deg: float, elevation_deg: float, distance: float
) -> RigidTransform:
    """X_WC of a camera that looks at `target` (m) from the given side; optical axis +z, y down."""
    a, e = np.radians([azimuth_deg, elevation_deg])
    toward = np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
    # Right stays level; it is defined even for a view straight down.
    right = np.array([-np.sin(a), np.cos(a), 0.0])
    R_WC = RotationMatrix(np.column_stack([right, np.cross(-toward, right), -toward]))
    return RigidTransform(R_WC, target + distance * toward)


def render_tool(
    models: Path,
    name: str,
    *,
    azimuth_deg: float = -62.0,
    elevation_deg: float = 38.0,
    width: int = 900,
    height: int = 600,
    field_of_view_deg: float = 11.0,
) -> np.ndarray:
    """An image (height, width, 3) of a tool lying on a pale table. `models` holds package.xml."""
    builder = DiagramBuilder()
    plant, scene_graph = AddMultibodyPlantSceneGraph(builder, 0.0)
    scene_graph.AddRenderer(
        "vtk",
        MakeRenderEngineVtk(
            RenderEngineVtkParams(
                default_clear_color=_BACKGROUND,
                lights=_LIGHTS,
                cast_shadows=True,
                shadow_map_size=4096,
            )
        ),
    )
    parser = Parser(plant)
    parser.package_map().AddPackageXml(str(models / "package.xml"))
    parser.AddModels(str(models / "tools" / name / f"{name}.sdf"))
    plant.Finalize()
    _add_table(scene_graph)
    diagram = builder.Build()
    context = diagram.CreateDefaultContext()

    pose = camera_pose(np.array([0.0, 0.0, 0.006]), azimuth_deg, elevation_deg, 0.72)
    core = RenderCameraCore(
        "vtk",
        CameraInfo(width, height, np.radians(field_of_view_deg)),
        ClippingRange(0.05, 5.0),
        RigidTransform(),
    )
    query = scene_graph.get_query_output_port().Eval(scene_graph.GetMyContextFromRoot(context))
    image = query.RenderColorImage(
        ColorRenderCamera(core, False), scene_graph.world_frame_id(), pose
    )
    return image.data[:, :, :3].copy()


def _add_table(scene_graph: SceneGraph) -> None:
    source = scene_graph.RegisterSource("table")
    table = GeometryInstance(RigidTransform([0.0, 0.0, -0.01]), Box(4.0, 4.0, 0.02), "table")
    properties = PerceptionProperties()
    properties.AddProperty("phong", "diffuse", Rgba(0.97, 0.97, 0.96, 1.0))
    table.set_perception_properties(properties)
    scene_graph.RegisterAnchoredGeometry(source, table)


def write_sheet(models: Path, names: list[str], output: Path) -> None:
    """Writes one picture of all the tools with their names."""
    # Imported here: drawing is the only use, and the other verbs should not wait for it.
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    columns = min(len(names), 2 if len(names) <= 4 else 6)
    rows = -(-len(names) // columns)
    figure, axes = plt.subplots(
        rows, columns, figsize=(4.5 * columns, 3.3 * rows), squeeze=False, facecolor=_BACKGROUND
    )
    for axis in axes.flat:
        axis.set_axis_off()
    for axis, name in zip(axes.flat, names, strict=False):
        axis.imshow(render_tool(models, name))
        axis.set_title(name.replace("_", " "), fontsize=13, color="0.15")
    figure.tight_layout()
    figure.savefig(output, dpi=130)
    plt.close(figure)
