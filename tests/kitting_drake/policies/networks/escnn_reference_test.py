import itertools

import pytest
import torch
from torch import Tensor, nn

from kitting_drake.policies.networks.architecture import NetworkConfig
from kitting_drake.policies.networks.escnn_reference import as_escnn
from kitting_drake.policies.networks.factored import Networks, SO2Networks
from kitting_drake.policies.networks.layers.planar_escnn import enn
from kitting_drake.policies.networks.layers.steerable import SteerableConv2d
from kitting_drake.policies.networks.methods import make_networks


@pytest.fixture(scope="module")
def both() -> tuple[Networks, Networks]:
    """Our networks with nonzero biases, and escnn's with the same weights."""
    torch.manual_seed(0)
    ours = make_networks(NetworkConfig(preset="tiny"))
    assert isinstance(ours, SO2Networks)
    for name, weight in ours.named_parameters():
        if name.endswith("bias"):
            nn.init.normal_(weight)
    return ours, as_escnn(ours)


def layers(network: nn.Module, kind: type[nn.Module]) -> list[nn.Module]:
    return [module for module in network.modules() if isinstance(module, kind)]


def assert_close(found: Tensor, expected: Tensor) -> None:
    """Equal up to float32 rounding in about thirty layers."""
    scale = float(expected.detach().abs().max())
    torch.testing.assert_close(found, expected, atol=1e-5 * scale, rtol=0)


@pytest.mark.parametrize(
    ("name", "sides"),
    [("alpha", (33, 49)), ("phi", (17, 33)), ("psi", (33, 33)), ("beta", (65, 65))],
)
def test_is_the_same_network(name: str, sides: tuple[int, int], both: tuple[Networks, Networks]):
    ours, escnn = (networks.get_submodule(name) for networks in both)
    image = torch.randn(2, 4, *sides)
    expected, found = escnn(image), ours(image)
    assert found.shape == expected.shape
    assert expected.std() > 0.01
    assert_close(found, expected)

    # Both networks have the same gradient for every weight.
    (expected**2).sum().backward()
    (found**2).sum().backward()
    pairs = list(zip(layers(ours, SteerableConv2d), layers(escnn, enn.R2Conv), strict=True))
    for one, other in pairs:
        assert_close(one.weights.grad.flatten(), other.weights.grad)
        assert (one.bias is None) == (other.bias is None)
        if one.bias is not None:
            assert_close(one.bias.grad, other.bias.grad)
    # Neither network has parameters outside these layers.
    for network, kind in ((ours, SteerableConv2d), (escnn, enn.R2Conv)):
        weights = itertools.chain.from_iterable(
            layer.parameters(recurse=False) for layer in layers(network, kind)
        )
        assert {id(weight) for weight in weights} == {id(item) for item in network.parameters()}


def test_inference_gives_the_same(both: tuple[Networks, Networks]):
    ours, escnn = both
    assert isinstance(ours, SO2Networks)
    image = torch.randn(1, 4, 33, 33)
    with torch.inference_mode():
        expected = ours.alpha(image)
        assert_close(escnn.alpha.eval()(image), expected)
        escnn.alpha.train()


@pytest.mark.slow
def test_inference_with_half_the_bits_is_near(both: tuple[Networks, Networks]):
    ours, _ = both
    assert isinstance(ours, SO2Networks)
    image = torch.randn(1, 4, 33, 33)
    with torch.inference_mode():
        expected = ours.alpha(image)
        half = as_escnn(ours, torch.bfloat16).eval().alpha(image)
    assert half.dtype == torch.float32
    difference = float((half - expected).std() / expected.std())
    # bfloat16 has eight bits of precision, so the output differs, but little.
    assert 1e-4 < difference < 0.1


def test_supports_only_fibres_of_so2():
    networks = make_networks(NetworkConfig("equivariant_transporter", "tiny", 36))
    with pytest.raises(ValueError, match=r"SO\(2\)"):
        as_escnn(networks)  # type: ignore[arg-type]
