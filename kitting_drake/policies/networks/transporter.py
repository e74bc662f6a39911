"""The Transporter, the second baseline of the paper (section V-C.3): ordinary convolutions.

Its networks are not equivariant to rotations, so they get rotated images. For picking, the scene is
rotated N / 2 times, because a parallel jaw is symmetric. In each rotated scene f_pick predicts
where a gripper at angle zero would pick. For placing, as in the original (Zeng et al.), the crop is
rotated N times and psi encodes each rotated crop. The equivariant methods encode the crop once.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from kitting_drake.policies.data.images import Image, LabelledImage
from kitting_drake.policies.networks import architecture as sizes
from kitting_drake.policies.networks.architecture import NetworkConfig
from kitting_drake.policies.networks.factored import (
    AnglePrediction,
    Networks,
    PickPrediction,
    PlacePrediction,
)
from kitting_drake.policies.networks.layers.correlation import (
    KERNEL,
    Candidate,
    cross_correlation_fft,
    finer_bins,
    kernel_window,
    peaks,
    ranked,
    window_around,
)
from kitting_drake.policies.networks.layers.steerable import Convolution, SteerableConv2d
from kitting_drake.policies.networks.losses import (
    interpolate_label,
    joint_loss,
    log_odds,
    presence_loss,
)
from kitting_drake.policies.networks.resnet import ResNet

_NEAR = math.radians(10)
"""Rotations within this angle of a label, in radians, are easily confused with it and form their
own stratum (see `draw_bins`)."""
_DRAWS = 2
"""The default number of rotations that a training step draws in each stratum.

More draws make a step slower and did not help in a test. After 750 steps of the place networks on
the task align-box-corner, with a learning rate of 3e-4, the validation cross-entropy over all
rotations was 6.6 with 2 draws and 7.9 with 16.
"""
_COARSE = 36
"""The largest number of crop rotations in the coarse search at inference."""
_CANDIDATES = 3
"""The number of coarse peaks that are refined at inference."""


class TransporterNetworks(Networks):
    """The networks f_pick, phi and psi of the Transporter, each a residual network of 43 layers."""

    picking = "pick"

    def __init__(self, config: NetworkConfig, convolution: Convolution = SteerableConv2d) -> None:
        """
        Args:
            config: the architecture.
            convolution: not used, because the Transporter has no steerable convolutions.
        """
        super().__init__(config)
        widths = self.preset.resnet
        self.f_pick = ResNet(config.channels, 1, widths)
        self.phi = ResNet(config.channels, sizes.FEATURES, widths)
        self.psi = ResNet(config.channels, sizes.FEATURES, widths)

    def check_orientations(self, orientations: int) -> None:
        """Raises ValueError if N is odd: N / 2 rotations must span half a turn."""
        if orientations < 2 or orientations % 2:
            raise ValueError(f"orientations must be an even number, not {orientations}")

    def pick_volume(self, image: Image, orientations: int) -> Tensor:
        """Returns f_pick, (N / 2, rows, cols): the logits of all pixels at the gripper angles
        2 pi i / N."""
        self.check_orientations(orientations)
        step = math.tau / orientations
        return torch.stack([self._pick_scores(image, i * step) for i in range(orientations // 2)])

    def _pick_scores(self, image: Image, theta: float) -> Tensor:
        """Returns the logits (rows, cols) of picking with the gripper at the angle `theta`."""
        rows, cols = image.shape[1:]
        canvas = canvas_shape((rows, cols), theta)
        scene = rotated(self._on_device(image), -theta, canvas)
        scores = self.f_pick(self.prepare_batch(scene))[:, :, : canvas[0], : canvas[1]]
        return rotated(scores, theta, (rows, cols))[0, 0]

    def _on_device(self, image: Image) -> Tensor:
        """Moves an image to the networks' device, as (1, 4, rows, cols)."""
        return torch.from_numpy(np.array(image, order="C")).to(self.device)[None]

    def predict_pick(self, image: Image, orientations: int) -> PickPrediction:
        """Predicts position and angle from one volume of scores over pixels and angles."""
        volume = self.pick_volume(image, orientations)
        return PickPrediction(
            position=volume.amax(0),
            angle=lambda pixel: AnglePrediction(volume[:, pixel[0], pixel[1]], None),
            log_odds=float(log_odds(volume, len(volume))) if self.config.stop else None,
        )

    def pick_losses(
        self,
        sample: LabelledImage,
        pixels: list[tuple[int, int]],
        random: np.random.Generator,
    ) -> Iterator[tuple[str, Callable[[], Tensor]]]:
        step = math.tau / self.config.orientations
        bins = self.config.orientations // 2
        thetas = (sample.pick_theta, *sample.other_thetas)
        angles = [interpolate_label(theta % math.pi / step, bins, cyclic=True) for theta in thetas]
        labels = {bin_ for angle in angles for bin_, _ in angle}
        drawn = draw_bins(labels, bins, step, random, self._pick_rotations)
        picks = [(float(row), float(col)) for row, col in (sample.pick, *sample.other_picks)]

        def loss() -> Tensor:
            logits = self._drawn_scores(sample.image, drawn)
            targets = [
                (among(angle, drawn), pick) for angle, pick in zip(angles, picks, strict=True)
            ]
            value = joint_loss(logits, *targets)
            if self.config.stop:
                value = value + presence_loss(log_odds(logits, bins), present=True)
            return value

        yield "pick", loss

    def stop_loss(self, image: Image, random: np.random.Generator) -> Tensor:
        bins = self.config.orientations // 2
        step = math.tau / self.config.orientations
        drawn = draw_bins(set(), bins, step, random, self._pick_rotations)
        return presence_loss(log_odds(self._drawn_scores(image, drawn), bins), present=False)

    @property
    def _pick_rotations(self) -> int | None:
        """Half of `rotations`, because a gripper has only half as many distinct angles as a
        crop."""
        return None if self.rotations is None else self.rotations // 2

    def _drawn_scores(self, image: Image, drawn: dict[int, float]) -> Tensor:
        """Returns the logits (n, rows, cols) of picking at the angles of n randomly drawn bins.
        Each bin's log weight is added (see `draw_bins`)."""
        step = math.tau / self.config.orientations
        scores = [self._pick_scores(image, bin_ * step) + stands for bin_, stands in drawn.items()]
        return torch.stack(scores)

    def encode_crops(self, image: Image, pixel: tuple[int, int], angles: Sequence[float]) -> Tensor:
        """Returns the kernels of f_place: psi's encodings of crops of the rotated scene.

        Args:
            image: the observation.
            pixel: (row, col) of the centre of all crops and rotations.
            angles: n rotations of the scene about `pixel`, in radians.

        Returns:
            (n, channels, KERNEL, KERNEL).
        """
        crops = rotated_crops(self._on_device(image), pixel, angles)
        encodings = self.psi(self.prepare_batch(crops))
        margin = (sizes.PLACE_CROP - KERNEL) // 2
        return encodings[:, :, margin:-margin, margin:-margin]

    def predict_place(
        self, image: Image, pixel: tuple[int, int], orientations: int
    ) -> PlacePrediction:
        """Predicts f_place over all pixels and, for N up to 36, at all rotations.

        For larger N, 36 nearly evenly spaced rotations are evaluated first. The three best peaks
        are then refined: the pixels near a peak are evaluated at all bins between its two
        neighbours among the 36 rotations.
        """
        shape = (image.shape[1], image.shape[2])
        step = math.tau / orientations
        scene = self.encode_scene(image)
        coarse = coarse_bins(orientations)
        kernels = self.encode_crops(image, pixel, [bin_ * step for bin_ in coarse])
        volume = cross_correlation_fft(scene, kernels)[:, : shape[0], : shape[1]]
        candidates = []
        for rotation, row, col in peaks(volume, _CANDIDATES):
            first, last = finer_bins(rotation, len(coarse), orientations)
            corner, size = window_around((row, col), shape)
            if len(coarse) == orientations:
                around = [bin_ % orientations for bin_ in range(first, last + 1)]
                rows, cols = (slice(a, a + n) for a, n in zip(corner, size, strict=True))
                scores = volume[around][:, rows, cols]
            else:
                angles = [bin_ * step for bin_ in range(first, last + 1)]
                finer = self.encode_crops(image, pixel, angles)
                scores = kernel_window(scene, finer, corner, size)
            candidates.append(Candidate(scores, first, corner))
        return PlacePrediction(ranked(candidates, orientations), volume.amax(0))

    def place_loss(self, sample: LabelledImage, pixel: tuple[int, int], seed: int) -> Tensor:
        """Returns the cross-entropy over all pixels and the drawn rotations (see `draw_bins`)."""
        orientations = self.config.orientations
        step = math.tau / orientations
        row, col = sample.place_of(np.array(pixel, float))
        bins = interpolate_label(sample.rotation % math.tau / step, orientations, cyclic=True)
        labels, random = {bin_ for bin_, _ in bins}, np.random.default_rng(seed)
        drawn = draw_bins(labels, orientations, step, random, self.rotations)
        kernels = self.encode_crops(sample.image, pixel, [bin_ * step for bin_ in drawn])
        logits = cross_correlation_fft(self.encode_scene(sample.image), kernels)
        stands = logits.new_tensor(list(drawn.values()))
        label = (among(bins, drawn), (float(row), float(col)))
        return joint_loss(logits + stands[:, None, None], label)

    def modules_by_loss(self) -> dict[str, list[nn.Module]]:
        return {"pick": [self.f_pick], "place": [self.phi, self.psi]}


def coarse_bins(orientations: int) -> list[int]:
    """Returns the crop rotations of the coarse search at inference, in bins; at most 36."""
    count = min(orientations, _COARSE)
    return [round(i * orientations / count) for i in range(count)]


def encodings_per_decision(orientations: int) -> int:
    """Returns the number of crops that `TransporterNetworks.predict_place` encodes at N
    orientations."""
    coarse = len(coarse_bins(orientations))
    if coarse == orientations:
        return coarse
    first, last = finer_bins(0, coarse, orientations)
    return coarse + _CANDIDATES * (last - first + 1)


def draw_bins(
    labels: set[int],
    bins: int,
    step: float,
    random: np.random.Generator,
    rotations: int | None = None,
) -> dict[int, float]:
    """Draws the rotations of a training step for a sampled softmax with two strata, near the labels
    and far from them.

    Args:
        labels: bins that must be included.
        bins: the total number of bins, over half a rotation or a full rotation.
        step: the angle between neighbouring bins, in radians.
        random: the generator that draws the other bins.
        rotations: the number of bins to return, including the labels. Half of the drawn bins are
            near a label, if so many exist. At least two bins are drawn in each stratum. None: two
            bins are drawn in each stratum.

    Returns:
        A dict from bins to log weights in nats. Adding these to the logits makes the drawn bins
        stand for their whole stratum.
    """
    strata: tuple[list[int], list[int]] = ([], [])
    for bin_ in range(bins):
        if bin_ in labels:
            continue
        apart = [abs(math.remainder((bin_ - label) * step, bins * step)) for label in labels]
        strata[min(apart, default=math.inf) > _NEAR].append(bin_)
    wanted = [_DRAWS, _DRAWS]
    if rotations is not None:
        others = max(rotations - len(labels), sum(wanted))
        near, far = map(len, strata)
        wanted[0] = min(max(others // 2, others - far), near)
        wanted[1] = others - wanted[0]
    drawn = dict.fromkeys(sorted(labels), 0.0)
    for stratum, most in zip(strata, wanted, strict=True):
        count = min(most, len(stratum))
        for bin_ in random.choice(stratum, count, replace=False) if count else ():
            drawn[int(bin_)] = math.log(len(stratum) / count)
    return drawn


def among(label: list[tuple[int, float]], drawn: dict[int, float]) -> list[tuple[int, float]]:
    """Replaces each bin of an interpolated label by its index among the keys of `drawn`, the bins
    of this training step."""
    index = {bin_: position for position, bin_ in enumerate(drawn)}
    return [(index[bin_], weight) for bin_, weight in label]


def canvas_shape(shape: tuple[int, int], angle: float) -> tuple[int, int]:
    """Returns the rows and cols that hold all pixel centres of an image (rows, cols) after its
    rotation by an angle in radians."""
    cos, sin = abs(math.cos(angle)), abs(math.sin(angle))
    height, width = shape[0] - 1, shape[1] - 1
    # Subtract a little, so that rounding errors do not add a pixel at a rotation by 90 degrees.
    rows = math.ceil(height * cos + width * sin - 1e-6)
    cols = math.ceil(height * sin + width * cos - 1e-6)
    return rows + 1, cols + 1


def rotated(image: Tensor, angle: float, shape: tuple[int, int]) -> Tensor:
    """Rotates an image about its centre with bilinear sampling; pixels outside the image are zero
    (unseen).

    Args:
        image: (1, channels, rows, cols).
        angle: the rotation, counter-clockwise, in radians.
        shape: rows and cols of the result, which has the same centre.

    Returns:
        (1, channels, *shape).
    """
    rows, cols = image.shape[2:]
    return _sampled(image, ((rows - 1) / 2, (cols - 1) / 2), [angle], shape)


def rotated_crops(image: Tensor, pixel: tuple[int, int], angles: Sequence[float]) -> Tensor:
    """Returns crops of the scene after rotations about a pixel, which is the centre of each crop.

    Rotating the scene rather than the crop keeps the crop's corners filled.

    Args:
        image: (1, channels, rows, cols).
        pixel: (row, col).
        angles: n counter-clockwise angles in radians.

    Returns:
        (n, channels, PLACE_CROP, PLACE_CROP); zero (unseen) outside the image.
    """
    return _sampled(image, pixel, angles, (sizes.PLACE_CROP, sizes.PLACE_CROP))


def _sampled(
    image: Tensor, centre: tuple[float, float], angles: Sequence[float], shape: tuple[int, int]
) -> Tensor:
    """Rotates an image about the point `centre` (row, col) by each of n angles, in radians.

    Returns:
        (n, channels, *shape). The point lies at the centre of each result.
    """
    axes = [
        torch.arange(side, dtype=image.dtype, device=image.device) - (side - 1) / 2
        for side in shape
    ]
    row, col = torch.meshgrid(*axes, indexing="ij")
    rows, cols = image.shape[2:]
    sources = []
    for angle in angles:
        cos, sin = math.cos(angle), math.sin(angle)
        # Rotate each pixel of the result back to find where to sample the image. `grid_sample`
        # takes these positions as (col, row), from -1 to 1.
        source_row = cos * row + sin * col + (centre[0] - (rows - 1) / 2)
        source_col = cos * col - sin * row + (centre[1] - (cols - 1) / 2)
        source = [source_col * (2 / (cols - 1)), source_row * (2 / (rows - 1))]
        sources.append(torch.stack(source, dim=-1))
    stack = image.expand(len(sources), -1, -1, -1)
    return F.grid_sample(
        stack, torch.stack(sources), mode="bilinear", padding_mode="zeros", align_corners=True
    )
