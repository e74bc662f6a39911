import dataclasses
import math

import numpy as np
import pytest

from kitting_drake.policies.data.images import Image, make_action, rotation_matrix
from kitting_drake.policies.data.recorded import FinalObservation, record
from kitting_drake.policies.data.samples import ObservedScene
from kitting_drake.policies.learned_policy import Decision
from kitting_drake.policies.networks.architecture import NetworkConfig
from kitting_drake.policies.networks.methods import make_networks
from kitting_drake.policies.training.validation import (
    ERRORS,
    choose_stop_threshold,
    mean_loss,
    prediction_errors,
    validate,
)
from systems.signals import Observation, PixelGrid

GRID = PixelGrid(resolution=0.002, rows=60, cols=80)
"""2 mm per pixel."""
IMAGE: Image = np.zeros((4, *GRID.shape), np.float32)
SEEN = Observation(IMAGE, GRID)
PICK, PLACE, THETA, ROTATION = np.array([20.0, 30.0]), np.array([40.0, 60.0]), 1.2, 2.9
SCENE = ObservedScene(
    record(SEEN),
    (
        make_action(SEEN, np.array([50.0, 70.0]), THETA, PLACE, ROTATION),
        make_action(SEEN, PICK, THETA, PLACE, ROTATION),
    ),
    GRID,
)


def predicted(
    *,
    pick: tuple[float, float] = (0.0, 0.0),
    theta: float = 0.0,
    place: tuple[float, float] = (0.0, 0.0),
    rotation: float = 0.0,
    log_odds: float | None = None,
) -> Decision:
    """The expert's action with given errors.

    The place moves with the pick, so that a wrong pick alone still places the object correctly.
    The error `place` is added to that.
    """
    pick_pixel = PICK + pick
    place_pixel = PLACE + rotation_matrix(ROTATION) @ np.array(pick) + place
    action = make_action(SEEN, pick_pixel, THETA + theta, place_pixel, ROTATION + rotation)
    maps = np.zeros(GRID.shape, np.float32)
    curve = np.zeros(3, np.float32)
    return Decision(action, maps, curve, maps, pick_pixel, place_pixel, log_odds)


@pytest.mark.parametrize(
    ("decision", "expected"),
    [
        (predicted(), (0, 0, 0, 0, 0)),
        # A grasp elsewhere on the object costs nothing if the object is placed correctly.
        (predicted(pick=(3, 4)), (10, 0, 0, 0, 0)),
        (predicted(place=(0.3, -0.4)), (0, 0, 1, 0, 1)),
        (predicted(theta=math.radians(2)), (0, 2, 0, 0, 50 * math.radians(2))),
        (predicted(theta=math.pi - math.radians(2)), (0, 2, 0, 0, 50 * math.radians(2))),
        (predicted(rotation=-math.radians(3)), (0, 0, 0, 3, 50 * math.radians(3))),
        (predicted(rotation=math.tau), (0, 0, 0, 0, 0)),
        # The cost adds up the place's error and both angle errors, but is clipped at 20 mm.
        (predicted(place=(3, 4), theta=0.02, rotation=0.04), (0, 1.1459, 10, 2.2918, 13)),
        (predicted(rotation=math.pi), (0, 0, 0, 180, 20)),
        # A pick that misses every object has the largest cost.
        (predicted(pick=(-9, 6)), (2 * math.hypot(9, 6), 0, 0, 0, 20)),
    ],
)
def test_errors_of_a_prediction(decision: Decision, expected: tuple[float, ...]):
    found = prediction_errors(decision, SCENE.targets, 2.0)
    np.testing.assert_allclose(found, expected, atol=1e-4)


class Scripted:
    """A policy that returns given decisions and log-odds in turn."""

    def __init__(self, *decisions: Decision, log_odds: tuple[float, ...] = ()) -> None:
        self._decisions, self._log_odds = iter(decisions), iter(log_odds)

    def decide(self, observation: Observation) -> Decision:
        assert observation.grid == GRID
        return next(self._decisions)

    def log_odds(self, observation: Observation) -> float:
        assert observation.grid == GRID
        return next(self._log_odds)


def test_the_report_without_final_observations():
    policy = Scripted(predicted(), predicted(place=(0, 1)), predicted(place=(9, 12)))
    report = validate(policy, [SCENE] * 3)  # type: ignore[arg-type]
    assert report["median_place_mm"] == pytest.approx(2)
    assert report["p95_place_mm"] == pytest.approx(30 - 0.1 * 28)
    assert report["displacement_mm"] == report["cost_mm"] == pytest.approx((0 + 2 + 20) / 3)
    named = {f"{kind}_{name}" for kind in ("median", "p95") for name in ERRORS}
    assert report.keys() == {"displacement_mm", "cost_mm", *named}


def test_wrong_stop_decisions_are_counted_and_cost_as_if_lost():
    policy = Scripted(
        predicted(log_odds=5.0),
        predicted(log_odds=-2.0),
        predicted(place=(0, 1), log_odds=3.0),
        log_odds=(-4.0, -3.0, -3.5, 4.0),
    )
    final = FinalObservation.of(SEEN)
    report = validate(policy, [SCENE] * 3, [final] * 4)  # type: ignore[arg-type]
    assert report["stop_threshold"] == pytest.approx(-2.75)
    assert (report["false_stops"], report["missed_stops"]) == (0, 1)
    assert report["stop_margin"] == pytest.approx(-2.0 - 4.0)
    assert report["displacement_mm"] == pytest.approx(2 / 3)
    assert report["cost_mm"] == pytest.approx((0 + 0 + 2 + 20) / 7)


@pytest.mark.parametrize(
    ("present", "absent", "threshold"),
    [
        # If the two ranges of log-odds do not overlap, the threshold lies between them, nearer to
        # the range of final observations.
        ((3.0, 9.0, 5.0), (-1.0, -7.0), 0.0),
        # Otherwise it is the threshold with the fewest errors; the lowest one if there are several.
        ((3.0, 5.0, 6.0, -2.0), (-1.0, -3.0, 0.0), 0.75),
        ((1.0,), (2.0,), 0.0),
        ((), (1.0,), None),
        ((1.0,), (), None),
    ],
)
def test_the_stop_threshold(
    present: tuple[float, ...], absent: tuple[float, ...], threshold: float | None
):
    assert choose_stop_threshold(present, absent) == threshold


def test_the_mean_loss_is_that_of_the_taken_action():
    networks = make_networks(NetworkConfig(preset="tiny")).eval()
    seen = np.random.default_rng(0).random((4, *GRID.shape)).astype(np.float32)
    sample = dataclasses.replace(SCENE.targets[0], image=seen)
    found = mean_loss(networks, [sample, sample])
    assert found == mean_loss(networks, [sample, sample])
    parts = {
        name: float(loss().detach())
        for name, loss in networks.losses(sample, np.random.default_rng(0))
    }
    assert mean_loss(networks, [sample]) == pytest.approx(sum(parts.values()), rel=1e-4)
    assert parts.keys() == {"pick_position", "pick_angle", "place"}
