"""Grasps are found where o_t shows enough room for the jaws along the planner's motion."""

import dataclasses
import math

import numpy as np
import pytest

from kitting_drake.policies.matching.jaw_clearance import jaw_grasps, tip_height
from kitting_drake.policies.matching.regions.segmentation import segment
from systems.motion_heights import motion_heights
from systems.pick_place_parameters import PickPlaceParameters
from systems.signals import Observation, PixelGrid, SurfaceHeights

GRID = PixelGrid()
HIGH, LOW = 0.040, 0.024


def beside(distance: float) -> Observation:
    """A high bar, 20 mm wide, between two low bars that begin `distance` from its centre line."""
    image = np.zeros((4, *GRID.shape), np.float32)
    row, half, away = 80, round(0.010 / GRID.resolution), round(distance / GRID.resolution)
    image[3, row - half : row + half, 100:140] = HIGH
    for side in (-1, 1):
        low = sorted((row + side * away, row + side * (away + 6)))
        image[3, low[0] : low[1], 100:140] = LOW
    return Observation(image, GRID, np.ones(GRID.shape, bool))


def grasps_across(planner: PickPlaceParameters) -> int:
    """The number of grasps found near the high bar's centre; the fingers go between the bars."""
    seen = beside(0.035)
    segmentation = segment(seen)
    bar = max(segmentation.objects, key=lambda region: region.height)
    found = jaw_grasps(segmentation, bar, GRID.resolution, planner)
    return sum(110 < grasp.pixel[1] < 130 for grasp in found)


def test_the_jaws_have_room_above_lower_objects():
    assert grasps_across(PickPlaceParameters(grasp_depth=0.012, max_grasp_depth=0.012)) > 0
    assert grasps_across(PickPlaceParameters(grasp_depth=0.030, max_grasp_depth=0.030)) == 0


def test_jaws_that_open_less_stay_clear_of_neighbours():
    deep = PickPlaceParameters(grasp_depth=0.030, max_grasp_depth=0.030)
    assert grasps_across(dataclasses.replace(deep, open_width=0.032)) > 0


@pytest.mark.parametrize(
    "planner",
    [
        PickPlaceParameters(),
        PickPlaceParameters(grasp_depth=0.03, max_grasp_depth=0.01),
        PickPlaceParameters(grasp_depth_share=0.9, max_grasp_depth=0.05, floor_clearance=0.01),
    ],
)
@pytest.mark.parametrize("top", [0.012, 0.024, 0.045])
def test_the_tip_height_is_that_of_the_planner(planner: PickPlaceParameters, top: float):
    expected = motion_heights(SurfaceHeights(pick_top=top), planner).grasp
    # `tip_height` stays at least 3 mm above the support.
    assert tip_height(np.array(top), 0.0, planner) == pytest.approx(max(expected, 0.003))


def test_a_grasp_is_poor_if_the_pads_may_enter_a_notch():
    """Pads as long as the notch is wide either touch the legs beside it, or enter it and push."""

    def across_the_notch(columns: slice) -> list[float]:
        """The ranks of the grasps of a U, with the notch between its legs in given columns."""
        image = np.zeros((4, *GRID.shape), np.float32)
        image[3, 70:86, 100:120] = 0.02
        image[3, 78:86, columns] = 0
        segmentation = segment(Observation(image, GRID, np.ones(GRID.shape, bool)))
        [item] = segmentation.objects
        found = jaw_grasps(segmentation, item, GRID.resolution, PickPlaceParameters())
        return [
            grasp.rank
            for grasp in found
            if abs(grasp.pixel[1] - 109.5) < 4 and abs(math.cos(grasp.theta)) < 0.2
        ]

    assert min(across_the_notch(slice(107, 112))) > 5
    assert min(across_the_notch(slice(106, 113))) < 1
