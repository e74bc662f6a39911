import pytest
import torch
from torch import Tensor

from kitting_drake.policies.networks.layers.fibres import Fibre, Irreps, Regular, Scalar
from kitting_drake.policies.networks.layers.group_convolution import GroupConv2d
from kitting_drake.policies.networks.layers.steerable import PlainConv2d, kernel_basis

QUOTIENT = Regular(8, quotient=2)


def kernels(layer: GroupConv2d) -> Tensor:
    """The layer's kernels for each of the D unit vectors of weights, as an array (D, entries)."""
    count = layer.weights.shape[-1]
    rows = []
    with torch.no_grad():
        for index in range(count):
            layer.weights.copy_(torch.eye(count)[index])
            rows.append(layer.kernel().flatten().double())
    return torch.stack(rows)


@pytest.mark.parametrize("direction", ["lift", "between", "project"])
@pytest.mark.parametrize(
    ("fibre", "size"),
    [(Regular(6), 3), (Regular(4), 5), (QUOTIENT, 5), (Regular(6, quotient=2), 7)],
    ids=str,
)
def test_spans_the_kernels_of_escnn(fibre: Regular, size: int, direction: str):
    pair: tuple[Fibre, Fibre] = {
        "lift": (Scalar(), fibre),
        "between": (fibre, fibre),
        "project": (fibre, Scalar()),
    }[direction]
    ours = kernels(GroupConv2d(1, pair[0], 1, pair[1], size))
    escnn = kernel_basis(*pair, size).flatten(1)
    assert len(ours) == len(escnn)
    together = torch.cat([ours, escnn])
    ranks = [int(torch.linalg.matrix_rank(rows, tol=1e-4)) for rows in (ours, escnn, together)]
    assert ranks == [len(ours)] * 3


def rotate(features: Tensor, fibre: Fibre) -> Tensor:
    """A feature field rotated by 90 degrees (equation 2): both the image and the fields."""
    fields = features.rot90(1, (2, 3)).unflatten(1, (-1, fibre.channels))
    if isinstance(fibre, Regular):
        fields = fields.roll(fibre.order // 4, 2)
    return fields.flatten(1, 2)


@pytest.mark.parametrize("group", [QUOTIENT, Regular(12), Regular(180, quotient=2)], ids=str)
@pytest.mark.parametrize("direction", ["lift", "between", "project"])
def test_rotations_by_90_degrees_are_exact(group: Regular, direction: str):
    pair: tuple[Fibre, Fibre] = {
        "lift": (Scalar(), group),
        "between": (group, group),
        "project": (group, Scalar()),
    }[direction]
    layer = GroupConv2d(2, pair[0], 3, pair[1], 5, bias=True)
    assert layer.bias is not None
    torch.nn.init.normal_(layer.bias)
    features = torch.randn(1, 2 * pair[0].channels, 9, 11)
    expected = rotate(layer(features), pair[1])
    torch.testing.assert_close(layer(rotate(features, pair[0])), expected, atol=1e-5, rtol=1e-5)
    assert expected.std() > 0.1


def test_initial_features_have_the_scale_of_the_input():
    fibre = Regular(36, quotient=2)
    layer = GroupConv2d(4, fibre, 8, fibre, 3)
    features = torch.randn(1, 4 * 18, 32, 32)
    assert 0.5 < layer(features).std() / features.std() < 2


@pytest.mark.parametrize("bias", [False, True])
def test_converts_to_a_plain_layer(bias: bool):
    layer = GroupConv2d(2, QUOTIENT, 3, QUOTIENT, 3, padding=0, bias=bias)
    plain = PlainConv2d(2, QUOTIENT, 3, QUOTIENT, 3, padding=0, bias=bias)
    state = {"weight": layer.kernel()}
    if layer.bias is not None:
        torch.nn.init.normal_(layer.bias)
        state["bias"] = layer.channel_bias()
    plain.load_state_dict(state)
    features = torch.randn(1, 8, 9, 11)
    torch.testing.assert_close(plain(features), layer(features), atol=1e-5, rtol=0)


def test_the_number_of_weights_is_proportional_to_the_group():
    def count(order: int) -> int:
        fibre = Regular(order, quotient=2)
        return GroupConv2d(3, fibre, 5, fibre, 7).weights.numel()

    # escnn's basis has ten circular harmonics of even order on kernels of seven pixels.
    assert [count(order) for order in (36, 72, 180)] == [3 * 5 * 10 * m for m in (18, 36, 90)]


def test_supports_only_fields_of_one_group_and_scalars():
    for pair in [
        (Regular(6), Regular(4)),
        (Regular(6), Regular(6, quotient=2)),
        (Scalar(), Scalar()),
        (Irreps((0, 1)), Regular(6)),
        (Scalar(), Irreps((0, 1))),
    ]:
        with pytest.raises(ValueError, match="GroupConv2d"):
            GroupConv2d(1, pair[0], 1, pair[1], 3)
