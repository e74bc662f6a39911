"""Convolutions between regular fields of large cyclic groups, without a dense basis.

Between regular fields of C_N, or of C_N / C_q, with M = N / q channels, every steerable kernel is

    K[m, n](x) = kappa[(n - m) mod M](R_m^-1 x),

where R_m is the rotation by 2 pi m / N. The kernels to output channel 0 can be chosen freely: each
is a combination of B patterns. The kernels to channel m are their rotated copies. escnn spans the
same space with a basis of M B kernels. Each of these has M^2 numbers per pixel, so the basis does
not fit into memory at N = 180. This layer stores only the B patterns in M rotations.
"""

from __future__ import annotations

import functools
import math

import torch
from torch import Tensor

from kitting_drake.policies.networks.layers.fibres import Irreps, Regular, Scalar
from kitting_drake.policies.networks.layers.steerable import ExpandedConv2d, kernel_basis


class GroupConv2d(ExpandedConv2d):
    """A convolution like `SteerableConv2d`, for regular fields of one cyclic group and for scalars.

    At most one of the two fibres may be scalar.
    """

    def _make_basis(self, in_fields: int, size: int) -> tuple[Tensor, int, float]:
        fibres = [f for f in (self.in_fibre, self.out_fibre) if not isinstance(f, Scalar)]
        if not fibres or not isinstance(fibres[0], Regular) or fibres[0] != fibres[-1]:
            raise ValueError(
                f"GroupConv2d cannot map {self.in_fibre} to {self.out_fibre}: they must be equal "
                "regular fibres, or one of them scalar"
            )
        basis = rotated_patterns(fibres[0], size)
        gathered = in_fields * self.in_fibre.channels * float(basis[0].square().sum())
        taps = basis.shape[1] * (len(basis) if len(fibres) == 2 else 1)
        return basis.to(torch.get_default_dtype()), taps, math.sqrt(2 / gathered)

    def kernel(self, dtype: torch.dtype = torch.float32) -> Tensor:
        if isinstance(self.in_fibre, Scalar):
            kernel = torch.einsum("oib,mbxy->omxyi", self.weights, self.basis)
        elif isinstance(self.out_fibre, Scalar):
            kernel = torch.einsum("oib,nbxy->oxyin", self.weights, self.basis)
        else:
            # Write two copies of kappa one after the other. Each cyclic shift of kappa is a window
            # of the result: the shift by m starts at -m, modulo kappa's length.
            kappa = self.weights.unflatten(2, self.basis.shape[:2])
            cyclic = torch.cat([kappa, kappa], dim=2).unfold(2, len(self.basis), 1)
            kernel = torch.einsum("oimbn,mbxy->omxyin", cyclic[:, :, 1:].flip(2), self.basis)
        size = self.basis.shape[-1]
        channels = self.weights.shape[0] * self.out_fibre.channels
        return kernel.to(dtype).reshape(channels, size, size, -1).permute(0, 3, 1, 2)

    @torch.no_grad()
    def fit(self, kernel: Tensor) -> None:
        # Use only the first channel of each output field, which is not rotated and determines all
        # weights. A fit to all channels would take 20 GB at N = 180.
        first = kernel[:: self.out_fibre.channels].unflatten(1, (self.weights.shape[1], -1))
        if isinstance(self.out_fibre, Scalar):
            first = first[:, :, :1]
        patterns = self.basis[0].flatten(1).double()
        found = torch.linalg.lstsq(patterns.T, first.flatten(3).flatten(0, 2).double().T).solution
        self.weights.copy_(found.T.reshape(self.weights.shape))


@functools.lru_cache(maxsize=16)
def rotated_patterns(fibre: Regular, size: int) -> Tensor:
    """Returns escnn's circular harmonics that are invariant under C_q, in all rotations of
    C_N / C_q.

    Args:
        fibre: the regular representation of C_N / C_q.
        size: the side of the kernel, odd, in pixels.

    Returns:
        (M, B, size, size), float64: B patterns, each rotated counter-clockwise by 2 pi m / N
        for m = 0 to M - 1, where M = N / q.
    """
    reach = size // 2
    # Ask for more frequencies than escnn keeps: it keeps about one for each pixel of the radius.
    frequencies = tuple(range(0, 3 * reach + 1, fibre.quotient))
    pairs = kernel_basis(Scalar(), Irreps(frequencies), size)[:, :, 0]
    angles = 2 * math.pi * torch.arange(fibre.size, dtype=torch.float64) / fibre.order
    rotated = []
    row = 0
    for j in frequencies:
        # A kernel (p, q) from scalars to rho_j satisfies (p, q)(R x) = rho_j(R) (p, q)(x), so the
        # rotated p is a combination of p and q.
        block = pairs[:, row : row + (2 if j else 1)]
        block = block[block.abs().amax(dim=(1, 2, 3)) > 1e-9]
        first, last = block[:, 0], block[:, -1]
        cos, sin = torch.cos(j * angles), torch.sin(j * angles)
        rotated.append(torch.einsum("m,bxy->mbxy", cos, first))
        if j:
            rotated[-1] += torch.einsum("m,bxy->mbxy", sin, last)
        row += 2 if j else 1
    return torch.cat(rotated, dim=1)
