from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from kitting_drake.policies.data.images import LabelledImage
from kitting_drake.policies.networks.angle_net import AngleNet
from kitting_drake.policies.networks.architecture import PICK_CROP, PRESETS, NetworkConfig
from kitting_drake.policies.networks.equivariant_transporter import EquivariantTransporterNetworks
from kitting_drake.policies.networks.layers.fibres import Regular
from kitting_drake.policies.networks.layers.group_convolution import GroupConv2d
from kitting_drake.policies.networks.methods import make_networks
from kitting_drake.policies.networks.weights import load_networks, save_weights
from kitting_drake.policies.training.training_step import Trainer

N = 12
TINY = NetworkConfig(method="equivariant_transporter", preset="tiny", orientations=N)


def sample() -> LabelledImage:
    image = np.random.default_rng(0).random((4, 49, 65), np.float32)
    return LabelledImage(
        image=image,
        pick=np.array([20.3, 30.6]),
        pick_theta=0.7,
        place=np.array([25.2, 40.1]),
        rotation=2.1,
        other_picks=np.array([[33.0, 12.5]]),
        other_thetas=np.array([1.9]),
    )


def assert_near(found: Tensor, expected: Tensor) -> None:
    assert expected.std() > 0
    assert (found - expected).norm() < 1e-5 * expected.norm()


def test_is_made_by_its_name():
    assert isinstance(make_networks(TINY), EquivariantTransporterNetworks)


@pytest.mark.parametrize("name", ["alpha", "phi", "psi"])
def test_encodings_are_equivariant_to_rotations_by_180_degrees(name: str):
    # Of the rotations of C_6, only those by 0 and 180 degrees need no interpolation on a grid.
    network = getattr(make_networks(TINY), name)
    image = torch.randn(1, 4, 33, 49)
    assert_near(network(image.rot90(2, (2, 3))), network(image).rot90(2, (2, 3)))


@pytest.mark.parametrize("orientations", [4, 12, 36])
def test_angles_are_equivariant_to_rotations_by_90_degrees(orientations: int):
    config = NetworkConfig(TINY.method, "tiny", orientations)
    network = make_networks(config)
    crop = torch.randn(2, 4, PICK_CROP, PICK_CROP)
    with torch.no_grad():
        logits = network.crop_angle_logits(crop, orientations)
        rotated = network.crop_angle_logits(crop.rot90(1, (2, 3)), orientations)
        half = network.crop_angle_logits(crop.rot90(2, (2, 3)), orientations)
    assert logits.shape == (2, orientations // 2)
    assert_near(rotated, logits.roll(orientations // 4, 1))
    assert_near(half, logits)


@pytest.mark.parametrize(
    ("orientations", "count"), [(36, 902_880), (72, 1_805_040), (120, 3_007_920), (180, 4_511_520)]
)
def test_the_paper_s_angle_network_has_the_authors_size(orientations: int, count: int):
    # The authors report 0.90, 1.81, 3.01 and 4.51 million parameters.
    fibre = Regular(orientations, quotient=2)
    network = AngleNet(4, fibre, fibre, PRESETS["paper"].group_angle, GroupConv2d)
    assert sum(weight.numel() for weight in network.parameters()) == count
    convolutions = [name for name, item in network.named_modules() if isinstance(item, GroupConv2d)]
    assert sum("shortcut" not in name for name in convolutions) == 9


@pytest.mark.parametrize("preset", ["small", "tiny"])
def test_parameters_of_the_angle_network_grow_with_n(preset: str):
    def count(orientations: int) -> int:
        fibre = Regular(orientations, quotient=2)
        network = AngleNet(4, fibre, fibre, PRESETS[preset].group_angle, GroupConv2d)
        return sum(weight.numel() for weight in network.parameters())

    assert count(72) - count(36) == pytest.approx((count(180) - count(72)) / 3)
    assert count(180) > 4 * count(36)


def test_predicts_only_at_its_own_n():
    networks = make_networks(TINY)
    image = sample().image
    networks.check_orientations(N)
    picking = networks.predict_pick(image, N)
    assert picking.position.shape == image.shape[1:]
    angles, refined = picking.angle((20, 30))
    assert angles.shape == (N // 2,)
    assert refined is None
    with pytest.raises(ValueError, match="12 orientations"):
        networks.check_orientations(36)
    with pytest.raises(ValueError, match="12 orientations"):
        networks.predict_pick(image, 36).angle((20, 30))


def losses(steps: int) -> list[dict[str, float]]:
    torch.manual_seed(1)
    trainer = Trainer(make_networks(TINY), seed=0, learning_rate=1e-3)
    found = []
    for _ in range(steps):
        # Random draws depend on the step number, so keep it at 0 to move the scene alike each time.
        trainer.step_count = 0
        found.append(trainer.step([sample()]))
    return found


@pytest.mark.slow
def test_learns_a_sample_reproducibly():
    found = losses(5)
    assert set(found[0]) == {"pick_position", "pick_angle", "place"}
    for name in found[0]:
        assert found[-1][name] < found[0][name]
    assert losses(2) == found[:2]


def test_loads_from_a_file_as_plain_convolutions(tmp_path: Path):
    networks = make_networks(TINY).eval()
    path = tmp_path / "policy.safetensors"
    save_weights(path, networks, {})
    loaded = load_networks(path)
    assert loaded.config == TINY
    image = sample().image
    with torch.no_grad():
        for ask in (
            lambda item: item.position_logits(image),
            lambda item: item.predict_angle(image, (20, 30), N).logits,
            lambda item: item.encode_scene(image),
            lambda item: item.encode_crop(image, (20, 30)),
        ):
            assert_near(ask(loaded), ask(networks))
