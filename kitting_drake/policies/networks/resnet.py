"""The Transporter's backbone (Zeng et al.): an hourglass of ordinary convolutions."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from kitting_drake.policies.networks.layers.steerable import MixedPrecision, upsample


class PlainLayer(nn.Module):
    """A convolution that computes in the type of its input and casts its weights to that type."""

    def __init__(
        self, channels_in: int, channels: int, size: int, *, stride: int = 1, gain: float = 1.0
    ) -> None:
        super().__init__()
        self.stride, self.padding = stride, size // 2
        scale = gain * math.sqrt(2 / (channels_in * size**2))
        self.weight = nn.Parameter(torch.randn(channels, channels_in, size, size) * scale)
        self.bias = nn.Parameter(torch.zeros(channels))

    def forward(self, features: Tensor) -> Tensor:
        """Convolves a map.

        Args:
            features: the map, of shape (batch, channels in, rows, cols).

        Returns:
            A map of shape (batch, channels, rows / stride, cols / stride).
        """
        weight = self.weight.to(features.dtype, memory_format=torch.channels_last)
        bias = self.bias.to(features.dtype)
        return F.conv2d(features, weight, bias, stride=self.stride, padding=self.padding)


class Bottleneck(nn.Module):
    """A residual block of three convolutions with kernels of 1, 3 and 1 pixels."""

    def __init__(
        self,
        channels_in: int,
        width: int,
        channels: int,
        *,
        stride: int = 1,
        identity: bool = False,
        gain: float = 1.0,
    ) -> None:
        """
        Args:
            channels_in: the number of input channels.
            width: the number of hidden channels.
            channels: the number of output channels.
            stride: the stride of the first convolution and of the shortcut.
            identity: whether the shortcut is the input itself instead of a convolution.
            gain: a factor of the output's initial scale.
        """
        super().__init__()
        self.first = PlainLayer(channels_in, width, 1, stride=stride)
        self.second = PlainLayer(width, width, 3)
        # Without normalisation, fourteen blocks at full gain would make the features too large.
        self.third = PlainLayer(width, channels, 1, gain=0.5 * gain)
        self.shortcut = (
            nn.Identity()
            if identity
            else PlainLayer(channels_in, channels, 1, stride=stride, gain=0.7 * gain)
        )

    def forward(self, features: Tensor, result_type: torch.dtype | None = None) -> Tensor:
        """Maps (batch, channels in, rows, cols) to (batch, channels, rows / stride, cols / stride).

        Args:
            features: the input.
            result_type: the type of the last convolution and the shortcut; by default the input's.
        """
        hidden = F.relu_(self.second(F.relu_(self.first(features))))
        result_type = result_type or features.dtype
        return self.third(hidden.to(result_type)) + self.shortcut(features.to(result_type))


class ResNet(MixedPrecision):
    """The Transporter's hourglass network, which reduces the resolution to an eighth and restores
    it.

    It has 43 layers: a stem, and two blocks of three convolutions in each of four stages down and
    three up. Shortcut convolutions are not counted.
    """

    def __init__(
        self, in_channels: int, out_channels: int, widths: tuple[int, int, int, int, int]
    ) -> None:
        super().__init__()
        stem, *stages = widths
        top, second = stages[:2]
        self.stem = PlainLayer(in_channels, stem, 3)
        self.down = nn.ModuleList([_stage(stem, top)])
        self.down.extend(_stage(a, b, stride=2) for a, b in itertools.pairwise(stages))
        self.up = nn.ModuleList(_stage(a, b) for a, b in itertools.pairwise(stages[:0:-1]))
        self.last = Bottleneck(second, top, top)
        self.out = Bottleneck(top, top, out_channels, gain=0.1)

    def forward(self, image: Tensor) -> Tensor:
        """Maps (batch, in channels, rows, cols) to (batch, out channels, rows, cols) in float32.

        Computes in the type of the image. The image's sides must be one more than a multiple of 8.
        """
        features = F.relu_(self.stem(image.contiguous(memory_format=torch.channels_last)))
        for stage in self.down:
            features = stage(features)
        for stage in self.up:
            features = stage(upsample(features))
        features = F.relu_(self.last(upsample(features)))
        # Logits need float32: bfloat16 has eight bits of precision only.
        return self.out(features, torch.float32)

    def reduced_precision_parts(self) -> Iterator[nn.Module]:
        yield from (self.stem, self.down, self.up, self.last, self.out.first, self.out.second)


def _stage(channels_in: int, channels: int, *, stride: int = 1) -> nn.Sequential:
    """Makes a stage of two blocks. Only the first block has the stride."""
    return nn.Sequential(
        Bottleneck(channels_in, channels, channels, stride=stride),
        nn.ReLU(inplace=True),
        Bottleneck(channels, channels, channels, identity=True),
        nn.ReLU(inplace=True),
    )
