import math

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from kitting_drake.policies.networks.layers.correlation import (
    COARSE_ROTATIONS,
    KERNEL,
    coarse_volume,
    cross_correlation_fft,
    lift,
    rotation_angles,
)
from kitting_drake.policies.networks.losses import (
    NOTHING_LOGIT,
    angle_loss,
    cross_entropy,
    interpolate_label,
    joint_loss,
    log_odds,
    place_loss,
    position_loss,
    presence_loss,
    soft_label,
)
from tests.kitting_drake.policies.equivariance import smooth_image

N = 36
STEP = math.tau / N


@pytest.mark.parametrize(
    ("position", "cyclic", "expected"),
    [
        (3.0, False, {3: 1.0}),
        (3.25, False, {3: 0.75, 4: 0.25}),
        (9.5, True, {9: 0.5, 0: 0.5}),
        (-0.25, True, {9: 0.25, 0: 0.75}),
        (9.5, False, {9: 1.0}),
        (-3.5, False, {0: 1.0}),
    ],
)
def test_interpolates_between_neighbours(position: float, cyclic: bool, expected: dict[int, float]):
    found = np.zeros(10)
    for index, weight in interpolate_label(position, 10, cyclic=cyclic):
        assert weight > 0
        found[index] += weight
    np.testing.assert_allclose(found, [expected.get(i, 0.0) for i in range(10)])


def test_a_label_on_a_pixel_or_bin_is_one_hot():
    pixels, bins = torch.randn(7, 9), torch.randn(N // 2)
    torch.testing.assert_close(
        position_loss(pixels, (4.0, 5.0)), F.cross_entropy(pixels.view(1, -1), torch.tensor([41]))
    )
    for index in (0, 17):
        torch.testing.assert_close(
            angle_loss(bins, index * STEP, N), F.cross_entropy(bins[None], torch.tensor([index]))
        )
    volume = torch.randn(6, 7, 9)
    torch.testing.assert_close(
        joint_loss(volume, (interpolate_label(2, 6), (4.0, 5.0))),
        F.cross_entropy(volume.view(1, -1), torch.tensor([2 * 63 + 41])),
    )


def test_the_optimal_prediction_has_its_mean_at_the_label():
    logits = torch.randn(7, 9, requires_grad=True)
    (gradient,) = torch.autograd.grad(position_loss(logits, (3.25, 4.6)), logits)
    # The loss's gradient is the softmax minus the optimal prediction.
    best = logits.detach().flatten().softmax(0).view(7, 9) - gradient
    assert best.min() > -1e-6
    assert float(best.sum(1) @ torch.arange(7.0)) == pytest.approx(3.25, abs=1e-5)
    assert float(best.sum(0) @ torch.arange(9.0)) == pytest.approx(4.6, abs=1e-5)


def test_angles_are_equal_modulo_pi():
    logits = torch.zeros(N // 2)
    logits[[0, -1]] = 5
    between = (N // 2 - 0.5) * STEP
    assert angle_loss(logits, between, N) == angle_loss(logits, 0.0, N)
    assert angle_loss(logits, between, N) < angle_loss(logits, 5 * STEP, N) - 4


def test_nothing_to_pick_is_an_additional_class():
    logits, label = torch.randn(7, 9), (4.0, 5.0)
    classes = torch.cat([logits.flatten(), torch.tensor([NOTHING_LOGIT])])[None]
    odds = log_odds(logits)
    torch.testing.assert_close(
        position_loss(logits, label) + presence_loss(odds, present=True),
        F.cross_entropy(classes, torch.tensor([41])),
    )
    torch.testing.assert_close(
        presence_loss(odds, present=False), F.cross_entropy(classes, torch.tensor([63]))
    )
    # Logits that are repeated for every orientation give the same odds.
    torch.testing.assert_close(log_odds(logits.expand(6, -1, -1), 6), odds)


def test_several_labels_are_equally_likely():
    volume = torch.randn(6, 7, 9)
    labels = [(interpolate_label(1.5, 6), (2.0, 3.0)), (interpolate_label(4, 6), (5.25, 6.0))]
    each = [joint_loss(volume, label) for label in labels]
    torch.testing.assert_close(joint_loss(volume, *labels), torch.stack(each).mean())


class Placing:
    """Smooth random encodings, and the exact loss that `place_loss` estimates."""

    def __init__(self, seed: int, std: float) -> None:
        scene = smooth_image(97, seed=2 * seed, channels=3, blur=4)[:, :, 8:-8]
        self.encoding = smooth_image(97, seed=2 * seed + 1, channels=3, blur=4)
        kernels = lift(self.encoding, rotation_angles(N, scene), KERNEL)
        volume = cross_correlation_fft(scene, kernels)
        self.scene = scene * (std / volume.std())
        self.volume = volume * (std / volume.std())

    def exact(self, pixel: tuple[float, float], rotation: float) -> float:
        """The cross-entropy of the volume of equation 8, with all pixels and bins."""
        label = (interpolate_label(rotation / STEP, N, cyclic=True), pixel)
        return float(joint_loss(self.volume, label))

    def coarse(self, pixel: tuple[float, float], rotation: float, seed: int) -> float:
        """The part of `place_loss` that comes from the coarse volume."""
        phase = float(torch.rand(1, generator=torch.Generator().manual_seed(seed)))
        volume = coarse_volume(
            self.scene, self.encoding, rotation_angles(COARSE_ROTATIONS, self.scene, phase)
        )
        label = soft_label(
            interpolate_label(
                rotation / math.tau * COARSE_ROTATIONS - phase, COARSE_ROTATIONS, cyclic=True
            ),
            interpolate_label(pixel[0] / 2, volume.shape[1]),
            interpolate_label(pixel[1] / 2, volume.shape[2]),
            like=volume,
        )
        return float(cross_entropy(volume, label))

    def estimated(self, pixel: tuple[float, float], rotation: float, seed: int) -> float:
        """The value of `place_loss` without the coarse part."""
        generator = torch.Generator().manual_seed(seed)
        loss = place_loss(self.scene, self.encoding, pixel, rotation, N, generator)
        return float(loss) - self.coarse(pixel, rotation, seed)


@pytest.mark.parametrize(("std", "tolerance"), [(0.5, 0.02), (2.0, 0.3)])
@pytest.mark.parametrize("seed", range(3))
def test_the_place_loss_estimates_that_of_the_full_volume(seed: int, std: float, tolerance: float):
    placing = Placing(seed, std)
    best, row, col = np.unravel_index(int(placing.volume.argmax()), placing.volume.shape)
    for pixel, angle in [
        ((row + 0.3, col - 0.2), (best + 0.4) * STEP % math.tau),
        ((30.0, 60.5), 0.1),
        ((40.2, 20.0), math.tau - 0.05),
        ((1.5, 95.0), 3.0),
    ]:
        found = placing.estimated(pixel, angle, seed)
        assert found == pytest.approx(placing.exact(pixel, angle), abs=tolerance)


@pytest.mark.parametrize("orientations", [26, 180, 720])
@pytest.mark.parametrize("pixel", [(40.3, 50.8), (0.0, 96.0), (-3.0, 50.0)])
def test_gradients_are_finite(orientations: int, pixel: tuple[float, float]):
    placing = Placing(0, 3.0)
    scene, encoding = placing.scene.requires_grad_(), placing.encoding.requires_grad_()
    generator = torch.Generator().manual_seed(0)
    loss = place_loss(scene, encoding, pixel, 6.28, orientations, generator)
    for gradient in torch.autograd.grad(loss, [scene, encoding]):
        assert gradient.isfinite().all()
        assert gradient.abs().max() > 0


def test_the_generator_determines_the_draws():
    placing = Placing(0, 3.0)

    def loss(seed: int) -> Tensor:
        generator = torch.Generator().manual_seed(seed)
        return place_loss(placing.scene, placing.encoding, (40.0, 50.0), 1.0, N, generator)

    assert loss(0) == loss(0)
    assert loss(0) != loss(1)
