import numpy as np
import pytest
from numpy.typing import NDArray
from pydrake.multibody.math import SpatialForce
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import Frame, JacobianWrtVariable

from kitting_drake.scenario.robots import FrankaArm
from kitting_drake.station.robot import arm_model
from systems.wrist_force import WristForce

# With these joint positions the hand points down, 50 mm above the table. The base is turned by
# 30 degrees.
Q = np.array([0.4, 0.57, 0.2, -2.0, -0.1, 2.6, 1.1])
ROBOT = FrankaArm(base=[0.1, 0.0, 0.0], yaw_deg=30.0)
V = np.linspace(1.0, -1.5, 7)
STEP = 1 / 128
FORCE, TORQUE = np.array([3.0, -4.0, 20.0]), np.array([0.2, -0.3, 0.7])
Model = tuple[MultibodyPlant, Frame]


@pytest.fixture(scope="module")
def model() -> Model:
    return arm_model(ROBOT)


def joint_torque(model: Model, q: NDArray[np.float64] = Q) -> NDArray[np.float64]:
    """The joint torques of FORCE and TORQUE at G, from the Jacobian that Drake computes."""
    plant, gripper = model
    context = plant.CreateDefaultContext()
    plant.SetPositions(context, np.append(q, [0.01, 0.01]))
    world, body = plant.world_frame(), plant.GetFrameByName("hand")
    jacobian = plant.CalcJacobianSpatialVelocity(
        context, JacobianWrtVariable.kV, body, np.zeros(3), world, world
    )[:, :7]
    p_GHand_W = (
        body.CalcPoseInWorld(context).translation() - gripper.CalcPoseInWorld(context).translation()
    )
    at_hand = SpatialForce(TORQUE, FORCE).Shift(p_GHand_W)
    return jacobian.T @ at_hand.get_coeffs()


def estimate(
    model: Model,
    torque: NDArray[np.float64],
    *,
    noise: float = 0.0,
    seed: int = 0,
    time: float = 0,
    port: str = "wrist_force",
) -> NDArray[np.float64]:
    plant, gripper = model
    system = WristForce(arm=plant, gripper=gripper, step=STEP, noise=noise, seed=seed)
    context = system.CreateDefaultContext()
    context.SetTime(time)
    # The torques belong to the positions before the last step, Q.
    state = np.concatenate([Q + STEP * V, [0.01, 0.01], V, [0.0, 0.0]])
    system.GetInputPort("robot_state").FixValue(context, state)
    system.GetInputPort("joint_contact_torque").FixValue(context, torque)
    system.GetInputPort("finger_contact_force").FixValue(context, [5.0, -6.0])
    return system.GetOutputPort(port).Eval(context).copy()


def test_ports(model: Model):
    plant, gripper = model
    system = WristForce(arm=plant, gripper=gripper, step=STEP)
    inputs = {"robot_state": 18, "joint_contact_torque": 7, "finger_contact_force": 2}
    assert system.num_input_ports() == len(inputs)
    for name, size in inputs.items():
        assert system.GetInputPort(name).size() == size
    outputs = {"wrist_force": 6, "wrist_moment": 1}
    assert system.num_output_ports() == len(outputs)
    for name, size in outputs.items():
        assert system.GetOutputPort(name).size() == size


def test_it_equals_the_applied_force(model: Model):
    found = estimate(model, joint_torque(model))
    np.testing.assert_allclose(found, [*FORCE, TORQUE[2], 5.0, -6.0], atol=1e-9)


def test_the_moment_is_about_the_jaws_and_positive_for_a_load_in_front(model: Model):
    plant, gripper = model
    context = plant.CreateDefaultContext()
    plant.SetPositions(context, np.append(Q, [0.01, 0.01]))
    R_WG = gripper.CalcPoseInWorld(context).rotation()
    (found,) = estimate(model, joint_torque(model), port="wrist_moment")
    assert found == pytest.approx(TORQUE @ R_WG.col(1), abs=1e-9)
    weight = np.array([0.0, 0.0, -1.0])
    assert np.cross(R_WG.col(0), weight) @ R_WG.col(1) > 0.9


def test_no_contact_is_no_force(model: Model):
    np.testing.assert_array_equal(estimate(model, np.zeros(7)), [0, 0, 0, 0, 5.0, -6.0])


def test_noise_is_a_function_of_seed_and_time(model: Model):
    torque = joint_torque(model)
    errors = np.array(
        [
            estimate(model, torque, noise=0.1, seed=3, time=step / 128)[:4] - [*FORCE, TORQUE[2]]
            for step in range(200)
        ]
    )
    assert len(np.unique(errors[:, 2])) == 200
    assert 0.05 < errors[:, 2].std() < 2.0
    assert abs(errors[:, 2].mean()) < 0.3 * errors[:, 2].std()
    again = estimate(model, torque, noise=0.1, seed=3, time=5 / 128)[:4] - [*FORCE, TORQUE[2]]
    np.testing.assert_array_equal(again, errors[5])
    other = estimate(model, torque, noise=0.1, seed=4, time=5 / 128)[:4] - [*FORCE, TORQUE[2]]
    assert np.abs(other - errors[5]).max() > 0.01
