"""Adds the planner and the robot's controller to the station."""

from dataclasses import dataclass

import numpy as np
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import ModelInstanceIndex
from pydrake.systems.framework import DiagramBuilder, InputPort, OutputPort
from pydrake.systems.primitives import Demultiplexer, Multiplexer

from kitting_drake.scenario.robots import FrankaArm
from kitting_drake.scenario.schema import Scenario
from kitting_drake.station.robot import ARM, HAND, HAND_JOINT_NAMES, arm_model, hand_model
from kitting_drake.tasks.task import Scene
from systems.arm_hand_state import ArmHandState
from systems.arm_limits import JOINTS
from systems.contact_torque import ContactTorque
from systems.heightmap_projector import HeightmapProjector
from systems.joint_controller import JointController
from systems.pick_place_planner import PickPlacePlanner
from systems.robot_motion import RobotMotion
from systems.trajectory_controller import FINGERS, FingerLaw, TrajectoryController
from systems.wrist_force import WristForce
from systems.wrist_moment import WristMoment

_EXPORTED = {
    "failed_picks": "failed_picks",
    "history": "history",
    "peak_force": "peak_force",
    "accepted_action": "accepted_action",
    "asks": "asks",
    "mode": "mode",
    "counts": "counts",
    "desired_motion": "commanded",
    "desired_opening": "commanded_opening",
    "closing_force": "commanded_closing_force",
}
"""The station's name for each of the planner's output ports."""


@dataclass(frozen=True)
class _Driven:
    """Ports of a robot with its controller."""

    controller: JointController | TrajectoryController
    robot_state: OutputPort
    hand_state: OutputPort
    wrist_force: OutputPort
    actuation: OutputPort
    wrist_moment: OutputPort
    """The moment about the hand's y axis, for the planner's port of that name."""


def add_control(
    builder: DiagramBuilder,
    scenario: Scenario,
    scene: Scene,
    plant: MultibodyPlant,
    projector: HeightmapProjector | None,
    motion: RobotMotion,
    seed: int,
    *,
    takes_joint_targets: bool = False,
) -> PickPlacePlanner:
    """Adds planner and controller, connects them to the plant, and exports their ports. Returns the
    planner.

    Args:
        builder: the builder of the station.
        scenario: the scenario, which configures planner and controller.
        scene: determines the number of actions, and whether objects are inserted into cavities.
        plant: the finalized plant, with the robot.
        projector: the system that computes o_t, from which the planner reads heights; None if each
            action carries its heights.
        motion: computes the robot's motions.
        seed: the seed of the noise of an arm's wrist force.
        takes_joint_targets: whether the controller's inputs are exported instead of connected to
            the planner.
    """
    planner = builder.AddNamedSystem(
        "planner",
        PickPlacePlanner(
            parameters=scenario.planner,
            max_actions=scene.max_actions,
            motion=motion,
            insertion=any(goal.rim_height is not None for goal in scene.goals),
            force_period=plant.time_step(),
        ),
    )
    if isinstance(scenario.robot, FrankaArm):
        driven = drive_arm(builder, scenario, scenario.robot, plant, seed)
    else:
        driven = _drive_hand(builder, scenario, plant)
    builder.ExportInput(planner.GetInputPort("action"), "action")
    if projector is not None:
        builder.Connect(projector.GetOutputPort("heights"), planner.GetInputPort("observation"))
    builder.Connect(driven.hand_state, planner.GetInputPort("hand_state"))
    builder.Connect(driven.wrist_force, planner.GetInputPort("hand_contact_force"))
    builder.Connect(driven.wrist_moment, planner.GetInputPort("wrist_moment"))
    for port in ("desired_motion", "desired_opening", "closing_force"):
        target = driven.controller.GetInputPort(port)
        if takes_joint_targets:
            builder.ExportInput(target, port)
        else:
            builder.Connect(planner.GetOutputPort(port), target)
    if isinstance(driven.controller, JointController):
        builder.Connect(planner.GetOutputPort("payload"), driven.controller.GetInputPort("payload"))
    for port, name in _EXPORTED.items():
        builder.ExportOutput(planner.GetOutputPort(port), name)
    builder.ExportOutput(driven.actuation, "actuation")
    builder.ExportOutput(driven.robot_state, "robot_state")
    builder.ExportOutput(driven.hand_state, "hand_state")
    builder.ExportOutput(driven.wrist_force, "wrist_force")
    return planner


def _drive_hand(builder: DiagramBuilder, scenario: Scenario, plant: MultibodyPlant) -> _Driven:
    """Adds the controller of the floating hand; returns the ports of hand and controller."""
    hand = plant.GetModelInstanceByName(HAND)
    state = plant.get_state_output_port(hand)
    controller = builder.AddNamedSystem("controller", _hand_controller(scenario, plant))
    builder.Connect(state, controller.GetInputPort("hand_state"))
    builder.Connect(controller.get_output_port(), plant.get_actuation_input_port(hand))
    torque = _add_contact_torque(builder, plant, hand_model(), state, (hand,))
    force = builder.AddNamedSystem("wrist_force", Multiplexer([len(HAND_JOINT_NAMES), FINGERS]))
    builder.Connect(torque, force.get_input_port(0))
    builder.Connect(_finger_force(builder, plant), force.get_input_port(1))
    reactions = plant.get_reaction_forces_output_port()
    yaw = plant.GetJointByName("yaw").index()
    moment = builder.AddNamedSystem(
        "wrist_moment", WristMoment(reactions, plant.GetJointIndices().index(yaw))
    )
    builder.Connect(reactions, moment.get_input_port())
    return _Driven(
        controller,
        state,
        state,
        force.get_output_port(),
        controller.get_output_port(),
        moment.get_output_port(),
    )


def drive_arm(
    builder: DiagramBuilder, scenario: Scenario, robot: FrankaArm, plant: MultibodyPlant, seed: int
) -> _Driven:
    """Adds the controller of an arm, and the estimate of the force on its hand. Returns their
    ports."""
    arm, hand = (plant.GetModelInstanceByName(name) for name in (ARM, HAND))
    model, gripper = arm_model(robot)
    controller = builder.AddNamedSystem(
        "controller",
        JointController(arm=model, step=plant.time_step(), fingers=_finger_law(scenario)),
    )
    robot_state = _robot_state(builder, plant)
    wrist = builder.AddNamedSystem(
        "wrist_force",
        WristForce(
            arm=model,
            gripper=gripper,
            step=plant.time_step(),
            noise=robot.torque_noise,
            seed=seed,
        ),
    )
    hand_state = builder.AddNamedSystem("hand_state", ArmHandState(robot.arm_base()))
    actuation = builder.AddNamedSystem("actuation", Multiplexer([JOINTS, FINGERS]))

    def connect(source: OutputPort, *targets: InputPort) -> None:
        for target in targets:
            builder.Connect(source, target)

    connect(
        robot_state,
        *(it.GetInputPort("robot_state") for it in (controller, wrist, hand_state)),
    )
    torque = _add_contact_torque(builder, plant, model, robot_state, (arm, hand))
    connect(torque, wrist.GetInputPort("joint_contact_torque"))
    connect(_finger_force(builder, plant), wrist.GetInputPort("finger_contact_force"))
    connect(controller.GetOutputPort("desired_state"), plant.get_desired_state_input_port(arm))
    connect(controller.GetOutputPort("feedforward"), plant.get_actuation_input_port(arm))
    connect(plant.get_net_actuation_output_port(arm), actuation.get_input_port(0))
    connect(
        controller.GetOutputPort("finger_force"),
        plant.get_actuation_input_port(hand),
        actuation.get_input_port(1),
    )
    return _Driven(
        controller,
        robot_state,
        hand_state.get_output_port(),
        wrist.GetOutputPort("wrist_force"),
        actuation.get_output_port(),
        wrist.GetOutputPort("wrist_moment"),
    )


def _add_contact_torque(
    builder: DiagramBuilder,
    plant: MultibodyPlant,
    robot: MultibodyPlant,
    state: OutputPort,
    instances: tuple[ModelInstanceIndex, ...],
) -> OutputPort:
    """Adds the computation of the contact forces that a robot's joints feel, except for the
    fingers; returns their port.

    Args:
        builder: the builder of the station.
        plant: the station's plant.
        robot: a plant that contains only the robot.
        state: the robot's state.
        instances: the robot's model instances in the station's plant, in the order of its joints.
    """
    system = builder.AddNamedSystem(
        "contact_torque",
        ContactTorque(robot=robot, joints=robot.num_velocities() - FINGERS, step=plant.time_step()),
    )
    builder.Connect(state, system.GetInputPort("robot_state"))
    for name, port_of in (
        ("acceleration", plant.get_generalized_acceleration_output_port),
        ("actuation", plant.get_net_actuation_output_port),
    ):
        ports = [port_of(instance) for instance in instances]
        if len(ports) == 1:
            builder.Connect(ports[0], system.GetInputPort(name))
            continue
        joined = builder.AddNamedSystem(f"robot_{name}", Multiplexer([it.size() for it in ports]))
        for number, port in enumerate(ports):
            builder.Connect(port, joined.get_input_port(number))
        builder.Connect(joined.get_output_port(), system.GetInputPort(name))
    return system.get_output_port()


def _finger_force(builder: DiagramBuilder, plant: MultibodyPlant) -> OutputPort:
    """Returns the port of the contact forces on the fingers' joints. A coupler makes the fingers
    move alike, so their motion does not tell the forces on each of them."""
    force = plant.get_generalized_contact_forces_output_port(plant.GetModelInstanceByName(HAND))
    if force.size() == FINGERS:
        return force
    parts = builder.AddNamedSystem(
        "hand_contact_force", Demultiplexer([force.size() - FINGERS, FINGERS])
    )
    builder.Connect(force, parts.get_input_port())
    return parts.get_output_port(1)


def _robot_state(builder: DiagramBuilder, plant: MultibodyPlant) -> OutputPort:
    """Concatenates the states of arm and hand: positions of joints and fingers, then their
    velocities."""
    joined = builder.AddNamedSystem("robot_state", Multiplexer([JOINTS, FINGERS, JOINTS, FINGERS]))
    for index, (name, size) in enumerate(((ARM, JOINTS), (HAND, FINGERS))):
        halves = builder.AddNamedSystem(f"{name}_state", Demultiplexer([size, size]))
        state = plant.get_state_output_port(plant.GetModelInstanceByName(name))
        builder.Connect(state, halves.get_input_port())
        for half in range(2):
            builder.Connect(halves.get_output_port(half), joined.get_input_port(2 * half + index))
    return joined.get_output_port()


def _finger_law(scenario: Scenario) -> FingerLaw:
    config = scenario.controller
    return FingerLaw(config.finger_stiffness, config.finger_damping, config.finger_force_limit)


def _hand_controller(scenario: Scenario, plant: MultibodyPlant) -> TrajectoryController:
    config = scenario.controller
    context = plant.CreateDefaultContext()
    hand = plant.GetModelInstanceByName(HAND)
    joints = [plant.GetJointByName(name) for name in HAND_JOINT_NAMES]
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
        fingers=_finger_law(scenario),
    )
