"""The station: a Diagram of the whole robot cell, without the policy."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform
from pydrake.multibody.tree import BodyIndex, RigidBody
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context, Diagram, DiagramBuilder, EventStatus

from kitting_drake.common.errors import UserError
from kitting_drake.common.rendering import X_WARM_OVERVIEW, X_WOVERVIEW, can_render
from kitting_drake.scenario.robots import FrankaArm
from kitting_drake.scenario.schema import Scenario
from kitting_drake.station.control import add_control
from kitting_drake.station.free_bodies import FreeBodies
from kitting_drake.station.held_bodies import ArmPath
from kitting_drake.station.paint import paint_surfaces
from kitting_drake.station.plant import add_models, add_plant, bounded_body, set_initial_poses
from kitting_drake.station.robot import (
    add_robot,
    arm_model,
    make_motion,
    set_home,
)
from kitting_drake.station.scene_reach import check_scene_reach
from kitting_drake.station.sensing import add_cameras
from kitting_drake.tasks.task import TABLE, Scene
from systems.object_feeder import ObjectFeeder
from systems.pick_place_parameters import Mode
from systems.placement import PlacedObject, Placement
from systems.placement_monitor import PlacementMonitor
from systems.rest_detector import RestDetector
from systems.signals import Attempt, Observation, PickPlaceAction

Monitor = Callable[[Context], EventStatus]
"""A monitor of a Simulator: called after each step, with the root context."""


class KittingStation(Diagram):
    """A table with objects, a robot, cameras and controllers. The policy is connected outside.

    .. pydrake_system::

        name: KittingStation
        input_ports:
        - action
        - desired_motion (with takes_joint_targets)
        - desired_opening (with takes_joint_targets)
        - closing_force (with takes_joint_targets)
        output_ports:
        - observation
        - observation_heights
        - failed_picks
        - history
        - peak_force
        - accepted_action
        - asks
        - mode
        - counts
        - robot_state
        - hand_state
        - wrist_force
        - actuation
        - commanded
        - commanded_opening
        - commanded_closing_force
        - body_poses
        - contact_results
        - query_object
        - at_rest
        - placements
        - kept_goals
        - reward
        - success
        - add_s
        - position_error
        - angle_error
        - height_error
        - color_image_<camera>
        - depth_image_<camera>
        - camera_pose_<camera>

    - `action` (abstract, `PickPlaceAction`): the next action. The port is evaluated only when the
      planner needs an action.
    - `desired_motion` (12 or 21), `desired_opening` (2), `closing_force` (1): the controller's
      inputs, which replace the planner's commands; see `TrajectoryController`.
    - `observation` (abstract, `Observation`): o_t. `observation_heights`: o_t without colours;
      evaluating it renders no colour images. These and the camera ports exist only if the scenario
      has cameras and the machine can render.
    - `failed_picks`, `history`, `peak_force`, `accepted_action`, `asks`, `mode`, `counts`: the
      ports of the `PickPlacePlanner` of these names.
    - `robot_state` (12 or 18): positions, then velocities, of the joints and both fingers, in m,
      rad and s. The floating hand's joints are x, y, z, yaw; an arm has seven joints.
    - `hand_state` (12): positions, then velocities, of x, y, z, yaw and both fingers, for any
      robot.
    - `wrist_force` (6): contact forces along x, y, z (N), the moment about z (N m), and the force
      on each finger (N). `ContactTorque` computes all but the fingers' forces from the robot's
      motion, and for an arm `WristForce` then computes the force on the hand.
    - `actuation` (6 or 9): actuation of the joints (N, N m) and of each finger (N). For an arm it
      is that of the last step.
    - `commanded` (12 or 21): desired positions q_d, velocities v_d and accelerations a_d of the
      joints. `commanded_opening` (2): the desired opening between the pads in m, and its rate in
      m/s. `commanded_closing_force` (1): the closing force of each pad, in N.
    - `body_poses`, `contact_results`: the plant's ports of these names. `query_object`: the scene
      graph's port `query`.
    - `at_rest` (n): 1 for an object at rest, else 0; see `RestDetector`.
    - `placements` to `height_error`: the ports of the `PlacementMonitor` of these names.
    - `color_image_<camera>`, `depth_image_<camera>`, `camera_pose_<camera>`: images with noise, and
      the calibrated pose X_WB of the camera; the observation is computed from them.

    All state is in the Context. Ports compute only on demand; in particular, images are rendered
    only when an observation or an image is evaluated.

    Simulate the station with `make_simulator`. It lets objects appear during the episode, and
    freezes objects at rest.
    """

    def __init__(
        self, scenario: Scenario, *, seed: int, base: Path, takes_joint_targets: bool = False
    ) -> None:
        """For the arguments see `build_station`."""
        super().__init__()
        self.scenario, self.seed, self.base = scenario, seed, base
        self.grid = scenario.heightmap.grid()
        """The pixel grid of the observations."""
        self.scene: Scene = scenario.task.make_scene(grid=self.grid, seed=seed, base=base)
        _check_scene(scenario, self.scene)
        builder = DiagramBuilder()
        self.plant, self.scene_graph = add_plant(builder, scenario)
        self.objects, self.still_bodies = add_models(
            self.plant, self.scene, scenario.variation, seed
        )
        """The scene's objects with their bodies, and the bodies of table and fixtures. They are
        stored as indices, because a body would keep the plant, and so the station, alive
        forever."""
        add_robot(self.plant, scenario.robot)
        self.plant.Finalize()
        set_initial_poses(self.plant, self.scene, self.objects)
        motion = make_motion(scenario)
        check_scene_reach(self.scene, motion, scenario.planner)
        self._arm_path: ArmPath | None = None
        if isinstance(scenario.robot, FrankaArm):
            self._arm_path = ArmPath(*arm_model(scenario.robot), self.plant.time_step())
        set_home(self.plant, motion, scenario.planner.open_width)
        groups = _surface_groups(self.scene, self.still_bodies, self.objects)
        paint_surfaces(self.plant, self.scene_graph, scenario.appearance, groups, seed)
        projector = None
        if scenario.cameras and can_render():
            projector = add_cameras(builder, scenario, self.scene_graph, self.grid, seed)
            builder.ExportOutput(projector.GetOutputPort("observation"), "observation")
            builder.ExportOutput(projector.GetOutputPort("heights"), "observation_heights")
        self.has_cameras = projector is not None
        """Whether the port `observation` exists."""
        self._planner = add_control(
            builder,
            scenario,
            self.scene,
            self.plant,
            projector,
            motion,
            seed,
            takes_joint_targets=takes_joint_targets,
        )
        self._add_score_and_rest(builder)
        self._feeder = self._add_feeder(builder)
        for system in (self._monitor, self._feeder):
            if system is not None:
                builder.Connect(self._planner.GetOutputPort("mode"), system.GetInputPort("mode"))
        for name in ("body_poses", "contact_results"):
            builder.ExportOutput(self.plant.GetOutputPort(name), name)
        builder.ExportOutput(self.scene_graph.get_query_output_port(), "query_object")
        builder.BuildInto(self)
        self.set_name("station")

    def _add_score_and_rest(self, builder: DiagramBuilder) -> None:
        """Adds placement monitor and rest detector, and exports their ports."""
        scene, plant, sleep = self.scene, self.plant, self.scenario.sleep
        self._monitor = builder.AddNamedSystem(
            "monitor",
            PlacementMonitor(objects=self.objects, goals=scene.goals, success=scene.success),
        )
        hand = [plant.GetBodyByName(name) for name in ("hand", "left_finger", "right_finger")]
        self._rest_detector = builder.AddNamedSystem(
            "rest_detector",
            RestDetector(
                objects=[bounded_body(plant, self.scene_graph, body) for body in self._bodies],
                movers=[bounded_body(plant, self.scene_graph, body) for body in hand],
                position_tolerance=sleep.position_tolerance,
                angle_tolerance=sleep.angle_tolerance,
                time_to_sleep=sleep.time_to_sleep,
                wake_distance=sleep.wake_distance,
            ),
        )
        for system in (self._monitor, self._rest_detector):
            builder.Connect(plant.get_body_poses_output_port(), system.GetInputPort("body_poses"))
            for index in range(system.num_output_ports()):
                port = system.get_output_port(index)
                builder.ExportOutput(port, port.get_name())

    def _add_feeder(self, builder: DiagramBuilder) -> ObjectFeeder | None:
        """Adds the feeder, if objects appear during the episode."""
        arrivals = self.scene.arrivals
        if arrivals is None:
            return None
        there = [i for i in range(len(self.objects)) if i not in arrivals.objects]
        feeder = ObjectFeeder(
            waiting=[
                (self.objects[i].body, self.scene.objects[i].X_WB.translation())
                for i in arrivals.objects
            ],
            others=[self.objects[i].body for i in there],
            area=arrivals.area,
        )
        builder.AddNamedSystem("feeder", feeder)
        builder.Connect(self.plant.get_body_poses_output_port(), feeder.GetInputPort("body_poses"))
        return feeder

    # Methods that evaluate the ports, for callers that hold the context of an enclosing Diagram.

    def object_poses(self, root_context: Context) -> list[RigidTransform]:
        """X_WB of each of the scene's objects."""
        context = self.plant.GetMyContextFromRoot(root_context)
        return [body.EvalPoseInWorld(context) for body in self._bodies]

    def placements(self, root_context: Context) -> list[Placement]:
        """The port `placements`: a placement for each of the scene's objects."""
        return self._monitor.placements(self._monitor.GetMyContextFromRoot(root_context))

    def reward(self, root_context: Context) -> float:
        """The port `reward`: the task's reward so far, 0 to 1."""
        return self._monitor.reward(self._monitor.GetMyContextFromRoot(root_context))

    def kept_goals(self, root_context: Context) -> frozenset[int]:
        """The port `kept_goals`: indices of goals that count as filled from now on."""
        return frozenset(np.flatnonzero(self._eval(root_context, "kept_goals")).tolist())

    def at_rest(self, root_context: Context) -> NDArray[np.bool_]:
        """The port `at_rest`: (n,) whether each of the scene's objects is at rest."""
        return self._rest_detector.at_rest(self._rest_detector.GetMyContextFromRoot(root_context))

    def mode(self, root_context: Context) -> Mode:
        """The port `mode`: the planner's present mode."""
        return self._planner.mode(self._planner.GetMyContextFromRoot(root_context))

    def asks(self, root_context: Context) -> bool:
        """The port `asks`: whether the planner will read the action at its next update."""
        return bool(self._eval(root_context, "asks")[0])

    def observation(self, root_context: Context) -> Observation:
        """The port `observation`: the present observation o_t, which is rendered if necessary."""
        return self._eval(root_context, "observation")

    def counts(self, root_context: Context) -> tuple[int, int, int, int]:
        """The port `counts`: actions begun, grasps missed, objects dropped, actions stopped."""
        actions, missed, dropped, stopped = map(int, self._eval(root_context, "counts"))
        return actions, missed, dropped, stopped

    def peak_force(self, root_context: Context) -> tuple[float, float, Mode]:
        """The port `peak_force`: the largest vertical and lateral contact force in N, and the mode
        in which the larger of the two occurred."""
        vertical, lateral, mode = self._eval(root_context, "peak_force").tolist()
        return vertical, lateral, Mode(int(mode))

    def point_contact_pairs(self, root_context: Context) -> int:
        """Number of pairs in point contact; 0 if contact is strictly hydroelastic."""
        return self._eval(root_context, "contact_results").num_point_pair_contacts()

    def history(self, root_context: Context) -> tuple[Attempt, ...]:
        """The port `history`: the last actions with a known outcome, oldest first."""
        return self._eval(root_context, "history")

    def proposed_action(self, root_context: Context) -> PickPlaceAction:
        """The port `action`: the connected policy's present action."""
        return self.GetInputPort("action").Eval(self.GetMyContextFromRoot(root_context))

    def accepted_action(self, root_context: Context) -> PickPlaceAction:
        """The port `accepted_action`: the action that began last or, after a stop, the stopping
        action."""
        return self._eval(root_context, "accepted_action")

    def _eval(self, root_context: Context, port: str) -> Any:
        return self.GetOutputPort(port).Eval(self.GetMyContextFromRoot(root_context))

    @property
    def X_WOverview(self) -> RigidTransform:
        """Pose of a camera that sees the whole cell."""
        return X_WOVERVIEW if self._arm_path is None else X_WARM_OVERVIEW

    # Simulation, with objects that appear or sleep.

    def make_simulator(
        self, diagram: Diagram | None = None, *, monitor: Monitor | None = None
    ) -> Simulator:
        """Makes a Simulator in which objects appear (see `ObjectFeeder`). If the scenario enables
        sleep, objects at rest are frozen (see `RestDetector`).

        Args:
            diagram: the outermost Diagram, which contains this station; None if it is the station
                itself.
            monitor: a function that is called after each step. Use it instead of
                `Simulator.set_monitor`, which would keep objects from appearing and sleeping.

        Raises:
            ValueError: `diagram` is None, but the station is part of a Diagram.
        """
        if diagram is None and self.GetSystemPathname().strip(":").count("::"):
            raise ValueError(
                "the station is part of a Diagram: pass the outermost Diagram to make_simulator"
            )
        simulator = Simulator(self if diagram is None else diagram)
        bodies = self._free_bodies()

        def step(root_context: Context) -> EventStatus:
            bodies.let_appear(root_context)
            bodies.apply_sleep(root_context, self.at_rest(root_context))
            status = EventStatus.DidNothing() if monitor is None else monitor(root_context)
            # Correct the drift last, so that the monitor sees the bodies where the planner's update
            # saw them.
            bodies.correct_drift(root_context)
            return status

        simulator.set_monitor(step)
        return simulator

    def _free_bodies(self) -> FreeBodies:
        return FreeBodies(
            self.plant,
            self.scene_graph,
            self.scene,
            bodies=[item.body for item in self.objects],
            still_bodies=self.still_bodies,
            may_sleep=self.scenario.sleep.enabled,
            feeder=self._feeder,
            arm_path=self._arm_path,
        )

    @property
    def _bodies(self) -> list[RigidBody]:
        """The bodies of the scene's objects."""
        return [self.plant.get_body(item.body) for item in self.objects]


def build_station(
    scenario: Scenario,
    seed: int = 0,
    base: Path | None = None,
    *,
    takes_joint_targets: bool = False,
) -> KittingStation:
    """Builds the station of a scenario.

    Args:
        scenario: the scenario. Its policy is not part of the station (see `station.policy`).
        seed: the seed of the scene and of all noise; see `TaskConfig.make_scene`.
        base: base folder of the scenario's relative paths; None for the working directory.
        takes_joint_targets: whether the caller commands the joints instead of the planner.

    Raises:
        UserError: the scenario is invalid.
    """
    folder = Path.cwd() if base is None else base
    return KittingStation(scenario, seed=seed, base=folder, takes_joint_targets=takes_joint_targets)


def _check_scene(scenario: Scenario, scene: Scene) -> None:
    """Checks the scene that a task made.

    Raises:
        UserError: it is not a Scene, or an object or a goal is off the table, too high for the
            heightmap or too wide for the jaws.
    """
    if not isinstance(scene, Scene):
        raise UserError(f"task: make_scene must return a Scene, but returns {scene!r}")
    _check_on_table(scene)
    tops = {item.name: float((item.X_WB @ item.p_BPoints.T)[2].max()) for item in scene.objects}
    tops |= {goal.name: goal.rim_height for goal in scene.goals if goal.rim_height is not None}
    name, top = max(tops.items(), key=lambda pair: pair[1])
    if top > scenario.heightmap.z_max:
        raise UserError(
            f"heightmap.z_max is {scenario.heightmap.z_max:g}, too low to see the top of {name}: "
            f"set at least {top:.3f}"
        )
    for index in scene.goal_objects:
        item = scene.objects[index]
        narrowest = min((grasp.width for grasp in item.grasps), default=0.0)
        if narrowest >= scenario.planner.open_width:
            raise UserError(
                f"planner.open_width is {scenario.planner.open_width:g}, too narrow for {item.name}"
                f": set more than {narrowest:.3f}"
            )


def _check_on_table(scene: Scene) -> None:
    poses = [item.X_WB for item in scene.objects]
    if scene.arrivals is not None:
        for index, X_WB in zip(scene.arrivals.objects, scene.arrivals.poses, strict=True):
            poses[index] = X_WB
    middles = [item.p_BPoints.mean(axis=0) for item in scene.objects]
    things = [
        (f"the object '{item.name}'", X_WB @ middle)
        for item, X_WB, middle in zip(scene.objects, poses, middles, strict=True)
    ]
    things += [
        (f"the goal '{goal.name}'", X_WGoal @ middles[index])
        for goal in scene.goals
        for index in goal.objects
        for X_WGoal in goal.poses
    ]
    low, high = TABLE
    for name, (x, y, _) in things:
        if not (low[0] <= x <= high[0] and low[1] <= y <= high[1]):
            raise UserError(
                f"{name} at ({x:.2f}, {y:.2f}) m is not on the table: choose x from {low[0]:g} to "
                f"{high[0]:g} m and y from {low[1]:g} to {high[1]:g} m"
            )


def _surface_groups(
    scene: Scene, still_bodies: Sequence[BodyIndex], objects: Sequence[PlacedObject]
) -> dict[BodyIndex, str]:
    """For each body, the prefix of its surfaces' names in a scenario's `appearance`: `table`,
    `fixtures/NAME` or `objects/NAME`."""
    groups = {still_bodies[0]: "table"}
    for fixture, body in zip(scene.fixtures, still_bodies[1:], strict=True):
        groups[body] = f"fixtures/{fixture.name}"
    return groups | {item.body: f"objects/{item.name}" for item in objects}
