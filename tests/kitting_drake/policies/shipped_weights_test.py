"""The weights that come with the project: what they say of themselves, and how they turn."""

from pathlib import Path

import numpy as np
import pytest
import torch

from kitting_drake.common.paths import MODELS
from kitting_drake.common.seeds import TEST_SEEDS
from kitting_drake.policies.config import PICK_CROP, NetworkConfig
from kitting_drake.policies.methods import make_networks
from kitting_drake.policies.networks import SO2Networks
from kitting_drake.policies.weights import load_networks, read_weights_file
from tests.kitting_drake.policies.turning import relative_error, smooth_image, turn_image

SHIPPED = sorted((MODELS / "policies").glob("*.safetensors"))


def test_there_is_one_for_each_task():
    assert [path.stem for path in SHIPPED] == ["kitting_seen", "kitting_unseen"]


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.stem)
def test_no_test_seed_was_learned_from(path: Path):
    file = read_weights_file(path)
    assert file.config == NetworkConfig(
        **{**file.config.as_dict(), "method": "so2", "preset": "small", "orientations": 180}
    )
    assert file.card["demonstrations"] == len(file.card["demonstration_seeds"]) == 100
    learned = {*file.card["demonstration_seeds"], *file.card["validation_seeds"]}
    assert not learned.intersection(TEST_SEEDS)
    assert file.card["validation"]["median_turn_deg"] < 0.5


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.stem)
@torch.inference_mode()
def test_training_keeps_them_equivariant(path: Path):
    image = smooth_image(113)
    trained = load_networks(path)
    torch.manual_seed(0)
    fresh = make_networks(trained.config).eval()
    for name in ("alpha", "phi", "psi"):
        errors = []
        for networks in (fresh, trained):
            network = getattr(networks, name)
            answer = network(image)
            assert relative_error(network(turn_image(image, 90)), turn_image(answer, 90)) < 1e-4
            errors += [
                relative_error(network(turn_image(image, degrees)), turn_image(answer, degrees))
                for degrees in (15, 30, 45)
            ]
        print(path.stem, name, "fresh, then trained:", *(f"{error:.3f}" for error in errors))
        assert max(errors) < 0.3


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.stem)
@torch.inference_mode()
def test_training_makes_pick_angles_turn(path: Path):
    trained = load_networks(path)
    torch.manual_seed(0)
    fresh = make_networks(trained.config).eval()
    errors: dict[str, list[float]] = {"fresh": [], "trained": []}
    for seed in range(4):
        crop = smooth_image(PICK_CROP, seed=seed)
        for name, networks in (("fresh", fresh), ("trained", trained)):
            assert isinstance(networks, SO2Networks)
            logits = networks.crop_angle_logits(crop, 72)[0]
            for degrees in (15, 30, 45):
                found = networks.crop_angle_logits(turn_image(crop, degrees), 72)[0]
                deviation = (found - logits.roll(degrees // 5)).norm()
                errors[name].append(float(deviation / (logits - logits.mean()).norm()))
    medians = {name: float(np.median(values)) for name, values in errors.items()}
    print(path.stem, "beta:", *(f"{name} {median:.3f}" for name, median in medians.items()))
    assert medians["trained"] < min(0.2, medians["fresh"])
