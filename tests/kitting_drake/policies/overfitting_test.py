"""Four scenes learned by heart, and their turned copies, which nobody has seen."""

import math

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from kitting_drake.policies import training
from kitting_drake.policies.images import LabelledImage, move
from kitting_drake.policies.learned_policy import LearnedPolicy
from kitting_drake.policies.methods import make_networks
from kitting_drake.policies.networks import Networks
from systems.signals import Observation, PixelGrid
from tests.kitting_drake.policies.scenes import ORIENTATIONS, SIDE, config, scene


def answer_errors(networks: Networks, sample: LabelledImage) -> list[float]:
    """Of the pick in pixels and bins, then of the place."""
    policy = LearnedPolicy(networks, orientations=ORIENTATIONS, continuous=False)
    decision = policy.decide(Observation(sample.image, PixelGrid(rows=SIDE, cols=SIDE)))
    action = decision.action
    bins = ORIENTATIONS / math.tau
    goal = sample.place_of(decision.pick_pixel)
    turn = action.place.theta - action.pick.theta - sample.turn
    return [
        np.abs(decision.pick_pixel - sample.pick).max(),
        bins * abs(math.remainder(action.pick.theta - sample.pick_theta, math.pi)),
        np.abs(decision.place_pixel - goal).max(),
        bins * abs(math.remainder(turn, math.tau)),
    ]


def turned_errors(
    networks: Networks, samples: list[LabelledImage], degrees: float
) -> NDArray[np.float64]:
    """(scenes, 4)."""
    copies = [move(sample, math.radians(degrees), np.zeros(2)) for sample in samples]
    return np.array([answer_errors(networks, copy) for copy in copies])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("method", "steps"),
    [("so2", 250), ("equivariant_transporter", 250), ("transporter", 500)],
)
def test_learns_by_heart_and_perhaps_more(method: str, steps: int, monkeypatch: pytest.MonkeyPatch):
    # No turned copy is ever shown.
    monkeypatch.setattr(training, "augment", lambda sample, random, *, rigid: sample)
    samples = [scene(seed) for seed in range(4)]
    torch.manual_seed(0)
    networks = make_networks(config(method))
    trainer = training.Trainer(networks, seed=0, steps=steps, learning_rate=3e-3, decay=True)
    for _ in range(steps):
        trainer.step(samples)
    networks.eval()
    seen = np.array([answer_errors(networks, sample) for sample in samples])
    turned = {degrees: turned_errors(networks, samples, degrees) for degrees in (90, 180, 33)}
    print(method, "largest errors (pick px, bins; place px, bins): seen", seen.max(0).round(2))
    for degrees, errors in turned.items():
        within = int((errors <= 1.01).all(axis=1).sum())
        print(f"  turned by {degrees}: {within}/4 within one; largest", errors.max(0).round(2))
    assert seen.max() < 0.01
    quarter, half = turned[90], turned[180]
    if method == "so2":
        assert max(quarter.max(), half.max()) < 0.01
    elif method == "equivariant_transporter":
        # C_6 has half turns, but no quarter turns.
        assert half.max() < 0.01 < quarter.max()
    else:
        assert not (quarter <= 1.01).all() and not (half <= 1.01).all()
