import numpy as np
import pytest
from numpy.typing import NDArray
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import MultibodyForces
from pydrake.systems.framework import Context

from kitting_drake.scenario.robots import FrankaArm
from kitting_drake.station.robot import arm_model
from systems.joint_controller import JointController
from systems.trajectory_controller import FingerLaw

STEP = 1 / 128
FINGERS = FingerLaw(stiffness=500.0, damping=10.0, force_limit=40.0)
Q, V = np.array([0.2, 0.3, -0.1, -2.2, 0.1, 2.5, 0.8]), np.linspace(0.5, -0.7, 7)
Q_D, V_D, A_D = Q + 0.01, V - 0.1, np.linspace(-3.0, 4.0, 7)


@pytest.fixture(scope="module")
def arm() -> MultibodyPlant:
    return arm_model(FrankaArm())[0]


def make(arm: MultibodyPlant, opening: float = 0.03) -> tuple[JointController, Context]:
    controller = JointController(arm=arm, step=STEP, fingers=FINGERS)
    context = controller.CreateDefaultContext()
    state = np.concatenate([Q, [0.02, 0.021], V, [-0.01, -0.02]])
    controller.GetInputPort("robot_state").FixValue(context, state)
    controller.GetInputPort("desired_motion").FixValue(context, np.concatenate([Q_D, V_D, A_D]))
    controller.GetInputPort("desired_opening").FixValue(context, [opening, -0.1])
    return controller, context


def value(controller: JointController, context: Context, port: str) -> NDArray[np.float64]:
    return controller.GetOutputPort(port).Eval(context)


def test_ports(arm: MultibodyPlant):
    controller, _ = make(arm)
    inputs = {
        "robot_state": 18,
        "desired_motion": 21,
        "desired_opening": 2,
        "closing_force": 1,
        "payload": 1,
    }
    outputs = {"desired_state": 14, "feedforward": 7, "finger_force": 2}
    assert controller.num_input_ports() == len(inputs)
    assert controller.num_output_ports() == len(outputs)
    for name, size in inputs.items():
        assert controller.GetInputPort(name).size() == size
    for name, size in outputs.items():
        assert controller.GetOutputPort(name).size() == size


def test_feedforward_is_mass_matrix_times_acceleration_and_bias(arm: MultibodyPlant):
    controller, context = make(arm)
    own = arm.CreateDefaultContext()
    arm.SetPositions(own, np.append(Q, [0.02, 0.021]))
    arm.SetVelocities(own, np.append(V, [-0.01, -0.02]))
    mass = arm.CalcMassMatrix(own)
    # The mass matrix includes the reflected inertia of the drives.
    assert mass[0, 0] > 0.6 and mass[6, 6] > 0.2
    expected = (mass @ np.append(A_D, [0.0, 0.0]) + arm.CalcBiasTerm(own))[:7]
    np.testing.assert_allclose(value(controller, context, "feedforward"), expected, atol=1e-9)
    # The arm's model has no gravity.
    at_rest = arm.CalcInverseDynamics(arm.CreateDefaultContext(), np.zeros(9), MultibodyForces(arm))
    np.testing.assert_allclose(at_rest, 0.0, atol=1e-12)


def test_desired_state_is_that_at_the_end_of_the_step(arm: MultibodyPlant):
    controller, context = make(arm)
    position, velocity = np.split(value(controller, context, "desired_state"), 2)
    np.testing.assert_allclose(position, Q_D + STEP * V_D + STEP**2 / 2 * A_D)
    np.testing.assert_allclose(position, Q_D + STEP * velocity)


def test_fingers_saturate_and_the_closing_force_is_optional(arm: MultibodyPlant):
    controller, context = make(arm)
    held = value(controller, context, "finger_force").copy()
    assert held == pytest.approx([500 * (0.03 - 0.041) / 2 + 10 * (-0.1 + 0.03) / 2] * 2)
    closing = controller.GetInputPort("closing_force")
    closing.FixValue(context, [7.0])
    np.testing.assert_allclose(value(controller, context, "finger_force"), held - 7.0)
    closing.FixValue(context, [1000.0])
    np.testing.assert_array_equal(value(controller, context, "finger_force"), [-40.0, -40.0])


def test_another_plant_raises():
    plant = MultibodyPlant(0.0)
    plant.Finalize()
    with pytest.raises(ValueError, match="9 positions"):
        JointController(arm=plant, step=STEP, fingers=FINGERS)
