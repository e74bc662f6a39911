import copy
from typing import Any

import numpy as np
import pytest
import torch

from kitting_drake.policies.data.recorded import FinalObservation
from kitting_drake.policies.networks.architecture import METHODS
from kitting_drake.policies.networks.methods import make_networks
from kitting_drake.policies.training import training_step as training
from kitting_drake.policies.training.training_step import Trainer, decayed
from systems.signals import Observation
from tests.kitting_drake.policies.scenes import config, final_scene, scene

FINALS = [FinalObservation.of(Observation(final_scene(seed))) for seed in range(2)]


def trainer(
    *, weights: int = 0, method: str = "so2", stop: bool = False, **arguments: Any
) -> Trainer:
    torch.manual_seed(weights)
    return Trainer(make_networks(config(method, stop=stop)), **{"seed": 0, **arguments})


def assert_same(one: Trainer, other: Trainer) -> None:
    pairs = zip(one.networks.parameters(), other.networks.parameters(), strict=True)
    assert all(torch.equal(a, b) for a, b in pairs)


def test_the_seed_determines_all_draws():
    samples = [scene(0), scene(1)]
    one, same, other = trainer(), trainer(), trainer(seed=1)
    losses = [[item.step(samples)] for item in (one, same)]
    assert losses[0] == losses[1]
    assert other.step(samples) != losses[0][0]
    assert_same(one, same)


@pytest.mark.slow
@pytest.mark.parametrize(("decay", "stop"), [(False, False), (True, True)])
def test_a_resumed_run_continues_exactly(decay: bool, stop: bool, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(training, "_STOP_PROBABILITY", 0.5)
    samples = [scene(0), scene(1)]
    whole, before, after = (
        trainer(weights=weights, steps=4, decay=decay, stop=stop, learning_rate=1e-2)
        for weights in (0, 0, 1)
    )
    expected = [whole.step(samples, FINALS) for _ in range(4)]
    found = [before.step(samples, FINALS) for _ in range(2)]
    after.load_state_dict(copy.deepcopy(before.state_dict()))
    found += [after.step(samples, FINALS) for _ in range(2)]
    assert found == expected
    assert after.step_count == 4
    assert_same(after, whole)
    # If the networks can stop, some of the steps had a final observation, and others had none.
    assert {"stop" in losses for losses in found} == ({True, False} if stop else {False})


def test_a_final_observation_only_affects_the_pick_position(
    monkeypatch: pytest.MonkeyPatch,
):
    outcomes = []
    for probability in (0.0, 1.0):
        monkeypatch.setattr(training, "_STOP_PROBABILITY", probability)
        learner = trainer(stop=True, learning_rate=1e-3)
        losses = learner.step([scene(0)], FINALS)
        outcomes.append((losses, copy.deepcopy(learner.networks.state_dict())))
    (without, before), (with_final, after) = outcomes
    assert with_final.pop("stop") > 0
    assert with_final == without
    changed = {name.split(".")[0] for name in before if not torch.equal(before[name], after[name])}
    assert changed == {"alpha"}


def test_a_batch_averages_the_gradients_of_its_samples():
    samples = [scene(0), scene(1)]

    def gradients(learner: Trainer) -> list[torch.Tensor]:
        losses.append(learner.step(samples))
        return [weight.grad.clone() for weight in learner.networks.parameters()]

    losses: list[dict[str, float]] = []
    # The rate is so small that the weights do not change between the two steps.
    single, both = trainer(learning_rate=1e-30), trainer(learning_rate=1e-30, batch=2)
    expected = [(a + b) / 2 for a, b in zip(gradients(single), gradients(single), strict=True)]
    for one, other in zip(gradients(both), expected, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-4, atol=1e-6)
    for name, value in losses[2].items():
        assert value == pytest.approx((losses[0][name] + losses[1][name]) / 2, rel=1e-5)


def test_training_one_loss_alone_gives_the_same_weights():
    whole, alone = trainer(learning_rate=1e-3), trainer(learning_rate=1e-3, only="pick_angle")
    before = copy.deepcopy(alone.networks.state_dict())
    for _ in range(2):
        losses = whole.step([scene(0)]), alone.step([scene(0)])
        assert losses[1] == {"pick_angle": losses[0]["pick_angle"]}
    expected, found = (item.networks.state_dict() for item in (whole, alone))
    for name, values in found.items():
        trained = name.startswith("beta.")
        assert torch.equal(values, (expected if trained else before)[name]), name
    assert not torch.equal(expected["alpha.lift.weights"], before["alpha.lift.weights"])


@pytest.mark.slow
def test_a_prepared_draw_is_used_only_for_its_step_and_samples():
    samples, others = [scene(0), scene(1)], [scene(2)]
    one, other = trainer(), trainer()
    for learner, first in ((one, samples), (other, others)):
        learner.step(first)
        learner.load_state_dict(copy.deepcopy(trainer().state_dict()))
    assert one.step(others) == other.step(others)
    one.step_count = other.step_count = 7
    assert one.step(samples) == other.step(samples)


def test_one_step_in_eight_has_a_final_observation():
    learner = trainer(stop=True)
    samples = [scene(0)]
    drawn = [learner._draw(step, samples, FINALS).final for step in range(240)]
    images = [image for image in drawn if image is not None]
    assert 18 < len(images) < 45
    # Every final observation was moved differently.
    assert len({image.tobytes() for image in images}) == len(images)


def rates(learner: Trainer) -> set[float]:
    """All learning rates of the trainer's optimisers, as set for the next step."""
    return {group["lr"] for item in learner.optimisers.values() for group in item.param_groups}


def test_the_learning_rate_follows_the_step():
    learner, constant = trainer(steps=300, decay=True), trainer(steps=300)
    constant.step([scene(0)])
    assert rates(constant) == {1e-4}
    for step in range(2):
        assert rates(learner) == {1e-4 * decayed(step, 300)}
        learner.step([scene(0)])
    resumed = trainer(steps=300, decay=True)
    resumed.load_state_dict(copy.deepcopy(learner.state_dict()))
    assert rates(resumed) == rates(learner) == {1e-4 * decayed(2, 300)}


@pytest.mark.slow
def test_every_loss_falls():
    learner = trainer(learning_rate=6e-3)
    losses = [learner.step([scene(0)]) for _ in range(9)]
    for name in ("pick_position", "pick_angle", "place"):
        first, last = (np.mean([step[name] for step in part]) for part in (losses[:3], losses[-3:]))
        assert last < 0.9 * first, name


@pytest.mark.parametrize("method", METHODS)
def test_every_weight_is_trained_by_one_loss(method: str):
    networks = make_networks(config(method))
    trained = [
        weight
        for modules in networks.modules_by_loss().values()
        for module in modules
        for weight in module.parameters()
    ]
    assert sorted(map(id, trained)) == sorted(map(id, networks.parameters()))
    before = copy.deepcopy(networks.state_dict())
    Trainer(networks, seed=0).step([scene(0)])
    after = networks.state_dict()
    unmoved = {name for name in before if torch.equal(before[name], after[name])}
    # A softmax ignores an offset of all logits, so only rounding can change these biases.
    assert unmoved <= {"alpha.out.bias", "f_pick.out.third.bias", "f_pick.out.shortcut.bias"}


def test_the_learning_rate_warms_up_and_decays_to_zero():
    shares = [decayed(step, 1000) for step in range(1001)]
    assert shares[0] == pytest.approx(0.01, rel=0.01)
    assert max(shares) == pytest.approx(1, rel=0.05)
    assert (np.diff(shares[100:]) < 0).all()
    assert shares[1000] == pytest.approx(0, abs=1e-8)
    # After the last step the rate stays zero.
    assert decayed(1500, 1000) == pytest.approx(0, abs=1e-8)
