"""Four scenes learned by heart, and copies of them that were turned before anyone looked."""

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
from tests.kitting_drake.policies.scenes import ORIENTATIONS, ROOM, SIDE, config, scene

TURNS = (10, 20, 33, 45, 57, 70, 110, 155)
"""In degrees: after any of them the labels lie between pixels."""


def answer_errors(
    networks: Networks, sample: LabelledImage, *, continuous: bool = False
) -> list[float]:
    """Of the pick in pixels and bins, then of the place."""
    policy = LearnedPolicy(networks, orientations=ORIENTATIONS, continuous=continuous)
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


def shifted(sample: LabelledImage, random: np.random.Generator, *, rigid: bool) -> LabelledImage:
    """All that is ever shown: no scene is turned."""
    return move(sample, 0.0, random.integers(-ROOM, ROOM + 1, size=2).astype(float))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("method", "steps"),
    [("so2", 250), ("equivariant_transporter", 250), ("transporter", 500)],
)
def test_learns_by_heart_and_perhaps_more(method: str, steps: int, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(training, "augment", shifted)
    samples = [scene(seed) for seed in range(4)]
    torch.manual_seed(0)
    networks = make_networks(config(method))
    trainer = training.Trainer(networks, seed=0, steps=steps, learning_rate=3e-3, decay=True)
    for _ in range(steps):
        trainer.step(samples)
    networks.eval()

    def errors(*turns: float, continuous: bool = False) -> NDArray[np.float64]:
        """(turns, scenes, 4)."""
        return np.array(
            [
                [
                    answer_errors(networks, scene(seed, degrees), continuous=continuous)
                    for seed in range(4)
                ]
                for degrees in turns
            ]
        )

    seen, quarter, half = errors(0, 90, 180)
    turned = errors(*TURNS, continuous=True)
    # Errors of one whole bin are rounded.
    right = (turned < 1.001).all(axis=2)
    print(f"{method}: largest errors of pick (pixels, bins) and place (pixels, bins)")
    for name, found in {"as shown": seen, "by 90": quarter, "by 180": half}.items():
        print(f"  {name:9}{found.max(0).round(2)}")
    print(f"  others   {turned.max((0, 1)).round(2)}, {right.sum()} of {right.size} within one")
    assert seen.max() < 0.01
    if method == "so2":
        assert max(quarter.max(), half.max()) < 0.01
        assert right.all()
    elif method == "equivariant_transporter":
        # C_6 has half turns, but no quarter turns.
        assert half.max() < 0.01 < quarter.max()
        assert right.mean() < 0.6
    else:
        # Picking looks at the image from N sides; placing knows only what it was shown.
        assert right.mean() < 0.4
        assert min(quarter.max(), half.max()) > 5
