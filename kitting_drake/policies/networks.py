"""The four networks alpha, beta, phi and psi, and what is asked of them (section III-C)."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from kitting_drake.policies import config as sizes
from kitting_drake.policies.angle_net import AngleNet
from kitting_drake.policies.config import PRESETS, NetworkConfig
from kitting_drake.policies.discretization import (
    discretization_matrix,
    discretize,
    series_maximum,
)
from kitting_drake.policies.fibres import Irreps
from kitting_drake.policies.images import Image, LabelledImage, crop
from kitting_drake.policies.losses import angle_loss, place_loss, position_loss
from kitting_drake.policies.steerable import Convolution, SteerableConv2d
from kitting_drake.policies.unet import STRIDE, UNet

_JITTER = 2
"""Crops of a training step lie up to this far beside the label's pixel, as those of a picking
network that is not perfect will."""


class Networks(nn.Module):
    """What every method has: inputs made ready, and the placing module.

    Subclasses have `phi` and `psi` (scalar encodings of the scene and of a crop) and say where and
    at which angle to pick.
    """

    phi: nn.Module
    psi: nn.Module

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        self.config = config
        self.preset = PRESETS[config.preset]
        self.compute_type = torch.float32

    @property
    def device(self) -> torch.device:
        """Where the weights are."""
        return next(self.parameters()).device

    def prepare(self, image: Image) -> Tensor:
        """An observation, or a part of one, as input.

        Args:
            image: (4, rows, cols), as `Observation.image`.

        Returns:
            (1, 4, rows, cols): normalised, in the type and at the place of computation, padded
            below and on the right, as if unseen, to sides that a U-net takes.
        """
        config = self.config
        mean = np.array([config.colour_mean] * 3 + [config.height_mean], np.float32)
        deviation = np.array([config.colour_deviation] * 3 + [config.height_deviation], np.float32)
        padding = [(0, 0)] + [(0, (1 - side) % STRIDE) for side in image.shape[1:]]
        padded = np.pad(image, padding)
        normalised = (padded - mean[:, None, None]) / deviation[:, None, None]
        return torch.from_numpy(normalised)[None].to(self.device, self.compute_type)

    def encode_scene(self, image: Image) -> Tensor:
        """phi(o_t): (1, channels, rows, cols), the padding included."""
        return self.phi(self.prepare(image))

    def encode_crop(self, image: Image, pixel: tuple[int, int]) -> Tensor:
        """psi(c_2) for the crop around a pixel: (1, channels, side, side)."""
        return self.psi(self.prepare(crop(image, pixel, sizes.PLACE_CROP)))

    def check_orientations(self, orientations: int) -> None:
        """Raises ValueError if the networks cannot answer at N orientations."""
        discretization_matrix(orientations, self.config.angle_frequencies, quotient=2)

    def position_logits(self, image: Image, orientations: int) -> Tensor:
        """f_p: (rows, cols)."""
        raise NotImplementedError

    def angle_logits(self, image: Image, pixel: tuple[int, int], orientations: int) -> Tensor:
        """f_theta around a pixel: (N / 2,), at the gripper angles 2 pi i / N."""
        raise NotImplementedError

    def angle_answer(
        self, image: Image, pixel: tuple[int, int], orientations: int
    ) -> tuple[Tensor, float | None]:
        """`angle_logits`, and the most likely of all angles in radians if the method knows angles
        between the bins, else None."""
        return self.angle_logits(image, pixel, orientations), None

    def losses(
        self, sample: LabelledImage, random: np.random.Generator
    ) -> Iterator[tuple[str, Callable[[], Tensor]]]:
        """Each module's name and its loss on a sample, to be called and differentiated in turn."""
        sample = within_image(sample)
        pixels = [jittered(pick, random) for pick in (sample.pick, *sample.other_picks)]
        generator = torch.Generator().manual_seed(int(random.integers(2**62)))
        yield from self.pick_losses(sample, pixels, random)
        yield "place", lambda: self.place_loss(sample, pixels[0], generator)

    def pick_losses(
        self,
        sample: LabelledImage,
        pixels: list[tuple[int, int]],
        random: np.random.Generator,
    ) -> Iterator[tuple[str, Callable[[], Tensor]]]:
        """Those of the picking module.

        Args:
            sample: what to learn from.
            pixels: around which crops are taken: near the pick, and near each of the others.
            random: for what else is drawn.
        """
        raise NotImplementedError

    def place_loss(
        self, sample: LabelledImage, pixel: tuple[int, int], generator: torch.Generator
    ) -> Tensor:
        """That of the placing module."""
        goal = sample.place_of(np.array(pixel, float))
        return place_loss(
            self.encode_scene(sample.image),
            self.encode_crop(sample.image, pixel),
            (float(goal[0]), float(goal[1])),
            sample.turn % math.tau,
            self.config.orientations,
            generator,
        )

    def modules_by_loss(self) -> dict[str, list[nn.Module]]:
        """What each loss trains: an optimiser each."""
        raise NotImplementedError


class FactoredNetworks(Networks):
    """Those that first choose where to pick, then at which angle (section III-C.1)."""

    alpha: nn.Module
    beta: nn.Module

    def crop_angle_logits(self, crops: Tensor, orientations: int) -> Tensor:
        """f_theta: (n, channels, side, side), crops made ready, to (n, N / 2)."""
        raise NotImplementedError

    def position_logits(self, image: Image, orientations: int) -> Tensor:
        rows, cols = image.shape[1:]
        return self.alpha(self.prepare(image))[0, 0, :rows, :cols]

    def angle_logits(self, image: Image, pixel: tuple[int, int], orientations: int) -> Tensor:
        prepared = self.prepare(crop(image, pixel, sizes.PICK_CROP))
        return self.crop_angle_logits(prepared, orientations)[0]

    def pick_losses(
        self,
        sample: LabelledImage,
        pixels: list[tuple[int, int]],
        random: np.random.Generator,
    ) -> Iterator[tuple[str, Callable[[], Tensor]]]:
        orientations = self.config.orientations
        picks = [(float(row), float(col)) for row, col in (sample.pick, *sample.other_picks)]

        def angle() -> Tensor:
            crops = [crop(sample.image, pixel, sizes.PICK_CROP) for pixel in pixels]
            thetas = [sample.pick_theta, *sample.other_thetas]
            if len(sample.bends):
                crops += [
                    sample.bent_crop(index, pixel, sizes.PICK_CROP)
                    for index, pixel in enumerate(pixels)
                ]
                thetas += thetas
            prepared = torch.cat([self.prepare(item) for item in crops])
            logits = self.crop_angle_logits(prepared, orientations)
            losses = [
                angle_loss(row, theta % math.pi, orientations)
                for row, theta in zip(logits, thetas, strict=True)
            ]
            return torch.stack(losses).mean()

        yield (
            "pick_position",
            lambda: position_loss(self.position_logits(sample.image, orientations), *picks),
        )
        yield "pick_angle", angle

    def modules_by_loss(self) -> dict[str, list[nn.Module]]:
        return {
            "pick_position": [self.alpha],
            "pick_angle": [self.beta],
            "place": [self.phi, self.psi],
        }


class SO2Networks(FactoredNetworks):
    """The paper's own: irrep fields of SO(2), and a discretized answer for the angle."""

    def __init__(self, config: NetworkConfig, convolution: Convolution = SteerableConv2d) -> None:
        super().__init__(config)
        preset = self.preset
        fibre = Irreps(tuple(range(config.band + 1)), preset.samples)
        angle_fibre = Irreps(tuple(range(preset.angle_band + 1)), preset.angle_samples)
        answer = Irreps(config.angle_frequencies)
        self.alpha = UNet(4, 1, fibre, preset.unet, convolution)
        self.beta = AngleNet(4, angle_fibre, answer, preset.angle, convolution)
        self.phi = UNet(4, sizes.FEATURES, fibre, preset.unet, convolution)
        self.psi = UNet(4, sizes.FEATURES, fibre, preset.unet, convolution)

    def crop_angle_logits(self, crops: Tensor, orientations: int) -> Tensor:
        frequencies = self.config.angle_frequencies
        return discretize(self.beta(crops), orientations, frequencies, quotient=2)

    def angle_answer(
        self, image: Image, pixel: tuple[int, int], orientations: int
    ) -> tuple[Tensor, float | None]:
        frequencies = self.config.angle_frequencies
        # Computed once for both: (13,), the Fourier coefficients of the angle's logits.
        coefficients = self.beta(self.prepare(crop(image, pixel, sizes.PICK_CROP)))[0]
        logits = discretize(coefficients, orientations, frequencies, quotient=2)
        return logits, series_maximum(coefficients.detach().double().cpu().numpy(), frequencies)


def within_image(sample: LabelledImage) -> LabelledImage:
    """Without the other picks that lie outside the image."""
    rows, cols = sample.image.shape[1:]
    picks = sample.other_picks
    inside = ((picks >= 0) & (picks <= (rows - 1, cols - 1))).all(axis=1)
    return dataclasses.replace(
        sample,
        other_picks=picks[inside],
        other_thetas=sample.other_thetas[inside],
        bends=sample.bends[np.append(True, inside)] if len(sample.bends) else sample.bends,
    )


def jittered(pixel: NDArray[np.float64], random: np.random.Generator) -> tuple[int, int]:
    """A pixel near a position."""
    offset = random.integers(-_JITTER, _JITTER + 1, size=2)
    row, col = np.rint(pixel).astype(int) + offset
    return int(row), int(col)
