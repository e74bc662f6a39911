"""The shipped weights: their cards, decisions and equivariance."""

import math
from pathlib import Path

import numpy as np
import pytest
import torch

from kitting_drake.common.paths import GENERALIST, MODELS
from kitting_drake.common.seeds import TEST_SEEDS
from kitting_drake.policies.learned_policy import LearnedPolicy
from kitting_drake.policies.networks.architecture import PICK_CROP, NetworkConfig
from kitting_drake.policies.networks.factored import SO2Networks
from kitting_drake.policies.networks.methods import make_networks
from kitting_drake.policies.networks.weights import load_networks, read_weights_file
from systems.signals import Observation
from tests.kitting_drake.policies.equivariance import relative_error, rotate_image, smooth_image
from tests.kitting_drake.policies.scenes import stored_observation

SHIPPED = sorted((MODELS / "policies").glob("*.safetensors"))
ONE_OF_THEM = [
    pytest.param(path, id=path.stem, marks=[] if path.stem == "generalist" else [pytest.mark.slow])
    for path in SHIPPED
]
TAUGHT = [path for path in SHIPPED if path.stem != "generalist"]
"""The shipped weights that were trained on demonstrations: all but the generalist's."""
OBSERVED = {"generalist": "kitting_unseen"}
"""The stored observation for weights that have no observation of the same name.

Observations were rendered with seeds 103 and 105, at rest, with four tools on the table.
"""

GOLDEN = {
    "generalist": ((59.179, 219.931), 40.516, (69.985, 124.046), -146.184),
    "kitting_seen": ((19.879, 24.805), 57.140, (60.811, 177.621), -151.209),
    "kitting_unseen": ((59.612, 219.980), 41.040, (69.570, 123.653), -146.237),
}
"""The predictions of the shipped weights (float32) for their stored observations: pick (row, col),
pick angle in degrees, place (row, col), rotation in degrees."""


def test_there_is_a_file_for_each_task_and_a_generalist():
    assert [path.stem for path in SHIPPED] == ["generalist", "kitting_seen", "kitting_unseen"]


def test_the_generalist_sees_no_colour():
    file = read_weights_file(GENERALIST)
    assert not file.config.colour
    assert file.card["scenario"] == "static scenes"
    assert file.card["demonstrations"] > 1000
    policy = LearnedPolicy(load_networks(GENERALIST), orientations=36)
    seen = stored_observation("kitting_unseen")
    image = seen.image.copy()
    image[:3] = image[[2, 0, 1]] / 2
    assert policy(seen) == policy(Observation(image, seen.grid, seen.valid))


@pytest.mark.parametrize("path", TAUGHT, ids=lambda path: path.stem)
def test_no_test_seed_was_used_in_training(path: Path):
    file = read_weights_file(path)
    assert file.config == NetworkConfig(
        **{**file.config.as_dict(), "method": "so2", "preset": "small", "orientations": 180}
    )
    assert file.card["demonstrations"] == len(file.card["demonstration_seeds"]) > 90
    learned = {*file.card["demonstration_seeds"], *file.card["validation_seeds"]}
    assert not learned.intersection(TEST_SEEDS)
    assert file.card["validation"]["median_rotation_deg"] < 0.5
    assert file.card["validation"]["false_stops"] == file.card["validation"]["missed_stops"] == 0


def test_stops_when_all_tools_are_in_the_kit():
    """The final observation was made after the demonstration of a validation seed, 20011."""
    networks = load_networks(MODELS / "policies" / "kitting_unseen.safetensors")
    policy = LearnedPolicy(networks, orientations=36)
    names = ("kitting_unseen_final", "kitting_unseen")
    finished, unfinished = (policy(stored_observation(name)) for name in names)
    assert finished.stop
    assert not unfinished.stop
    # The log-odds of both observations are at least 2 from the threshold.
    odds = [policy.log_odds(stored_observation(name)) for name in names]
    assert odds[0] < networks.stop_threshold - 2 < networks.stop_threshold + 2 < odds[1]


@pytest.mark.parametrize("path", ONE_OF_THEM)
def test_predicts_as_when_it_was_shipped(path: Path):
    policy = LearnedPolicy(load_networks(path), orientations=180)
    found = policy.decide(stored_observation(OBSERVED.get(path.stem, path.stem)))

    pick, angle, place, rotation = GOLDEN[path.stem]
    action = found.action
    np.testing.assert_allclose(found.pick_pixel, pick, atol=1 / 3)
    np.testing.assert_allclose(found.place_pixel, place, atol=1 / 3)
    difference = action.place.theta - action.pick.theta
    assert not found.stop
    assert abs(math.remainder(math.degrees(action.pick.theta) - angle, 180)) < 1
    assert abs(math.remainder(math.degrees(difference) - rotation, 360)) < 1


@pytest.mark.parametrize("path", ONE_OF_THEM)
@torch.inference_mode()
def test_trained_networks_stay_equivariant(path: Path):
    trained = load_networks(path)
    image = smooth_image(113)[:, -trained.config.channels :]
    for name in ("alpha", "phi", "psi"):
        network = getattr(trained, name)
        output = network(image)
        assert relative_error(network(rotate_image(image, 90)), rotate_image(output, 90)) < 1e-4
        errors = [
            relative_error(network(rotate_image(image, degrees)), rotate_image(output, degrees))
            for degrees in (15, 45)
        ]
        assert max(errors) < 0.3


@pytest.mark.parametrize("path", ONE_OF_THEM)
@torch.inference_mode()
def test_training_makes_pick_angles_more_equivariant(path: Path):
    trained = load_networks(path)
    torch.manual_seed(0)
    fresh = make_networks(trained.config).eval()
    errors: dict[str, list[float]] = {"fresh": [], "trained": []}
    for seed in range(4):
        crop = smooth_image(PICK_CROP, seed=seed)[:, -trained.config.channels :]
        for name, networks in (("fresh", fresh), ("trained", trained)):
            assert isinstance(networks, SO2Networks)
            logits = networks.crop_angle_logits(crop, 72)[0]
            for degrees in (15, 30, 45):
                found = networks.crop_angle_logits(rotate_image(crop, degrees), 72)[0]
                deviation = (found - logits.roll(degrees // 5)).norm()
                errors[name].append(float(deviation / (logits - logits.mean()).norm()))
    medians = {name: float(np.median(values)) for name, values in errors.items()}
    print(path.stem, "beta:", *(f"{name} {median:.3f}" for name, median in medians.items()))
    assert medians["trained"] < min(0.2, medians["fresh"])
