"""Convolutions between the regular fields of large cyclic groups, without a dense basis.

Between regular fields of C_N, or of C_N / C_q, with M = N / q channels, every steerable kernel is

    K[m, n](x) = kappa[(n - m) mod M](R_m^-1 x),

R_m being the turn by 2 pi m / N: the kernels that lead to channel 0 are free, and those that lead
to channel m are the same ones, turned. It is escnn's space; its basis, M B kernels of M^2 numbers a
pixel, would fill the memory at N = 180. Here are but B patterns, turned M ways.
"""

from __future__ import annotations

import functools
import math

import torch
from torch import Tensor

from kitting_drake.policies.fibres import Fibre, Irreps, Regular, Scalar
from kitting_drake.policies.steerable import ExpandedConv2d, kernel_basis


class GroupConv2d(ExpandedConv2d):
    """What `SteerableConv2d` is, for regular fields of one group and scalars."""

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
            in_fields: how many fields come in.
            in_fibre: what each carries.
            out_fields: how many go out.
            out_fibre: what each carries; of both fibres, one may be scalar.
            size: side of the kernel, odd, in pixels.
            padding: of the image by zeros; by default the image keeps its size.
            bias: one for each field.
            gain: of the initial weights' standard deviation.
        """
        fibres = [fibre for fibre in (in_fibre, out_fibre) if not isinstance(fibre, Scalar)]
        if not fibres or not isinstance(fibres[0], Regular) or fibres[0] != fibres[-1]:
            raise ValueError(f"no group convolution leads from {in_fibre} to {out_fibre}")
        basis = turned_patterns(fibres[0], size)
        scale = math.sqrt(2 / (in_fields * in_fibre.channels * float(basis[0].square().sum())))
        taps = basis.shape[1] * (len(basis) if len(fibres) == 2 else 1)
        weights = torch.randn(out_fields, in_fields, taps) * (gain * scale)
        super().__init__(in_fibre, out_fibre, size, padding, weights, bias)
        self.register_buffer("basis", basis.to(torch.get_default_dtype()), persistent=False)

    def kernel(self) -> Tensor:
        """(out channels, in channels, size, size): what a plain convolution takes."""
        if isinstance(self.in_fibre, Scalar):
            kernel = torch.einsum("oib,mbxy->omxyi", self.weights, self.basis)
        elif isinstance(self.out_fibre, Scalar):
            kernel = torch.einsum("oib,nbxy->oxyin", self.weights, self.basis)
        else:
            # Windows of kappa, written down twice: that of m begins at -m.
            kappa = self.weights.unflatten(2, self.basis.shape[:2])
            cyclic = torch.cat([kappa, kappa], dim=2).unfold(2, len(self.basis), 1)
            kernel = torch.einsum("oimbn,mbxy->omxyin", cyclic[:, :, 1:].flip(2), self.basis)
        # In the order of channels_last, which convolutions want.
        size = self.basis.shape[-1]
        channels = self.weights.shape[0] * self.out_fibre.channels
        return kernel.reshape(channels, size, size, -1).permute(0, 3, 1, 2)


@functools.lru_cache(maxsize=16)
def turned_patterns(fibre: Regular, size: int) -> Tensor:
    """escnn's circular harmonics that live on the quotient, turned by all the group.

    Args:
        fibre: C_N / C_q: a pattern must look the same after 1 / q of a full turn.
        size: side of the kernel, odd, in pixels.

    Returns:
        (M, B, size, size), float64: B patterns, each turned counter-clockwise by 2 pi m / N.
    """
    reach = size // 2
    # A bound: by default escnn keeps far fewer, about as many as the radius has pixels.
    frequencies = tuple(range(0, 3 * reach + 1, fibre.quotient))
    pairs = kernel_basis(Scalar(), Irreps(frequencies), size)[:, :, 0]
    angles = 2 * math.pi * torch.arange(fibre.size, dtype=torch.float64) / fibre.order
    turned = []
    row = 0
    for j in frequencies:
        # A kernel from scalars to rho_j: (p, q)(R x) = rho_j(R) (p, q)(x), so p turns within it.
        block = pairs[:, row : row + (2 if j else 1)]
        block = block[block.abs().amax(dim=(1, 2, 3)) > 1e-9]
        first, last = block[:, 0], block[:, -1]
        cos, sin = torch.cos(j * angles), torch.sin(j * angles)
        turned.append(torch.einsum("m,bxy->mbxy", cos, first))
        if j:
            turned[-1] += torch.einsum("m,bxy->mbxy", sin, last)
        row += 2 if j else 1
    return torch.cat(turned, dim=1)
