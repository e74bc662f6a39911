"""Renders contact sheets of tools and kits with Drake's VTK engine, without a display."""

import hashlib
import io
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image
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
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.sensors import CameraInfo

from kitting_drake.common.cached_folder import cached_folder
from kitting_drake.common.files import write_atomically
from kitting_drake.common.paths import cache_directory
from kitting_drake.common.provenance import versions
from kitting_drake.common.rendering import require_rendering
from kitting_drake.hkd.kits.kit import Kit
from kitting_drake.hkd.kits.parameters import KitParameters
from kitting_drake.hkd.tools.tool import Tool

_FORMAT_VERSION = "1"
"""The version of the pictures in the cache. Increase it when the same subject gives a different
picture."""
_PICTURE = "picture.png"
_BACKGROUND = (0.97, 0.97, 0.96)
# A key light casts the shadows. The fill light is at the camera, where its shadows are hidden.
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
    """Returns the pose X_WC of a camera that looks at the point `target`, in metres.

    The camera's z axis points forward, and its y axis points down.

    Args:
        target: (3,) the point in the world.
        azimuth_deg: the direction from the target to the camera, about world z from +x.
        elevation_deg: the angle of this direction above the horizontal.
        distance: the distance between camera and target, in metres.
    """
    a, e = np.radians([azimuth_deg, elevation_deg])
    toward = np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
    # The image's rightward direction is horizontal. This also defines it for a camera that looks
    # straight down.
    right = np.array([-np.sin(a), np.cos(a), 0.0])
    R_WC = RotationMatrix(np.column_stack([right, np.cross(-toward, right), -toward]))
    return RigidTransform(R_WC, target + distance * toward)


@dataclass(frozen=True)
class Subject:
    """The content of one picture of the sheet."""

    title: str
    models: Sequence[tuple[Path, RigidTransform]]
    """Pairs of an SDFormat file with one link, and the pose of this link in the world."""
    target: tuple[float, float, float]
    """The point in the world at which the camera looks, in metres."""
    size: float
    """The width of the view at the target, in metres."""
    elevation_deg: float = 38.0


def tool_subject(tool: Tool) -> Subject:
    """Returns the subject of a picture: a tool at rest on the table."""
    title = tool.name.replace("_", " ")
    # If a tool is larger than those of the dataset, view it from farther away.
    size = 0.208 * max(1.0, tool.length / 0.2, tool.width / 0.13)
    return Subject(title, [(tool.sdf, RigidTransform())], (0.0, 0.0, 0.006), size)


def kit_subject(title: str, kit: Kit) -> Subject:
    """Returns the subject of a picture: a kit on the table.

    All tools but the last are seated, to show one empty cavity.
    """
    seated = [
        (tool.sdf, RigidTransform(RollPitchYaw(0, 0, pose.yaw), [pose.x, pose.y, pose.z]))
        for tool, pose in zip(kit.tools[:-1], kit.layout.poses[:-1], strict=True)
    ]
    models = [(kit.sdf, RigidTransform()), *seated]
    # A block of the template's size fills the picture; view a larger block from farther away.
    template = KitParameters()
    size = 0.52 * max(1.0, kit.size[0] / template.length, kit.size[1] / template.width)
    return Subject(title, models, (0.0, 0.0, 0.02), size, elevation_deg=52.0)


def render_subject(
    subject: Subject, *, azimuth_deg: float = -62.0, width: int = 900, height: int = 600
) -> np.ndarray:
    """Renders a subject on a pale table to an image (height, width, 3)."""
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
    for path, X_WB in subject.models:
        (instance,) = parser.AddModels(str(path))
        (body,) = plant.GetBodyIndices(instance)
        plant.WeldFrames(plant.world_frame(), plant.get_body(body).body_frame(), X_WB)
    plant.Finalize()
    _add_table(scene_graph)
    diagram = builder.Build()
    context = diagram.CreateDefaultContext()

    # Use a distant camera, which keeps parallel edges nearly parallel.
    distance = 3.46 * subject.size
    field_of_view = 2 * np.arctan(subject.size / distance / 2 * height / width)
    pose = camera_pose(np.array(subject.target), azimuth_deg, subject.elevation_deg, distance)
    core = RenderCameraCore(
        "vtk",
        CameraInfo(width, height, field_of_view),
        ClippingRange(0.05, 5.0),
        RigidTransform(),
    )
    query = scene_graph.get_query_output_port().Eval(scene_graph.GetMyContextFromRoot(context))
    image = query.RenderColorImage(
        ColorRenderCamera(core, False), scene_graph.world_frame_id(), pose
    )
    return image.data[:, :, :3].copy()


def _kept_picture(subject: Subject) -> np.ndarray:
    """Returns the picture of a subject from the cache; renders it if it is missing."""
    digest = hashlib.sha256(f"{_FORMAT_VERSION} {versions()}".encode())
    digest.update(f"{subject.target} {subject.size} {subject.elevation_deg}".encode())
    for path, X_WB in subject.models:
        digest.update(X_WB.GetAsMatrix4().tobytes())
        for file in sorted(path.parent.iterdir()):
            if file.is_file():
                digest.update(file.read_bytes())
    folder = cached_folder(
        cache_directory() / "pictures" / digest.hexdigest()[:24],
        [_PICTURE],
        lambda made: Image.fromarray(render_subject(subject)).save(made / _PICTURE),
    )
    with Image.open(folder / _PICTURE) as picture:
        return np.asarray(picture)


def _add_table(scene_graph: SceneGraph) -> None:
    source = scene_graph.RegisterSource("table")
    table = GeometryInstance(RigidTransform([0.0, 0.0, -0.01]), Box(4.0, 4.0, 0.02), "table")
    properties = PerceptionProperties()
    properties.AddProperty("phong", "diffuse", Rgba(0.97, 0.97, 0.96, 1.0))
    table.set_perception_properties(properties)
    scene_graph.RegisterAnchoredGeometry(source, table)


def write_sheet(subjects: Iterable[Subject], count: int, output: Path) -> None:
    """Writes one picture of all the subjects with their titles.

    The picture of each subject is stored in the cache, so that a call after an interruption
    continues where the interrupted call stopped.

    Args:
        subjects: the contents of the pictures.
        count: the number of subjects.
        output: the PNG file to write.

    Raises:
        UserError: rendering is not available, or the picture cannot be written.
    """
    require_rendering()
    # Import matplotlib lazily, because it is slow to import.
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    columns = min(count, 2 if count <= 4 else 6)
    rows = -(-count // columns)
    figure, axes = plt.subplots(
        rows, columns, figsize=(4.5 * columns, 3.3 * rows), squeeze=False, facecolor=_BACKGROUND
    )
    for axis in axes.flat:
        axis.set_axis_off()
    for axis, subject in zip(axes.flat, subjects, strict=False):
        axis.imshow(_kept_picture(subject))
        axis.set_title(subject.title, fontsize=13, color="0.15")
    figure.tight_layout()
    picture = io.BytesIO()
    figure.savefig(picture, format="png", dpi=130 if count <= 12 else 60)
    plt.close(figure)
    write_atomically(output, picture.getvalue())
