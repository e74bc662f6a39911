"""An arm that compensates the weight of its load holds still."""

import numpy as np
from pydrake.multibody.math import SpatialForce
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph, ExternallyAppliedSpatialForce
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder

from kitting_drake.scenario.robots import FrankaArm
from kitting_drake.station.control import _robot_state
from kitting_drake.station.robot import ARM, HAND, add_robot, arm_model
from systems.arm_kinematics import fingertips, planar
from systems.joint_controller import JointController
from systems.trajectory_controller import FingerLaw

STEP, WEIGHT = 1 / 128, 9.81
Q = planar(np.array([0.6, 0.1, 0.1]), np.array(0.7))


def sag(payload: float) -> float:
    """How far the hand sinks within 1 s under its load (m), if the arm compensates `payload`."""
    robot = FrankaArm(base=[0.0, 0.0, 0.0])
    builder = DiagramBuilder()
    plant, _ = AddMultibodyPlantSceneGraph(builder, STEP)
    add_robot(plant, robot)
    plant.Finalize()
    arm, hand = (plant.GetModelInstanceByName(name) for name in (ARM, HAND))
    fingers = FingerLaw(stiffness=500.0, damping=10.0, force_limit=40.0)
    controller = builder.AddSystem(
        JointController(arm=arm_model(robot)[0], step=STEP, fingers=fingers)
    )
    builder.Connect(_robot_state(builder, plant), controller.GetInputPort("robot_state"))
    for port, target in (
        ("desired_state", plant.get_desired_state_input_port(arm)),
        ("feedforward", plant.get_actuation_input_port(arm)),
        ("finger_force", plant.get_actuation_input_port(hand)),
    ):
        builder.Connect(controller.GetOutputPort(port), target)
    diagram = builder.Build()
    simulator = Simulator(diagram)
    root = simulator.get_mutable_context()
    context, own = (it.GetMyMutableContextFromRoot(root) for it in (plant, controller))
    plant.SetPositions(context, arm, Q)
    pull = ExternallyAppliedSpatialForce()
    pull.body_index = plant.GetBodyByName("hand").index()
    pull.p_BoBq_B = np.array([0.0, 0.0, 0.1121])
    pull.F_Bq_W = SpatialForce(np.zeros(3), np.array([0.0, 0.0, -WEIGHT]))
    plant.get_applied_spatial_force_input_port().FixValue(context, [pull])
    for name, value in (
        ("desired_motion", [*Q, *np.zeros(14)]),
        ("desired_opening", [0.02, 0.0]),
        ("payload", [payload]),
    ):
        controller.GetInputPort(name).FixValue(own, value)
    simulator.AdvanceTo(1.0)
    tip = fingertips(plant.GetPositions(context, arm))
    return float(fingertips(Q)[2] - tip[2])


def test_what_was_weighed_causes_no_sag():
    assert sag(0.0) > 0.002
    assert abs(sag(-WEIGHT)) < 0.0003
    # Even if the compensated weight is wrong by a tenth, the hand hardly sinks.
    assert abs(sag(-0.9 * WEIGHT)) < 0.001
