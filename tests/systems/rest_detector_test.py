import numpy as np
import pytest
from pydrake.common.value import Value
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.math import SpatialVelocity
from pydrake.multibody.tree import BodyIndex
from pydrake.systems.analysis import Simulator

from systems.rest_detector import BoundedBody, RestDetector

PATIENCE = 0.25
LEFT, RIGHT, HAND = 1, 2, 3
STILL = SpatialVelocity(np.zeros(3), np.zeros(3))
CREEPING = SpatialVelocity([0.0, 0.0, 0.04], [0.0019, 0.0, 0.0])
SLIDING = SpatialVelocity([0.0, 0.0, 0.0], [0.003, 0.0, 0.0])
TURNING = SpatialVelocity([0.0, 0.0, 0.06], [0.0, 0.0, 0.0])
AWAY, BESIDE = 1.0, 0.004


class Table:
    """Two bars 20 cm long and 2 cm wide, 20 cm apart, and a hand; their motion set by hand."""

    def __init__(self) -> None:
        half = np.array([0.1, 0.01, 0.01])
        self.detector = RestDetector(
            objects=[BoundedBody(BodyIndex(i), -half, half) for i in (LEFT, RIGHT)],
            movers=[BoundedBody(BodyIndex(HAND), np.full(3, -0.02), np.full(3, 0.02))],
            linear_speed=0.002,
            angular_speed=0.05,
            time_to_sleep=PATIENCE,
            wake_distance=0.006,
        )
        self.simulator = Simulator(self.detector)
        self.poses = {LEFT: RigidTransform([0, 0.1, 0]), RIGHT: RigidTransform([0, -0.1, 0])}
        self.poses[HAND] = RigidTransform([0, 0, AWAY])
        self.velocities = {LEFT: STILL, RIGHT: STILL, HAND: SLIDING}

    def at_rest_after(self, seconds: float) -> list[bool]:
        """Whether left and right are at rest, some time later."""
        context = self.simulator.get_mutable_context()
        for name, of, world in (
            ("body_poses", self.poses, RigidTransform()),
            ("body_spatial_velocities", self.velocities, STILL),
        ):
            values = [world, *(of[i] for i in (LEFT, RIGHT, HAND))]
            self.detector.GetInputPort(name).FixValue(context, Value(values))
        self.simulator.AdvanceTo(context.get_time() + seconds)
        self.simulator.AdvancePendingEvents()
        assert self.detector.GetOutputPort("at_rest").Eval(context).tolist() == [
            float(value) for value in self.detector.at_rest(context)
        ]
        return self.detector.at_rest(context).tolist()

    def hand_over(self, body: int, gap: float) -> None:
        """Puts the hand over a bar, with a gap between the boxes."""
        self.poses[HAND] = self.poses[body] @ RigidTransform([0, 0, 0.01 + 0.02 + gap])


def test_ports():
    detector = Table().detector
    assert detector.num_input_ports() == 2
    assert detector.HasInputPort("body_poses")
    assert detector.HasInputPort("body_spatial_velocities")
    assert detector.num_output_ports() == 1
    assert detector.GetOutputPort("at_rest").size() == 2


def test_rest_takes_time_to_sleep():
    table = Table()
    assert table.at_rest_after(PATIENCE - 2 / 64) == [False, False]
    assert table.at_rest_after(2 / 64) == [True, True]


@pytest.mark.parametrize(
    ("velocity", "rests"), [(CREEPING, True), (SLIDING, False), (TURNING, False)]
)
def test_both_speeds_count(velocity: SpatialVelocity, rests: bool):
    table = Table()
    table.velocities[LEFT] = velocity
    assert table.at_rest_after(1.0) == [rests, True]


def test_a_stir_starts_the_wait_again():
    table = Table()
    table.at_rest_after(0.2)
    table.velocities[LEFT] = SLIDING
    assert table.at_rest_after(1 / 64)[0] is False
    table.velocities[LEFT] = STILL
    assert table.at_rest_after(0.2) == [False, True]
    assert table.at_rest_after(0.1) == [True, True]


def test_a_mover_nearby_keeps_awake():
    table = Table()
    table.hand_over(RIGHT, gap=BESIDE)
    assert table.at_rest_after(1.0) == [True, False]
    table.hand_over(RIGHT, gap=0.007)
    assert table.at_rest_after(1 / 64) == [True, True]


def test_wakes_at_once():
    table = Table()
    table.at_rest_after(1.0)
    table.hand_over(LEFT, gap=BESIDE)
    assert table.at_rest_after(1 / 64) == [False, True]


def test_an_awake_neighbour_wakes_a_sleeper():
    table = Table()
    table.poses[RIGHT] = RigidTransform([0, 0.1 - 0.02 - BESIDE, 0])
    assert table.at_rest_after(1.0) == [True, True]  # Two that lie side by side may both rest.
    # The hand touches the far side of the left bar only.
    table.poses[HAND] = RigidTransform([0, 0.1 + 0.01 + 0.02 + BESIDE, 0])
    assert table.at_rest_after(1 / 64) == [False, False]
    # The neighbour moves off: only the bar at the hand stays awake.
    table.poses[RIGHT] = RigidTransform([0, -0.1, 0])
    assert table.at_rest_after(1 / 64) == [False, True]


def test_nearness_is_that_of_turned_boxes():
    """The boxes' world-aligned bounds overlap here, but they are 3 cm apart."""
    table = Table()
    turn = RollPitchYaw(0, 0, np.pi / 4)
    table.poses[LEFT] = RigidTransform(turn, [0, 0, 0])
    normal = turn.ToRotationMatrix() @ [0, 1, 0]
    table.poses[HAND] = RigidTransform(turn, normal * (0.01 + 0.02 + 0.03))
    assert table.at_rest_after(1.0) == [True, True]
    table.poses[HAND] = RigidTransform(turn, normal * (0.01 + 0.02 + BESIDE))
    assert table.at_rest_after(1 / 64) == [False, True]
