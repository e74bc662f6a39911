import numpy as np
import pytest
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.analysis import Simulator

from kitting_drake.scenario.robots import FloatingHand, FrankaArm, Robot
from kitting_drake.station.robot import ARM, HAND, add_robot, arm_model, hand_model
from systems.contact_torque import ContactTorque
from systems.trajectory_controller import FINGERS

STEP = 1 / 128
Q = np.array([0.4, 0.57, 0.2, -2.0, -0.1, 2.6, 1.1])
"""Positions of an arm's joints, within their limits."""
ROBOTS = {
    "hand": FloatingHand(),
    "arm": FrankaArm(base=[0.04, 0.0, -0.76], friction=[5.0] * 7),
}
"""An arm at the height of the floor has no pedestal, whose geometry would need a SceneGraph."""


def model_of(robot: Robot) -> MultibodyPlant:
    return arm_model(robot)[0] if isinstance(robot, FrankaArm) else hand_model()


def moving(robot: Robot, push: np.ndarray) -> tuple[MultibodyPlant, Simulator]:
    """A robot that moves freely, with a generalized force `push` that no actuator causes."""
    plant = MultibodyPlant(STEP)
    add_robot(plant, robot)
    plant.Finalize()
    simulator = Simulator(plant)
    context = simulator.get_mutable_context()
    size = plant.num_velocities()
    rng = np.random.default_rng(0)
    start = Q if plant.HasModelInstanceNamed(ARM) else np.full(size - FINGERS, 0.3)
    plant.SetPositions(context, [*start, 0.02, 0.02])
    plant.SetVelocities(context, [*rng.uniform(-0.5, 0.5, len(start)), 0.0, 0.0])
    for instance in (ARM, HAND):
        if plant.HasModelInstanceNamed(instance):
            port = plant.get_actuation_input_port(plant.GetModelInstanceByName(instance))
            port.FixValue(context, rng.uniform(-2.0, 2.0, port.size()))
    if plant.HasModelInstanceNamed(ARM):
        port = plant.get_desired_state_input_port(plant.GetModelInstanceByName(ARM))
        port.FixValue(context, [*(Q + 0.01), *np.zeros(len(Q))])
    plant.get_applied_generalized_force_input_port().FixValue(context, push)
    return plant, simulator


def contact_torque(robot: Robot, plant: MultibodyPlant, simulator: Simulator) -> np.ndarray:
    model, context = model_of(robot), simulator.get_context()
    joints = model.num_velocities() - FINGERS
    system = ContactTorque(robot=model, joints=joints, step=STEP)
    assert [system.get_input_port(i).get_name() for i in range(3)] == [
        "robot_state",
        "acceleration",
        "actuation",
    ]
    assert system.get_output_port().size() == joints
    own = system.CreateDefaultContext()
    ports = (
        plant.get_state_output_port(),
        plant.get_generalized_acceleration_output_port(),
        plant.get_net_actuation_output_port(),
    )
    for number, port in enumerate(ports):
        system.get_input_port(number).FixValue(own, port.Eval(context))
    return system.get_output_port().Eval(own).copy()


@pytest.mark.parametrize("robot", ROBOTS.values(), ids=ROBOTS)
def test_it_equals_the_force_that_no_actuator_causes(robot: Robot):
    """The robot moves, and is slowed down by damping; an arm also holds a desired state."""
    size = model_of(robot).num_velocities()
    push = np.linspace(-5.0, 8.0, size)
    plant, simulator = moving(robot, push)
    for step in range(1, 4):
        simulator.AdvanceTo(step * STEP)
        found = contact_torque(robot, plant, simulator)
        np.testing.assert_allclose(found, push[: size - FINGERS], atol=1e-8)


def test_it_is_zero_before_the_first_step():
    system = ContactTorque(robot=hand_model(), joints=4, step=STEP)
    context = system.CreateDefaultContext()
    for number, size in enumerate((12, 6, 6)):
        system.get_input_port(number).FixValue(context, np.zeros(size))
    np.testing.assert_array_equal(system.get_output_port().Eval(context), np.zeros(4))
