"""The Transporter, the second baseline of the paper (section V-C.3): ordinary convolutions.

Nothing in its networks turns with the image. For a parallel jaw the scene itself is turned N / 2
times, and f_pick says of each turned scene where a gripper at angle zero would pick.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from kitting_drake.policies import config as sizes
from kitting_drake.policies.config import NetworkConfig
from kitting_drake.policies.images import Image, LabelledImage
from kitting_drake.policies.losses import joint_loss, spread
from kitting_drake.policies.networks import Networks
from kitting_drake.policies.steerable import Convolution, SteerableConv2d, upsample

_NEAR = math.radians(10)
"""What is near a label: easily taken for it, so a draw of its own."""
_DRAWS = 2
"""Turns that a training step draws near its labels, and as many among the rest."""


class TransporterNetworks(Networks):
    """f_pick, and phi and psi, as three residual networks of 43 layers.

    As in the other methods, and unlike the original, psi encodes a crop once and its encoding is
    turned, not the crop.
    """

    def __init__(self, config: NetworkConfig, convolution: Convolution = SteerableConv2d) -> None:
        """
        Args:
            config: what to make.
            convolution: not used; there are no steerable ones.
        """
        super().__init__(config)
        widths = self.preset.resnet
        self.pick = ResNet(4, 1, widths)
        self.phi = ResNet(4, sizes.FEATURES, widths)
        self.psi = ResNet(4, sizes.FEATURES, widths)
        self._known: tuple[Image, int, Tensor] | None = None

    def check_orientations(self, orientations: int) -> None:
        """Raises ValueError if N is odd: half of them must make half a turn."""
        if orientations < 2 or orientations % 2:
            raise ValueError(f"orientations must be an even number, not {orientations}")

    def train(self, mode: bool = True) -> TransporterNetworks:
        self._known = None
        return super().train(mode)

    def load_state_dict(
        self, state_dict: Mapping[str, Any], strict: bool = True, assign: bool = False
    ) -> Any:
        self._known = None
        return super().load_state_dict(state_dict, strict, assign)

    def pick_volume(self, image: Image, orientations: int) -> Tensor:
        """f_pick: (N / 2, rows, cols), logits of all gripper angles 2 pi i / N and pixels at once.

        In evaluation mode it is kept for `angle_logits`.
        """
        self.check_orientations(orientations)
        step = math.tau / orientations
        volume = torch.stack([self._scores(image, i * step) for i in range(orientations // 2)])
        if not self.training:
            self._known = (image, orientations, volume)
        return volume

    def _scores(self, image: Image, theta: float) -> Tensor:
        """(rows, cols): the logits of picking with the gripper at `theta`."""
        rows, cols = image.shape[1:]
        canvas = canvas_shape((rows, cols), theta)
        scene = turned(torch.tensor(image)[None], -theta, canvas)
        scores = self.pick(self.prepare(scene[0].numpy()))[:, :, : canvas[0], : canvas[1]]
        return turned(scores, theta, (rows, cols))[0, 0]

    def position_logits(self, image: Image, orientations: int) -> Tensor:
        """The best of all angles at each pixel: with `angle_logits` there, the best of the volume.

        Returns:
            (rows, cols).
        """
        return self.pick_volume(image, orientations).amax(0)

    def angle_logits(self, image: Image, pixel: tuple[int, int], orientations: int) -> Tensor:
        volume = None
        if self._known is not None:
            known, count, found = self._known
            # `position_logits` has been asked of this very array just now.
            volume = found if known is image and count == orientations else None
        if volume is None:
            volume = self.pick_volume(image, orientations)
        return volume[:, pixel[0], pixel[1]]

    def pick_losses(
        self,
        sample: LabelledImage,
        pixels: list[tuple[int, int]],
        random: np.random.Generator,
    ) -> Iterator[tuple[str, Callable[[], Tensor]]]:
        step = math.tau / self.config.orientations
        bins = self.config.orientations // 2
        thetas = (sample.pick_theta, *sample.other_thetas)
        shares = [spread(theta % math.pi / step, bins, cyclic=True) for theta in thetas]
        drawn = draw_bins({bin_ for share in shares for bin_, _ in share}, bins, step, random)
        index = {bin_: position for position, bin_ in enumerate(drawn)}
        labels = [
            ([(index[bin_], weight) for bin_, weight in share], (float(row), float(col)))
            for share, (row, col) in zip(shares, (sample.pick, *sample.other_picks), strict=True)
        ]

        def loss() -> Tensor:
            logits = [
                self._scores(sample.image, bin_ * step) + stands for bin_, stands in drawn.items()
            ]
            return joint_loss(torch.stack(logits), *labels)

        yield "pick", loss

    def modules_by_loss(self) -> dict[str, list[nn.Module]]:
        return {"pick": [self.pick], "place": [self.phi, self.psi]}


def draw_bins(
    labels: set[int], bins: int, step: float, random: np.random.Generator
) -> dict[int, float]:
    """Which turns of the scene a training step looks at: sampled softmax in two strata.

    Args:
        labels: those that must be among them.
        bins: how many there are over half a turn.
        step: between neighbours, in radians.
        random: draws the others.

    Returns:
        Turns, and what to add to the logits of each, in nats, for it to stand for those of its
        stratum that were not drawn.
    """
    strata: tuple[list[int], list[int]] = ([], [])
    for bin_ in range(bins):
        if bin_ in labels:
            continue
        apart = min(abs(math.remainder((bin_ - label) * step, math.pi)) for label in labels)
        strata[apart > _NEAR].append(bin_)
    drawn = dict.fromkeys(sorted(labels), 0.0)
    for stratum in strata:
        count = min(_DRAWS, len(stratum))
        for bin_ in random.choice(stratum, count, replace=False) if count else ():
            drawn[int(bin_)] = math.log(len(stratum) / count)
    return drawn


def canvas_shape(shape: tuple[int, int], angle: float) -> tuple[int, int]:
    """Rows and cols that hold all pixel centres of an image of some rows and cols, turned."""
    cos, sin = abs(math.cos(angle)), abs(math.sin(angle))
    height, width = shape[0] - 1, shape[1] - 1
    # A quarter turn is not a pixel larger for being rounded.
    rows = math.ceil(height * cos + width * sin - 1e-6)
    cols = math.ceil(height * sin + width * cos - 1e-6)
    return rows + 1, cols + 1


def turned(image: Tensor, angle: float, shape: tuple[int, int]) -> Tensor:
    """An image turned about its middle, bilinearly sampled; zero, as if unseen, outside it.

    Args:
        image: (1, channels, rows, cols).
        angle: counter-clockwise, in radians.
        shape: rows and cols of the answer; middle comes upon middle.

    Returns:
        (1, channels, *shape).
    """
    axes = [
        torch.arange(side, dtype=image.dtype, device=image.device) - (side - 1) / 2
        for side in shape
    ]
    row, col = torch.meshgrid(*axes, indexing="ij")
    cos, sin = math.cos(angle), math.sin(angle)
    # Where each pixel comes from: turned back. grid_sample wants (col, row) from -1 to 1.
    rows, cols = image.shape[2:]
    source = torch.stack(
        [
            (cos * col - sin * row) * (2 / (cols - 1)),
            (cos * row + sin * col) * (2 / (rows - 1)),
        ],
        dim=-1,
    )
    return F.grid_sample(
        image, source[None], mode="bilinear", padding_mode="zeros", align_corners=True
    )


class PlainLayer(nn.Module):
    """A convolution of float32 weights that computes in the type of its input."""

    def __init__(
        self, channels_in: int, channels: int, size: int, *, stride: int = 1, gain: float = 1.0
    ) -> None:
        super().__init__()
        self.stride, self.padding = stride, size // 2
        scale = gain * math.sqrt(2 / (channels_in * size**2))
        self.weight = nn.Parameter(torch.randn(channels, channels_in, size, size) * scale)
        self.bias = nn.Parameter(torch.zeros(channels))

    def forward(self, features: Tensor) -> Tensor:
        """(batch, channels in, rows, cols) to (batch, channels, rows / stride, cols / stride)."""
        weight = self.weight.to(features.dtype, memory_format=torch.channels_last)
        bias = self.bias.to(features.dtype)
        return F.conv2d(features, weight, bias, stride=self.stride, padding=self.padding)


class Bottleneck(nn.Module):
    """Three convolutions, of one, three and one pixels, beside a shortcut."""

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
            channels_in: that come in.
            width: channels within.
            channels: that go out.
            stride: of the first convolution and of the shortcut.
            identity: the shortcut is the input itself, not a convolution.
            gain: of the output.
        """
        super().__init__()
        self.first = PlainLayer(channels_in, width, 1, stride=stride)
        self.second = PlainLayer(width, width, 3)
        # Without normalisation, fourteen blocks at full gain would blow the features up.
        self.third = PlainLayer(width, channels, 1, gain=0.5 * gain)
        self.shortcut = (
            nn.Identity()
            if identity
            else PlainLayer(channels_in, channels, 1, stride=stride, gain=0.7 * gain)
        )

    def forward(self, features: Tensor, result_type: torch.dtype | None = None) -> Tensor:
        """(batch, channels in, rows, cols) to (batch, channels, rows / stride, cols / stride), the
        last convolution and the shortcut in a type of their own."""
        hidden = F.relu_(self.second(F.relu_(self.first(features))))
        result_type = result_type or features.dtype
        return self.third(hidden.to(result_type)) + self.shortcut(features.to(result_type))


class ResNet(nn.Module):
    """The Transporter's hourglass: an eighth of the resolution at its waist.

    43 layers, convolutions on shortcuts not counted: a stem, and two blocks of three in each of
    four stages down and three up.
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
        """(batch, in channels, rows, cols), sides one above a multiple of 8, in the type to compute
        in, to (batch, out channels, rows, cols) in float32."""
        features = F.relu_(self.stem(image.contiguous(memory_format=torch.channels_last)))
        for stage in self.down:
            features = stage(features)
        for stage in self.up:
            features = stage(upsample(features))
        features = F.relu_(self.last(upsample(features)))
        # The output wants more than eight bits.
        return self.out(features, torch.float32)


def _stage(channels_in: int, channels: int, *, stride: int = 1) -> nn.Sequential:
    """Two blocks; the stride is the first one's."""
    return nn.Sequential(
        Bottleneck(channels_in, channels, channels, stride=stride),
        nn.ReLU(inplace=True),
        Bottleneck(channels, channels, channels, identity=True),
        nn.ReLU(inplace=True),
    )
