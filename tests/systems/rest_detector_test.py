import numpy as np
import pytest
from pydrake.common.value import Value
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.tree import BodyIndex
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context

from systems.rest_detector import BoundedBody, Box, RestDetector

PATIENCE = 0.25
LEFT, RIGHT, HAND = 1, 2, 3
POSITION, ANGLE = 0.0005, 0.02
AWAY, BESIDE = 1.0, 0.004


class Table:
    """A detector for two bars of 20 x 2 cm, 20 cm apart, and a hand, whose poses the tests set."""

    def __init__(self, time_to_sleep: float = PATIENCE) -> None:
        bar = Box(RigidTransform(), np.array([0.1, 0.01, 0.01]))
        self.detector = RestDetector(
            objects=[BoundedBody(BodyIndex(i), [bar]) for i in (LEFT, RIGHT)],
            movers=[BoundedBody(BodyIndex(HAND), [Box(RigidTransform(), np.full(3, 0.02))])],
            position_tolerance=POSITION,
            angle_tolerance=ANGLE,
            time_to_sleep=time_to_sleep,
            wake_distance=0.006,
        )
        self.simulator = Simulator(self.detector)
        self.poses = {LEFT: RigidTransform([0, 0.1, 0]), RIGHT: RigidTransform([0, -0.1, 0])}
        self.poses[HAND] = RigidTransform([0, 0, AWAY])

    def advance(self, seconds: float) -> Context:
        """Advances by some time. An update that is due at the end is not executed yet."""
        context = self.simulator.get_mutable_context()
        poses = [RigidTransform(), *(self.poses[i] for i in (LEFT, RIGHT, HAND))]
        self.detector.GetInputPort("body_poses").FixValue(context, Value(poses))
        self.simulator.AdvanceTo(context.get_time() + seconds)
        return context

    def at_rest_after(self, seconds: float) -> list[bool]:
        """Whether the left and the right bar are at rest after some time."""
        context = self.advance(seconds)
        self.simulator.AdvancePendingEvents()
        assert self.detector.GetOutputPort("at_rest").Eval(context).tolist() == [
            float(value) for value in self.detector.at_rest(context)
        ]
        return self.detector.at_rest(context).tolist()

    def move_by(self, body: int, metres: float = 0.0, radians: float = 0.0) -> None:
        """Moves a bar along its own x axis and rotates it about its middle."""
        motion = RigidTransform(RollPitchYaw(0, 0, radians), [metres, 0, 0])
        self.poses[body] = self.poses[body] @ motion

    def hand_over(self, body: int, gap: float) -> None:
        """Puts the hand over a bar, with this gap (m) between their boxes."""
        self.poses[HAND] = self.poses[body] @ RigidTransform([0, 0, 0.01 + 0.02 + gap])


def test_ports():
    detector = Table().detector
    assert detector.num_input_ports() == 1
    assert detector.HasInputPort("body_poses")
    assert detector.num_output_ports() == 1
    assert detector.GetOutputPort("at_rest").size() == 2


def test_rest_takes_time_to_sleep():
    table = Table()
    assert table.at_rest_after(PATIENCE - 1 / 64) == [False, False]
    assert table.at_rest_after(2 / 64) == [True, True]


@pytest.mark.parametrize(
    ("metres", "radians"), [(0.8 * POSITION, 0.8 * ANGLE), (0.0, 0.8 * ANGLE), (0.0, 0.0)]
)
def test_an_object_that_trembles_in_place_rests(metres: float, radians: float):
    """Only the distance matters, not the speed. At a tenth of the trembling object's speed, a
    drifting object would exceed the tolerance within `time_to_sleep`."""
    table = Table()
    for sign in (1, -1) * 8:
        table.move_by(LEFT, sign * metres, sign * radians)
        table.at_rest_after(1 / 64)
    assert table.at_rest_after(2 / 64) == [True, True]


@pytest.mark.parametrize(("metres", "radians"), [(0.1 * POSITION, 0.0), (0.0, 0.1 * ANGLE)])
def test_an_object_that_creeps_does_not_rest(metres: float, radians: float):
    """The object creeps by a tenth of the tolerance in 1/64 s, so it exceeds the tolerance within
    `time_to_sleep`."""
    table = Table()
    for _ in range(64):
        table.move_by(LEFT, metres, radians)
        assert table.at_rest_after(1 / 64)[0] is False
    assert table.at_rest_after(0)[1] is True


def test_a_movement_restarts_the_wait():
    table = Table()
    table.at_rest_after(0.2)
    table.move_by(LEFT, 2 * POSITION)
    assert table.at_rest_after(1 / 64)[0] is False
    assert table.at_rest_after(0.2) == [False, True]
    assert table.at_rest_after(0.1) == [True, True]


def test_a_mover_nearby_keeps_an_object_awake():
    table = Table()
    table.hand_over(RIGHT, gap=BESIDE)
    assert table.at_rest_after(1.0) == [True, False]
    table.hand_over(RIGHT, gap=0.007)
    assert table.at_rest_after(1 / 16) == [True, True]


def test_an_object_wakes_at_the_next_update():
    table = Table()
    table.at_rest_after(1.0)
    table.hand_over(LEFT, gap=BESIDE)
    assert table.at_rest_after(1 / 64) == [False, True]


@pytest.mark.parametrize("step", [0.0004, 0.0011, 0.017])
def test_a_slow_hand_wakes_an_object_in_time(step: float):
    """Distances are not tested at every update, but never too late."""
    table = Table()
    gap = 0.08
    table.hand_over(LEFT, gap)
    assert table.at_rest_after(1.0) == [True, True]
    while gap > 0:
        gap -= step
        table.hand_over(LEFT, gap)
        assert table.at_rest_after(1 / 64) == [gap > 0.006, True]


@pytest.mark.parametrize("metres", [20.0, np.nan])
def test_an_object_outside_the_cell_rests_even_if_it_moves(metres: float):
    table = Table()
    table.poses[RIGHT] = RigidTransform([0, -0.1, metres])
    assert table.at_rest_after(1 / 64) == [False, True]
    table.move_by(RIGHT, metres=5.0, radians=1.0)
    assert table.at_rest_after(1 / 64) == [False, True]
    assert table.at_rest_after(PATIENCE) == [True, True]


def test_an_awake_neighbour_wakes_a_sleeper():
    table = Table()
    table.poses[RIGHT] = RigidTransform([0, 0.1 - 0.02 - BESIDE, 0])
    assert table.at_rest_after(1.0) == [True, True]  # Adjacent bars may rest.
    # The hand is near the left bar, on the side away from the right bar.
    table.poses[HAND] = RigidTransform([0, 0.1 + 0.01 + 0.02 + BESIDE, 0])
    assert table.at_rest_after(1 / 64) == [False, False]
    # If the right bar is moved away, only the left one, which is near the hand, stays awake.
    table.poses[RIGHT] = RigidTransform([0, -0.1, 0])
    assert table.at_rest_after(1.0) == [False, True]


def test_adjacent_objects_that_stopped_at_different_times_rest():
    """Neither may keep the other awake."""
    table = Table()
    table.poses[RIGHT] = RigidTransform([0, 0.1 - 0.02 - BESIDE, 0])
    table.at_rest_after(0.2)
    table.move_by(LEFT, 2 * POSITION)
    table.at_rest_after(2 / 64)
    table.move_by(RIGHT, 2 * POSITION)
    assert table.at_rest_after(PATIENCE - 1 / 64) == [False, False]
    assert table.at_rest_after(1 / 16) == [True, True]


def test_distances_are_between_oriented_boxes():
    """The boxes are 3 cm apart, although their bounds along the world's axes overlap."""
    table = Table()
    turn = RollPitchYaw(0, 0, np.pi / 4)
    table.poses[LEFT] = RigidTransform(turn, [0, 0, 0])
    normal = turn.ToRotationMatrix() @ [0, 1, 0]
    table.poses[HAND] = RigidTransform(turn, normal * (0.01 + 0.02 + 0.03))
    assert table.at_rest_after(1.0) == [True, True]
    table.poses[HAND] = RigidTransform(turn, normal * (0.01 + 0.02 + BESIDE))
    assert table.at_rest_after(1 / 64) == [False, True]


def test_distances_are_to_the_pieces_of_a_body():
    """The hand is in the bend of a hook: inside the hook's enclosing box, but not near its bars."""
    hook = [
        Box(RigidTransform([0.1, 0, 0]), np.array([0.1, 0.01, 0.01])),
        Box(
            RigidTransform(RollPitchYaw(0, 0, np.pi / 2), [0, 0.1, 0]), np.array([0.1, 0.01, 0.01])
        ),
    ]
    detector = RestDetector(
        objects=[BoundedBody(BodyIndex(LEFT), hook)],
        movers=[BoundedBody(BodyIndex(RIGHT), [Box(RigidTransform(), np.full(3, 0.02))])],
        position_tolerance=POSITION,
        angle_tolerance=ANGLE,
        time_to_sleep=PATIENCE,
        wake_distance=0.006,
    )
    simulator = Simulator(detector)
    context = simulator.get_mutable_context()

    def rests(p_WHand: list[float]) -> bool:
        poses = [RigidTransform(), RigidTransform(), RigidTransform(p_WHand)]
        detector.GetInputPort("body_poses").FixValue(context, Value(poses))
        simulator.AdvanceTo(context.get_time() + 0.5)
        return bool(detector.at_rest(context)[0])

    assert rests([0.1, 0.1, 0.0])
    assert not rests([0.1, 0.01 + 0.02 + BESIDE, 0.0])
    assert not rests([0.01 + 0.02 + BESIDE, 0.1, 0.0])


def test_a_moving_object_does_not_rest_with_zero_time_to_sleep():
    table = Table(time_to_sleep=0.0)
    for _ in range(6):
        table.move_by(LEFT, 2 * POSITION)
        context = table.advance(1 / 64)
    assert table.detector.at_rest(context).tolist() == [False, True]
    assert table.at_rest_after(1 / 16) == [True, True]
