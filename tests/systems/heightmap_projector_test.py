import ctypes
import math
import sys

import numpy as np
import pytest
from pydrake import geometry
from pydrake.common.value import Value
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph
from pydrake.multibody.tree import SpatialInertia
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.sensors import CameraInfo, ImageDepth32F, ImageRgba8U, RgbdSensor

from systems.heightmap_projector import HeightmapProjector
from systems.signals import PixelGrid

try:
    ctypes.CDLL("libEGL.so.1")
    can_render = True
except OSError:
    can_render = sys.platform != "linux"
needs_renderer = pytest.mark.skipif(
    not can_render, reason="RenderEngineVtk needs libEGL.so.1 (Debian package libegl1)"
)
OUTPUTS = ("color_image", "depth_image_32f", "body_pose_in_world")
INPUTS = ("color_image", "depth_image", "body_pose_in_world")

# The first tests use a rendered scene: a box on a table under the three cameras of Ravens.

BOX = np.array([0.10, 0.06, 0.04])
BOX_COLOR = np.array([0.8, 0.3, 0.1])
TABLE_COLOR = np.array([0.4, 0.4, 0.4])
CAMERAS = {
    "front": RigidTransform(RollPitchYaw(math.pi / 4, math.pi, -math.pi / 2), [1, 0, 0.75]),
    "left": RigidTransform(RollPitchYaw(math.pi / 4.5, math.pi, math.pi / 4), [0, 0.5, 0.75]),
    "right": RigidTransform(RollPitchYaw(math.pi / 4.5, math.pi, 3 * math.pi / 4), [0, -0.5, 0.75]),
}
GRID = PixelGrid()


class _Scene:
    """A box on a table, seen by cameras whose frames are not those of their sensor bodies."""

    def __init__(self):
        builder = DiagramBuilder()
        self.plant, scene_graph = AddMultibodyPlantSceneGraph(builder, time_step=0.01)
        scene_graph.AddRenderer(
            "vtk", geometry.MakeRenderEngineVtk(geometry.RenderEngineVtkParams())
        )
        self.body = self.plant.AddRigidBody("box", SpatialInertia.SolidBoxWithMass(1, *BOX))
        for body, X, size, color in (
            (self.plant.world_body(), RigidTransform([0.5, 0, -0.05]), [2, 3, 0.1], TABLE_COLOR),
            (self.body, RigidTransform(), BOX, BOX_COLOR),
        ):
            shape, rgba = geometry.Box(*size), np.append(color, 1)
            self.plant.RegisterVisualGeometry(body, X, shape, "look", rgba)
        self.plant.Finalize()
        X_BD = RigidTransform(RollPitchYaw(0.3, -0.2, 0.5), [0.01, 0.02, -0.03])
        info = CameraInfo(640, 480, 450, 450, 320, 240)
        core = geometry.RenderCameraCore("vtk", info, geometry.ClippingRange(0.01, 10), X_BD)
        self.camera = geometry.DepthRenderCamera(core, geometry.DepthRange(0.01, 10))
        self.projector = builder.AddSystem(
            HeightmapProjector(cameras=dict.fromkeys(CAMERAS, self.camera))
        )
        self.sensors = {}
        color_camera = geometry.ColorRenderCamera(core)
        for name, X_WD in CAMERAS.items():
            X_WB = X_WD.multiply(X_BD.inverse())
            sensor = RgbdSensor(scene_graph.world_frame_id(), X_WB, color_camera, self.camera)
            self.sensors[name] = builder.AddSystem(sensor)
            builder.Connect(scene_graph.get_query_output_port(), sensor.query_object_input_port())
            for source, to in zip(OUTPUTS, INPUTS, strict=True):
                to_port = self.projector.GetInputPort(f"{to}_{name}")
                builder.Connect(sensor.GetOutputPort(source), to_port)
        self.diagram = builder.Build()
        self.context = self.diagram.CreateDefaultContext()

    def observe(self, xy, yaw):
        """The observation with the box at `xy`, and the box's true pose."""
        X_WBox = RigidTransform(RotationMatrix.MakeZRotation(yaw), [*xy, BOX[2] / 2])
        self.plant.SetFreeBodyPose(self.plant.GetMyContextFromRoot(self.context), self.body, X_WBox)
        projector_context = self.projector.GetMyContextFromRoot(self.context)
        return self.projector.GetOutputPort("observation").Eval(projector_context), X_WBox


@pytest.fixture(scope="module")
def scene():
    return _Scene()


PIXELS = np.stack(np.meshgrid(*map(np.arange, GRID.shape), indexing="ij"), axis=-1)
CORNERS = np.array([(-0.5, -0.5), (-0.5, 0.5), (0.5, -0.5), (0.5, 0.5)])


def _cells_against_box(X_WBox):
    """Two masks: pixels that lie inside the box's footprint, and pixels that do not touch it.

    Pixels that do not touch it are found by the separating axis theorem, with a margin of 0.3 mm.
    """
    offset_W = GRID.to_world(PIXELS) - X_WBox.translation()[:2]
    R = X_WBox.rotation().matrix()[:2, :2]
    offset_Box = offset_W @ R
    half_cell = GRID.resolution / 2
    cell_in_box_axes = half_cell * np.abs(R).sum(axis=0)
    inside = np.all(np.abs(offset_Box) + cell_in_box_axes <= BOX[:2] / 2, axis=-1)
    apart = np.any(np.abs(offset_Box) > BOX[:2] / 2 + cell_in_box_axes + 3e-4, axis=-1)
    apart |= np.any(np.abs(offset_W) > np.abs(R) @ BOX[:2] / 2 + half_cell + 3e-4, axis=-1)
    return inside, apart


def _is_hidden(X_WBox, camera, pixels):
    """Whether the box hides the table from the camera at these pixels (..., 2)."""
    p_W = np.insert(GRID.to_world(pixels), 2, 0, axis=-1).reshape(-1, 3).T
    p_Box = X_WBox.inverse().multiply(p_W).T
    ray = X_WBox.inverse().multiply(CAMERAS[camera].translation()) - p_Box
    ray[ray == 0] = 1e-12
    slabs = np.sort([(side * BOX / 2 - p_Box) / ray for side in (-1, 1)], axis=0)
    enter, leave = slabs[0].max(axis=-1), slabs[1].min(axis=-1)
    return (leave > np.maximum(enter, 0)).reshape(pixels.shape[:-1])


@needs_renderer
@pytest.mark.parametrize(
    ("xy", "yaw_deg"),
    [
        pytest.param(xy, yaw_deg, marks=[] if yaw_deg in sharp else [pytest.mark.slow])
        for xy, sharp in (
            ((0.5, 0.0), (45,)),
            ((0.4013, 0.2524), (30,)),
            ((0.6321, -0.3307), (137,)),
        )
        for yaw_deg in (0, 30, 45, 90, 137)
    ],
)
def test_heightmap_shows_the_box_at_its_true_pose(scene, xy, yaw_deg):
    observation, X_WBox = scene.observe(xy, math.radians(yaw_deg))
    inside, apart = _cells_against_box(X_WBox)
    height = observation.height
    assert observation.grid == GRID
    assert np.count_nonzero(inside) > 400
    np.testing.assert_allclose(height[inside], BOX[2], atol=1e-4)
    np.testing.assert_allclose(height[apart], 0, atol=1e-4)

    lit_xy = GRID.to_world(np.argwhere(height > BOX[2] / 2))
    assert np.max(np.abs(lit_xy.mean(axis=0) - xy)) < 0.5 * GRID.resolution
    _, axes = np.linalg.eigh(np.cov(lit_xy.T))
    angle = math.degrees(math.atan2(axes[1, 1], axes[0, 1]))
    # An error of one pixel over the box's length would be 1.8 degrees.
    assert abs(math.remainder(angle - yaw_deg, 180)) < 1.5

    # Shading keeps a colour's hue. At the box's outline, the colours of box and table are mixed.
    blank = np.all(observation.image == 0, axis=0)
    for cells, color in ((inside, BOX_COLOR), (apart, TABLE_COLOR)):
        seen = observation.rgb[:, cells & ~blank]
        hue = (seen / seen.sum(axis=0)).T
        np.testing.assert_allclose(hue, np.tile(color / color.sum(), (len(hue), 1)), atol=0.08)
        assert np.quantile(np.abs(hue - color / color.sum()), 0.999) < 0.01
        assert 0.5 < seen.max() / color.max() <= 1.01

    # At most one of the pixels that a camera sees completely is blank.
    squares = PIXELS[:, :, None] + CORNERS
    visible = np.zeros(GRID.shape, bool)
    for camera in CAMERAS:
        visible |= ~np.any(_is_hidden(X_WBox, camera, squares), axis=-1)
    assert np.count_nonzero(blank & (inside | apart & visible)) <= 1


@needs_renderer
def test_hidden_pixels_are_zero_with_one_camera(scene):
    _, X_WBox = scene.observe((0.6, -0.3), 0.4)
    projector = HeightmapProjector(cameras={"eye": scene.camera})
    context = projector.CreateDefaultContext()
    sensor = scene.sensors["left"]
    sensor_context = sensor.GetMyContextFromRoot(scene.context)
    color, depth, X_WB = (sensor.GetOutputPort(name).Eval(sensor_context) for name in OUTPUTS)
    _fix(projector, context, "eye", color.data, depth.data[:, :, 0], X_WB)
    image = projector.GetOutputPort("observation").Eval(context).image

    # The shadow of the box on the table is convex, so it contains a square of 3 x 3 pixels if it
    # contains the square's corners.
    squares = PIXELS[:, :, None] + 3 * CORNERS
    in_shadow = np.all(_is_hidden(X_WBox, "left", squares), axis=-1)
    in_shadow &= _cells_against_box(X_WBox)[1]
    assert np.count_nonzero(in_shadow) > 50
    assert not np.any(image[:, in_shadow])


# The other tests use hand-made images of 5 x 4 pixels, seen from 1 m above a grid of 4 rows and
# 5 columns. At depth 1 the image's pixels coincide with the grid's; at depth 1/2 they are half as
# far apart.

SMALL = PixelGrid(x_min=0, y_min=0, resolution=0.1, rows=4, cols=5, z_max=0.6)
X_WD = RigidTransform(RotationMatrix([[0, 1, 0], [1, 0, 0], [0, 0, -1]]), [0.2, 0.25, 1])
COLOR = np.arange(80, dtype=np.uint8).reshape(4, 5, 4)
RGB = COLOR[:, :, :3] / 255
FLAT = np.ones((4, 5), np.float32)
X_BD = RigidTransform(RollPitchYaw(0.1, 0.2, 0.3), [0.4, 0.5, 0.6])
X_WB = X_WD.multiply(X_BD.inverse())


def _small_camera():
    info = CameraInfo(5, 4, 10, 10, 2.5, 2)
    core = geometry.RenderCameraCore("", info, geometry.ClippingRange(0.01, 10), X_BD)
    return geometry.DepthRenderCamera(core, geometry.DepthRange(0.1, 1.25))


def _fix(projector, context, name, color, depth, X_WB):
    rgba = ImageRgba8U(color.shape[1], color.shape[0])
    rgba.mutable_data[:] = color
    for port, value in zip(INPUTS, (rgba, _depth(depth), X_WB), strict=True):
        projector.GetInputPort(f"{port}_{name}").FixValue(context, Value(value))


def _depth(depth):
    image = ImageDepth32F(depth.shape[1], depth.shape[0])
    image.mutable_data[:, :, 0] = depth
    return image


def _small_projector(*names, grid=SMALL):
    projector = HeightmapProjector(cameras={name: _small_camera() for name in names}, grid=grid)
    return projector, projector.CreateDefaultContext()


def _project(*views, grid=SMALL):
    """The image of the observation that is projected from (color, depth) of several cameras."""
    names = [f"camera{i}" for i in range(len(views))]
    projector, context = _small_projector(*names, grid=grid)
    for name, (color, depth) in zip(names, views, strict=True):
        _fix(projector, context, name, color, depth, X_WB)
    return projector.GetOutputPort("observation").Eval(context).image


def test_ports():
    projector, _ = _small_projector("a", "b")
    names = [projector.get_input_port(i).get_name() for i in range(projector.num_input_ports())]
    assert names == [f"{name}_{camera}" for camera in "ab" for name in INPUTS]
    names = [projector.get_output_port(i).get_name() for i in range(projector.num_output_ports())]
    assert names == ["observation", "heights"]
    with pytest.raises(ValueError, match="camera"):
        HeightmapProjector(cameras={})


def test_flat_ground_reproduces_the_camera_image():
    image = _project((COLOR, FLAT))
    np.testing.assert_allclose(image[:3], RGB.transpose(2, 0, 1), atol=1e-6)
    np.testing.assert_allclose(image[3], 0, atol=1e-6)
    raised = _project((COLOR, FLAT), grid=PixelGrid(0, 0, 0.1, 4, 5, z_min=-0.1))
    np.testing.assert_allclose(raised[3], 0.1, atol=1e-6)


def test_each_pixel_takes_height_and_color_of_its_highest_point():
    depth = FLAT.copy()
    depth[0, 0] = 0.5  # The point at x = 0.125, y = 0.15, in the grid's pixel (1, 1).
    image = _project((COLOR, depth))
    np.testing.assert_allclose(image[:, 1, 1], [*RGB[0, 0], 0.5], atol=1e-6)
    np.testing.assert_array_equal(image[:, 0, 0], 0)
    assert np.count_nonzero(image[3] > 1e-6) == 1


@pytest.mark.parametrize("out", [0, 0.09, 1.3, np.inf, np.nan])
def test_depths_out_of_range_are_ignored(out):
    high = PixelGrid(x_min=0, y_min=0, resolution=0.1, rows=4, cols=5, z_min=-1, z_max=2)
    assert not np.any(_project((COLOR, out * FLAT), grid=high))


def test_points_above_the_workspace_are_dropped_and_below_it_read_as_zero():
    depth = FLAT.copy()
    depth[1, 2], depth[2, 2] = 0.3, 1.2  # At heights 0.7 (above z_max) and -0.2.
    image = _project((COLOR, depth))
    np.testing.assert_allclose(image[:, 1, 2], [*(RGB[1, 1] + RGB[1, 3]) / 2, 0], atol=1e-6)
    np.testing.assert_allclose(image[:, 2, 2], [*RGB[2, 2], 0], atol=1e-6)


def test_only_gaps_of_one_pixel_within_one_surface_are_filled():
    hole, step, ridge = FLAT.copy(), FLAT.copy(), FLAT.copy()
    hole[1:3, 1:3] = 0
    np.testing.assert_array_equal(_project((COLOR, hole))[:, 1:3, 1:3], 0)
    step[1, 2], step[1, 1], step[0, 2] = 0, 0.98, 0.98
    np.testing.assert_array_equal(_project((COLOR, step))[:, 1, 2], 0)
    ridge[1, 2], ridge[0, 2], ridge[2, 2] = 0, 0.98, 0.98  # A gap in a ridge.
    bridged = (RGB[0, 2] + RGB[2, 2]) / 2
    np.testing.assert_allclose(_project((COLOR, ridge))[:, 1, 2], [*bridged, 0.02], atol=1e-6)


@pytest.mark.parametrize(("lower", "tints"), [(0.005, True), (0.02, False)])
def test_only_cameras_that_see_the_top_surface_color_it(lower, tints):
    depth = FLAT.copy()
    depth[1, 2] -= 0.02  # A surface 20 mm above the table.
    image = _project((COLOR, depth), (2 * COLOR, depth + np.float32(lower)))
    share = 1.5 if tints else 1
    np.testing.assert_allclose(image[:, 1, 2], [*share * RGB[1, 2], 0.02], atol=1e-6)


def test_port_heights_needs_no_color_image():
    projector, context = _small_projector("a")
    _fix(projector, context, "a", COLOR, 0.9 * FLAT, X_WB)
    whole = projector.GetOutputPort("observation").Eval(context)
    projector, context = _small_projector("a")
    for port, value in (("depth_image_a", _depth(0.9 * FLAT)), ("body_pose_in_world_a", X_WB)):
        projector.GetInputPort(port).FixValue(context, Value(value))
    heights = projector.GetOutputPort("heights").Eval(context)
    np.testing.assert_array_equal(heights.height, whole.height)
    np.testing.assert_array_equal(heights.valid, whole.valid)
    assert whole.rgb.any()
    assert not heights.rgb.any()


def test_outputs_are_cached_until_an_input_changes():
    projector, context = _small_projector("a")
    _fix(projector, context, "a", COLOR, FLAT, X_WB)
    port = projector.GetOutputPort("observation")
    first = port.Eval(context)
    context.SetTime(1)
    assert port.Eval(context) is first
    with pytest.raises(ValueError, match="read-only"):
        first.image[0, 0, 0] = 1
    _fix(projector, context, "a", COLOR, 0.9 * FLAT, X_WB)
    assert port.Eval(context).height.max() == pytest.approx(0.1)
    assert first.height.max() == pytest.approx(0, abs=1e-6)


@pytest.mark.parametrize("name", ["observation", "heights"])
def test_outputs_follow_the_pose_of_a_camera(name):
    projector, context = _small_projector("a")
    _fix(projector, context, "a", COLOR, FLAT, X_WB)
    port = projector.GetOutputPort(name)
    assert port.Eval(context).height.max() == pytest.approx(0, abs=1e-6)
    raised = RigidTransform([0, 0, 0.1]) @ X_WB
    projector.GetInputPort("body_pose_in_world_a").FixValue(context, Value(raised))
    assert port.Eval(context).height.max() == pytest.approx(0.1)


@pytest.mark.parametrize("wrong", ["color", "depth"])
def test_an_image_of_the_wrong_size_raises(wrong):
    images = {"color": COLOR, "depth": FLAT}
    images[wrong] = images[wrong].swapaxes(0, 1)
    projector, context = _small_projector("a")
    _fix(projector, context, "a", **images, X_WB=X_WB)
    with pytest.raises(ValueError, match=f"{wrong}_image_a .*4x5 .*5x4"):
        projector.GetOutputPort("observation").Eval(context)
