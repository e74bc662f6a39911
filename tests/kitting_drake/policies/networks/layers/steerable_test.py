import numpy as np
import pytest
import torch
import torch.nn.functional as F
from scipy.linalg import block_diag
from torch import Tensor

from kitting_drake.policies.networks.layers.fibres import Fibre, Irreps, Regular, Scalar
from kitting_drake.policies.networks.layers.planar_escnn import enn, gspaces
from kitting_drake.policies.networks.layers.steerable import (
    BandLimit,
    BlurPool,
    InvariantPart,
    PlainConv2d,
    SteerableConv2d,
    expand_kernel,
    upsample,
)
from tests.kitting_drake.policies.equivariance import relative_error, rotate_image, smooth_image

FREQUENCIES = (0, 1, 2, 3)
SAMPLES = Irreps(FREQUENCIES, samples=8)


def random_features(*shape: int) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(0))


def rotate_by_90(features: Tensor) -> Tensor:
    """Rotates the grid of pixels by 90 degrees, but does not transform the fields in the pixels."""
    return features.rot90(1, (2, 3))


def rotate_fields(features: Tensor, fibre: Fibre, degrees: float = 90) -> Tensor:
    """Transforms the channels of each field by a rotation, but does not move the pixels."""
    if isinstance(fibre, Irreps):
        blocks = []
        for j in fibre.frequencies:
            cos, sin = (f(j * np.radians(degrees)) for f in (np.cos, np.sin))
            blocks.append(np.array([[cos, -sin], [sin, cos]]) if j else np.ones((1, 1)))
        matrix = fibre.synthesis() @ block_diag(*blocks) @ fibre.analysis()
    elif isinstance(fibre, Regular):
        matrix = np.roll(np.eye(fibre.channels), int(fibre.order * degrees) // 360, axis=0)
    else:
        matrix = np.eye(1)
    representation = torch.from_numpy(matrix).float()
    fields = features.unflatten(1, (-1, fibre.channels))
    return torch.einsum("ab,nfbxy->nfaxy", representation, fields).flatten(1, 2)


@pytest.mark.parametrize(
    ("fibre_in", "fibre_out", "size"),
    [
        (Scalar(), SAMPLES, 7),
        (SAMPLES, SAMPLES, 3),
        (SAMPLES, Irreps((0, 2, 4)), 3),
        (SAMPLES, Scalar(), 3),
        (Scalar(), Regular(4), 7),
        (Regular(8), Regular(8), 3),
        (Regular(8), Regular(8, quotient=2), 3),
    ],
    ids=str,
)
def test_rotations_by_90_degrees_are_exact(fibre_in: Fibre, fibre_out: Fibre, size: int):
    layer = SteerableConv2d(2, fibre_in, 3, fibre_out, size)
    features = BandLimit(fibre_in, 2)(random_features(1, 2 * fibre_in.channels, 11, 13))
    expected = rotate_fields(rotate_by_90(layer(features)), fibre_out)
    found = layer(rotate_fields(rotate_by_90(features), fibre_in))
    torch.testing.assert_close(found, expected, atol=1e-5, rtol=1e-5)
    # If all outputs were zero, their equality would prove nothing.
    assert expected.std() > 0.1


@pytest.mark.parametrize("degrees", [15, 45, 100])
@pytest.mark.parametrize(
    ("fibre_in", "fibre_out"),
    [(Scalar(), SAMPLES), (SAMPLES, SAMPLES), (SAMPLES, Irreps((0, 2, 4)))],
    ids=str,
)
def test_other_rotations_are_nearly_exact(fibre_in: Fibre, fibre_out: Fibre, degrees: int):
    layer = SteerableConv2d(1, fibre_in, 2, fibre_out, 5)
    features = BandLimit(fibre_in, 1)(smooth_image(65, channels=fibre_in.channels))
    expected = rotate_fields(rotate_image(layer(features), degrees), fibre_out, degrees)
    found = layer(rotate_fields(rotate_image(features, degrees), fibre_in, degrees))
    assert relative_error(found.detach(), expected.detach()) < 0.05


@pytest.mark.parametrize(("samples", "tolerance"), [(8, 0.25), (12, 0.05), (16, 0.02)])
def test_the_nonlinearity_is_nearly_equivariant(samples: int, tolerance: float):
    fibre = Irreps(FREQUENCIES, samples)
    limit = BandLimit(fibre, 1)
    features = limit(smooth_image(33, channels=samples))
    for degrees in (5, 10, 22.5, 30):
        expected = rotate_fields(limit(F.elu(features)), fibre, degrees)
        found = limit(F.elu(rotate_fields(features, fibre, degrees)))
        assert relative_error(found, expected) < tolerance


def escnn_layers(fields: int) -> tuple[enn.R2Conv, enn.FourierELU, enn.R2Conv]:
    space = gspaces.rot2dOnR2(-1, maximum_frequency=3)
    elu = enn.FourierELU(
        space, fields, [(j,) for j in FREQUENCIES], inplace=False, type="regular", N=8
    )
    image = enn.FieldType(space, 2 * [space.trivial_repr])
    first = enn.R2Conv(image, elu.in_type, 5, padding=2, bias=False)
    return first, elu, enn.R2Conv(elu.out_type, elu.in_type, 3, padding=1, bias=False)


def copy_weights(source: enn.R2Conv, target: SteerableConv2d) -> None:
    """Copies the weights of an escnn layer, which are in the same order as ours."""
    with torch.no_grad():
        target.weights.copy_(source.weights.view_as(target.weights))


def test_two_layers_equal_those_of_escnn():
    reference_first, reference_elu, reference_second = escnn_layers(fields=3)
    first = SteerableConv2d(2, Scalar(), 3, SAMPLES, 5)
    second = SteerableConv2d(3, SAMPLES, 3, SAMPLES, 3)
    copy_weights(reference_first, first)
    copy_weights(reference_second, second)
    image = random_features(2, 2, 15, 17)

    hidden = reference_elu(reference_first(enn.GeometricTensor(image, reference_first.in_type)))
    expected = reference_elu(reference_second(hidden)).tensor
    found = F.elu(second(F.elu(first(image))))

    analysis = torch.from_numpy(SAMPLES.analysis()).float()
    coefficients = torch.einsum("fs,nksxy->nkfxy", analysis, found.unflatten(1, (3, 8)))
    torch.testing.assert_close(coefficients.flatten(1, 2), expected, atol=1e-5, rtol=1e-5)
    assert expected.std() > 0.1
    # escnn's layer ends with a projection onto the irreps, as `BandLimit` does.
    synthesis = torch.from_numpy(SAMPLES.synthesis()).float()
    limited = torch.einsum("sf,nkfxy->nksxy", synthesis, expected.unflatten(1, (3, 7)))
    torch.testing.assert_close(
        BandLimit(SAMPLES, 3)(found), limited.flatten(1, 2), atol=1e-5, rtol=0
    )
    torch.testing.assert_close(
        InvariantPart(SAMPLES, 3)(found), expected.unflatten(1, (3, 7))[:, :, 0], atol=1e-5, rtol=0
    )


@pytest.mark.parametrize("samples", [8, 16, 32])
def test_the_initial_gain_does_not_depend_on_the_samples(samples: int):
    fibre = Irreps(FREQUENCIES, samples)
    layer = SteerableConv2d(32, fibre, 32, fibre, 3)
    features = BandLimit(fibre, 32)(random_features(1, 32 * samples, 32, 32))
    # He initialisation has a gain of sqrt(2), which makes up for the nonlinearity.
    gain = float(layer(features).detach().std() / features.std())
    assert gain == pytest.approx(2**0.5, rel=0.1)


@pytest.mark.parametrize("bias", [False, True])
def test_converts_to_a_plain_layer(bias: bool):
    layer = SteerableConv2d(2, SAMPLES, 3, SAMPLES, 3, bias=bias)
    plain = PlainConv2d(2, SAMPLES, 3, SAMPLES, 3, bias=bias)
    state = {"weight": layer.kernel()}
    if bias:
        torch.nn.init.normal_(layer.bias)
        state["bias"] = layer.channel_bias()
    plain.load_state_dict(state)
    features = random_features(1, 16, 9, 11)
    torch.testing.assert_close(plain(features), layer(features), atol=1e-5, rtol=0)
    before = {name: value.clone() for name, value in plain.state_dict().items()}
    half = plain(features.bfloat16())
    assert half.dtype == torch.bfloat16
    torch.testing.assert_close(half.float(), layer(features), atol=0.05, rtol=0.05)
    # The computation in bfloat16 did not change the layer's weights.
    for name, value in plain.state_dict().items():
        assert value.dtype == torch.float32
        assert torch.equal(value, before[name])


def test_fibres_of_different_groups_are_rejected():
    for pair in [(SAMPLES, Regular(4)), (Regular(4), Regular(6))]:
        with pytest.raises(ValueError, match="their groups differ"):
            SteerableConv2d(1, pair[0], 1, pair[1], 3)


@pytest.mark.parametrize("sides", [(9, 9), (17, 33), (5, 3)])
def test_resampling_is_equivariant_to_rotations_by_90_degrees(sides: tuple[int, int]):
    features = random_features(1, 2, *sides)
    pool = BlurPool()
    halved = pool(features)
    assert halved.shape[2:] == tuple((side + 1) // 2 for side in sides)
    assert upsample(halved).shape == features.shape
    for function in (pool, upsample):
        torch.testing.assert_close(
            function(rotate_by_90(features)), rotate_by_90(function(features)), atol=1e-6, rtol=0
        )


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_gradients_of_resampling_equal_those_of_plain_operations(dtype: torch.dtype):
    features = random_features(1, 3, 9, 17).to(dtype)
    pool = BlurPool()
    kernel = pool.kernel.expand(3, 1, 5, 5)

    def plain_pool(features: torch.Tensor) -> torch.Tensor:
        return F.conv2d(features, kernel, stride=2, padding=2, groups=3)

    def plain_upsample(features: torch.Tensor) -> torch.Tensor:
        return F.interpolate(features, size=(17, 33), mode="bilinear", align_corners=True)

    for function, plain in ((pool, plain_pool), (upsample, plain_upsample)):
        wanted = torch.randn(plain(features.float()).shape)
        gradients = []
        for way, precision in ((function, dtype), (plain, torch.float32)):
            leaf = features.clone().to(precision).requires_grad_()
            # Because of the concatenation, the incoming gradient is a slice of a larger tensor.
            output = torch.cat([way(leaf), way(leaf.detach())], dim=1)
            output.backward(torch.cat([wanted, wanted], dim=1).to(precision))
            gradients.append(leaf.grad.float())
        tolerance = 1e-5 if dtype == torch.float32 else 0.03
        torch.testing.assert_close(*gradients, atol=tolerance, rtol=tolerance)


def test_pooling_keeps_constants_and_removes_chequers():
    chequers = (-1.0) ** (torch.arange(33)[:, None] + torch.arange(33))
    inside = (slice(None), slice(None), slice(1, -1), slice(1, -1))
    pool = BlurPool()
    torch.testing.assert_close(pool(torch.ones(1, 1, 33, 33))[inside], torch.ones(1, 1, 15, 15))
    assert pool(chequers[None, None])[inside].abs().max() < 0.1


def test_upsampling_is_exact_for_a_plane():
    row, col = torch.meshgrid(torch.arange(9.0), torch.arange(5.0), indexing="ij")
    plane = (2 * row - col)[None, None]
    torch.testing.assert_close(upsample(plane[:, :, ::2, ::2]), plane)


def test_expand_kernel_works_for_any_basis():
    weights, basis = torch.randn(2, 3, 5), torch.randn(5, 4, 6, 3, 3)
    kernel = expand_kernel(weights, basis)
    assert kernel.shape == (8, 18, 3, 3)
    expected = (weights[1, 2, :, None, None, None, None] * basis).sum(0)
    torch.testing.assert_close(kernel[4:8, 12:18], expected)
    assert kernel.is_contiguous(memory_format=torch.channels_last)
    cast = expand_kernel(weights, basis, torch.bfloat16)
    torch.testing.assert_close(cast, kernel.bfloat16(), atol=0, rtol=0)
