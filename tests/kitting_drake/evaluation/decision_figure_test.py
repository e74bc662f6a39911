import dataclasses
import io

import numpy as np
import pytest
from PIL import Image

from kitting_drake.evaluation.decision_figure import draw_action, draw_decision, draw_maps
from kitting_drake.policies.data.images import make_action
from kitting_drake.policies.learned_policy import Decision
from systems.signals import Observation, PickPlaceAction, PixelGrid

GRID = PixelGrid(rows=33, cols=49)


def decision(
    observation: Observation, theta: float = 1.0, pick: tuple[float, float] = (8.5, 12.0)
) -> Decision:
    random = np.random.default_rng(0)
    pick_map = random.random(GRID.shape, np.float32)
    curve = random.random(90, np.float32)
    picked, placed = np.array(pick), np.array([30.0, 40.0])
    return Decision(
        action=make_action(observation, picked, theta, placed, 2.0),
        pick_map=pick_map / pick_map.sum(),
        angle_curve=curve / curve.sum(),
        place_map=-20 * random.random(GRID.shape, np.float32),
        pick_pixel=picked,
        place_pixel=placed,
    )


@pytest.fixture(scope="module")
def observation() -> Observation:
    return Observation(np.random.default_rng(1).random((4, *GRID.shape), np.float32), GRID)


def drawn(observation: Observation, decision: Decision) -> np.ndarray:
    with Image.open(io.BytesIO(draw_decision(observation, decision))) as picture:
        assert picture.format == "PNG"
        return np.asarray(picture.convert("RGB"))


@pytest.fixture(scope="module")
def picture(observation: Observation) -> np.ndarray:
    return drawn(observation, decision(observation))


def test_draw_decision_shows_the_decision(observation: Observation, picture: np.ndarray):
    assert picture.shape == (880, 1320, 3)
    np.testing.assert_array_equal(picture, drawn(observation, decision(observation)))
    for other in (
        decision(observation, theta=1.5),
        decision(observation, pick=(20.0, 12.0)),
        dataclasses.replace(decision(observation), log_odds=3.0),
    ):
        assert (drawn(observation, other) != picture).any()


def test_no_gripper_is_drawn_if_the_policy_stops(observation: Observation, picture: np.ndarray):
    pick_colour, place_colour = (228, 87, 46), (27, 153, 139)
    stops = dataclasses.replace(
        decision(observation), action=PickPlaceAction(stop=True), log_odds=-4.0
    )
    pictures = [picture, drawn(observation, stops)]
    for colour, shown_in_curve in ((pick_colour, True), (place_colour, False)):
        counts = [int((item == colour).all(axis=2).sum()) for item in pictures]
        assert counts[0] > counts[1]
        assert (counts[1] > 0) == shown_in_curve


def test_pictures_show_what_is_not_seen(observation: Observation):
    """Pixels out of view are grey, and unseen ones within the view are striped, in two panels."""
    valid, in_view = np.ones((2, *GRID.shape), bool)
    valid[:, 10:], in_view[:, 30:] = False, False
    partly = dataclasses.replace(observation, valid=valid, in_view=in_view)
    stop = PickPlaceAction(stop=True)
    pictures = []
    for item, title in ((observation, ""), (partly, ""), (partly, "not seen: " + 40 * "word ")):
        with Image.open(io.BytesIO(draw_action(item, stop, title=title))) as picture:
            pictures.append(np.asarray(picture.convert("RGB")))
    grey, stripe = (230, 230, 230), (173, 145, 199)
    for colour in (grey, stripe):
        counts = [int((np.abs(one - np.array(colour)) < 2).all(axis=2).sum()) for one in pictures]
        assert counts[0] < 200 and min(counts[1:]) > 10_000
    assert pictures[1].shape == pictures[2].shape and (pictures[1] != pictures[2]).any()


def test_draw_decision_of_an_empty_observation_with_certain_maps():
    """No colours, flat heights, all probability in one pixel, and a grasp at the edge."""
    nothing = Observation(np.zeros((4, *GRID.shape), np.float32), GRID)
    sure = decision(nothing, pick=(0.0, 0.0))
    sure.pick_map[:], sure.angle_curve[:], sure.place_map[:] = 0, 0, 0
    sure.pick_map[0, 0] = sure.angle_curve[0] = 1
    assert drawn(nothing, sure).shape == (880, 1320, 3)


def test_the_maps_alone_are_as_wide_as_asked(observation: Observation):
    pictures = []
    for item in (decision(observation), decision(observation, pick=(20.0, 12.0))):
        with Image.open(io.BytesIO(draw_maps(observation, item, width=400))) as picture:
            pictures.append(np.asarray(picture.convert("RGB")))
    assert pictures[0].shape[1] == 400
    changed = (pictures[0] != pictures[1]).any(axis=(0, 2))
    # The pictures differ only in the pick map, which is on the left.
    assert changed[:200].any()
    assert not changed[204:].any()
