"""The networks alpha, beta, phi and psi, their predictions and their losses (section III-C of the
paper)."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor, nn

from kitting_drake.policies.data.images import Image, LabelledImage, crop
from kitting_drake.policies.networks import architecture as sizes
from kitting_drake.policies.networks.angle_net import AngleNet
from kitting_drake.policies.networks.architecture import PRESETS, NetworkConfig
from kitting_drake.policies.networks.layers.correlation import Candidate, search
from kitting_drake.policies.networks.layers.discretization import (
    discretization_matrix,
    discretize,
)
from kitting_drake.policies.networks.layers.fibres import Irreps
from kitting_drake.policies.networks.layers.fourier_series import series_maximum
from kitting_drake.policies.networks.layers.steerable import (
    Convolution,
    MixedPrecision,
    SteerableConv2d,
)
from kitting_drake.policies.networks.losses import (
    angle_loss,
    log_odds,
    place_loss,
    position_loss,
    presence_loss,
)
from kitting_drake.policies.networks.unet import STRIDE, UNet

_JITTER = 2
"""The crops of a training step are shifted by up to this many pixels, to imitate errors of the
predicted pick."""


class AnglePrediction(NamedTuple):
    """The predicted pick angles at one pixel, f_theta of the paper."""

    logits: Tensor
    """(N / 2,) logits at the gripper angles 2 pi i / N."""
    refined: float | None
    """The most likely angle in radians, not quantized; None if the method predicts only discrete
    angles."""


@dataclass(frozen=True)
class PickPrediction:
    """The picking module's prediction for one observation."""

    position: Tensor
    """(rows, cols): the logits of the pick position, f_p of the paper."""
    angle: Callable[[tuple[int, int]], AnglePrediction]
    """A function that predicts the pick angles at a pixel (row, col)."""
    log_odds: float | None
    """The log-odds that there is something to pick (see `losses.log_odds`); None if the networks do
    not predict it."""


@dataclass(frozen=True)
class PlacePrediction:
    """The placing module's prediction for one observation and pick."""

    candidates: list[Candidate]
    """Windows of f_place around its peaks, best first."""
    score_map: Tensor
    """(rows, cols): the best score of each pixel over all rotations, possibly interpolated."""


class Networks(nn.Module):
    """The base class of every method's networks, with the preparation of inputs and the placing
    module.

    Subclasses define `phi` and `psi` (scalar encodings of the scene and of a crop) and the picking
    module. Calls do not change the networks' state.
    """

    phi: nn.Module
    psi: nn.Module
    picking: str
    """The name of the loss that trains the pick position."""

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        self.config = config
        self.preset = PRESETS[config.preset]
        self.compute_type = torch.float32
        """The floating-point type of the networks' inputs and computations."""
        self.rotations: int | None = None
        """The number of crop rotations in a training step of the Transporter. The number of scene
        rotations is half of it. None uses the default of `transporter.draw_bins`. Other methods
        ignore it."""
        self.stop_threshold: float | None = None
        """The log-odds below which a policy stops; None if it never stops. `validation.validate`
        chooses it, and it is stored with the weights."""

    @property
    def device(self) -> torch.device:
        """The device that holds the weights."""
        return next(self.parameters()).device

    def freeze(self, compute_type: torch.dtype) -> None:
        """Prepares the networks for inference: evaluation mode, no gradients, and weights cast
        once.

        Args:
            compute_type: the type to compute in.
        """
        self.compute_type = compute_type
        self.eval().requires_grad_(False)
        for module in self.modules():
            if isinstance(module, MixedPrecision):
                module.cast(compute_type)

    def prepare(self, image: Image) -> Tensor:
        """Converts an observation, or a crop of an observation, to a network input.

        Args:
            image: (4, rows, cols), as `Observation.image`.

        Returns:
            (1, channels, rows, cols): see `prepare_batch`.
        """
        return self.prepare_batch(torch.from_numpy(np.array(image, order="C"))[None])

    def prepare_batch(self, images: Tensor) -> Tensor:
        """Converts images to a batch of network inputs.

        Args:
            images: (n, 4, rows, cols), each as `Observation.image`.

        Returns:
            (n, channels, rows, cols): normalised, in `compute_type`, on `device`. Before they are
            normalised, the images are padded with zeros below and on the right, to sides that a
            U-net can take.
        """
        config = self.config
        rows, cols = images.shape[2:]
        padding = (0, (1 - cols) % STRIDE, 0, (1 - rows) % STRIDE)
        channels = config.channels
        seen = F.pad(images[:, -channels:], padding)
        mean = images.new_tensor([config.colour_mean] * 3 + [config.height_mean])[-channels:]
        std = images.new_tensor([config.colour_std] * 3 + [config.height_std])[-channels:]
        normalised = (seen - mean[:, None, None]) / std[:, None, None]
        return normalised.to(self.device, self.compute_type)

    def encode_scene(self, image: Image) -> Tensor:
        """Returns phi(o_t), (1, channels, rows, cols). Rows and cols include the padding."""
        return self.phi(self.prepare(image))

    def encode_crop(self, image: Image, pixel: tuple[int, int]) -> Tensor:
        """Returns psi(c_2) for the crop around a pixel, (1, channels, side, side)."""
        return self.psi(self.prepare(crop(image, pixel, sizes.PLACE_CROP)))

    def check_orientations(self, orientations: int) -> None:
        """Raises ValueError if the networks do not support N orientations."""
        discretization_matrix(orientations, self.config.angle_frequencies, quotient=2)

    def predict_pick(self, image: Image, orientations: int) -> PickPrediction:
        """Predicts the pick position f_p and the pick angle f_theta (section III-C.1) at N
        orientations."""
        raise NotImplementedError

    def predict_place(
        self, image: Image, pixel: tuple[int, int], orientations: int
    ) -> PlacePrediction:
        """Predicts placements f_place (section III-C.2) for the crop around a pick.

        Args:
            image: the observation.
            pixel: (row, col) of the pick.
            orientations: N, the number of orientations in a full turn.
        """
        rows, cols = image.shape[1:]
        scene, encoding = self.encode_scene(image), self.encode_crop(image, pixel)
        candidates, volume = search(scene, encoding, orientations, shape=(rows, cols))
        best = volume.amax(0)
        # Cell (i, j) of the coarse volume corresponds to pixel (2 i, 2 j).
        size = (2 * best.shape[0] - 1, 2 * best.shape[1] - 1)
        full = F.interpolate(best[None, None], size=size, mode="bilinear", align_corners=True)
        return PlacePrediction(candidates, full[0, 0, :rows, :cols])

    def losses(
        self, sample: LabelledImage, random: np.random.Generator
    ) -> Iterator[tuple[str, Callable[[], Tensor]]]:
        """Yields the name of each loss and a function that computes this loss on a sample."""
        sample = within_image(sample)
        pixels = [jittered(pick, random) for pick in (sample.pick, *sample.other_picks)]
        seed = int(random.integers(2**62))
        yield from self.pick_losses(sample, pixels, random)
        yield "place", lambda: self.place_loss(sample, pixels[0], seed)

    def pick_losses(
        self,
        sample: LabelledImage,
        pixels: list[tuple[int, int]],
        random: np.random.Generator,
    ) -> Iterator[tuple[str, Callable[[], Tensor]]]:
        """Yields the names and losses of the picking module, as `losses` does.

        Args:
            sample: the training sample.
            pixels: the centres of the crops, near the pick and each of the other picks.
            random: the generator of all random draws.
        """
        raise NotImplementedError

    def stop_loss(self, image: Image, random: np.random.Generator) -> Tensor:
        """Returns the cross-entropy for an observation with nothing to pick.

        Args:
            image: the observation.
            random: the generator of all random draws.
        """
        raise NotImplementedError

    def place_loss(self, sample: LabelledImage, pixel: tuple[int, int], seed: int) -> Tensor:
        """Returns the loss of the placing module.

        Args:
            sample: the training sample.
            pixel: the centre of the crop, near the pick.
            seed: the seed of all random draws.
        """
        goal = sample.place_of(np.array(pixel, float))
        return place_loss(
            self.encode_scene(sample.image),
            self.encode_crop(sample.image, pixel),
            (float(goal[0]), float(goal[1])),
            sample.rotation % math.tau,
            self.config.orientations,
            torch.Generator().manual_seed(seed),
        )

    def modules_by_loss(self) -> dict[str, list[nn.Module]]:
        """Returns the modules that each loss trains. Each loss has its own optimiser."""
        raise NotImplementedError


class FactoredNetworks(Networks):
    """Networks that predict the pick position first, then the angle (section III-C.1)."""

    alpha: nn.Module
    beta: nn.Module
    picking = "pick_position"

    def position_logits(self, image: Image) -> Tensor:
        """Returns the logits (rows, cols) of the pick position, f_p of the paper."""
        rows, cols = image.shape[1:]
        return self.alpha(self.prepare(image))[0, 0, :rows, :cols]

    def crop_angle_logits(self, crops: Tensor, orientations: int) -> Tensor:
        """Maps prepared crops (n, channels, side, side) to logits of the pick angle (n, N / 2),
        f_theta of the paper."""
        raise NotImplementedError

    def predict_angle(
        self, image: Image, pixel: tuple[int, int], orientations: int
    ) -> AnglePrediction:
        """Predicts the pick angles at a pixel (row, col)."""
        prepared = self.prepare(crop(image, pixel, sizes.PICK_CROP))
        return AnglePrediction(self.crop_angle_logits(prepared, orientations)[0], None)

    def predict_pick(self, image: Image, orientations: int) -> PickPrediction:
        logits = self.position_logits(image)
        return PickPrediction(
            position=logits,
            angle=lambda pixel: self.predict_angle(image, pixel, orientations),
            log_odds=float(log_odds(logits.detach())) if self.config.stop else None,
        )

    def pick_losses(
        self,
        sample: LabelledImage,
        pixels: list[tuple[int, int]],
        random: np.random.Generator,
    ) -> Iterator[tuple[str, Callable[[], Tensor]]]:
        picks = [(float(row), float(col)) for row, col in (sample.pick, *sample.other_picks)]

        def position() -> Tensor:
            logits = self.position_logits(sample.image)
            loss = position_loss(logits, *picks)
            if self.config.stop:
                loss = loss + presence_loss(log_odds(logits), present=True)
            return loss

        yield "pick_position", position
        yield "pick_angle", lambda: self._angle_loss(sample, pixels)

    def _angle_loss(self, sample: LabelledImage, pixels: list[tuple[int, int]]) -> Tensor:
        """Returns the mean loss over the crops of all picks.

        If the sample has curvatures, the mean also includes the `curved_crop` of each pick, which
        shows the object bent.
        """
        orientations = self.config.orientations
        crops = [crop(sample.image, pixel, sizes.PICK_CROP) for pixel in pixels]
        thetas = [sample.pick_theta, *sample.other_thetas]
        if len(sample.curvatures):
            crops += [
                sample.curved_crop(index, pixel, sizes.PICK_CROP)
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

    def stop_loss(self, image: Image, random: np.random.Generator) -> Tensor:
        return presence_loss(log_odds(self.position_logits(image)), present=False)

    def modules_by_loss(self) -> dict[str, list[nn.Module]]:
        return {
            "pick_position": [self.alpha],
            "pick_angle": [self.beta],
            "place": [self.phi, self.psi],
        }


class SO2Networks(FactoredNetworks):
    """The networks of the paper's own method. Their hidden fields are irreps of SO(2), and beta's
    output vector of irreps is discretized to angles."""

    def __init__(self, config: NetworkConfig, convolution: Convolution = SteerableConv2d) -> None:
        super().__init__(config)
        preset = self.preset
        fibre = Irreps(tuple(range(config.band + 1)), preset.samples)
        angle_fibre = Irreps(tuple(range(preset.angle_band + 1)), preset.angle_samples)
        angle_output = Irreps(config.angle_frequencies)
        self.alpha = UNet(config.channels, 1, fibre, preset.unet, convolution)
        self.beta = AngleNet(config.channels, angle_fibre, angle_output, preset.angle, convolution)
        self.phi = UNet(config.channels, sizes.FEATURES, fibre, preset.unet, convolution)
        self.psi = UNet(config.channels, sizes.FEATURES, fibre, preset.unet, convolution)

    def crop_angle_logits(self, crops: Tensor, orientations: int) -> Tensor:
        frequencies = self.config.angle_frequencies
        return discretize(self.beta(crops), orientations, frequencies, quotient=2)

    def predict_angle(
        self, image: Image, pixel: tuple[int, int], orientations: int
    ) -> AnglePrediction:
        frequencies = self.config.angle_frequencies
        # The Fourier coefficients of the logits give both the discrete and the refined angle.
        coefficients = self.beta(self.prepare(crop(image, pixel, sizes.PICK_CROP)))[0]
        return AnglePrediction(
            discretize(coefficients, orientations, frequencies, quotient=2),
            series_maximum(coefficients.detach().double().cpu().numpy(), frequencies),
        )


def within_image(sample: LabelledImage) -> LabelledImage:
    """Returns the sample without those of its `other_picks` that lie outside the image."""
    rows, cols = sample.image.shape[1:]
    picks = sample.other_picks
    inside = ((picks >= 0) & (picks <= (rows - 1, cols - 1))).all(axis=1)
    curvatures = sample.curvatures
    return dataclasses.replace(
        sample,
        other_picks=picks[inside],
        other_thetas=sample.other_thetas[inside],
        curvatures=curvatures[np.append(True, inside)] if len(curvatures) else curvatures,
    )


def jittered(pixel: NDArray[np.float64], random: np.random.Generator) -> tuple[int, int]:
    """Draws a random pixel near a position (row, col)."""
    offset = random.integers(-_JITTER, _JITTER + 1, size=2)
    row, col = np.rint(pixel).astype(int) + offset
    return int(row), int(col)
