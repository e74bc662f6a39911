from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from pydrake.systems.framework import Context

from systems.trajectory_controller import FingerLaw, TrajectoryController

INERTIA = np.array([2.0, 2.0, 1.5, 0.01])
WEIGHT = 12.0
STIFFNESS = np.array([1000.0, 900.0, 800.0, 20.0])
DAMPING = np.array([50.0, 40.0, 30.0, 1.0])
LIMIT = np.array([60.0, 60.0, 60.0, 3.0])
PARAMETERS: dict[str, Any] = {
    "inertia": INERTIA,
    "weight": WEIGHT,
    "stiffness": STIFFNESS,
    "damping": DAMPING,
    "force_limit": LIMIT,
    "fingers": FingerLaw(stiffness=500.0, damping=10.0, force_limit=40.0),
}

Q, V = np.array([0.4, 0.1, 0.2, 0.3]), np.array([0.1, -0.2, 0.05, 0.5])
FINGERS, FINGER_RATES = np.array([0.02, 0.021]), np.array([-0.01, -0.02])
Q_D, V_D = np.array([0.41, 0.08, 0.21, 0.32]), np.array([0.2, -0.1, 0.0, 0.4])
A_D = np.array([1.0, -2.0, 3.0, 4.0])


def make(**changes: Any) -> tuple[TrajectoryController, Context]:
    """A controller and its context, in which `set_ports` has set the required ports."""
    controller = TrajectoryController(**{**PARAMETERS, **changes})
    context = controller.CreateDefaultContext()
    set_ports(controller, context)
    return controller, context


def set_ports(
    controller: TrajectoryController,
    context: Context,
    q_d: NDArray = Q_D,
    opening: tuple[float, float] = (0.03, -0.1),
) -> None:
    state = np.concatenate([Q, FINGERS, V, FINGER_RATES])
    controller.GetInputPort("hand_state").FixValue(context, state)
    controller.GetInputPort("desired_motion").FixValue(context, np.concatenate([q_d, V_D, A_D]))
    controller.GetInputPort("desired_opening").FixValue(context, opening)


def actuation(controller: TrajectoryController, context: Context) -> NDArray:
    return controller.GetOutputPort("actuation").Eval(context)


def test_ports():
    controller = TrajectoryController(**PARAMETERS)
    inputs = {"hand_state": 12, "desired_motion": 12, "desired_opening": 2, "closing_force": 1}
    assert controller.num_input_ports() == len(inputs)
    for name, size in inputs.items():
        assert controller.GetInputPort(name).size() == size
    assert controller.num_output_ports() == 1
    assert controller.GetOutputPort("actuation").size() == 6


def test_law():
    controller, context = make()
    controller.GetInputPort("closing_force").FixValue(context, [7.0])
    axes = [
        2.0 * 1.0 + 1000 * 0.01 + 50 * 0.1,
        2.0 * -2.0 + 900 * -0.02 + 40 * 0.1,
        1.5 * 3.0 + 12.0 + 800 * 0.01 + 30 * -0.05,
        0.01 * 4.0 + 20 * 0.02 + 1.0 * -0.1,
    ]
    finger = 500 * (0.03 - 0.041) / 2 + 10 * (-0.1 + 0.03) / 2 - 7
    np.testing.assert_allclose(actuation(controller, context), [*axes, finger, finger], atol=1e-12)


def test_unconnected_closing_force_is_zero():
    controller, context = make()
    left_open = actuation(controller, context).copy()
    controller.GetInputPort("closing_force").FixValue(context, [0.0])
    np.testing.assert_array_equal(actuation(controller, context), left_open)


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("axis", range(4))
def test_an_axis_saturates_alone(axis: int, sign: int):
    controller, context = make()
    free = actuation(controller, context).copy()
    far = Q_D.copy()
    far[axis] += sign * 10
    set_ports(controller, context, q_d=far)
    expected = free.copy()
    expected[axis] = sign * LIMIT[axis]
    np.testing.assert_array_equal(actuation(controller, context), expected)


@pytest.mark.parametrize(("opening", "force"), [(10.0, 40.0), (-10.0, -40.0)])
def test_fingers_saturate(opening: float, force: float):
    controller, context = make()
    axes = actuation(controller, context)[:4].copy()
    set_ports(controller, context, opening=(opening, 0.0))
    np.testing.assert_array_equal(actuation(controller, context), [*axes, force, force])


def test_closing_force_cannot_exceed_the_finger_limit():
    controller, context = make()
    controller.GetInputPort("closing_force").FixValue(context, [1000.0])
    np.testing.assert_array_equal(actuation(controller, context)[4:], [-40.0, -40.0])


@pytest.mark.parametrize("name", ["inertia", "stiffness", "damping", "force_limit"])
def test_an_array_of_the_wrong_size_raises(name: str):
    with pytest.raises(ValueError, match=name):
        TrajectoryController(**{**PARAMETERS, name: np.ones(3)})


@pytest.mark.parametrize(
    "limit",
    [{"force_limit": np.array([1.0, 1.0, 0.0, 1.0])}, {"fingers": FingerLaw(500.0, 10.0, 0.0)}],
)
def test_a_force_limit_of_zero_raises(limit: dict[str, Any]):
    with pytest.raises(ValueError, match="limits"):
        TrajectoryController(**{**PARAMETERS, **limit})
