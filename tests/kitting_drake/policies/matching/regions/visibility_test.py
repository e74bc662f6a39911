"""Policies pick and place only where o_t shows enough."""

import dataclasses

import numpy as np
import pytest

from kitting_drake.policies.matching.regions.segmentation import segment
from kitting_drake.policies.matching.regions.visibility import Visibility
from kitting_drake.policies.matching.shape_matching import ShapeMatchingPolicy
from systems.pick_place_parameters import PickPlaceParameters
from systems.signals import Observation, PixelGrid

GRID = PixelGrid()
PLANNER = PickPlaceParameters()
OPEN = PLANNER.open_width


def visibility(unseen: tuple[slice, slice], *, in_view: bool) -> Visibility:
    seen, view = np.ones((2, *GRID.shape), bool)
    seen[unseen] = False
    if not in_view:
        view[unseen] = False
    return Visibility(seen, view, GRID.resolution)


@pytest.mark.parametrize(
    ("unseen", "in_view", "theta", "good"),
    [
        # These pixels are in view, but unseen: at the pick; below a finger; at the same position,
        # but the hand is turned; below a small part of a finger.
        ((slice(78, 83), slice(158, 163)), True, 0.0, False),
        ((slice(75, 86), slice(172, 180)), True, 0.0, False),
        ((slice(75, 86), slice(172, 180)), True, np.pi / 2, True),
        ((slice(79, 81), slice(172, 180)), True, 0.0, True),
        # These pixels are out of view: one under the jaws; many elsewhere.
        ((slice(80, 81), slice(176, 177)), False, 0.0, False),
        ((slice(110, 160), slice(0, 320)), False, 0.0, True),
    ],
)
def test_picks_need_sight_of_what_the_jaws_sweep(
    unseen: tuple[slice, slice], in_view: bool, theta: float, good: bool
):
    found = visibility(unseen, in_view=in_view)
    pixel = np.array([[80.0, 160.0]])
    assert found.picks_are_seen(pixel, np.array([theta]), OPEN).tolist() == [good]


@pytest.mark.parametrize(
    ("place", "rotation", "good"),
    [
        ((80.0, 60.0), 0.0, True),
        ((80.0, 3.0), 0.0, False),  # Half of the object would lie outside the workspace.
        ((80.0, 250.0), 0.0, False),  # The place is hidden.
        ((80.0, 190.0), 0.0, False),  # The object would reach into hidden pixels ...
        ((80.0, 190.0), np.pi / 2, True),  # ... unless it is rotated.
    ],
)
def test_places_need_sight_of_where_the_object_will_lie(
    place: tuple[float, float], rotation: float, good: bool
):
    found = visibility((slice(0, 160), slice(200, 320)), in_view=False)
    rows, cols = np.mgrid[78:83, 100:131]
    footprint = np.stack([rows, cols], axis=-1).reshape(-1, 2).astype(float)
    pick = np.array([80.0, 115.0])
    assert found.place_is_seen(footprint, pick, rotation, np.array(place)) is good


@pytest.mark.parametrize(
    ("floor", "rim", "good"),
    [(2, 0, True), (1, 0, True), (0, 0, False), (1, 30, False), (2, 30, True)],
)
def test_a_rim_that_is_seen_all_around_needs_little_of_the_floor(floor: int, rim: int, good: bool):
    """Of a place of 31 x 5 pixels, `floor` rows are seen; of its rim, `rim` columns are not."""
    seen = np.ones(GRID.shape, bool)
    seen[78 : 83 - floor, 100:131] = False
    seen[72:78, 100 : 100 + rim] = False
    found = Visibility(seen, np.ones(GRID.shape, bool), GRID.resolution)
    rows, cols = np.mgrid[38:43, 100:131]
    footprint = np.stack([rows, cols], axis=-1).reshape(-1, 2).astype(float)
    pick, place = np.array([40.0, 115.0]), np.array([80.0, 115.0])
    assert found.place_is_seen(footprint, pick, 0.0, place) is good


def kit_and_bar(hidden: tuple[slice, slice] | None) -> Observation:
    """A kit with one recess, and the bar that belongs there; `hidden` pixels are out of view."""
    image = np.full((4, *GRID.shape), 0.5, np.float32)
    height = image[3]
    height[:] = 0
    height[40:110, 60:130] = 0.05
    height[50:100, 90:98] = 0.035
    height[78:85, 220:269] = 0.015
    view = np.ones(GRID.shape, bool)
    if hidden is not None:
        view[hidden] = False
        image[:, ~view] = 0
    return Observation(image, GRID, valid=view.copy(), in_view=view)


def test_shape_matching_refuses_what_it_does_not_see():
    policy = ShapeMatchingPolicy(PLANNER)
    assert not policy(kit_and_bar(None)).stop
    # First the bar is hidden, then the recess.
    for hidden in ((slice(0, 160), slice(236, 320)), (slice(0, 160), slice(0, 94))):
        seen = kit_and_bar(hidden)
        action = policy(seen)
        if action.stop:
            assert action.reason in ("not seen", "nothing fits", "done", "no kit seen")
            continue
        for pose in action.poses.values():
            row, col = np.rint(GRID.to_pixel((pose.x, pose.y))).astype(int)
            assert seen.in_view[row, col]
    assert policy(kit_and_bar((slice(0, 160), slice(0, 94)))).stop


def test_a_stop_tells_why():
    policy = ShapeMatchingPolicy(PLANNER)
    whole = kit_and_bar(None)

    def reason(*boxes: tuple[slice, slice, float]) -> str:
        image = whole.image.copy()
        for rows, cols, height in boxes:
            image[3, rows, cols] = height
        return policy(dataclasses.replace(whole, image=image, edge_height=None)).reason

    everything = slice(None)
    assert reason((everything, everything, 0.0)) == "no kit seen"
    assert reason((slice(78, 85), slice(220, 269), 0.0)) == "done"
    bigger = (slice(60, 110), slice(220, 260), 0.03)
    assert reason((slice(78, 85), slice(220, 269), 0.0), bigger) == "nothing fits"
    # A box without recesses is no kit.
    assert reason((slice(50, 100), slice(90, 98), 0.05)) == "no kit seen"


def test_the_gaps_around_a_seated_object_are_no_free_recess():
    seen = kit_and_bar(None)
    image = seen.image.copy()
    image[3, 51:99, 91:97] = 0.058
    found = segment(dataclasses.replace(seen, image=image, edge_height=None))
    assert found.kit_seen and not found.free_recesses
    assert segment(seen).free_recesses
