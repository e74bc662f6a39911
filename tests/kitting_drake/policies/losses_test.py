import math

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from kitting_drake.policies.correlation import (
    COARSE_TURNS,
    KERNEL,
    coarse_volume,
    cross_correlation_fft,
    lift,
    turns,
)
from kitting_drake.policies.losses import (
    angle_loss,
    cross_entropy,
    joint_loss,
    place_loss,
    position_loss,
    soft_label,
    spread,
)
from tests.kitting_drake.policies.turning import smooth_image

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
def test_spreads_over_neighbours(position: float, cyclic: bool, expected: dict[int, float]):
    found = np.zeros(10)
    for index, weight in spread(position, 10, cyclic=cyclic):
        assert weight > 0
        found[index] += weight
    np.testing.assert_allclose(found, [expected.get(i, 0.0) for i in range(10)])


def test_on_a_pixel_or_a_bin_as_in_the_paper():
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
        joint_loss(volume, (spread(2, 6), (4.0, 5.0))),
        F.cross_entropy(volume.view(1, -1), torch.tensor([2 * 63 + 41])),
    )


def test_the_best_prediction_has_its_mean_at_the_label():
    logits = torch.randn(7, 9, requires_grad=True)
    (gradient,) = torch.autograd.grad(position_loss(logits, (3.25, 4.6)), logits)
    # The gradient vanishes where this is what is predicted.
    best = logits.detach().flatten().softmax(0).view(7, 9) - gradient
    assert best.min() > -1e-6
    assert float(best.sum(1) @ torch.arange(7.0)) == pytest.approx(3.25, abs=1e-5)
    assert float(best.sum(0) @ torch.arange(9.0)) == pytest.approx(4.6, abs=1e-5)


def test_just_below_a_half_turn_is_next_to_none():
    logits = torch.zeros(N // 2)
    logits[[0, -1]] = 5
    between = (N // 2 - 0.5) * STEP
    assert angle_loss(logits, between, N) == angle_loss(logits, 0.0, N)
    assert angle_loss(logits, between, N) < angle_loss(logits, 5 * STEP, N) - 4


def test_several_answers_are_equally_likely():
    volume = torch.randn(6, 7, 9)
    labels = [(spread(1.5, 6), (2.0, 3.0)), (spread(4, 6), (5.25, 6.0))]
    each = [joint_loss(volume, label) for label in labels]
    torch.testing.assert_close(joint_loss(volume, *labels), torch.stack(each).mean())


class Placing:
    """Smooth random encodings, and the whole of what `place_loss` estimates."""

    def __init__(self, seed: int, deviation: float) -> None:
        scene = smooth_image(97, seed=2 * seed, channels=3, blur=4)[:, :, 8:-8]
        self.encoding = smooth_image(97, seed=2 * seed + 1, channels=3, blur=4)
        kernels = lift(self.encoding, turns(N, scene), KERNEL)
        volume = cross_correlation_fft(scene, kernels)
        self.scene = scene * (deviation / volume.std())
        self.volume = volume * (deviation / volume.std())

    def exact(self, pixel: tuple[float, float], turn: float) -> float:
        """Equation 8 at all pixels and bins, and its cross-entropy."""
        label = (spread(turn / STEP, N, cyclic=True), pixel)
        return float(joint_loss(self.volume, label))

    def coarse(self, pixel: tuple[float, float], turn: float, seed: int) -> float:
        """The part of the loss that is of the coarse volume alone."""
        phase = float(torch.rand(1, generator=torch.Generator().manual_seed(seed)))
        volume = coarse_volume(self.scene, self.encoding, turns(COARSE_TURNS, self.scene, phase))
        label = soft_label(
            spread(turn / math.tau * COARSE_TURNS - phase, COARSE_TURNS, cyclic=True),
            spread(pixel[0] / 2, volume.shape[1]),
            spread(pixel[1] / 2, volume.shape[2]),
            like=volume,
        )
        return float(cross_entropy(volume, label))

    def estimated(self, pixel: tuple[float, float], turn: float, seed: int) -> float:
        """What `place_loss` says, without that part."""
        generator = torch.Generator().manual_seed(seed)
        loss = place_loss(self.scene, self.encoding, pixel, turn, N, generator)
        return float(loss) - self.coarse(pixel, turn, seed)


@pytest.mark.parametrize(("deviation", "tolerance"), [(0.5, 0.02), (2.0, 0.3)])
@pytest.mark.parametrize("seed", range(3))
def test_the_loss_of_placing_is_nearly_that_of_the_whole(
    seed: int, deviation: float, tolerance: float
):
    placing = Placing(seed, deviation)
    turn, row, col = np.unravel_index(int(placing.volume.argmax()), placing.volume.shape)
    for pixel, angle in [
        ((row + 0.3, col - 0.2), (turn + 0.4) * STEP % math.tau),
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


def test_draws_are_those_of_the_generator():
    placing = Placing(0, 3.0)

    def loss(seed: int) -> Tensor:
        generator = torch.Generator().manual_seed(seed)
        return place_loss(placing.scene, placing.encoding, (40.0, 50.0), 1.0, N, generator)

    assert loss(0) == loss(0)
    assert loss(0) != loss(1)
