"""What would lie outside the recess is not gripped."""

import numpy as np
import pytest

from kitting_drake.policies.data.images import rotation_matrix
from kitting_drake.policies.matching import shape_matching
from kitting_drake.policies.matching.evidence import fit_quality
from kitting_drake.policies.matching.regions.placed_object import at_pixel, held_outside
from kitting_drake.policies.matching.regions.segmentation import Region
from kitting_drake.policies.matching.registration import Registration, trace_outline
from kitting_drake.policies.matching.shape_matching import ShapeMatchingPolicy
from systems.pick_place_parameters import PickPlaceParameters
from systems.signals import Observation, PixelGrid
from tests.kitting_drake.policies.matching.registration_test import RESOLUTION, SHAPE, tool

GRID, PLANNER = PixelGrid(), PickPlaceParameters()
HAMMER, KIT = (80.0, 60.0), (80.0, 220.0)
ROWS, COLS = np.indices(SHAPE)
SMALL = (np.abs(ROWS - 88) < 4) & (np.abs(COLS - 68) < 5)
"""A small object that touches the hammer's shaft."""
MOTION = np.array(HAMMER), 0.0, np.array(KIT)


def test_only_what_belongs_to_the_small_object_is_outside():
    hammer, recess = Region(tool(HAMMER, 0.0) | SMALL, 0.02), Region(tool(KIT, 0.0, 0.64), 0.02)
    outside = held_outside(hammer, recess, *MOTION, RESOLUTION)
    assert at_pixel(outside, np.array([65.2, 60.0])) == 0
    assert at_pixel(outside, np.array([88.0, 71.0])) > 0.8
    assert at_pixel(outside, np.array([20.0, 20.0])) == 1  # Nothing is held there.
    # A place beyond the edge of the image is outside of every recess.
    beyond = held_outside(hammer, recess, MOTION[0], 0.0, np.array([80.0, 400.0]), RESOLUTION)
    assert at_pixel(beyond, np.array([65.2, 60.0])) == 1


def test_the_large_object_is_gripped_not_the_small_one(monkeypatch: pytest.MonkeyPatch):
    image = np.full((4, *SHAPE), 0.5, np.float32)
    image[3] = 0
    image[3, 30:130, 175:265] = 0.04
    image[3][tool(KIT, 0.0, 0.64)] = 0.02
    image[3][tool(HAMMER, 0.0)] = 0.0193
    image[3][SMALL] = 0.035
    observation = Observation(image, GRID)

    def grips_small() -> bool:
        action = ShapeMatchingPolicy(PLANNER)(observation)
        assert not action.stop
        pixel = GRID.to_pixel(np.array([action.pick.x, action.pick.y]))
        return bool(SMALL[tuple(np.rint(pixel).astype(int))])

    assert not grips_small()
    monkeypatch.setattr(shape_matching, "MOST_OUTSIDE", 1.0)
    assert grips_small()


@pytest.mark.parametrize(("half_turn", "is_good"), [(False, True), (True, False)])
def test_fit_quality_tells_a_good_fit_from_a_half_turn(half_turn: bool, is_good: bool):
    outline = trace_outline(tool(HAMMER, 0.0), RESOLUTION, close=True)
    recess = trace_outline(tool(KIT, 0.0, 0.64), RESOLUTION)
    angle = np.pi * half_turn
    quality = fit_quality(
        outline, recess, Registration(angle, KIT - rotation_matrix(angle) @ HAMMER, 0.0)
    )
    assert (quality.agreement > 0.95) == (quality.reverse_agreement > 0.95) == is_good
    assert (quality.rival > 0) == is_good
    assert quality.asymmetry > 0.001


def test_a_bar_looks_the_same_after_half_a_turn():
    bar = (np.abs(ROWS - 80) < 25) & (np.abs(COLS - 60) < 5)
    outline = trace_outline(bar, RESOLUTION, close=True)
    quality = fit_quality(outline, outline, Registration(0.0, np.zeros(2), 0.0))
    assert quality.rival < 0.0005 and quality.asymmetry < 0.0005
