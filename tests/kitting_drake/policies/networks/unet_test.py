import numpy as np
import pytest
import torch

from kitting_drake.policies.networks.architecture import PRESETS
from kitting_drake.policies.networks.layers.fibres import Fibre, Irreps, Regular
from kitting_drake.policies.networks.layers.steerable import SteerableConv2d
from kitting_drake.policies.networks.unet import UNet
from tests.kitting_drake.policies.equivariance import relative_error, rotate_image, smooth_image

BAND_3 = Irreps((0, 1, 2, 3), samples=8)


def tiny_unet(fibre: Fibre = BAND_3) -> UNet:
    return UNet(4, 3, fibre, PRESETS["tiny"].unet, SteerableConv2d)


def test_has_the_paper_s_size():
    preset = PRESETS["paper"]
    fibre = Irreps((0, 1, 2, 3), preset.samples)
    alpha = UNet(4, 1, fibre, preset.unet, SteerableConv2d)
    parameters = sum(weights.numel() for weights in alpha.parameters())
    assert parameters == pytest.approx(4.54e6, abs=0.005e6)
    layers = [
        name
        for name, module in alpha.named_modules()
        if isinstance(module, SteerableConv2d) and "shortcut" not in name
    ]
    assert len(layers) == 21


@pytest.mark.parametrize("fibre", [BAND_3, Regular(8)], ids=str)
@pytest.mark.parametrize("sides", [(49, 49), (33, 65)])
def test_rotations_by_90_degrees_are_exact(fibre: Fibre, sides: tuple[int, int]):
    network = tiny_unet(fibre)
    image = torch.randn(1, 4, *sides)
    for quarters in (1, 2, 3):
        expected = network(image).rot90(quarters, (2, 3))
        found = network(image.rot90(quarters, (2, 3)))
        assert (found - expected).norm() < 1e-5 * expected.std() * expected.numel() ** 0.5


@pytest.mark.parametrize("samples", [8, 16])
def test_other_rotations_are_nearly_exact(samples: int):
    errors = []
    for seed in range(3):
        torch.manual_seed(seed)
        network = tiny_unet(Irreps((0, 1, 2, 3), samples))
        image = smooth_image(97, seed=seed)
        with torch.no_grad():
            output = network(image)
            errors += [
                relative_error(network(rotate_image(image, degrees)), rotate_image(output, degrees))
                for degrees in (15, 30, 45)
            ]
    # The remaining error comes from the aliasing of four poolings.
    assert np.median(errors) < 0.2
    assert np.max(errors) < 0.3


def test_computes_in_the_type_of_the_image():
    network = tiny_unet()
    image = smooth_image(49)
    with torch.no_grad():
        output, half = network(image), network(image.bfloat16())
    assert half.dtype == torch.float32
    assert relative_error(half, output) < 0.1


@pytest.mark.parametrize("sides", [(48, 49), (49, 50), (32, 32)])
def test_rejects_sides_that_do_not_fit(sides: tuple[int, int]):
    with pytest.raises(ValueError, match="multiple of 16"):
        tiny_unet()(torch.zeros(1, 4, *sides))
