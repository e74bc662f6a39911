"""Touching objects are told apart, heaps are taken apart, and vain attempts are not repeated."""

import dataclasses

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import ndimage

from kitting_drake.policies.data.images import rotation_matrix
from kitting_drake.policies.matching.inventory import Inventory
from kitting_drake.policies.matching.separating import separating_action, turning_action
from kitting_drake.policies.matching.shape_matching import ShapeMatchingPolicy
from systems.pick_place_parameters import PickPlaceParameters
from systems.signals import Attempt, Observation, PickPlaceAction, PixelGrid, PlanarPose
from systems.surface_heights import read_surface_heights

GRID = PixelGrid()
PLANNER = PickPlaceParameters()


def hammer(rows: int, cols: int) -> NDArray[np.bool_]:
    """The mask of a hammer: a T of 50 by 24 pixels whose bounding box starts at (rows, cols)."""
    mask = np.zeros(GRID.shape, bool)
    mask[rows + 8 : rows + 15, cols : cols + 50] = True
    mask[rows : rows + 24, cols + 42 : cols + 50] = True
    return mask


def rotated(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """A mask whose object is rotated by 90 degrees about the middle of its bounding box."""
    pixels = np.argwhere(mask)
    middle = np.rint((pixels.min(axis=0) + pixels.max(axis=0)) / 2).astype(int)
    away = pixels - middle
    result = np.zeros_like(mask)
    result[middle[0] - away[:, 1], middle[1] + away[:, 0]] = True
    return result


def bar(rows: int, cols: int) -> NDArray[np.bool_]:
    mask = np.zeros(GRID.shape, bool)
    mask[rows : rows + 7, cols : cols + 44] = True
    return mask


def scene(*objects: tuple[NDArray[np.bool_], float], filled: bool = False) -> Observation:
    """A kit with recesses for a hammer and a bar, and objects of given heights on the table."""
    height = np.zeros(GRID.shape, np.float32)
    height[20:110, 20:110] = 0.05
    for recess in (hammer(30, 35), bar(75, 40)):
        height[recess] = 0.05 if filled else 0.035
    for mask, top in objects:
        height[mask] = np.maximum(height[mask], top)
    image = np.full((4, *GRID.shape), 0.5, np.float32)
    image[3] = height
    return Observation(image, GRID)


def placed_at(pixel: tuple[float, float], *, aside: bool = True, pick: bool = False) -> Attempt:
    """An earlier action that laid an object at a pixel, or (`pick`) picked one up there."""
    x, y = GRID.to_world(pixel)
    here, away = PlanarPose(float(x), float(y)), PlanarPose(0.3, -0.45)
    poses = (here, away) if pick else (away, here)
    return Attempt(PickPlaceAction(*poses, aside=aside), "placed")


TOUCHING = scene((hammer(60, 180), 0.015), (bar(75, 179), 0.015))


def test_touching_objects_are_told_apart_by_the_recesses():
    found = Inventory.of(TOUCHING)
    sizes = [int(item.mask.sum()) for item in found.segmentation.objects]
    assert sizes == pytest.approx([hammer(0, 0).sum(), bar(0, 0).sum()], rel=0.2)
    assert {(pair.item, pair.recess) for pair in found.pairs} == {(0, 0), (1, 1)}


def test_a_box_that_contains_the_outline_of_a_recess_is_not_split():
    box = np.zeros(GRID.shape, bool)
    box[60:90, 180:240] = True
    found = Inventory.of(scene((box, 0.015)))
    assert [int(item.mask.sum()) for item in found.segmentation.objects] == [box.sum()]
    assert not found.pairs


def crossed() -> Observation:
    """A scene with a bar that lies under a longer and wider bar, which fits no recess."""
    upright = np.zeros(GRID.shape, bool)
    upright[36:92, 215:226] = True
    return scene((bar(60, 200), 0.015), (upright, 0.030))


def test_a_heap_is_taken_apart_from_the_top():
    observation = crossed()
    action = separating_action(Inventory.of(observation), PLANNER)
    assert action is not None and action.aside
    row, col = np.rint(GRID.to_pixel((action.pick.x, action.pick.y))).astype(int)
    assert observation.height[row, col] == pytest.approx(0.030)
    row, col = np.rint(GRID.to_pixel((action.place.x, action.place.y))).astype(int)
    assert observation.height[row - 3 : row + 4, col - 3 : col + 4].max() == 0
    # The upper bar is taken away only with `recover`.
    assert ShapeMatchingPolicy(PLANNER)(observation).reason == "nothing fits"
    assert ShapeMatchingPolicy(PLANNER, recover=True)(observation).poses == action.poses


def test_what_was_laid_aside_and_fits_nowhere_is_left_alone():
    stranger = np.zeros(GRID.shape, bool)
    stranger[36:80, 215:226] = True
    laid = (placed_at((62.0, 218.0)),)
    observation = dataclasses.replace(scene((stranger, 0.015)), history=laid)
    action = ShapeMatchingPolicy(PLANNER, recover=True)(observation)
    assert action.stop and action.reason == "gave up"
    assert action.left_over is not None
    assert len(action.left_over.objects) == 1 and len(action.left_over.cavities) == 2


@pytest.mark.parametrize("times", [1, 2])
def test_an_object_is_laid_aside_twice_at_most(times: int):
    left, right = (np.zeros(GRID.shape, bool) for _ in range(2))
    left[36:80, 215:226], right[82:126, 215:226] = True, True
    first, second = (placed_at((row, 220.0)) for row in (45.0, 58.0))
    again = Attempt(PickPlaceAction(first.action.place, second.action.place, aside=True), "placed")
    history = (first, again) if times == 2 else (second,)
    seen = scene((left, 0.015), (right, 0.025))
    inventory = Inventory.of(dataclasses.replace(seen, history=history))
    # The objects almost touch, so one may hide a part of the other.
    region = next(it for it in inventory.segmentation.objects if it.mask[60, 220])
    assert inventory.is_tried(region) is (times == 2)


def test_a_region_that_is_larger_than_any_recess_is_a_heap():
    stranger = np.zeros(GRID.shape, bool)
    stranger[36:80, 215:226] = True
    long = np.zeros(GRID.shape, bool)
    long[20:110, 218:222] = True
    pixel = np.array([63.0, 220.0])
    assert Inventory.of(crossed()).is_heap(pixel)
    assert Inventory.of(scene((long, 0.015))).is_heap(pixel)
    assert not Inventory.of(scene((stranger, 0.015))).is_heap(pixel)


def test_a_region_that_holds_more_than_was_laid_there_is_taken_apart_again():
    laid = placed_at((62.0, 218.0))
    policy = ShapeMatchingPolicy(PLANNER, recover=True)
    assert policy(dataclasses.replace(crossed(), history=(laid,))).aside
    # There are two open recesses, so the region counts as two objects at most.
    other = placed_at((62.0, 240.0))
    other = dataclasses.replace(
        other, action=dataclasses.replace(other.action, pick=PlanarPose(0.6, 0.45))
    )
    assert policy(dataclasses.replace(crossed(), history=(laid, other))).reason == "gave up"


def test_where_other_objects_were_laid_before_an_object_is_not_given_up():
    alone = scene((hammer(60, 180), 0.015))
    away = [(30.0 + 40 * k, 300.0) for k in range(3)]
    history = []
    for start in away:
        # Each of three objects is laid where the hammer lies now, and then taken away.
        x, y = GRID.to_world(start)
        come, go = placed_at((71.0, 200.0)), placed_at((71.0, 200.0), pick=True, aside=False)
        come = dataclasses.replace(
            come, action=dataclasses.replace(come.action, pick=PlanarPose(float(x), float(y)))
        )
        history += [come, go]
    assert not ShapeMatchingPolicy(PLANNER)(dataclasses.replace(alone, history=tuple(history))).stop


def test_an_object_that_fits_is_tried_again_but_not_forever():
    missed = dataclasses.replace(placed_at((71.0, 200.0), pick=True, aside=False), outcome="missed")
    policy = ShapeMatchingPolicy(PLANNER)
    alone = scene((hammer(60, 180), 0.015))
    assert not policy(dataclasses.replace(alone, history=(missed,) * 2)).stop
    assert policy(dataclasses.replace(alone, history=(missed,) * 3)).reason == "gave up"


@pytest.mark.parametrize("way", [(0.0, -8.0), (7.0, 0.0)])
def test_an_object_that_is_lost_on_its_way_again_and_again_is_not_tried_forever(
    way: tuple[float, float],
):
    # Each action moves the hammer by about 20 mm, then the force guard stops the hand.
    starts = [np.array((71.0, 215.0)) - k * np.array(way) for k in (3, 2, 1)]
    lost = [
        dataclasses.replace(placed_at(tuple(start), pick=True, aside=False), outcome="stopped")
        for start in starts
    ]
    alone = scene((hammer(60, 180), 0.015))
    policy = ShapeMatchingPolicy(PLANNER)
    assert policy(dataclasses.replace(alone, history=tuple(lost))).reason == "gave up"
    # The history of an object that still lies there is not that of its neighbour.
    beside = scene((hammer(60, 180), 0.015), (bar(60, 240), 0.015))
    found = Inventory.of(dataclasses.replace(beside, history=tuple(lost)))
    tries = {int(item.mask.sum()): found.memory.tries(item) for item in found.segmentation.objects}
    assert tries[int(bar(60, 240).sum())] == 0


@pytest.mark.parametrize(("gap", "is_tried"), [(2, False), (8, True)])
def test_an_object_that_was_laid_beside_another_is_tried_again(gap: int, is_tried: bool):
    here, beside = np.zeros((2, *GRID.shape), bool)
    here[60:74, 180:214] = True
    beside[74 + gap : 88 + gap, 180:214] = True
    laid = tuple(placed_at((row, 197.0)) for row in (67.0, 81.0 + gap))
    seen = scene((here, 0.015), (beside, 0.015))
    found = Inventory.of(dataclasses.replace(seen, history=laid))
    assert len(found.segmentation.objects) == 2
    assert [found.is_tried(item) for item in found.segmentation.objects] == [is_tried] * 2


def test_two_actions_that_set_an_object_down_count_as_one():
    laid = placed_at((71.0, 200.0), pick=True, aside=False)
    missed, set_down = (dataclasses.replace(laid, outcome=o) for o in ("missed", "set down"))
    policy = ShapeMatchingPolicy(PLANNER)
    alone = scene((hammer(60, 180), 0.015))
    assert not policy(dataclasses.replace(alone, history=(set_down,) * 5)).stop
    assert policy(dataclasses.replace(alone, history=(set_down,) * 6)).reason == "gave up"
    assert policy(dataclasses.replace(alone, history=(missed, *(set_down,) * 4))).stop


def test_an_action_names_the_middle_of_its_object():
    action = ShapeMatchingPolicy(PLANNER)(scene((hammer(60, 180), 0.015)))
    middle = GRID.to_world(np.argwhere(hammer(60, 180)).mean(axis=0))
    assert action.middle == pytest.approx(tuple(middle), abs=0.002)


def test_a_full_kit_is_no_missing_kit():
    full = scene(filled=True)
    assert Inventory.of(full).why_stop == "no kit seen"
    kitted = dataclasses.replace(full, history=(placed_at((42.0, 60.0), aside=False),))
    assert Inventory.of(kitted).why_stop == "done"


def test_a_recess_that_was_filled_is_not_left_over():
    # No object is visible. A recess may still be filled by a tool as flat as the recess's floor.
    empty = scene()
    assert len(Inventory.of(empty).left_over.cavities) == 2
    placed = dataclasses.replace(empty, history=(placed_at((42.0, 60.0), aside=False),))
    assert len(Inventory.of(placed).left_over.cavities) == 1


def test_the_visible_parts_of_a_filled_recess_are_not_free():
    """A box beside a full kit is as large as the visible part of a recess, but must stay."""
    box = np.zeros(GRID.shape, bool)
    box[60:70, 180:205] = True
    observation = scene((box, 0.015), filled=True)
    # The seated hammer's head is low enough in the block to count as a recess, its shaft is not.
    seated = observation.height.copy()
    seated[hammer(30, 35)] = 0.048
    seated[30:54, 77:85] = 0.0465
    image = observation.image.copy()
    image[3] = seated
    observation = dataclasses.replace(observation, image=image, edge_height=None)
    found = Inventory.of(observation)
    assert found.segmentation.kit_seen and not found.segmentation.unfilled_recesses
    action = ShapeMatchingPolicy(PLANNER, recover=True)(observation)
    assert action.stop and action.reason == "done"
    assert action.left_over is not None and not action.left_over.cavities


def test_two_kits_are_seen():
    height = scene((hammer(60, 180), 0.015)).height.copy()
    height[20:110, 250:310] = 0.04
    height[30:100, 270:277] = 0.03
    image = np.full((4, *GRID.shape), 0.5, np.float32)
    image[3] = height
    found = Inventory.of(Observation(image, GRID)).segmentation
    assert len(found.free_recesses) == 3 and len(found.objects) == 1


def angle(rows: int, cols: int, *, mirrored: bool = False) -> NDArray[np.bool_]:
    """The mask of an L of 50 by 24 pixels, which is not its own mirror image."""
    mask = np.zeros(GRID.shape, bool)
    mask[rows : rows + 8, cols : cols + 50] = True
    arm = slice(rows, rows + 24) if not mirrored else slice(rows - 16, rows + 8)
    mask[arm, cols + 42 : cols + 50] = True
    return mask


def with_angle_recess(item: NDArray[np.bool_]) -> Observation:
    height = scene((item, 0.015)).height.copy()
    height[20:110, 20:110] = 0.05
    height[angle(50, 40)] = 0.035
    image = np.full((4, *GRID.shape), 0.5, np.float32)
    image[3] = height
    return Observation(image, GRID)


def test_an_object_on_its_wrong_face_is_turned_over_the_block_s_edge():
    right = Inventory.of(with_angle_recess(angle(60, 200)))
    assert right.pairs and not right.reversed_items
    wrong = with_angle_recess(angle(60, 200, mirrored=True))
    found = Inventory.of(wrong)
    assert len(found.reversed_items) == 1 and not found.pairs
    action = turning_action(found, PLANNER)
    assert action is not None and action.aside
    # The place is near an edge of the block, which spans pixels 20 to 109 in both directions.
    row, col = GRID.to_pixel((action.place.x, action.place.y))
    assert min(abs(row - 19.5), abs(row - 109.5), abs(col - 19.5), abs(col - 109.5)) < 8
    assert ShapeMatchingPolicy(PLANNER)(wrong).reason == "nothing fits"
    assert ShapeMatchingPolicy(PLANNER, recover=True)(wrong).poses == action.poses


def horseshoe(middle: tuple[float, float], angle: float, grown: float) -> NDArray[np.bool_]:
    """The mask of a U of about 16 by 20 pixels, which is its own mirror image."""
    offsets = np.stack(np.indices(GRID.shape), axis=-1) - middle
    u, v = np.moveaxis(offsets @ rotation_matrix(angle), -1, 0)
    back = (np.abs(u + 5) < 3.2 + grown) & (np.abs(v) < 10 + grown)
    legs = (np.abs(np.abs(v) - 6.5) < 3.2 + grown) & (np.abs(u) < 8 + grown)
    return np.asarray(back | legs)


def test_an_object_that_is_its_own_mirror_image_is_never_reversed():
    """In these pixels the mirror image happens to fit better than the object."""
    height = scene((horseshoe((70.0, 200.1), -2.29, 0.35), 0.02)).height.copy()
    height[20:110, 20:110] = 0.03
    height[horseshoe((65.0, 65.1), -2.43, 0.2)] = 0.01
    image = np.full((4, *GRID.shape), 0.5, np.float32)
    image[3] = height
    found = Inventory.of(Observation(image, GRID))
    assert len(found.pairs) == 1 and not found.reversed_items


def noisy(observation: Observation, deviation: float = 0.0015) -> Observation:
    image = observation.image.copy()
    image[3] += np.random.default_rng(0).normal(0.0, deviation, GRID.shape).astype(np.float32)
    return dataclasses.replace(observation, image=image, edge_height=None)


def test_with_noise_a_recess_that_was_filled_is_not_worth_a_try():
    """With noise, an object that lies low in its recess looks like the recess's floor."""
    box = np.zeros(GRID.shape, bool)
    box[60:72, 180:215] = True
    seen = noisy(scene((box, 0.015)))
    assert len(Inventory.of(seen).worth_a_try) == 1
    places = [placed_at(pixel, aside=False) for pixel in ((42.0, 60.0), (78.0, 60.0))]
    found = Inventory.of(dataclasses.replace(seen, history=tuple(places)))
    assert len(found.segmentation.free_recesses) == 2
    assert not found.free_recesses and not found.worth_a_try
    assert found.why_stop == "done"


def test_a_recess_whose_object_was_taken_out_is_free_even_if_its_floor_looks_rough():
    on_edge = np.zeros(GRID.shape, bool)
    on_edge[60:64, 180:205] = True
    seen = noisy(scene((on_edge, 0.02)))
    rough = noisy(seen, deviation=0.003).image[3]
    seen.image[3, hammer(30, 35)] = rough[hammer(30, 35)]
    assert len(Inventory.of(seen).free_recesses) == 1
    there, here = (PlanarPose(*map(float, GRID.to_world(p))) for p in ((42.0, 60.0), (62.0, 192.0)))
    taken_out = Attempt(PickPlaceAction(there, here, aside=True), "placed")
    found = Inventory.of(dataclasses.replace(seen, history=(taken_out,)))
    assert len(found.free_recesses) == 2
    assert found.why_stop == "gave up"


def placed_by_policy(observation: Observation) -> Attempt:
    """The action of shape matching on an observation, as if it had succeeded."""
    action = ShapeMatchingPolicy(PLANNER)(observation)
    assert not action.stop
    return Attempt(action, "placed", top=0.05, floor=0.035)


def test_with_noise_the_parts_of_a_filled_recess_are_not_free():
    """The handle's end lies 40 pixels from the head, where the hammer was gripped."""
    history = (placed_by_policy(scene((hammer(60, 180), 0.015))),)
    seen = noisy(scene())
    seen.image[3, 30:54, 55:85] = 0.05
    assert len(Inventory.of(seen).free_recesses) == 2
    (free,) = Inventory.of(dataclasses.replace(seen, history=history)).free_recesses
    assert free.mask[bar(75, 40)].all()


def test_nothing_is_placed_into_what_is_left_of_a_filled_recess():
    """The end of the placed hammer's handle lies so low that a short bar seems to fit above it."""
    history = (placed_by_policy(scene((hammer(60, 180), 0.015))),)
    short = np.zeros(GRID.shape, bool)
    short[30:37, 180:204] = True
    seen = noisy(scene((short, 0.015)))
    seen.image[3, 30:54, 59:85] = 0.05
    (pair,) = Inventory.of(seen).pairs
    assert Inventory.of(seen).segmentation.recesses[pair.recess].mask[40:44, 40:55].all()
    found = Inventory.of(dataclasses.replace(seen, history=history))
    assert not found.pairs
    assert all(item.mask[bar(75, 40)].all() for item in found.memory.unfilled_recesses)
    # The hammer was picked from a heap, so the size of its region tells little.
    heap = dataclasses.replace(history[0].action, spread=(0.001, 0.0, 0.002))
    found = Inventory.of(dataclasses.replace(seen, history=(Attempt(heap, "placed"),)))
    assert found.pairs
    # A failed attempt to take the hammer out changes nothing.
    missed = Attempt(dataclasses.replace(history[0].action, pick=history[0].action.place), "missed")
    found = Inventory.of(dataclasses.replace(seen, history=(*history, missed)))
    assert not found.pairs


def test_a_placed_object_that_left_its_recess_is_missing():
    """It slid off the table: nothing is loose, but its recess is as deep as before."""
    seen = scene()
    history = (placed_by_policy(scene((hammer(60, 180), 0.015))),)
    found = Inventory.of(dataclasses.replace(seen, history=history))
    assert found.why_stop == "gave up" and len(found.free_recesses) == 2
    # A flat hammer lies in it, lower than expected: it had lain on another tool.
    seen.image[3, hammer(30, 35)] = 0.04
    found = Inventory.of(dataclasses.replace(seen, history=history))
    assert found.why_stop == "done" and len(found.free_recesses) == 1


@pytest.mark.parametrize("gap", [1, 2, 3])
def test_the_gap_around_a_placed_object_is_no_empty_recess(gap: int):
    history = (placed_by_policy(scene((hammer(60, 180), 0.015))),)
    seen = scene()
    seen.image[3, ndimage.binary_dilation(hammer(30, 35), iterations=gap)] = 0.035
    assert Inventory.of(dataclasses.replace(seen, history=history)).why_stop == "gave up"
    seen.image[3, hammer(30, 35)] = 0.05
    assert Inventory.of(dataclasses.replace(seen, history=history)).why_stop == "done"


def test_a_lost_object_is_missing_on_a_table_that_is_lower_than_calibrated():
    action = placed_by_policy(scene((hammer(60, 180), 0.015))).action
    low = scene()
    low.image[3] -= 0.005
    place = action.place
    floor = read_surface_heights(low, place, place).place_floor
    history = (Attempt(action, "dropped", floor=floor),)
    assert Inventory.of(dataclasses.replace(low, history=history)).why_stop == "gave up"


def test_an_object_that_the_edge_of_the_image_cuts_is_tried_again():
    part = np.zeros(GRID.shape, bool)
    part[60:72, 290:320] = True
    laid = (placed_at((66.0, 305.0)),)
    whole = np.roll(part, -40, axis=1)
    tried = []
    for mask, history in ((part, laid), (whole, (placed_at((66.0, 265.0)),))):
        found = Inventory.of(dataclasses.replace(scene((mask, 0.015)), history=history))
        tried.append(found.is_tried(found.segmentation.objects[0]))
    assert tried == [False, True]


def test_an_object_covers_its_recess_after_it_was_turned():
    """The hammer lay across its recess."""
    turned = rotated(hammer(60, 180))
    history = (placed_by_policy(scene((turned, 0.015))),)
    assert abs(np.sin(history[0].action.place.theta - history[0].action.pick.theta)) > 0.9
    seen = noisy(scene())
    seen.image[3, hammer(30, 35)] += 0.007
    assert len(Inventory.of(seen).free_recesses) == 2
    (free,) = Inventory.of(dataclasses.replace(seen, history=history)).free_recesses
    assert free.mask[bar(75, 40)].all()


def test_the_hole_of_a_placed_ring_is_no_empty_recess():
    rows, cols = np.indices(GRID.shape)
    away = np.hypot(rows - 65, cols - 65)
    block = np.zeros(GRID.shape, np.float32)
    block[20:110, 20:110] = 0.05
    block[away < 20] = 0.035
    for inner, reason in ((16.0, "done"), (25.0, "gave up")):
        height = block.copy()
        height[(away < 19) & (away > inner)] = 0.049
        spread = (20**2 + 14**2) / 4 * GRID.resolution**2
        x, y = GRID.to_world((65.0, 65.0)).tolist()
        action = PickPlaceAction(
            PlanarPose(), PlanarPose(x, y), middle=(0.0, 0.0), spread=(spread, 0.0, spread)
        )
        image = np.full((4, *GRID.shape), 0.5, np.float32)
        image[3] = height
        history = (Attempt(action, "placed", top=0.049, floor=0.035),)
        assert Inventory.of(Observation(image, GRID, history=history)).why_stop == reason


def test_the_handle_of_a_placed_hammer_is_no_floor():
    """Before, only a wall of its recess was seen, which ended where the handle lies now."""
    image = np.full((4, *GRID.shape), 0.5, np.float32)
    image[3] = 0
    image[3, 20:110, 20:140] = 0.049
    image[3, 60:72, 50:100] = 0.039
    xy = GRID.to_world((65.5, 74.5)).tolist()
    long, narrow = (size**2 / 12 * GRID.resolution**2 for size in (62, 16))
    action = PickPlaceAction(
        PlanarPose(), PlanarPose(*xy), middle=(0.0, 0.0), spread=(narrow, 0.0, long)
    )
    for height, reason in ((0.022, "done"), (0.010, "gave up")):
        history = (Attempt(action, "placed", top=0.039 + height, floor=0.039),)
        assert Inventory.of(Observation(image, GRID, history=history)).why_stop == reason


def test_an_object_that_was_dropped_out_of_sight_is_missing():
    dropped = dataclasses.replace(placed_by_policy(scene((bar(60, 180), 0.015))), outcome="dropped")
    empty = scene()
    assert Inventory.of(empty).why_stop == "done"
    assert Inventory.of(dataclasses.replace(empty, history=(dropped,))).why_stop == "gave up"


@pytest.mark.parametrize(("column", "reason"), [(310, "not seen"), (200, "nothing fits")])
def test_an_object_that_is_only_partly_seen_does_not_fit_nowhere(column: int, reason: str):
    part = np.zeros(GRID.shape, bool)
    part[60:72, column : column + 10] = True
    assert Inventory.of(scene((part, 0.015))).why_stop == reason


def test_nothing_is_done_while_a_cavity_is_hidden_and_an_object_is_left():
    """The rims hide most of both recesses. A box is on the table."""
    box = np.zeros(GRID.shape, bool)
    box[60:90, 200:240] = True
    for objects, reason in (((box, 0.03),), "not seen"), ((), "done"):
        seen = scene(*objects)
        valid = np.ones(GRID.shape, bool)
        valid[hammer(30, 35) | bar(75, 40)] = False
        valid[:, 80:] = True
        found = Inventory.of(dataclasses.replace(seen, valid=valid))
        assert len(found.segmentation.hidden_recesses) == 2
        assert found.why_stop == reason


def test_an_object_for_a_free_cavity_may_lie_where_no_camera_looks():
    placed = (placed_by_policy(scene((hammer(60, 180), 0.015))),)
    full = dataclasses.replace(scene(filled=True), history=placed)
    part = np.ones(GRID.shape, bool)
    part[:, 300:] = False
    for seen, in_view, reason in (
        (scene(), np.ones_like(part), "done"),
        (scene(), part, "not seen"),
        (full, part, "done"),
    ):
        assert Inventory.of(dataclasses.replace(seen, in_view=in_view)).why_stop == reason


@pytest.mark.parametrize(("is_seen", "reason"), [(True, "nothing fits"), (False, "not seen")])
def test_an_unseen_patch_of_the_kit_may_be_a_slender_recess(is_seen: bool, reason: str):
    box = np.zeros(GRID.shape, bool)
    box[60:90, 200:240] = True
    seen = scene((box, 0.03))
    seen.image[3, bar(75, 40)] = 0.05
    valid = np.ones(GRID.shape, bool)
    valid[bar(75, 40)] = is_seen
    assert Inventory.of(dataclasses.replace(seen, valid=valid)).why_stop == reason


@pytest.mark.parametrize(("rise", "reason"), [(0.0025, "done"), (0.005, "gave up")])
def test_an_object_that_was_pressed_and_is_hardly_proud_is_placed(rise: float, reason: str):
    history = (placed_by_policy(scene((hammer(60, 180), 0.015))),)
    full = scene(filled=True)
    full.image[3, hammer(30, 35)] = 0.05 + rise
    seen = dataclasses.replace(full, history=history)
    press = ShapeMatchingPolicy(PLANNER, recover=True)(seen)
    assert press.press
    history += (Attempt(press, "pressed"),)
    found = Inventory.of(dataclasses.replace(full, history=history))
    assert found.why_stop == reason
    assert len(found.left_over.objects) == (reason == "gave up")


def test_a_tool_that_leans_on_the_kit_at_the_edge_of_the_image_is_no_corner_of_the_kit():
    seen = scene()
    for column in range(113, 160):
        seen.image[3, 80:90, column] = 0.015 + 0.045 * (160 - column) / 47
    found = Inventory.of(Observation(np.roll(seen.image, 160, axis=2), GRID))
    assert len(found.segmentation.objects) == 1
