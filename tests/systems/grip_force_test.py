import pytest

from systems.grip_force import (
    felt_lever,
    felt_weight,
    gentleness,
    grip_force,
    lifts_too_early,
    slips_when_carried,
    soft_force,
    turns_in_the_pads,
)
from systems.pick_place_parameters import PickPlaceParameters

PARAMETERS = PickPlaceParameters()


@pytest.mark.parametrize(
    ("weight", "force"), [(0.0, 30.0), (2.0, 30.0), (3.5, 49.0), (5.0, 70.0), (12.5, 105.0)]
)
def test_the_grip_is_proportional_to_the_weight_and_then_rises_to_the_peak(
    weight: float, force: float
):
    assert grip_force(weight, 30.0, PARAMETERS) == pytest.approx(force)


def test_the_grip_never_falls_nor_follows_noise_nor_exceeds_the_peak():
    assert grip_force(1.0, 80.0, PARAMETERS) == 80.0
    assert grip_force(5.1, 70.0, PARAMETERS) == 70.0
    assert grip_force(30.0, 139.0, PARAMETERS) == 140.0


def test_a_light_object_is_gripped_as_told_even_above_the_firm_force():
    assert grip_force(1.0, 90.0, PickPlaceParameters(grasp_force=90.0)) == 90.0


def test_the_weight_does_not_depend_on_the_acceleration():
    assert felt_weight(-15.0, 4.905) == pytest.approx(10.0)
    assert felt_weight(-10.0, 0.0) == 10.0


def test_only_a_heavy_object_waits_for_a_firm_grip():
    assert not lifts_too_early(grip_force(2.5, 30.0, PARAMETERS), 30.0)
    assert lifts_too_early(grip_force(6.0, 30.0, PARAMETERS), 30.0)


def test_the_lever_is_moment_over_weight_and_bounded_for_what_weighs_nothing():
    assert felt_lever(-0.5, 20.0) == pytest.approx(-0.025)
    assert abs(felt_lever(0.5, 0.0)) < 0.2


def test_what_was_set_down_before_may_hang_farther_from_the_pads():
    assert turns_in_the_pads(-0.25, 0) and not turns_in_the_pads(-0.25, 1)
    assert not turns_in_the_pads(0.15, 0) and turns_in_the_pads(0.6, 2)


def test_a_light_but_long_object_is_gripped_as_its_moment_asks():
    assert grip_force(2.0, 30.0, PARAMETERS, 0.05) == 30.0
    assert grip_force(2.0, 30.0, PARAMETERS, -0.15) == pytest.approx(50.0)
    assert grip_force(2.0, 30.0, PARAMETERS, 1.0) == 140.0


def test_jaws_that_sink_in_press_less_but_do_not_follow_every_millimetre():
    assert soft_force(120.0, 0.005, 0.05, 120.0, PARAMETERS) == 120.0
    assert soft_force(120.0, 0.0065, 0.05, 120.0, PARAMETERS) == 120.0
    assert soft_force(120.0, 0.012, 0.05, 120.0, PARAMETERS) == pytest.approx(35.0)
    assert soft_force(80.0, 0.006, 0.02, 80.0, PARAMETERS) == pytest.approx(62.2, abs=0.1)
    assert soft_force(120.0, 0.1, 0.05, 120.0, PARAMETERS) == 30.0


def test_the_heavier_the_gentler_and_never_faster_again():
    assert gentleness(4.0, 0.0, 0.0, PARAMETERS) == 1.0
    assert gentleness(4.0, -0.12, 0.0, PARAMETERS) == 0.5
    assert gentleness(10.0, 0.0, 0.0, PARAMETERS) == pytest.approx(0.5)
    assert gentleness(6.0, 0.0, 0.5, PARAMETERS) == 0.5
    assert gentleness(100.0, 0.0, 0.5, PARAMETERS) == 0.25


def test_what_hangs_still_may_exert_a_larger_moment():
    assert turns_in_the_pads(0.25, 0) and not slips_when_carried(0.25, 0)
    assert slips_when_carried(-0.4, 0) and not slips_when_carried(-0.4, 1)
