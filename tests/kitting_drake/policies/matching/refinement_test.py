"""Refined grasps stay near the predicted ones."""

import numpy as np
import pytest

from kitting_drake.policies.matching.jaw_clearance import jaw_grasps
from kitting_drake.policies.matching.refinement import nearest_region, refine_grasp
from kitting_drake.policies.matching.regions.segmentation import Region, Segmentation, segment
from systems.pick_place_parameters import PickPlaceParameters
from systems.signals import Observation, PixelGrid

GRID, PLANNER = PixelGrid(), PickPlaceParameters()


def bar(blocked: float) -> Segmentation:
    """A bar of 240 mm along x. Blocks beside its lower part leave no room for the jaws.

    `blocked` is the fraction of the bar's length that has blocks beside it.
    """
    image = np.full((4, *GRID.shape), 0.5, np.float32)
    image[3] = 0
    first, last = 30, 107
    end = first + round(blocked * (last - first))
    image[3, first:last, 157:164] = 0.014
    if blocked:
        image[3, first - 2 : end, 167:180] = 0.04
        image[3, first - 2 : end, 141:154] = 0.04
    return segment(Observation(image, GRID))


@pytest.mark.parametrize(
    ("row", "blocked", "moves"),
    [(66, 0.0, 0), (60, 0.0, 1), (60, 0.45, 1), (40, 0.45, None)],
)
def test_a_refined_grasp_is_near_the_predicted_one(row: int, blocked: float, moves: int | None):
    """A nearly optimal grasp stays. Any other grasp moves along the bar, but not far.

    If there is no good grasp nearby, None is returned; the policy then uses the network's grasp.
    """
    found, pick = bar(blocked), np.array([row, 160.0])
    [region] = [item for item in found.objects if item.mask[100, 160]]
    assert jaw_grasps(found, region, GRID.resolution, PLANNER)
    grasp = refine_grasp(found, pick, 0.0, GRID.resolution, PLANNER)
    if moves is None:
        assert grasp is None
        return
    assert grasp is not None
    moved = np.linalg.norm(grasp.pick - pick) * GRID.resolution
    assert (moved > 0.003) == bool(moves) and moved <= 0.04
    assert found.relief[tuple(np.rint(grasp.pick).astype(int))] == pytest.approx(0.014, abs=1e-3)


def test_a_grasp_goes_to_the_centre_of_mass_that_the_hand_has_felt():
    found, pick, felt = bar(0.0), np.array([66.0, 160.0]), np.array([90.0, 160.0])
    grasp = refine_grasp(found, pick, 0.0, GRID.resolution, PLANNER, balance=felt)
    assert grasp is not None
    assert np.linalg.norm(grasp.pick - felt) * GRID.resolution < 0.008


def test_the_middle_of_a_ring_belongs_to_the_ring():
    """Jaws that grip a ring from outside are centred on its hole."""
    rows, cols = np.indices(GRID.shape)
    away = np.hypot(rows - 60, cols - 100)
    ring = Region((away > 8) & (away < 14), 0.02)
    assert nearest_region((ring,), np.array([60.4, 100.2])) is ring
    assert nearest_region((ring,), np.array([60.0, 122.0])) is None
