import dataclasses
import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from kitting_drake.policies.matching.inventory import Inventory
from kitting_drake.policies.matching.recovery import preparing_action, recovery_action
from kitting_drake.policies.matching.regions.segmentation import segment
from kitting_drake.policies.matching.shape_matching import ShapeMatchingPolicy
from kitting_drake.policies.stages import Recovery
from systems.pick_place_parameters import PickPlaceParameters
from systems.signals import Attempt, Observation, PickPlaceAction, PixelGrid, PlanarPose

GRID = PixelGrid()
TOP = 0.05


def observed(rise: float = 0.0) -> Observation:
    """A loose object, and a fixture with an object in a recess, `rise` higher than the fixture."""
    height = np.zeros(GRID.shape, np.float32)
    height[40:120, 60:140] = TOP
    height[60:66, 75:125] = TOP - 0.02
    height[90:98, 75:125] = TOP - 0.02
    height[91:97, 77:123] = TOP + rise
    height[100:106, 220:270] = 0.02
    image = np.zeros((4, *GRID.shape), np.float32)
    image[3] = height
    return Observation(image, GRID, np.ones(GRID.shape, bool))


def mending(observation: Observation, tried=()):
    return recovery_action(Inventory.of(observation), PickPlaceParameters(), tried)


def is_on_object(action) -> bool:
    row, col = GRID.to_pixel((action.pick.x, action.pick.y))
    return 90 < row < 97 and 76 < col < 123


@pytest.mark.parametrize("rise", [-0.003, 0.0, 0.0015])
def test_a_seated_object_is_left_alone(rise: float):
    assert mending(observed(rise)) is None
    assert mending(Observation()) is None


def test_a_slightly_protruding_object_is_pressed_down_once():
    first = mending(observed(0.006))
    assert first is not None
    assert first.press
    assert is_on_object(first)
    second = mending(observed(0.006), [first.pick])
    assert second is None or not second.press


@pytest.mark.parametrize("rise", [0.014, 0.018])
def test_a_strongly_protruding_object_is_laid_on_the_table(rise: float):
    action = mending(observed(rise))
    assert action is not None
    assert not action.press
    assert is_on_object(action)
    row, col = np.rint(GRID.to_pixel((action.place.x, action.place.y))).astype(int)
    around = observed().height[row - 12 : row + 13, col - 12 : col + 13]
    assert around.shape == (25, 25)
    assert around.max() == 0
    # If that grasp has failed, only a different one may be tried.
    other = mending(observed(rise), [action.pick])
    assert other is not None
    assert math.dist((other.pick.x, other.pick.y), (action.pick.x, action.pick.y)) > 0.0099


def test_an_object_may_be_gripped_where_it_was_pressed():
    first = mending(observed(0.006)).pick
    grip = mending(observed(0.006), [first]).pick
    for outcome, is_same in (("pressed", True), ("missed", False)):
        tried = Attempt(PickPlaceAction(grip, grip, press=outcome == "pressed"), outcome)
        seen = dataclasses.replace(observed(0.006), history=(tried,))
        assert (mending(seen, [first, grip]).pick == grip) is is_same


def test_the_segmentation_measures_the_protrusion():
    (region,) = segment(observed(0.006)).protruding
    assert region.height == pytest.approx(0.006, abs=5e-4)


def move(start: tuple[float, float], end: tuple[float, float], *, aside: bool) -> Attempt:
    """An action that moved an object from one pixel to another."""
    poses = (PlanarPose(*GRID.to_world(pixel).tolist(), 0.0) for pixel in (start, end))
    return Attempt(PickPlaceAction(*poses, aside=aside), "placed")


def test_an_object_is_not_taken_out_again_after_it_was_put_back():
    seat, table, elsewhere = (94.0, 100.0), (30.0, 250.0), (140.0, 280.0)
    put, out, back = (
        move(elsewhere, seat, aside=False),
        move(seat, table, aside=True),
        move(table, seat, aside=False),
    )
    other = move(elsewhere, seat, aside=False)
    for history, gives_up in (
        ((put,), False),
        ((put, out, back), True),
        # Afterwards another object was placed there.
        ((put, out, other), False),
        ((put, out, back, other), False),
        # However many objects are placed there, only three are taken out.
        ((put, out, other, out, other, out, other), True),
    ):
        observation = dataclasses.replace(observed(0.014), history=history)
        assert (mending(observation) is None) is gives_up


@pytest.mark.parametrize(
    ("place", "removed", "obstructed"),
    [((94.0, 100.0), False, True), ((63.0, 100.0), False, False), ((63.0, 100.0), True, True)],
)
def test_what_protrudes_is_taken_out_before_the_next_object_goes_there(
    place: tuple[float, float], removed: bool, obstructed: bool
):
    out = move((94.0, 100.0), (30.0, 250.0), aside=True)
    seen = dataclasses.replace(observed(0.014), history=(out,) if removed else ())
    action = move((103.0, 245.0), place, aside=False).action
    assert Inventory.of(seen).needs_clearing(action) is obstructed


@dataclasses.dataclass(frozen=True)
class Stopped:
    """As much of a draft that stops as `Recovery` reads."""

    look: Any
    belongs: bool = False
    stop: bool = True
    pick: Any = None
    mending: PickPlaceAction | None = None


@pytest.mark.parametrize("removed", [False, True])
def test_where_the_networks_stop_the_outlines_insert_what_fits(removed: bool):
    out = move((94.0, 100.0), (30.0, 250.0), aside=True)
    seen = dataclasses.replace(observed(0.014), history=(out,) if removed else ())
    look = SimpleNamespace(inventory=Inventory.of(seen), observation=seen, failed_picks=())
    action = Recovery(PickPlaceParameters()).refine(Stopped(look)).mending
    # After a removal, what protrudes is taken out first.
    assert (bool(is_on_object(action)), action.aside) == (removed, removed)
    assert action.pick == ShapeMatchingPolicy(PickPlaceParameters(), recover=True)(seen).pick


@pytest.mark.parametrize(("width", "is_heap"), [(14, True), (9, False)])
def test_a_heap_is_taken_apart_even_if_the_networks_would_pick_from_it(width: int, is_heap: bool):
    seen = observed()
    # The open recess has 300 pixels.
    seen.image[3, 100:106, 220:270] = 0.0
    seen.image[3, 40:73, 220 : 220 + width] = 0.03
    look = SimpleNamespace(inventory=Inventory.of(seen), observation=seen, failed_picks=())
    draft = Stopped(look, stop=False, pick=np.array([56.0, 224.0]))
    action = Recovery(PickPlaceParameters()).refine(draft).mending
    assert (action is not None and action.aside) is is_heap


def test_an_object_is_known_again_wherever_it_is_gripped():
    """The object is gripped at its left end, and taken out at its right end."""
    left, right, table = (94.0, 80.0), (94.0, 118.0), (30.0, 250.0)
    seat, laid = ((94.0, 99.0), (30.0, 231.0))

    def at(attempt: Attempt, pixel: tuple[float, float]) -> Attempt:
        middle = tuple(GRID.to_world(pixel).tolist())
        return dataclasses.replace(
            attempt, action=dataclasses.replace(attempt.action, middle=middle)
        )

    away = (140.0, 280.0)
    put = at(move(away, left, aside=False), (140.0, 299.0))
    out = at(move(right, table, aside=True), seat)
    back = at(move((30.0, 212.0), left, aside=False), laid)
    for history, gives_up in (((put, out), False), ((put, out, back), True)):
        observation = dataclasses.replace(observed(0.014), history=history)
        assert (mending(observation) is None) is gives_up


def test_of_entangled_objects_the_topmost_that_can_be_gripped_is_taken_out():
    height = observed().height.copy()
    # A bar lies across the block, too long to be gripped where it is wide.
    height[70:112, 62:138] = TOP + 0.016
    height[88:94, 96:112] = TOP + 0.034
    image = np.zeros((4, *GRID.shape), np.float32)
    image[3] = height
    action = mending(Observation(image, GRID, np.ones(GRID.shape, bool)))
    assert action is not None and action.aside
    row, col = GRID.to_pixel((action.pick.x, action.pick.y))
    assert 87 < row < 94 and 95 < col < 112


@pytest.mark.parametrize(("higher", "presses"), [(0.0, False), (0.0005, False), (0.002, True)])
def test_an_object_that_is_jammed_below_the_rim_is_pressed_once_at_its_far_end(
    higher: float, presses: bool
):
    height = observed().height.copy()
    height[61:65, 76:124] = TOP - 0.006
    height[100:106, 220:270] = 0.0
    image = np.zeros((4, *GRID.shape), np.float32)
    image[3] = height
    put = move((140.0, 280.0), (63.0, 85.0), aside=False)
    seen = dataclasses.replace(
        Observation(image, GRID, np.ones(GRID.shape, bool)),
        history=(dataclasses.replace(put, top=TOP - 0.006 - higher),),
    )
    inventory, planner = Inventory.of(seen), PickPlaceParameters()
    action = preparing_action(inventory, planner, [], None)
    assert (action is not None and action.press) is presses
    if action is not None:
        row, col = GRID.to_pixel((action.pick.x, action.pick.y))
        assert 61 < row < 64 and 105 < col < 124
        assert preparing_action(inventory, planner, [action.pick], None) is None


@pytest.mark.parametrize("gap", [0, 12])
def test_an_object_that_may_lean_on_the_kit_belongs_to_a_heap(gap: int):
    height = observed().height.copy()
    height[90:98, 125:138] = TOP + 0.02
    height[90:98, 140 + gap : 180 + gap] = 0.03
    image = np.zeros((4, *GRID.shape), np.float32)
    image[3] = height
    inventory = Inventory.of(Observation(image, GRID, np.ones(GRID.shape, bool)))
    (protruding,) = inventory.segmentation.protruding
    assert inventory.leans(PlanarPose(*inventory.memory.middle(protruding))) is (gap == 0)


@pytest.mark.parametrize(("off", "moves"), [(1.0, True), (2.5, True), (0.3, False), (6.0, False)])
def test_an_object_that_lies_a_little_beside_its_place_is_moved_there_once(off: float, moves: bool):
    lies, table = (93.5, 99.5), (60.0, 240.0)
    meant = (lies[0] - off, lies[1])
    placed = move(table, meant, aside=False)
    middle = placed.action.pick.x, placed.action.pick.y
    placed = dataclasses.replace(placed, action=dataclasses.replace(placed.action, middle=middle))
    seen = dataclasses.replace(observed(0.014), history=(placed,))
    action = mending(seen)
    assert action is not None
    assert action.aside is not moves
    if not moves:
        return
    way = np.subtract(*(GRID.to_pixel((pose.x, pose.y)) for pose in (action.place, action.pick)))
    np.testing.assert_allclose(way, (-off, 0.0), atol=0.3)
    assert action.place.theta == action.pick.theta
    # If it still protrudes, it is taken out.
    again = dataclasses.replace(seen, history=(placed, move(lies, meant, aside=False)))
    assert mending(again).aside
