"""Steerable convolutions, computed as plain convolutions.

A kernel is a linear combination of escnn's basis kernels. The Fourier transforms before and after a
pointwise nonlinearity are folded into the kernels,

    kernel' = synthesis_out . kernel . analysis_in.

Feature maps are therefore stored as samples, and ELU acts on them directly. With the same weights
this is the same function as escnn's R2Conv followed by FourierELU.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from kitting_drake.policies.networks.layers.fibres import Fibre, Irreps, Regular, Scalar

Convolution = Callable[..., nn.Module]
"""A layer class: `SteerableConv2d`, `GroupConv2d` or `PlainConv2d`, called with
(in_fields, in_fibre, out_fields, out_fibre, size, padding=..., bias=..., gain=...)."""


_TOGETHER = 64
"""The largest number of channels that `BandLimit` and `InvariantPart` combine in one product."""


class ExpandedConv2d(nn.Module):
    """A trainable convolution between fields. Its kernel is a linear combination of a basis."""

    basis: Tensor

    def __init__(
        self,
        in_fields: int,
        in_fibre: Fibre,
        out_fields: int,
        out_fibre: Fibre,
        size: int,
        *,
        padding: int | None = None,
        bias: bool = False,
        gain: float = 1.0,
    ) -> None:
        """
        Args:
            in_fields: the number of input fields.
            in_fibre: the fibre of each input field.
            out_fields: the number of output fields.
            out_fibre: the fibre of each output field.
            size: the side of the kernel, odd, in pixels.
            padding: zero padding, in pixels; by default the image keeps its size.
            bias: whether to add a trainable bias to the invariant part of each output field. With
                a bias, the output fibre must be scalar or regular, or be stored as samples.
            gain: a factor of the initial weights' standard deviation.

        Raises:
            ValueError: there are no such kernels between the fibres.
        """
        super().__init__()
        self.in_fibre, self.out_fibre = in_fibre, out_fibre
        self.padding = size // 2 if padding is None else padding
        basis, taps, scale = self._make_basis(in_fields, size)
        self.weights = nn.Parameter(torch.randn(out_fields, in_fields, taps) * (gain * scale))
        self.bias = nn.Parameter(torch.zeros(out_fields)) if bias else None
        self.register_buffer("basis", basis, persistent=False)

    def _make_basis(self, in_fields: int, size: int) -> tuple[Tensor, int, float]:
        """Returns the basis, the number of weights between two fields, and the initial standard
        deviation of the weights (He initialisation)."""
        raise NotImplementedError

    def kernel(self, dtype: torch.dtype = torch.float32) -> Tensor:
        """Returns the expanded kernel (out channels, in channels, size, size), in the memory format
        channels_last."""
        raise NotImplementedError

    def fit(self, kernel: Tensor) -> None:
        """Sets the weights so that the layer has a given expanded kernel.

        Args:
            kernel: a kernel with the shape of `kernel()` that lies in the span of the basis.
        """
        raise NotImplementedError

    def channel_bias(self) -> Tensor | None:
        """Returns the bias (out channels,) of each channel; None if the layer has no bias."""
        return None if self.bias is None else self.bias.repeat_interleave(self.out_fibre.channels)

    def forward(self, features: Tensor) -> Tensor:
        """Maps (batch, in channels, rows, cols) to (batch, out channels, rows, cols)."""
        bias = self.channel_bias()
        return F.conv2d(
            features,
            self.kernel(features.dtype),
            None if bias is None else bias.to(features.dtype),
            padding=self.padding,
        )


class SteerableConv2d(ExpandedConv2d):
    """An equivariant convolution between fields (equation 3), in escnn's basis of kernels."""

    def _make_basis(self, in_fields: int, size: int) -> tuple[Tensor, int, float]:
        kind = torch.get_default_dtype()
        basis, squares = _shared_basis(self.in_fibre, self.out_fibre, size, kind)
        # The samples of a field are correlated, because they are computed from fewer coefficients.
        # Their weighted sums therefore vary more.
        repeated = self.in_fibre.channels / self.in_fibre.size
        gathered = in_fields * squares * repeated / self.out_fibre.channels
        return basis, len(basis), math.sqrt(2 / gathered)

    def kernel(self, dtype: torch.dtype = torch.float32) -> Tensor:
        return expand_kernel(self.weights, self.basis, dtype)

    @torch.no_grad()
    def fit(self, kernel: Tensor) -> None:
        out_fields, in_fields = self.weights.shape[:2]
        out_channels, in_channels = self.out_fibre.channels, self.in_fibre.channels
        blocks = kernel.reshape(out_fields, out_channels, in_fields, in_channels, *kernel.shape[2:])
        targets = blocks.transpose(1, 2).flatten(2).flatten(0, 1).double()
        found = torch.linalg.lstsq(self.basis.flatten(1).double().T, targets.T).solution
        self.weights.copy_(found.T.reshape(self.weights.shape))


def expand_kernel(weights: Tensor, basis: Tensor, dtype: torch.dtype = torch.float32) -> Tensor:
    """Expands weights in a basis to a plain kernel.

    Args:
        weights: (out fields, in fields, D).
        basis: (D, out channels, in channels, size, size), from one field to one field.
        dtype: the type of the kernel.

    Returns:
        (out fields * out channels, in fields * in channels, size, size), in channels_last.
    """
    out_fields, in_fields, _ = weights.shape
    _, out_channels, in_channels, size, _ = basis.shape
    kernel = weights.flatten(0, 1) @ basis.permute(0, 1, 3, 4, 2).flatten(1)
    # Casting before the fields are interleaved is cheaper.
    kernel = kernel.to(dtype)
    kernel = kernel.view(out_fields, in_fields, out_channels, size, size, in_channels)
    kernel = kernel.permute(0, 2, 3, 4, 1, 5).reshape(
        out_fields * out_channels, size, size, in_fields * in_channels
    )
    return kernel.permute(0, 3, 1, 2)


class PlainConv2d(nn.Conv2d):
    """A plain convolution with the expanded kernel of an `ExpandedConv2d`, for inference.

    It computes in the type of its input and casts its weights at every call if necessary.
    `MixedPrecision.cast` casts them once.
    """

    def __init__(
        self,
        in_fields: int,
        in_fibre: Fibre,
        out_fields: int,
        out_fibre: Fibre,
        size: int,
        *,
        padding: int | None = None,
        bias: bool = False,
        gain: float = 1.0,
    ) -> None:
        super().__init__(
            in_fields * in_fibre.channels,
            out_fields * out_fibre.channels,
            size,
            padding=size // 2 if padding is None else padding,
            bias=bias,
        )

    def forward(self, features: Tensor) -> Tensor:
        """Maps (batch, in channels, rows, cols) to (batch, out channels, rows, cols)."""
        weight = self.weight.to(features.dtype)
        bias = None if self.bias is None else self.bias.to(features.dtype)
        return F.conv2d(features, weight, bias, padding=self.padding)


@functools.lru_cache(maxsize=64)
@torch.inference_mode(False)
def _shared_basis(
    in_fibre: Fibre, out_fibre: Fibre, size: int, dtype: torch.dtype
) -> tuple[Tensor, float]:
    """Makes the basis that all layers between two fibres share.

    Returns:
        (D, out channels, in channels, size, size): the basis, in the memory order that
            `expand_kernel` needs.
        The sum of the squares of the basis's entries.
    """
    basis = kernel_basis(in_fibre, out_fibre, size)
    order = basis.permute(0, 1, 3, 4, 2).to(dtype).contiguous()
    return order.permute(0, 1, 4, 2, 3), float(basis.square().sum())


@functools.lru_cache(maxsize=64)
# escnn caches tensors that are also used outside inference mode, so switch that mode off here.
@torch.inference_mode(False)
def kernel_basis(in_fibre: Fibre, out_fibre: Fibre, size: int) -> Tensor:
    """Returns escnn's basis of the steerable kernels between two fibres, with the Fourier
    transforms folded in.

    Returns:
        (D, out channels, in channels, size, size), float64.
    """
    # Shipped weights include their kernel bases, so inference does not import escnn.
    from kitting_drake.policies.networks.layers.planar_escnn import enn, gspaces

    orders = {fibre.order for fibre in (in_fibre, out_fibre) if isinstance(fibre, Regular)}
    irreps = [fibre for fibre in (in_fibre, out_fibre) if isinstance(fibre, Irreps)]
    if len(orders) > 1 or (orders and irreps):
        raise ValueError(f"no kernels map {in_fibre} to {out_fibre}: their groups differ")
    if orders:
        space = gspaces.rot2dOnR2(orders.pop())
    else:
        band = max((max(fibre.frequencies) for fibre in irreps), default=0)
        space = gspaces.rot2dOnR2(-1, maximum_frequency=max(band, 1))

    def field(fibre: Fibre) -> enn.FieldType:
        if isinstance(fibre, Scalar):
            return enn.FieldType(space, [space.trivial_repr])
        if isinstance(fibre, Irreps):
            irreps = [(j,) for j in fibre.frequencies]
            return enn.FieldType(
                space, [space.fibergroup.spectral_regular_representation(*irreps, name=None)]
            )
        assert isinstance(fibre, Regular)
        if fibre.quotient == 1:
            return enn.FieldType(space, [space.regular_repr])
        return enn.FieldType(space, [space.quotient_repr(fibre.quotient)])

    convolution = enn.R2Conv(
        field(in_fibre),
        field(out_fibre),
        size,
        bias=False,
        initialize=False,
        frequencies_cutoff=frequencies_cutoff(in_fibre, out_fibre, size),
    )
    with torch.no_grad():
        # Unit vectors of weights give the basis kernels one by one.
        units = torch.eye(convolution.weights.numel())
        stack = torch.vmap(convolution.basisexpansion)(units).unflatten(-1, (size, size)).double()
    synthesis = torch.from_numpy(out_fibre.synthesis())
    analysis = torch.from_numpy(in_fibre.analysis())
    return torch.einsum("ms,dstxy,tn->dmnxy", synthesis, stack, analysis).contiguous()


def frequencies_cutoff(in_fibre: Fibre, out_fibre: Fibre, size: int) -> float | None:
    """Returns the largest angular frequency of kernels on a ring of pixels, divided by its radius.

    A kernel of angular frequency k maps rho_i to rho_j with j up to i + k. With escnn's own limit,
    the highest output frequencies may be unreachable and so always zero. The limit is then raised
    to the value that these frequencies need on the outermost ring. A larger limit would cause
    aliasing there.

    Returns:
        The limit; None for escnn's own limit.
    """
    if not (isinstance(in_fibre, Irreps) and isinstance(out_fibre, Irreps)):
        return None
    missing = max(out_fibre.frequencies) - max(in_fibre.frequencies)
    radius = size // 2
    if missing > 0 and not radius:
        raise ValueError(
            "a kernel of one pixel cannot map to higher frequencies: use a larger kernel"
        )
    return missing / radius if missing > radius else None


class MixedPrecision(nn.Module):
    """A network that computes in the type of its input, except for some parts in float32."""

    def reduced_precision_parts(self) -> Iterator[nn.Module]:
        """Returns the submodules that compute in the type of the input."""
        raise NotImplementedError

    def cast(self, compute_type: torch.dtype) -> None:
        """Casts the submodules of `reduced_precision_parts` permanently to the type of the
        inputs."""
        for part in self.reduced_precision_parts():
            part.to(compute_type).to(memory_format=torch.channels_last)  # type: ignore[call-overload]


class BandLimit(nn.Module):
    """Projects the samples of each field onto its irreps, because ELU adds higher frequencies."""

    projection: Tensor

    def __init__(self, fibre: Fibre, fields: int) -> None:
        super().__init__()
        projection = fibre.synthesis() @ fibre.analysis()
        self.trivial = bool(np.allclose(projection, np.eye(len(projection))))
        self.register_buffer("projection", _of_several_fields(projection, fields), persistent=False)

    def forward(self, features: Tensor) -> Tensor:
        """Maps (batch, fields * channels, rows, cols) to the same shape."""
        return features if self.trivial else _multiply_fields(features, self.projection)


class InvariantPart(nn.Module):
    """Takes the rotation-invariant part of each field, which is its frequency 0."""

    functional: Tensor

    def __init__(self, fibre: Fibre, fields: int) -> None:
        super().__init__()
        functional = fibre.invariant()[:, None]
        self.register_buffer("functional", _of_several_fields(functional, fields), persistent=False)

    def forward(self, features: Tensor) -> Tensor:
        """Maps (batch, fields * channels, rows, cols) to (batch, fields, rows, cols)."""
        return _multiply_fields(features, self.functional)


def _of_several_fields(matrix: NDArray[np.float64], fields: int) -> Tensor:
    """Returns the block-diagonal matrix that applies a matrix to each of several fields.

    The matrix combines about 64 channels. Although most of its entries are zero, one product with
    it takes half as long as several products with eight channels each.
    """
    together = math.gcd(fields, max(_TOGETHER // len(matrix), 1))
    blocks = np.kron(np.eye(together), matrix)
    return torch.from_numpy(blocks).to(torch.get_default_dtype())


def _multiply_fields(features: Tensor, matrix: Tensor) -> Tensor:
    """Multiplies the channels of fields at each pixel by a matrix, from the right.

    Args:
        features: (batch, fields * channels, rows, cols), in channels_last.
        matrix: a result of `_of_several_fields`.
    """
    last = features.permute(0, 2, 3, 1)
    product = last.reshape(-1, len(matrix)) @ matrix.to(features.dtype)
    return product.view(*last.shape[:3], -1).permute(0, 3, 1, 2)


class BlurPool(nn.Module):
    """Antialiased pooling to every other pixel, from the first to the last.

    A side of 2 n + 1 pixels becomes n + 1. So the equivariance to rotations by 90 degrees about the
    image's centre stays exact.
    """

    kernel: Tensor
    _SIGMA = 0.66

    def __init__(self) -> None:
        super().__init__()
        taps = torch.exp(-(torch.arange(-2, 3) ** 2) / (2 * self._SIGMA**2))
        kernel = torch.outer(taps, taps)
        self.register_buffer("kernel", kernel / kernel.sum(), persistent=False)

    def forward(self, features: Tensor) -> Tensor:
        """Maps (batch, channels, rows, cols) with odd sides to half the resolution."""
        return _Blur.apply(features, self.kernel)


class _Blur(torch.autograd.Function):
    """The convolution of `BlurPool`, with a gradient in float32: on a CPU the gradient of depthwise
    convolutions takes six times as long in bfloat16."""

    @staticmethod
    def forward(ctx: Any, features: Tensor, kernel: Tensor) -> Tensor:
        channels = features.shape[1]
        ctx.kernel = kernel.expand(channels, 1, 5, 5)
        weight = ctx.kernel.to(features.dtype)
        return F.conv2d(features, weight, stride=2, padding=2, groups=channels)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None]:
        channels = gradient.shape[1]
        result = F.conv_transpose2d(
            gradient.float(), ctx.kernel.float(), stride=2, padding=2, groups=channels
        )
        return result.to(gradient.dtype), None


def upsample(features: Tensor) -> Tensor:
    """Upsamples bilinearly from n + 1 pixels to 2 n + 1, which reverses `BlurPool`'s change of
    size."""
    rows, cols = features.shape[2:]
    larger = F.interpolate(
        features, size=(2 * rows - 1, 2 * cols - 1), mode="bilinear", align_corners=True
    )
    if larger.requires_grad:
        # If the result is concatenated, its gradient is not contiguous, which slows torch down.
        # Make it contiguous.
        larger.register_hook(
            lambda gradient: gradient.contiguous(memory_format=torch.channels_last)
        )
    return larger
