"""Adds the planner and the hand's controller to the station."""

import numpy as np
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.framework import DiagramBuilder

from kitting_drake.scenario.schema import Scenario
from kitting_drake.tasks.task import Scene
from systems.heightmap_projector import HeightmapProjector
from systems.pick_place_planner import PickPlacePlanner
from systems.trajectory_controller import TrajectoryController
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
}
"""Names of the planner's output ports, and the station's names for them."""


def add_control(
    builder: DiagramBuilder,
    scenario: Scenario,
    scene: Scene,
    plant: MultibodyPlant,
    projector: HeightmapProjector | None,
) -> PickPlacePlanner:
    """Adds planner and controller, connects them to the plant, and exports their ports.

    Args:
        builder: the builder of the station.
        scenario: configures planner and controller.
        scene: says how many actions there are, and whether objects are inserted.
        plant: finalized, with the hand.
        projector: provides o_t, from which the planner reads heights; None if each action carries
            its heights.
    """
    hand = plant.GetModelInstanceByName("franka_hand")
    planner = builder.AddNamedSystem(
        "planner",
        PickPlacePlanner(
            parameters=scenario.planner,
            max_actions=scene.max_actions,
            insertion=any(goal.rim_height is not None for goal in scene.goals),
            force_period=plant.time_step(),
        ),
    )
    controller = builder.AddNamedSystem("controller", _make_controller(scenario, plant))
    state = plant.get_state_output_port(hand)
    force = plant.get_generalized_contact_forces_output_port(hand)
    builder.ExportInput(planner.GetInputPort("action"), "action")
    if projector is not None:
        builder.Connect(projector.GetOutputPort("heights"), planner.GetInputPort("observation"))
    builder.Connect(state, planner.GetInputPort("hand_state"))
    builder.Connect(force, planner.GetInputPort("hand_contact_force"))
    reactions = plant.get_reaction_forces_output_port()
    wrist = builder.AddNamedSystem(
        "wrist_moment",
        WristMoment(reactions, plant.GetJointIndices().index(plant.GetJointByName("yaw").index())),
    )
    builder.Connect(reactions, wrist.get_input_port())
    builder.Connect(wrist.get_output_port(), planner.GetInputPort("wrist_moment"))
    builder.Connect(state, controller.GetInputPort("hand_state"))
    for port in ("desired_motion", "desired_opening", "closing_force"):
        builder.Connect(planner.GetOutputPort(port), controller.GetInputPort(port))
    builder.Connect(controller.get_output_port(), plant.get_actuation_input_port(hand))
    for port, name in _EXPORTED.items():
        builder.ExportOutput(planner.GetOutputPort(port), name)
    builder.ExportOutput(controller.get_output_port(), "actuation")
    builder.ExportOutput(state, "robot_state")
    builder.ExportOutput(force, "wrist_force")
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
