"""Makes frames like those of a real bench from the simulated cell, in memory or as files."""

import dataclasses
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from pydrake.geometry import Box, ColorRenderCamera
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph
from pydrake.systems.framework import Context, DiagramBuilder

from docs.examples.make_sample_frame import calibration_of, take_frames
from kitting_drake.common.rendering import add_observation_renderer
from kitting_drake.real_camera.calibrations.calibration import Calibration, with_poses
from kitting_drake.real_camera.checking.kit_block import Block
from kitting_drake.real_camera.frames import Frame
from kitting_drake.scenario.cameras import camera_pose, depth_camera
from kitting_drake.scenario.schema import Scenario
from systems.signals import Observation, PickPlaceAction, PlanarPose
from tests.kitting_drake.rig import Rig, build_rig

ROOT = Path(__file__).resolve().parents[3]


@dataclass(frozen=True)
class Rendered:
    """The first frames of a cell's cameras."""

    frames: dict[str, Frame]
    calibration: Calibration
    """The cameras' calibration, with the poses that the cell assumes."""
    rig: Rig
    context: Context

    @property
    def observation(self) -> Observation:
        return self.rig.port("observation", self.context)

    @property
    def action(self) -> PickPlaceAction:
        """The action of the cell's own policy."""
        return self.rig.port("action", self.context)


def render(scenario: Scenario, seed: int, *, rig: Rig | None = None) -> Rendered:
    """Renders the frames for the first decision of the cell's policy."""
    rig = rig or build_rig(scenario, seed=seed, base=ROOT / "scenarios")
    context = rig.diagram.CreateDefaultContext()
    frames, poses = take_frames(rig.station, rig.station.GetMyContextFromRoot(context))
    calibration = with_poses(calibration_of(scenario), poses)
    return Rendered(frames, calibration, rig, context)


def write_frames(folder: Path, frames: dict[str, Frame], depth: str = "npy") -> Path:
    """Writes colours as PNG, and depths as `NAME_depth.npy` (m) or `NAME_depth.png` (mm)."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, frame in frames.items():
        Image.fromarray(frame.color).save(folder / f"{name}_color.png")
        if depth == "npy":
            np.save(folder / f"{name}_depth.npy", frame.depth)
        else:
            steps = np.rint(1e3 * np.where(np.isfinite(frame.depth), frame.depth, 0))
            Image.fromarray(steps.astype(np.uint16)).save(folder / f"{name}_depth.png")
    return folder


def difference(one: PickPlaceAction, other: PickPlaceAction) -> NDArray[np.float64]:
    """How two actions differ, as an array (3,).

    - The distance between the picks, in mm.
    - The distance between the positions to which the two actions move one point of the object, in
      mm. This point is at the second pick.
    - The difference between the object's rotations, in degrees.

    The last two are zero if different grasps move an object alike.
    """
    turned, other_turned = (item.place.theta - item.pick.theta for item in (one, other))
    c, s = math.cos(turned), math.sin(turned)
    x, y = other.pick.x - one.pick.x, other.pick.y - one.pick.y
    moved = (one.place.x + c * x - s * y, one.place.y + s * x + c * y)
    return np.array(
        [
            1e3 * math.hypot(x, y),
            1e3 * math.dist(moved, (other.place.x, other.place.y)),
            math.degrees(abs(math.remainder(turned - other_turned, math.tau))),
        ]
    )


def true_action(found: Rendered, action: PickPlaceAction) -> tuple[str, PickPlaceAction]:
    """The name of the object that an action picks, and the action with the exact place.

    With the exact place, the object would reach its goal.
    """
    pick = np.array([action.pick.x, action.pick.y])
    scene = found.rig.scene

    def away(index: int) -> float:
        item = scene.objects[index]
        points = item.X_WB.multiply(item.p_BPoints.T)[:2].T
        return float(np.linalg.norm(points - pick, axis=1).min())

    index = min(range(len(scene.objects)), key=away)
    item = scene.objects[index]
    goal = next(goal for goal in scene.goals if index in goal.objects)
    moved = goal.poses[0].multiply(item.X_WB.inverse())
    place = moved.multiply(np.append(pick, 0.0))
    theta = action.pick.theta + RollPitchYaw(moved.rotation()).yaw_angle()
    exact = PlanarPose(float(place[0]), float(place[1]), theta)
    return item.name, dataclasses.replace(action, place=exact)


def cast(calibration: Calibration, block: Block | None = None) -> dict[str, Frame]:
    """Frames of a table, empty or with a block, computed by exact ray casting."""
    frames = {}
    for camera in calibration.cameras:
        u, v = np.broadcast_arrays(camera.rays.u, camera.rays.v)
        rays = np.stack([u, v, np.ones_like(u)], axis=-1).astype(float) @ camera.X_BC[:3, :3].T
        depth = (calibration.table_height - camera.X_BC[2, 3]) / rays[..., 2]
        depth = np.where(depth > 0, depth, 0)
        if block is not None:
            entered = _entered(block, camera.X_BC[:3, 3], rays, calibration.table_height)
            depth = np.where(np.isfinite(entered), entered, depth)
        color = np.full((*depth.shape, 3), 120, np.uint8)
        frames[camera.name] = Frame(color, depth.astype(np.float32))
    return frames


def _entered(
    block: Block, origin: NDArray[np.float64], rays: NDArray[np.float64], table: float
) -> NDArray[np.float64]:
    """The depth at which each ray enters a block; NaN for rays that miss the block."""
    assert block.pose is not None
    x, y, yaw = block.pose
    R = np.array([[math.cos(yaw), math.sin(yaw)], [-math.sin(yaw), math.cos(yaw)]])
    start = np.array([*(R @ (origin[:2] - (x, y))), origin[2] - table])
    along = np.concatenate([rays[..., :2] @ R.T, rays[..., 2:]], axis=-1)
    length, width, height = block.size
    low, high = np.array([-length / 2, -width / 2, 0]), np.array([length / 2, width / 2, height])
    slabs = np.sort([(side - start) / along for side in (low, high)], axis=0)
    enter, leave = slabs[0].max(axis=-1), slabs[1].min(axis=-1)
    return np.where((leave > enter) & (enter > 0), enter, np.nan)


def render_table(scenario: Scenario) -> dict[str, Frame]:
    """Rendered frames of an empty table."""
    builder = DiagramBuilder()
    plant, scene_graph = AddMultibodyPlantSceneGraph(builder, time_step=0.01)
    X, size = RigidTransform([0.5, 0, -0.05]), Box(2, 3, 0.1)
    plant.RegisterVisualGeometry(plant.world_body(), X, size, "table", np.full(4, 0.5))
    renderer = add_observation_renderer(scene_graph)
    plant.Finalize()
    diagram = builder.Build()
    context = scene_graph.GetMyContextFromRoot(diagram.CreateDefaultContext())
    query = scene_graph.get_query_output_port().Eval(context)
    world, frames = scene_graph.world_frame_id(), {}
    for name, config in scenario.cameras.items():
        camera, X_WC = depth_camera(config, renderer), camera_pose(config)
        color = query.RenderColorImage(ColorRenderCamera(camera.core()), world, X_WC)
        depth = query.RenderDepthImage(camera, world, X_WC)
        frames[name] = Frame(color.data[:, :, :3].copy(), depth.data[:, :, 0].copy())
    return frames
