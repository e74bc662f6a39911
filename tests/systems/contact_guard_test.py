import numpy as np
import pytest

from systems.contact_guard import ContactGuard, known_payload
from systems.pick_place_parameters import Mode
from systems.planner_state import PlannerState

STEP = 1 / 128
GRAVITY = 9.81


class Hand:
    """A guard and the planner's state, to which tests feed contact forces."""

    def __init__(self, mode: Mode, *, payload: float = 0.0) -> None:
        self.guard = ContactGuard(30.0, STEP)
        self.state = PlannerState(np.zeros(PlannerState.size))
        self.state.mode = mode
        self.guard.reset(self.state)
        self.state.payload, self.state.weighings = -payload, float(payload > 0)

    def feel(self, force, acceleration=(0.0, 0.0, 0.0), height=0.0, times=1) -> bool:
        contact = np.array([*force, 0.0, 0.0, 0.0])
        stops = [
            self.guard.feel(self.state, contact, height, np.array(acceleration))
            for _ in range(times)
        ]
        return stops[-1]


@pytest.mark.parametrize("mass", [0.1, 2.0, 3.0])
def test_weight_and_inertia_of_the_held_object_are_no_contact(mass: float):
    hand = Hand(Mode.CARRY)
    for a in ((0.0, 0.0, 0.0), (5.0, 0.0, -5.0), (0.0, -5.0, 5.0)):
        force = (-mass * a[0], -mass * a[1], -mass * (GRAVITY + a[2]))
        assert not hand.feel(force, a, times=20)
    assert hand.state.payload == pytest.approx(-mass * GRAVITY)
    assert max(hand.state.peak_vertical, hand.state.peak_lateral) < 1e-9


def test_a_load_is_known_as_it_is_lifted_but_no_more_than_the_hand_can_carry():
    hand = Hand(Mode.LIFT)
    hand.feel((0, 0, -1.5 * (GRAVITY + 2.0)), acceleration=(0.0, 0.0, 2.0))
    assert known_payload(hand.state) == pytest.approx(-1.5 * GRAVITY)
    hand.feel((0, 0, -50.0))
    assert known_payload(hand.state) == pytest.approx(-3.0 * GRAVITY)
    hand.feel((0, 0, -10.0))
    hand.state.mode = Mode.CARRY
    # The payload stays the force that was felt last in LIFT, until CARRY has enough samples.
    hand.feel((0, 0, -12.0), times=2)
    assert known_payload(hand.state) == -10.0
    hand.feel((0, 0, -12.0), times=20)
    assert known_payload(hand.state) == pytest.approx(-12.0)
    hand.state.mode = Mode.RELEASE
    assert known_payload(hand.state) == 0.0


def test_contact_below_the_travel_height_is_not_weighed():
    hand = Hand(Mode.CARRY)
    hand.state.travel_z = 0.1
    hand.feel((0, 0, -5.0), height=0.2, times=20)
    hand.feel((0, 0, 15.0), height=0.05, times=2)
    assert hand.state.payload == pytest.approx(-5.0)
    assert hand.state.peak_vertical == pytest.approx(20.0)
    # A tare while something touches the hand does not change the payload either.
    hand.guard.tare(hand.state, np.array([0, 0, 15.0, 0, 0, 0]), 4.0)
    assert hand.state.payload == pytest.approx(-5.0)
    hand.guard.tare(hand.state, np.array([0, 0, -5.5, 0, 0, 0]), 4.0)
    assert hand.state.payload == -5.5


def test_an_impact_passes_where_contact_is_expected_but_a_jam_does_not():
    hand = Hand(Mode.LOWER, payload=2.0)
    assert not hand.feel((0, 0, 60.0), times=2)
    assert not hand.feel((0, 0, 0.0))
    assert hand.feel((0, 0, 29.0), times=3)
    assert hand.state.peak_vertical == pytest.approx(62.0)
    assert Hand(Mode.CARRY, payload=2.0).feel((31.0, 0, -2.0))


def test_a_press_is_limited_by_its_own_force():
    hand = Hand(Mode.DESCEND)
    hand.state.press = 1
    assert not hand.feel((0, 0, 100.0), times=10)
    assert hand.feel((31.0, 0, 0.0), times=3)


def test_a_rising_hand_may_be_pushed_but_not_held():
    assert not Hand(Mode.RETREAT).feel((0, 0, 50.0), times=10)
    assert Hand(Mode.RETREAT).feel((0, 0, -50.0), times=3)
    # While an object is lifted, it may pull with 29 N: objects may weigh up to 3 kg.
    assert not Hand(Mode.LIFT).feel((0, 0, -29.0), times=10)
    assert Hand(Mode.LIFT).feel((0, 0, -29.0 - 31.0), times=3)


def test_a_weight_passes_to_the_support_during_the_release():
    hand = Hand(Mode.RELEASE, payload=20.0)
    for force in (-20.0, -10.0, 0.0):
        hand.feel((0, 0, force))
    assert hand.state.peak_vertical == 0.0


def test_a_hand_at_rest_feels_nothing():
    hand = Hand(Mode.OBSERVE)
    assert not hand.feel((100.0, 0, 0), times=10)
    assert hand.state.peak_lateral == 0.0


def test_a_peak_is_a_mean_over_one_64th_of_a_second():
    for step, times in ((1 / 128, 1), (1 / 256, 2), (1 / 64, 1)):
        hand = Hand(Mode.LOWER, payload=2.0)
        hand.guard = ContactGuard(30.0, step)
        hand.feel((0, 0, -2.0), times=4)
        hand.feel((0, 0, 18.0), times=times)
        hand.feel((0, 0, -2.0), times=4)
        assert hand.state.peak_vertical == pytest.approx(20.0 if step == 1 / 64 else 10.0)
