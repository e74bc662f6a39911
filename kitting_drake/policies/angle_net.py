"""The pick-angle network beta (section III-C.1 and V-A.2 of the paper)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from kitting_drake.policies.fibres import Fibre, Scalar
from kitting_drake.policies.steerable import BlurPool, Convolution
from kitting_drake.policies.unet import ResidualBlock


@dataclass(frozen=True)
class AngleNetSize:
    """How deep and wide a pick-angle network is."""

    stages: tuple[tuple[int, ...], ...]
    """Fields of each layer; a pooling between stages."""
    kernel: int = 7
    """Side of each layer's kernels, in pixels."""
    readout: int = 7
    """Side of the last layer's kernels."""
    whole: bool = False
    """The last layer's kernel covers all that is left, instead of a mean being taken after it."""
    residual: bool = False
    """A stage of two layers is a residual block, with a shortcut of the same kernels where the
    number of fields changes; the first stage, which takes scalars, must be of another kind."""

    def __post_init__(self) -> None:
        if self.residual and len(self.stages[0]) == 2:
            raise ValueError("the first stage takes scalars, which no residual block does")


class AngleNet(nn.Module):
    """A crop to one vector of the output fibre, which turns as the crop turns."""

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
        padding = 0 if size.whole else size.readout // 2
        self.readout = convolution(*before, 1, out_fibre, size.readout, padding=padding)

    def forward(self, crop: Tensor) -> Tensor:
        """(batch, in channels, side, side) to (batch, out channels), in float32."""
        features = crop.contiguous(memory_format=torch.channels_last)
        for index, layers in enumerate(self.stages):
            assert isinstance(layers, nn.ModuleList)
            if index:
                features = self.pool(features)
            for layer in layers:
                # A block has an ELU of its own.
                is_block = isinstance(layer, ResidualBlock)
                features = layer(features) if is_block else F.elu_(layer(features))
        return self.readout(features.float()).mean(dim=(2, 3))
