import math

import numpy as np
import pytest

from kitting_drake.policies.images import Image, LabelledImage, rotation
from kitting_drake.policies.learned_policy import Decision, make_action
from kitting_drake.policies.samples import Scene
from kitting_drake.policies.validation import ERRORS, answer_errors, validate
from systems.signals import Observation, PixelGrid

GRID = PixelGrid(resolution=0.002, rows=60, cols=80)
"""2 mm a pixel."""
IMAGE: Image = np.zeros((4, *GRID.shape), np.float32)
PICK, PLACE, THETA, TURN = np.array([20.0, 30.0]), np.array([40.0, 60.0]), 1.2, 2.9


def target(pick: np.ndarray = PICK) -> LabelledImage:
    return LabelledImage(IMAGE, pick, THETA, PLACE, TURN)


SCENE = Scene(IMAGE, (target(np.array([50.0, 70.0])), target()))


def answer(*, pick=(0.0, 0.0), theta: float = 0.0, place=(0.0, 0.0), turn: float = 0.0) -> Decision:
    """The expert's answer, but for so much; the place of what was picked, not of the label."""
    pick_pixel = PICK + pick
    place_pixel = PLACE + rotation(TURN) @ np.array(pick) + place
    seen = Observation(IMAGE, GRID)
    action = make_action(seen, pick_pixel, THETA + theta, place_pixel, TURN + turn)
    maps = np.zeros(GRID.shape, np.float32)
    return Decision(action, maps, np.zeros(3, np.float32), maps, pick_pixel, place_pixel)


@pytest.mark.parametrize(
    ("decision", "expected"),
    [
        (answer(), (0, 0, 0, 0, 0)),
        # An object that is gripped elsewhere, and put down accordingly, is where it belongs.
        (answer(pick=(3, 4)), (10, 0, 0, 0, 0)),
        (answer(place=(0.3, -0.4)), (0, 0, 1, 0, 1)),
        (answer(theta=math.radians(2)), (0, 2, 0, 0, 50 * math.radians(2))),
        (answer(theta=math.pi - math.radians(2)), (0, 2, 0, 0, 50 * math.radians(2))),
        (answer(turn=-math.radians(3)), (0, 0, 0, 3, 50 * math.radians(3))),
        (answer(turn=math.tau), (0, 0, 0, 0, 0)),
        # All together, and no worse than lost.
        (answer(place=(3, 4), theta=0.02, turn=0.04), (0, 1.1459, 10, 2.2918, 13)),
        (answer(turn=math.pi), (0, 0, 0, 180, 20)),
        # A pick beside every object moves none, however well it is placed.
        (answer(pick=(-9, 6)), (2 * math.hypot(9, 6), 0, 0, 0, 20)),
    ],
)
def test_errors_of_an_answer(decision: Decision, expected: tuple[float, ...]):
    np.testing.assert_allclose(answer_errors(decision, SCENE, GRID), expected, atol=1e-4)


class Answers:
    """A policy that gives one answer after the other."""

    def __init__(self, *answers: Decision) -> None:
        self._answers = iter(answers)

    def decide(self, observation: Observation) -> Decision:
        assert observation.grid == GRID
        return next(self._answers)


def test_a_report_of_some_scenes():
    policy = Answers(answer(), answer(place=(0, 1)), answer(place=(9, 12)))
    report = validate(policy, [SCENE] * 3, GRID)  # type: ignore[arg-type]
    assert report["median_place_mm"] == pytest.approx(2)
    assert report["p95_place_mm"] == pytest.approx(30 - 0.1 * 28)
    assert report["displacement_mm"] == pytest.approx((0 + 2 + 20) / 3)
    named = {f"{kind}_{name}" for kind in ("median", "p95") for name in ERRORS}
    assert report.keys() == {"displacement_mm", *named}
