"""The U-net of alpha, phi and psi (section V-A.1 of the paper)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from kitting_drake.policies.networks.layers.fibres import Fibre, Scalar
from kitting_drake.policies.networks.layers.steerable import (
    BandLimit,
    BlurPool,
    Convolution,
    InvariantPart,
    MixedPrecision,
    upsample,
)

STRIDE = 16
"""The sides of an image in pixels must be one more than a multiple of this."""


@dataclass(frozen=True)
class UNetSize:
    """The width of a U-net."""

    down: tuple[int, int, int, int, int] = (16, 32, 64, 128, 128)
    """The number of fields in each of the encoder's five blocks. Pooling separates the blocks."""
    up: tuple[int, int, int, int] = (64, 32, 16, 16)
    """The number of fields in each of the decoder's four blocks."""
    head: int = 16
    """The number of scalar channels before the last layer."""
    skip: int = 3
    """The kernel side of residual shortcuts that change the number of fields."""


class ResidualBlock(nn.Module):
    """A residual block of two convolutions, with ELU after each."""

    def __init__(
        self,
        fields_in: int,
        fields: int,
        fibre: Fibre,
        convolution: Convolution,
        skip: int,
        size: int = 3,
    ) -> None:
        super().__init__()
        self.first = convolution(fields_in, fibre, fields, fibre, size)
        # Without normalisation, nine blocks at full gain would make the features too large.
        self.second = convolution(fields, fibre, fields, fibre, size, gain=0.5)
        self.shortcut = (
            BandLimit(fibre, fields)
            if fields_in == fields
            else convolution(fields_in, fibre, fields, fibre, skip, gain=0.7)
        )

    def forward(self, features: Tensor) -> Tensor:
        """Maps (batch, channels in, rows, cols) to (batch, channels out, rows, cols)."""
        hidden = self.second(F.elu_(self.first(features)))
        return F.elu_(hidden + self.shortcut(features))


class UNet(MixedPrecision):
    """Maps scalar images to scalar images through hidden fields of one fibre, in 21 layers.

    Its input and output are trivial fields, so a rotation of the input rotates the output (equation
    3 of the paper).
    """

    def __init__(
        self,
        in_channels: int,
        out_channels: int,
        fibre: Fibre,
        size: UNetSize,
        convolution: Convolution,
    ) -> None:
        super().__init__()
        down, up = size.down, size.up
        self.lift = convolution(in_channels, Scalar(), down[0], fibre, 3)
        before = (down[0], *down[:-1])
        self.down = nn.ModuleList(
            ResidualBlock(a, b, fibre, convolution, size.skip)
            for a, b in zip(before, down, strict=True)
        )
        below = (down[-1], *up[:-1])
        beside = down[-2::-1]
        self.up = nn.ModuleList(
            ResidualBlock(a + b, c, fibre, convolution, size.skip)
            for a, b, c in zip(below, beside, up, strict=True)
        )
        self.pool = BlurPool()
        self.invariant = InvariantPart(fibre, up[-1])
        self.mix = convolution(up[-1], Scalar(), size.head, Scalar(), 3, bias=True)
        self.out = convolution(size.head, Scalar(), out_channels, Scalar(), 1, bias=True, gain=0.1)

    def forward(self, image: Tensor) -> Tensor:
        """Maps (batch, in channels, rows, cols) to (batch, out channels, rows, cols) in float32.

        Computes in the type of the image. The image's sides must be one more than a multiple of 16.

        Raises:
            ValueError: a side is not one more than a multiple of 16.
        """
        if image.shape[2] % STRIDE != 1 or image.shape[3] % STRIDE != 1:
            raise ValueError(
                f"an image of {tuple(image.shape[2:])} pixels does not fit the U-net: its sides "
                f"must be one more than a multiple of {STRIDE}"
            )
        features = F.elu_(self.lift(image.contiguous(memory_format=torch.channels_last)))
        levels = []
        for index, block in enumerate(self.down):
            if index:
                levels.append(features)
                features = self.pool(features)
            features = block(features)
        for block in self.up:
            features = block(torch.cat([upsample(features), levels.pop()], dim=1))
        # The last two layers always compute in float32: logits need more precision than bfloat16.
        scalars = self.invariant(features).float()
        return self.out(F.elu(self.mix(scalars)))

    def reduced_precision_parts(self) -> Iterator[nn.Module]:
        yield from (self.lift, self.down, self.up)
