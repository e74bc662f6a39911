"""From a scenario to the Diagram of the kitting cell: here its systems are wired together."""

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydrake.geometry import (
    CollisionFilterDeclaration,
    GeometrySet,
    Meshcat,
    MeshcatVisualizer,
    MeshcatVisualizerParams,
    Role,
    SceneGraph,
)
from pydrake.math import RigidTransform
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import BodyIndex, RigidBody
from pydrake.systems.framework import Context, Diagram, DiagramBuilder, LeafSystem
from pydrake.visualization import VideoWriter

from kitting_drake.common.errors import UserError
from kitting_drake.common.rendering import add_picture_renderer, can_render
from kitting_drake.scenario.policies import DecisionObserver, PolicySite
from kitting_drake.scenario.schema import Scenario
from kitting_drake.station.paint import paint_surfaces
from kitting_drake.station.plant import add_models, add_plant, bounded_body, set_initial_poses
from kitting_drake.station.sensing import add_cameras, add_video
from kitting_drake.tasks.task import Scene
from systems.heightmap_projector import HeightmapProjector
from systems.pick_place_planner import PickPlacePlanner
from systems.pick_place_policy import PickPlacePolicy
from systems.placement import PlacedObject, Placement
from systems.placement_monitor import PlacementMonitor
from systems.rest_detector import RestDetector
from systems.trajectory_controller import TrajectoryController

MESHCAT_PERIOD = 1 / 32


@dataclass(frozen=True)
class Cell:
    """The Diagram and the handles that running it takes. All memory is in its Context."""

    diagram: Diagram
    plant: MultibodyPlant
    scene_graph: SceneGraph
    planner: PickPlacePlanner
    monitor: PlacementMonitor
    rest_detector: RestDetector
    scene: Scene
    objects: tuple[PlacedObject, ...]
    """The scene's objects, with their bodies."""
    still_bodies: tuple[RigidBody, ...]
    """The table and the fixtures."""
    sleep: bool
    video_writer: VideoWriter | None
    """Holds the film, if one was asked for, until its `Save()`."""

    def object_poses(self, root_context: Context) -> list[RigidTransform]:
        """X_WB of each of the scene's objects."""
        context = self.plant.GetMyContextFromRoot(root_context)
        return [self.plant.get_body(item.body).EvalPoseInWorld(context) for item in self.objects]

    def placements(self, root_context: Context) -> list[Placement]:
        """Where each of the scene's objects is relative to its goal."""
        return self.monitor.placements(self.monitor.GetMyContextFromRoot(root_context))

    def reward(self, root_context: Context) -> float:
        """The task's reward so far, 0 to 1: see `PlacementMonitor`."""
        return self.monitor.reward(self.monitor.GetMyContextFromRoot(root_context))

    def at_rest(self, root_context: Context) -> NDArray[np.bool_]:
        """(n,) which of the scene's objects are at rest."""
        return self.rest_detector.at_rest(self.rest_detector.GetMyContextFromRoot(root_context))

    def apply_sleep(self, root_context: Context) -> None:
        """Freezes the objects that are at rest and thaws the others.

        A frozen object's joint is locked, and its contact with table, fixtures and other frozen
        objects is not computed; what comes near it still collides with it. No LeafSystem may touch
        another's part of a context, hence a function for the simulator's monitor.
        """
        if not self.sleep:
            return
        plant_context = self.plant.GetMyMutableContextFromRoot(root_context)
        bodies = self._bodies
        at_rest = self.at_rest(root_context).tolist()
        changed = [
            (body, resting)
            for body, resting in zip(bodies, at_rest, strict=True)
            if resting != body.is_locked(plant_context)
        ]
        if not changed:
            return
        filters = self.scene_graph.collision_filter_manager(
            self.scene_graph.GetMyMutableContextFromRoot(root_context)
        )
        # First those that wake, as they are free of all; then those that fall asleep.
        for body, resting in sorted(changed, key=lambda change: change[1]):
            own = self._geometry([body])
            if resting:
                body.Lock(plant_context)
                frozen = [other for other in bodies if other.is_locked(plant_context)]
                others = self._geometry([*self.still_bodies, *frozen])
                filters.Apply(CollisionFilterDeclaration().ExcludeBetween(own, others))
            else:
                body.Unlock(plant_context)
                others = self._geometry([*self.still_bodies, *bodies])
                filters.Apply(CollisionFilterDeclaration().AllowBetween(own, others))

    @functools.cached_property
    def _bodies(self) -> list[RigidBody]:
        """The bodies of the scene's objects."""
        return [self.plant.get_body(item.body) for item in self.objects]

    def _geometry(self, bodies: Sequence[RigidBody]) -> GeometrySet:
        geometry = GeometrySet()
        for body in bodies:
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
    observer: DecisionObserver | None = None,
) -> Cell:
    """Builds the cell.

    Args:
        scenario: what to build.
        seed: of the scene; see `TaskConfig.make_scene`.
        base: where relative paths in the scenario start: the folder of its file.
        meshcat: where to show it, if anywhere.
        picture: have what `render_picture` takes.
        video: the file of a film to make (.gif or .webp), if any.
        observer: told of every decision of a learned policy, and of the observation it is about.

    Returns:
        The cell. Its Diagram exports the output ports `observation`, `action`, `placements`,
        `reward`, `success`, `add_s`, `position_error`, `angle_error`, `height_error`, `mode` and
        `counts`. Where images cannot be rendered, and the policy needs none, there are no cameras
        and there is no `observation`.

    Raises:
        UserError: something in the scenario cannot be had.
    """
    grid = scenario.heightmap.grid()
    scene = scenario.task.make_scene(grid=grid, seed=seed, base=base)
    _check_scene(scenario, scene)
    builder = DiagramBuilder()

    # The plant: table, fixtures, objects, hand.
    plant, scene_graph = add_plant(builder, scenario)
    objects, still_bodies = add_models(plant, scene, scenario.plant, seed)
    plant.Finalize()
    set_initial_poses(plant, scenario, scene, objects)
    groups = _surface_groups(scene, still_bodies, objects)
    paint_surfaces(plant, scene_graph, scenario.appearance, groups, seed)

    # Cameras, policy, planner and controller.
    projector = None
    if scenario.policy.needs_observation or (scenario.cameras and can_render()):
        projector = add_cameras(builder, scenario, scene_graph, grid, seed)
        builder.ExportOutput(projector.GetOutputPort("observation"), "observation")
    site = PolicySite(
        scene=scene,
        objects=objects,
        grid=grid,
        base=base,
        observer=observer,
        may_stop=not scenario.end_at_success,
    )
    policy = _add_policy(builder, scenario, site, plant, projector)
    planner = _add_planner_and_controller(builder, scenario, scene, plant, policy, projector)

    monitor, rest_detector = _add_score_and_rest(
        builder, scenario, scene, plant, scene_graph, objects
    )
    builder.Connect(planner.GetOutputPort("mode"), monitor.GetInputPort("mode"))
    if policy.HasInputPort("kept_goals"):
        builder.Connect(monitor.GetOutputPort("kept_goals"), policy.GetInputPort("kept_goals"))
    for system, ports in (
        (policy, ["action"]),
        (monitor, [monitor.get_output_port(i).get_name() for i in range(7)]),
        (planner, ["mode", "counts"]),
    ):
        for port in ports:
            builder.ExportOutput(system.GetOutputPort(port), port)

    # What shows it.
    if meshcat is not None:
        parameters = MeshcatVisualizerParams(role=Role.kIllustration)
        parameters.publish_period = MESHCAT_PERIOD
        MeshcatVisualizer.AddToBuilder(builder, scene_graph, meshcat, parameters)
    if picture:
        add_picture_renderer(scene_graph)
    video_writer = None if video is None else add_video(builder, scene_graph, video)
    diagram = builder.Build()
    diagram.set_name("cell")
    return Cell(
        diagram=diagram,
        plant=plant,
        scene_graph=scene_graph,
        planner=planner,
        monitor=monitor,
        rest_detector=rest_detector,
        scene=scene,
        objects=objects,
        still_bodies=still_bodies,
        sleep=scenario.sleep.enabled,
        video_writer=video_writer,
    )


def _check_scene(scenario: Scenario, scene: Scene) -> None:
    """Raises UserError where the hand would collide with what it cannot see or cannot span."""
    tops = {item.name: float((item.X_WB @ item.p_BPoints.T)[2].max()) for item in scene.objects}
    tops |= {goal.name: goal.rim_height for goal in scene.goals if goal.rim_height is not None}
    name, top = max(tops.items(), key=lambda pair: pair[1])
    if top > scenario.heightmap.z_max:
        raise UserError(
            f"heightmap.z_max is {scenario.heightmap.z_max:g}, and the hand would not see how high "
            f"{name} is: at least {top:.3f} is needed"
        )
    for index in scene.goal_objects:
        item = scene.objects[index]
        narrowest = min((grasp.width for grasp in item.grasps), default=0.0)
        if narrowest >= scenario.planner.open_width:
            raise UserError(
                f"planner.open_width is {scenario.planner.open_width:g}, and {item.name} is "
                f"{narrowest:.3f} m wide where it is gripped"
            )


def _surface_groups(
    scene: Scene, still_bodies: Sequence[RigidBody], objects: Sequence[PlacedObject]
) -> dict[BodyIndex, str]:
    """The names by which a scenario's `appearance` calls the bodies' surfaces."""
    groups = {still_bodies[0].index(): "table"}
    for fixture, body in zip(scene.fixtures, still_bodies[1:], strict=True):
        groups[body.index()] = f"fixtures/{fixture.name}"
    return groups | {item.body: f"objects/{item.name}" for item in objects}


def _add_policy(
    builder: DiagramBuilder,
    scenario: Scenario,
    site: PolicySite,
    plant: MultibodyPlant,
    projector: HeightmapProjector | None,
) -> LeafSystem:
    """Adds the scenario's policy, connected to what it looks at."""
    policy = builder.AddNamedSystem("policy", scenario.policy.make_system(site))
    if policy.HasInputPort("observation"):
        assert projector is not None
        builder.Connect(projector.GetOutputPort(_sight(policy)), policy.GetInputPort("observation"))
    if policy.HasInputPort("body_poses"):
        builder.Connect(plant.get_body_poses_output_port(), policy.GetInputPort("body_poses"))
    return policy


def _sight(policy: LeafSystem) -> str:
    """The projector's port that policy and planner look at: in colour only if the policy sees it;
    the planner reads heights."""
    if isinstance(policy, PickPlacePolicy) and policy.heights_only:
        return "heights"
    return "observation" if policy.HasInputPort("observation") else "heights"


def _add_planner_and_controller(
    builder: DiagramBuilder,
    scenario: Scenario,
    scene: Scene,
    plant: MultibodyPlant,
    policy: LeafSystem,
    projector: HeightmapProjector | None,
) -> PickPlacePlanner:
    """Adds both, and closes the loop through the plant."""
    hand = plant.GetModelInstanceByName("franka_hand")
    planner = builder.AddNamedSystem(
        "planner",
        PickPlacePlanner(
            parameters=scenario.planner,
            max_actions=scene.max_actions,
            insertion=any(goal.rim_height is not None for goal in scene.goals),
        ),
    )
    controller = builder.AddNamedSystem("controller", _make_controller(scenario, plant))
    hand_state = plant.get_state_output_port(hand)
    builder.Connect(policy.GetOutputPort("action"), planner.GetInputPort("action"))
    if policy.HasInputPort("failed_picks"):
        builder.Connect(planner.GetOutputPort("failed_picks"), policy.GetInputPort("failed_picks"))
    if projector is not None and scenario.policy.planner_observes:
        sight = projector.GetOutputPort(_sight(policy))
        builder.Connect(sight, planner.GetInputPort("observation"))
    builder.Connect(hand_state, planner.GetInputPort("hand_state"))
    builder.Connect(
        plant.get_generalized_contact_forces_output_port(hand),
        planner.GetInputPort("hand_contact_force"),
    )
    builder.Connect(hand_state, controller.GetInputPort("hand_state"))
    for port in ("desired_motion", "desired_opening", "closing_force"):
        builder.Connect(planner.GetOutputPort(port), controller.GetInputPort(port))
    builder.Connect(controller.get_output_port(), plant.get_actuation_input_port(hand))
    return planner


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


def _add_score_and_rest(
    builder: DiagramBuilder,
    scenario: Scenario,
    scene: Scene,
    plant: MultibodyPlant,
    scene_graph: SceneGraph,
    objects: tuple[PlacedObject, ...],
) -> tuple[PlacementMonitor, RestDetector]:
    """Adds both, which watch the bodies."""
    monitor = builder.AddNamedSystem(
        "monitor", PlacementMonitor(objects=objects, goals=scene.goals, success=scene.success)
    )
    rest_detector = builder.AddNamedSystem(
        "rest_detector", _make_rest_detector(scenario, plant, scene_graph, objects)
    )
    for system in (monitor, rest_detector):
        builder.Connect(plant.get_body_poses_output_port(), system.GetInputPort("body_poses"))
    return monitor, rest_detector


def _make_rest_detector(
    scenario: Scenario,
    plant: MultibodyPlant,
    scene_graph: SceneGraph,
    objects: tuple[PlacedObject, ...],
) -> RestDetector:
    hand = [plant.GetBodyByName(name) for name in ("hand", "left_finger", "right_finger")]
    return RestDetector(
        objects=[bounded_body(plant, scene_graph, plant.get_body(item.body)) for item in objects],
        movers=[bounded_body(plant, scene_graph, body) for body in hand],
        position_tolerance=scenario.sleep.position_tolerance,
        angle_tolerance=scenario.sleep.angle_tolerance,
        time_to_sleep=scenario.sleep.time_to_sleep,
        wake_distance=scenario.sleep.wake_distance,
    )
