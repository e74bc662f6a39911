import io

import numpy as np
import pytest
from PIL import Image

from kitting_drake.policies.learned_policy import Decision, make_action
from kitting_drake.reporting.decision_figure import draw_decision
from systems.signals import Observation, PixelGrid

GRID = PixelGrid(rows=33, cols=49)


def decision(
    seen: Observation, theta: float = 1.0, pick: tuple[float, float] = (8.5, 12.0)
) -> Decision:
    random = np.random.default_rng(0)
    pick_map = random.random(GRID.shape, np.float32)
    curve = random.random(90, np.float32)
    picked, placed = np.array(pick), np.array([30.0, 40.0])
    return Decision(
        action=make_action(seen, picked, theta, placed, 2.0),
        pick_map=pick_map / pick_map.sum(),
        angle_curve=curve / curve.sum(),
        place_map=-20 * random.random(GRID.shape, np.float32),
        pick_pixel=picked,
        place_pixel=placed,
    )


@pytest.fixture
def seen() -> Observation:
    return Observation(np.random.default_rng(1).random((4, *GRID.shape), np.float32), GRID)


def drawn(seen: Observation, decision: Decision) -> np.ndarray:
    with Image.open(io.BytesIO(draw_decision(seen, decision))) as picture:
        assert picture.format == "PNG"
        return np.asarray(picture.convert("RGB"))


def test_a_picture_shows_the_decision(seen: Observation):
    picture = drawn(seen, decision(seen))
    assert picture.shape == (880, 1320, 3)
    np.testing.assert_array_equal(picture, drawn(seen, decision(seen)))
    for other in (decision(seen, theta=1.5), decision(seen, pick=(20.0, 12.0))):
        assert (drawn(seen, other) != picture).any()


def test_what_sees_nothing_and_is_sure_is_drawn_too():
    """No colour, no height, all probability in one place, and a grasp at the edge."""
    seen = Observation(np.zeros((4, *GRID.shape), np.float32), GRID)
    sure = decision(seen, pick=(0.0, 0.0))
    sure.pick_map[:], sure.angle_curve[:], sure.place_map[:] = 0, 0, 0
    sure.pick_map[0, 0] = sure.angle_curve[0] = 1
    assert drawn(seen, sure).shape == (880, 1320, 3)
