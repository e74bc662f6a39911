import math

import numpy as np
import pytest
import torch
from torch import Tensor

from kitting_drake.policies.networks.angle_net import AngleNet, AngleNetSize
from kitting_drake.policies.networks.architecture import (
    ANGLE_FREQUENCIES,
    PICK_CROP,
    PRESETS,
    NetworkConfig,
)
from kitting_drake.policies.networks.factored import SO2Networks
from kitting_drake.policies.networks.layers.discretization import discretize
from kitting_drake.policies.networks.layers.fibres import Irreps
from kitting_drake.policies.networks.layers.steerable import SteerableConv2d
from tests.kitting_drake.policies.equivariance import rotate_image, smooth_image

MEAN = AngleNetSize(stages=((4,), (6,), (6,), (6,)), kernel=3, readout=3)
"""A size with which the last layer's output is averaged over its pixels, as in the paper."""
WHOLE = PRESETS["tiny"].angle
"""A size with which the last layer's kernel covers the whole feature map."""


def angle_net(frequencies: tuple[int, ...], size: AngleNetSize = WHOLE) -> AngleNet:
    hidden = Irreps((0, 1, 2, 3), samples=8)
    return AngleNet(4, hidden, Irreps(frequencies), size, SteerableConv2d)


def rho(frequencies: tuple[int, ...], degrees: float) -> Tensor:
    """The matrix rho_irrep of a rotation, from equations 1 and 4."""
    blocks = []
    for j in frequencies:
        cos, sin = (f(j * math.radians(degrees)) for f in (math.cos, math.sin))
        blocks.append(torch.tensor([[cos, -sin], [sin, cos]]) if j else torch.ones(1, 1))
    return torch.block_diag(*blocks)


@pytest.mark.parametrize(
    ("size", "frequencies"),
    [
        pytest.param(MEAN, (0, 1, 2, 3), id="mean"),
        pytest.param(WHOLE, (0, 2, 4, 6), id="whole"),
        pytest.param(MEAN, (0, 2, 4, 6), id="mean of even ones", marks=pytest.mark.slow),
        pytest.param(WHOLE, (0, 1, 2, 3), id="whole of all", marks=pytest.mark.slow),
    ],
)
def test_rotations_by_90_degrees_are_exact(size: AngleNetSize, frequencies: tuple[int, ...]):
    network = angle_net(frequencies, size)
    crop = torch.randn(1, 4, PICK_CROP, PICK_CROP)
    output = network(crop)
    for degrees in (90, 180, 270):
        expected = output @ rho(frequencies, degrees).T
        found = network(rotate_image(crop, degrees))
        assert (found - expected).norm() < 1e-5 * output.norm()


def test_bins_shift_with_the_crop_modulo_pi():
    network = angle_net(ANGLE_FREQUENCIES)
    crop = torch.randn(1, 4, PICK_CROP, PICK_CROP)

    def bins(degrees: int) -> Tensor:
        return discretize(network(rotate_image(crop, degrees)), 36, ANGLE_FREQUENCIES, quotient=2)[
            0
        ]

    logits = bins(0)
    assert logits.shape == (18,)
    assert logits.std() > 1e-3
    tolerance = 1e-5 * float(logits.detach().abs().max())
    torch.testing.assert_close(bins(90), logits.roll(9), atol=tolerance, rtol=0)
    torch.testing.assert_close(bins(180), logits, atol=tolerance, rtol=0)


@pytest.mark.parametrize(
    ("frequencies", "median", "most"), [((0, 2, 4, 6), 0.25, 0.4), (ANGLE_FREQUENCIES, 0.4, 0.5)]
)
def test_other_rotations_are_nearly_exact(frequencies: tuple[int, ...], median: float, most: float):
    errors = []
    for seed in range(2):
        torch.manual_seed(seed)
        network = angle_net(frequencies)
        crop = smooth_image(PICK_CROP, seed=seed)
        with torch.no_grad():
            output = network(crop)
            for degrees in (10, 30, 45):
                expected = output @ rho(frequencies, degrees).T
                found = network(rotate_image(crop, degrees))
                errors.append(float((found - expected).norm() / expected.norm()))
    # The bounds depend on the frequencies: high frequencies are less exact on a pixel grid.
    assert np.median(errors) < median
    assert np.max(errors) < most


@pytest.mark.parametrize("preset", ["tiny", "small", pytest.param("paper", marks=pytest.mark.slow)])
def test_every_output_frequency_is_used(preset: str):
    networks = SO2Networks(NetworkConfig(preset=preset))
    crop = torch.randn(1, 4, PICK_CROP, PICK_CROP)
    with torch.no_grad():
        output = networks.beta(crop)[0].numpy()
    sizes = [np.hypot(*output[i : i + 2]) for i in range(1, len(output), 2)]
    assert min(sizes) > 1e-3 * max(sizes)


def test_parameters_and_weights_do_not_depend_on_n():
    few, many = (SO2Networks(NetworkConfig(preset="tiny", orientations=n)) for n in (36, 720))
    many.load_state_dict(few.state_dict())
    image = np.random.default_rng(0).random((4, 80, 80), np.float32)
    coarse = few.predict_angle(image, (40, 40), 36).logits
    fine = many.predict_angle(image, (40, 40), 720).logits
    tolerance = 1e-5 * float(fine.detach().abs().max())
    torch.testing.assert_close(coarse, fine[::20], atol=tolerance, rtol=0)
