"""The pick-angle network beta (section III-C.1 and V-A.2 of the paper)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from kitting_drake.policies.networks.layers.fibres import Fibre, Scalar
from kitting_drake.policies.networks.layers.steerable import BlurPool, Convolution, MixedPrecision
from kitting_drake.policies.networks.unet import ResidualBlock


@dataclass(frozen=True)
class AngleNetSize:
    """The depth and width of a pick-angle network."""

    stages: tuple[tuple[int, ...], ...]
    """For each stage, the numbers of fields of its layers. Features are pooled between stages."""
    kernel: int = 7
    """The side of each layer's kernels, in pixels."""
    readout: int = 7
    """The side of the last layer's kernel, in pixels."""
    full_readout: bool = False
    """Whether the last layer's kernel covers the whole feature map. Otherwise the last layer is
    padded, and its output is averaged."""
    residual: bool = False
    """Whether each stage of two layers is a residual block. The first stage cannot be one, so it
    must not have two layers. If a block changes the number of fields, its shortcut is a convolution
    with the same kernel size."""

    def __post_init__(self) -> None:
        if self.residual and len(self.stages[0]) == 2:
            raise ValueError(
                "a stage of two layers is a residual block, but the first stage cannot be one, "
                "because its input is scalars: give it one layer, or more than two"
            )


class AngleNet(MixedPrecision):
    """Maps a crop equivariantly to one vector of the output fibre (equation 3 of the paper).

    If the crop is rotated by r, the vector is transformed by the fibre's representation rho(r).
    """

    def __init__(
        self,
        in_channels: int,
        fibre: Fibre,
        out_fibre: Fibre,
        size: AngleNetSize,
        convolution: Convolution,
    ) -> None:
        super().__init__()
        stages = []
        before: tuple[int, Fibre] = (in_channels, Scalar())
        for fields in size.stages:
            layers = nn.ModuleList()
            if size.residual and len(fields) == 2:
                count = fields[1]
                layers.append(
                    ResidualBlock(before[0], count, fibre, convolution, size.kernel, size.kernel)
                )
                before = (count, fibre)
            else:
                for count in fields:
                    layers.append(convolution(*before, count, fibre, size.kernel))
                    before = (count, fibre)
            stages.append(layers)
        self.stages = nn.ModuleList(stages)
        self.pool = BlurPool()
        padding = 0 if size.full_readout else size.readout // 2
        self.readout = convolution(*before, 1, out_fibre, size.readout, padding=padding)

    def forward(self, crop: Tensor) -> Tensor:
        """Maps (batch, in channels, side, side) to (batch, out channels), in float32."""
        features = crop.contiguous(memory_format=torch.channels_last)
        for index, layers in enumerate(self.stages):
            assert isinstance(layers, nn.ModuleList)
            if index:
                features = self.pool(features)
            for layer in layers:
                # A residual block applies its own ELU.
                is_block = isinstance(layer, ResidualBlock)
                features = layer(features) if is_block else F.elu_(layer(features))
        # The readout always computes in float32, because angles need more than the eight bits of
        # bfloat16.
        return self.readout(features.float()).mean(dim=(2, 3))

    def reduced_precision_parts(self) -> Iterator[nn.Module]:
        yield self.stages
