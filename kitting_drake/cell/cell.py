"""From a scenario to the Diagram of the kitting cell: the only place where systems are wired."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from pydrake.geometry import (
    CollisionFilterDeclaration,
    ColorRenderCamera,
    DepthRange,
    DepthRenderCamera,
    GeometrySet,
    Meshcat,
    MeshcatVisualizer,
    MeshcatVisualizerParams,
    Role,
    SceneGraph,
)
from pydrake.math import RigidTransform
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import (
    AddMultibodyPlant,
    MultibodyPlant,
    MultibodyPlantConfig,
)
from pydrake.multibody.tree import RigidBody
from pydrake.systems.framework import Context, Diagram, DiagramBuilder
from pydrake.systems.sensors import RgbdSensor
from pydrake.visualization import VideoWriter

from kitting_drake.cell.cameras import (
    OVERVIEW,
    add_film_renderer,
    add_observation_renderer,
    add_picture_renderer,
    camera_pose,
    can_render,
    depth_camera,
    picture_camera,
)
from kitting_drake.common.errors import UserError
from kitting_drake.common.paths import MODELS
from kitting_drake.scenario.policies import Watch, make_function
from kitting_drake.scenario.schema import (
    Heightmap,
    Learned,
    PythonPolicy,
    QuantisedOracle,
    Scenario,
)
from kitting_drake.tasks.kitting.scene import KittingScene, make_scene
from systems.heightmap_projector import HeightmapProjector
from systems.oracle_policy import OraclePolicy, OracleTarget, Rounding
from systems.pick_place_planner import PickPlacePlanner
from systems.pick_place_policy import PickPlacePolicy
from systems.placement_monitor import PlacementGoal, PlacementMonitor
from systems.rest_detector import BoundedBody, RestDetector
from systems.signals import PixelGrid, PlanarPose
from systems.trajectory_controller import TrajectoryController

MESHCAT_PERIOD = 1 / 32
_SURFACE_POINTS = 2000
_X_WTABLE = RigidTransform([0.5, 0.0, 0.0])


@dataclass(frozen=True)
class Cell:
    """The Diagram and the handles that running it takes. All memory is in its Context."""

    diagram: Diagram
    plant: MultibodyPlant
    scene_graph: SceneGraph
    planner: PickPlacePlanner
    monitor: PlacementMonitor
    rest_detector: RestDetector
    scene: KittingScene
    tool_bodies: tuple[RigidBody, ...]
    sleep: bool
    video_writer: VideoWriter | None
    """Holds the film, if one was asked for, until its `Save()`."""

    def apply_sleep(self, root_context: Context) -> None:
        """Freezes the tools that are at rest and thaws the others.

        A frozen tool's joint is locked and its contact with table and kit is not computed; what
        comes near it still collides with it. No LeafSystem may touch another's part of a context,
        hence a function for the simulator's monitor.
        """
        if not self.sleep:
            return
        at_rest = self.rest_detector.at_rest(self.rest_detector.GetMyContextFromRoot(root_context))
        plant_context = self.plant.GetMyMutableContextFromRoot(root_context)
        for body, resting in zip(self.tool_bodies, at_rest, strict=True):
            if resting == body.is_locked(plant_context):
                continue
            filters = self.scene_graph.collision_filter_manager(
                self.scene_graph.GetMyMutableContextFromRoot(root_context)
            )
            tool = GeometrySet(self.plant.GetCollisionGeometriesForBody(body))
            still = self._still_geometry()
            if resting:
                body.Lock(plant_context)
                filters.Apply(CollisionFilterDeclaration().ExcludeBetween(tool, still))
            else:
                body.Unlock(plant_context)
                filters.Apply(CollisionFilterDeclaration().AllowBetween(tool, still))

    def _still_geometry(self) -> GeometrySet:
        geometry = GeometrySet()
        for name in ("table", "kit"):
            body = self.plant.GetBodyByName(name)
            geometry.Add(self.plant.GetCollisionGeometriesForBody(body))
        return geometry


def build_cell(
    scenario: Scenario,
    *,
    seed: int,
    base: Path,
    meshcat: Meshcat | None = None,
    picture: bool = False,
    video: Path | None = None,
    watch: Watch | None = None,
) -> Cell:
    """Builds the cell.

    Args:
        scenario: what to build.
        seed: of the scene; see `make_scene`.
        base: where relative paths in the scenario start: the folder of its file.
        meshcat: where to show it, if anywhere.
        picture: have what `render_picture` takes.
        video: the file of a film to make (.gif or .webp), if any.
        watch: told of every decision of a learned policy, and of the observation it is about.

    Returns:
        The cell. Its Diagram exports the output ports `observation`, `action`, `add_s`,
        `position_error`, `angle_error`, `height_error`, `mode` and `counts`. Where images cannot be
        rendered, and the policy does not look, there are no cameras and there is no `observation`.

    Raises:
        UserError: something in the scenario cannot be had.
    """
    grid = make_grid(scenario.heightmap)
    scene = make_scene(scenario.task, grid=grid, seed=seed, base=base)
    builder = DiagramBuilder()

    # The plant: table, kit, tools, hand.
    plant, scene_graph = _add_plant(builder, scenario)
    tool_bodies = _add_models(plant, scene)
    hand = plant.GetModelInstanceByName("franka_hand")
    plant.Finalize()
    _set_initial_poses(plant, scenario, scene, tool_bodies)

    # The policy.
    looks = isinstance(scenario.policy, Learned | PythonPolicy)
    if looks or (scenario.cameras and can_render()):
        projector = _add_cameras(builder, scenario, scene_graph, grid)
        builder.ExportOutput(projector.GetOutputPort("observation"), "observation")
    if isinstance(scenario.policy, Learned | PythonPolicy):
        function = make_function(scenario.policy, base=base, grid=grid, watch=watch)
        policy = builder.AddNamedSystem("policy", PickPlacePolicy(policy=function))
        builder.Connect(projector.GetOutputPort("observation"), policy.GetInputPort("observation"))
    else:
        rounding = None
        if isinstance(scenario.policy, QuantisedOracle):
            rounding = Rounding(grid, scenario.policy.orientations)
        policy = builder.AddNamedSystem("policy", _make_oracle(scene, tool_bodies, rounding))
        builder.Connect(plant.get_body_poses_output_port(), policy.GetInputPort("body_poses"))

    # Planner and controller.
    planner = builder.AddNamedSystem("planner", PickPlacePlanner(parameters=scenario.planner))
    controller = builder.AddNamedSystem("controller", _make_controller(scenario, plant))
    hand_state = plant.get_state_output_port(hand)
    builder.Connect(policy.GetOutputPort("action"), planner.GetInputPort("action"))
    builder.Connect(hand_state, planner.GetInputPort("hand_state"))
    builder.Connect(
        plant.get_generalized_contact_forces_output_port(hand),
        planner.GetInputPort("hand_contact_force"),
    )
    builder.Connect(hand_state, controller.GetInputPort("hand_state"))
    for port in ("desired_motion", "desired_opening", "closing_force"):
        builder.Connect(planner.GetOutputPort(port), controller.GetInputPort(port))
    builder.Connect(controller.get_output_port(), plant.get_actuation_input_port(hand))

    # Score and rest.
    monitor = builder.AddNamedSystem("monitor", _make_monitor(scene, tool_bodies))
    builder.Connect(plant.get_body_poses_output_port(), monitor.GetInputPort("body_poses"))
    rest_detector = builder.AddNamedSystem(
        "rest_detector", _make_rest_detector(scenario, plant, scene_graph, tool_bodies)
    )
    for port in ("body_poses", "body_spatial_velocities"):
        builder.Connect(plant.GetOutputPort(port), rest_detector.GetInputPort(port))

    for system, ports in (
        (policy, ("action",)),
        (monitor, ("add_s", "position_error", "angle_error", "height_error")),
        (planner, ("mode", "counts")),
    ):
        for port in ports:
            builder.ExportOutput(system.GetOutputPort(port), port)
    if meshcat is not None:
        parameters = MeshcatVisualizerParams(role=Role.kIllustration)
        parameters.publish_period = MESHCAT_PERIOD
        MeshcatVisualizer.AddToBuilder(builder, scene_graph, meshcat, parameters)
    if picture:
        add_picture_renderer(scene_graph)
    video_writer = None if video is None else _add_video(builder, scene_graph, video)
    diagram = builder.Build()
    diagram.set_name("kitting_cell")
    return Cell(
        diagram=diagram,
        plant=plant,
        scene_graph=scene_graph,
        planner=planner,
        monitor=monitor,
        rest_detector=rest_detector,
        scene=scene,
        tool_bodies=tuple(tool_bodies),
        sleep=scenario.sleep.enabled,
        video_writer=video_writer,
    )


def make_grid(config: Heightmap) -> PixelGrid:
    """The pixel grid that a scenario describes."""
    return PixelGrid(
        x_min=config.x_min,
        y_min=config.y_min,
        resolution=config.resolution,
        rows=config.rows,
        cols=config.cols,
        z_min=config.z_min,
        z_max=config.z_max,
    )


def _add_plant(builder: DiagramBuilder, scenario: Scenario) -> tuple[MultibodyPlant, SceneGraph]:
    config = MultibodyPlantConfig(
        time_step=scenario.plant.time_step,
        # Strict: a pair that cannot be hydroelastic is an error, not a point contact in disguise.
        contact_model="hydroelastic",
        discrete_contact_approximation=scenario.plant.contact_approximation,
    )
    return AddMultibodyPlant(config, builder)


def _add_models(plant: MultibodyPlant, scene: KittingScene) -> list[RigidBody]:
    parser = Parser(plant)
    parser.package_map().AddPackageXml(str(MODELS / "package.xml"))
    parser.AddModels(str(MODELS / "table" / "table.sdf"))
    plant.WeldFrames(plant.world_frame(), plant.GetFrameByName("table"), _X_WTABLE)
    (kit,) = parser.AddModels(str(scene.kit.sdf))
    plant.WeldFrames(plant.world_frame(), plant.GetFrameByName("kit", kit), scene.X_WKit)
    tools = []
    for tool in scene.tools:
        try:
            (instance,) = parser.AddModels(str(tool.sdf))
        except (RuntimeError, ValueError) as error:
            reason = str(error).splitlines()[0]
            raise UserError(f"task.tools: {tool.sdf} cannot be loaded: {reason}") from error
        tools.append(plant.GetBodyByName("tool", instance))
    parser.AddModels(str(MODELS / "franka_hand" / "franka_hand.sdf"))
    return tools


def _set_initial_poses(
    plant: MultibodyPlant, scenario: Scenario, scene: KittingScene, tools: list[RigidBody]
) -> None:
    for body, X_WT in zip(tools, scene.X_WTools, strict=True):
        plant.SetDefaultFloatingBaseBodyPose(body, X_WT)
    for joint, position in zip(("x", "y", "z", "yaw"), scenario.planner.home, strict=True):
        plant.GetJointByName(joint).set_default_positions([position])
    for joint in ("left_finger_slide", "right_finger_slide"):
        plant.GetJointByName(joint).set_default_positions([scenario.planner.open_width / 2])


def _make_oracle(
    scene: KittingScene, tools: list[RigidBody], rounding: Rounding | None
) -> OraclePolicy:
    return OraclePolicy(
        targets=[
            OracleTarget(
                name=tool.name,
                body=body.index(),
                X_WGoal=X_WGoal,
                grasp=PlanarPose(tool.grasp.x, tool.grasp.y, tool.grasp.theta),
                surface_height=tool.grasp.surface_height,
                rim_height=scene.X_WKit.translation()[2] + scene.kit.parameters.height,
            )
            for tool, body, X_WGoal in zip(scene.tools, tools, scene.X_WGoals, strict=True)
        ],
        rounding=rounding,
    )


def _make_monitor(scene: KittingScene, tools: list[RigidBody]) -> PlacementMonitor:
    return PlacementMonitor(
        goals=[
            PlacementGoal(tool.name, body.index(), X_WGoal, tool.surface_points(_SURFACE_POINTS))
            for tool, body, X_WGoal in zip(scene.tools, tools, scene.X_WGoals, strict=True)
        ]
    )


def _make_controller(scenario: Scenario, plant: MultibodyPlant) -> TrajectoryController:
    config = scenario.controller
    context = plant.CreateDefaultContext()
    hand = plant.GetModelInstanceByName("franka_hand")
    joints = [plant.GetJointByName(name) for name in ("x", "y", "z", "yaw")]
    indices = [joint.velocity_start() for joint in joints]
    inertia = plant.CalcMassMatrix(context).diagonal()[indices]
    gravity = plant.CalcGravityGeneralizedForces(context)
    assert plant.num_actuated_dofs(hand) == 6
    return TrajectoryController(
        inertia=inertia,
        weight=-float(gravity[indices[2]]),
        stiffness=np.array(config.stiffness),
        damping=np.array(config.damping),
        force_limit=np.array(config.force_limit),
        finger_stiffness=config.finger_stiffness,
        finger_damping=config.finger_damping,
        finger_force_limit=config.finger_force_limit,
    )


def _make_rest_detector(
    scenario: Scenario,
    plant: MultibodyPlant,
    scene_graph: SceneGraph,
    tools: list[RigidBody],
) -> RestDetector:
    hand = [plant.GetBodyByName(name) for name in ("hand", "left_finger", "right_finger")]
    return RestDetector(
        objects=[_bounded(plant, scene_graph, body) for body in tools],
        movers=[_bounded(plant, scene_graph, body) for body in hand],
        linear_speed=scenario.sleep.linear_speed,
        angular_speed=scenario.sleep.angular_speed,
        patience=scenario.sleep.patience,
        wake_distance=scenario.sleep.wake_distance,
    )


def _bounded(plant: MultibodyPlant, scene_graph: SceneGraph, body: RigidBody) -> BoundedBody:
    inspector = scene_graph.model_inspector()
    corners = []
    for geometry in plant.GetCollisionGeometriesForBody(body):
        box = inspector.GetObbInGeometryFrame(geometry)
        half = np.asarray(box.half_width())
        signs = np.array(np.meshgrid(*[(-1, 1)] * 3)).reshape(3, -1)
        X_BBox = inspector.GetPoseInFrame(geometry) @ box.pose()
        corners.append(X_BBox.multiply(half[:, None] * signs))
    points = np.concatenate(corners, axis=1)
    return BoundedBody(body.index(), points.min(axis=1), points.max(axis=1))


def _add_cameras(
    builder: DiagramBuilder, scenario: Scenario, scene_graph: SceneGraph, grid: PixelGrid
) -> HeightmapProjector:
    if not scenario.cameras:
        raise UserError("cameras is empty: the heightmap needs at least one")
    renderer = add_observation_renderer(scene_graph)
    cameras = {name: depth_camera(config, renderer) for name, config in scenario.cameras.items()}
    projector = builder.AddNamedSystem(
        "heightmap_projector", HeightmapProjector(cameras=cameras, grid=grid)
    )
    for name, config in scenario.cameras.items():
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
        for output, port in (
            ("color_image", "color_image"),
            ("depth_image_32f", "depth_image"),
            ("body_pose_in_world", "body_pose_in_world"),
        ):
            builder.Connect(sensor.GetOutputPort(output), projector.GetInputPort(f"{port}_{name}"))
    return projector


def _add_video(builder: DiagramBuilder, scene_graph: SceneGraph, path: Path) -> VideoWriter:
    core = picture_camera(add_film_renderer(scene_graph), width=640, height=400)
    sensor = builder.AddNamedSystem(
        "camera_video",
        RgbdSensor(
            parent_id=scene_graph.world_frame_id(),
            X_PB=camera_pose(OVERVIEW),
            color_camera=ColorRenderCamera(core),
            depth_camera=DepthRenderCamera(core, DepthRange(0.05, 10.0)),
        ),
    )
    builder.Connect(scene_graph.get_query_output_port(), sensor.query_object_input_port())
    writer = builder.AddNamedSystem("video_writer", VideoWriter(filename=str(path), fps=16.0))
    writer.ConnectRgbdSensor(builder=builder, sensor=sensor)
    return writer
