import pytest

from systems.grip_force import (
    felt_lever,
    felt_weight,
    grip_force,
    lifts_too_early,
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
