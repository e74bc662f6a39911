import itertools
import math

import numpy as np
import pytest
import torch
from torch import Tensor

from kitting_drake.policies.data.images import rotation_matrix
from kitting_drake.policies.networks.layers.correlation import (
    KERNEL,
    Candidate,
    coarse_volume,
    cross_correlation,
    cross_correlation_fft,
    lift,
    ranked,
    rotation_angles,
    search,
    window,
)
from tests.kitting_drake.policies.equivariance import smooth_image

SCENE = (81, 97)
SIDE = 97


def random_pair(seed: int, blur: int = 3) -> tuple[Tensor, Tensor]:
    """Encodings of a scene and of an unrelated crop, as smooth as those of the networks."""
    scene = smooth_image(113, seed=2 * seed, channels=3, blur=blur)
    encoding = smooth_image(SIDE, seed=2 * seed + 1, channels=3, blur=blur)
    return scene[:, :, 16:, 8:][:, :, : SCENE[0], : SCENE[1]], encoding


def plain_volume(scene: Tensor, encoding: Tensor, orientations: int) -> Tensor:
    """The place volume by equations 7 and 8, computed for 30 rotations at a time."""
    parts = [
        cross_correlation_fft(scene, lift(encoding, angles, KERNEL))
        for angles in rotation_angles(orientations, scene).split(30)
    ]
    return torch.cat(parts)


def test_lifts_counter_clockwise():
    encoding = torch.randn(1, 2, 33, 33)
    lifted = lift(encoding, rotation_angles(4, encoding), 33)
    for quarters in range(4):
        expected = encoding[0].rot90(quarters, (1, 2))
        torch.testing.assert_close(lifted[quarters], expected, atol=1e-4, rtol=0)


def test_lift_rotates_a_point_like_a_label():
    encoding = torch.zeros(1, 1, 41, 41)
    offset = np.array([9, 4])
    encoding[0, 0, 20 + offset[0], 20 + offset[1]] = 1
    for angle in (0.3, 2.0, 4.4):
        lifted = lift(encoding, torch.tensor([angle]), 35)[0, 0]
        row, col = torch.meshgrid(*(torch.arange(-17.0, 18),) * 2, indexing="ij")
        centroid = [float((lifted * axis).sum() / lifted.sum()) for axis in (row, col)]
        np.testing.assert_allclose(centroid, rotation_matrix(angle) @ offset, atol=0.2)


def test_cross_correlation_computes_equation_8():
    generator = torch.Generator().manual_seed(0)
    scene = torch.randn(1, 3, 21, 33, generator=generator)
    kernels = torch.randn(4, 3, 5, 5, generator=generator)
    plain = cross_correlation(scene, kernels)
    assert plain.shape == (4, 21, 33)
    patch = scene[0, :, 8:13, 18:23]
    torch.testing.assert_close(plain[2, 10, 20], (kernels[2] * patch).sum() / KERNEL)
    corner = (kernels[1][:, 2:, 2:] * scene[0, :, :3, :3]).sum() / KERNEL
    torch.testing.assert_close(plain[1, 0, 0], corner)


@pytest.mark.parametrize(("sides", "size"), [((21, 33), 5), ((81, 97), 65), ((7, 100), 9)])
def test_correlation_by_fft_equals_direct_correlation(sides: tuple[int, int], size: int):
    scene, kernels = torch.randn(1, 3, *sides), torch.randn(4, 3, size, size)
    plain, fast = cross_correlation(scene, kernels), cross_correlation_fft(scene, kernels)
    # Sums of 12,675 products are rounded differently by different processors.
    torch.testing.assert_close(fast, plain, atol=1e-4 * float(plain.std()), rtol=0)


@pytest.mark.parametrize(("sides", "size"), [((21, 33), 5), ((7, 30), 9)])
def test_gradients_by_fft_equal_direct_gradients(sides: tuple[int, int], size: int):
    scene, kernels = torch.randn(1, 3, *sides), torch.randn(4, 3, size, size)
    weights = torch.randn(4, *sides)
    gradients = []
    for correlate in (cross_correlation, cross_correlation_fft):
        leaves = [item.clone().requires_grad_() for item in (scene, kernels)]
        (correlate(*leaves) * weights).sum().backward()
        gradients.append([leaf.grad for leaf in leaves])
    for plain, fast in zip(*gradients, strict=True):
        torch.testing.assert_close(fast, plain, atol=1e-5 * float(plain.std()), rtol=1e-4)


def test_a_window_is_the_same_with_gradients():
    scene, encoding = random_pair(0)
    arguments = (torch.tensor([0.0, 0.7]), (-3, 40), (9, 17))
    plain = window(scene, encoding, *arguments)
    found = window(scene, encoding.clone().requires_grad_(), *arguments)
    assert found.requires_grad
    torch.testing.assert_close(found, plain, atol=1e-5 * float(plain.std()), rtol=0)


@pytest.mark.parametrize(
    ("corner", "shape"),
    [((30, 40), (5, 9)), ((0, 0), (4, 4)), ((77, 90), (4, 7)), ((0, 50), SCENE)],
)
def test_a_window_is_a_part_of_the_full_correlation(
    corner: tuple[int, int], shape: tuple[int, int]
):
    scene, encoding = random_pair(0)
    angles = torch.tensor([0.0, 0.7, 3.0])
    found = window(scene, encoding, angles, corner, shape)
    assert found.shape == (3, *shape)
    whole = cross_correlation(scene, lift(encoding, angles, KERNEL))
    expected = whole[:, corner[0] :, corner[1] :][:, : shape[0], : shape[1]]
    inside = found[:, : expected.shape[1], : expected.shape[2]]
    torch.testing.assert_close(inside, expected, atol=1e-4 * float(whole.std()), rtol=0)


def test_a_window_may_lie_outside_the_scene():
    scene, encoding = random_pair(0)
    wide = torch.nn.functional.pad(scene, (20, 20, 20, 20))
    angles = torch.tensor([1.0])
    for corner in [(-10, -15), (75, 90), (-40, 30), (130, 130)]:
        found = window(scene, encoding, angles, corner, (12, 12))
        expected = window(wide, encoding, angles, (corner[0] + 20, corner[1] + 20), (12, 12))
        torch.testing.assert_close(found, expected, atol=1e-3, rtol=0)


def test_the_coarse_volume_approximates_the_full_correlation():
    scene, encoding = random_pair(1)
    angles = rotation_angles(8, scene)
    coarse = coarse_volume(scene, encoding, angles)
    plain = cross_correlation(scene, lift(encoding, angles, KERNEL))[:, ::2, ::2]
    assert coarse.shape == plain.shape
    # The volumes differ a little, because the coarse one lacks the finest detail.
    assert (coarse - plain).std() < 0.1 * plain.std()


@pytest.mark.parametrize(
    ("orientations", "seed"), [(36, 0), (36, 1), (36, 2), (72, 0), (72, 3), (180, 0), (180, 4)]
)
def test_the_search_finds_the_full_maximum(orientations: int, seed: int):
    scene, encoding = random_pair(seed)
    volume = plain_volume(scene, encoding, orientations)
    expected = np.unravel_index(int(volume.argmax()), volume.shape)
    candidates, _ = search(scene, encoding, orientations)
    score, rotation, row, col = candidates[0].best()
    assert (rotation % orientations, row, col) == expected
    assert score == pytest.approx(float(volume.max()), rel=1e-4)
    scores = [candidate.best()[0] for candidate in candidates]
    assert scores == sorted(scores, reverse=True)


@pytest.mark.parametrize("pixel", [(40, 50), (0, 0), (80, 96), (3, 95)])
@pytest.mark.parametrize("rotation", [0, 7, 71])
def test_the_search_finds_the_crop_in_the_scene(pixel: tuple[int, int], rotation: int):
    _, encoding = random_pair(5)
    angle = rotation * math.tau / 72
    stamp = lift(encoding, torch.tensor([angle]), KERNEL)
    canvas = torch.zeros(1, 3, SCENE[0] + KERNEL - 1, SCENE[1] + KERNEL - 1)
    canvas[:, :, pixel[0] :, pixel[1] :][:, :, :KERNEL, :KERNEL] = stamp
    reach = KERNEL // 2
    scene = canvas[:, :, reach:-reach, reach:-reach]
    candidates, _ = search(scene, encoding, 72)
    _, found, row, col = candidates[0].best()
    # At an edge of the scene half of the crop is missing, so the rotation may be off by a bin.
    assert (row, col) == pixel
    assert (found - rotation + 36) % 72 - 36 in (-1, 0, 1)


def test_of_windows_with_the_same_maximum_the_one_with_more_neighbours_is_kept():
    """Sub-pixel refinement needs the values around the maximum."""
    volume = torch.zeros(72, 20, 20)
    volume[70, 9, 9], volume[30, 2, 2] = 3.0, 5.0
    cut = Candidate(torch.cat([volume[66:], volume[:3]])[:, 1:10, 3:12], 66, (1, 3))
    # This window has the same maximum as `cut`, but with all its neighbours. Its bins are
    # numbered from -6 instead of 66, and its values differ as if by rounding.
    whole = Candidate(volume[66:72, 5:14, 5:14] * (1 - 1e-6), 66 - 72, (5, 5))
    other = Candidate(volume[28:33, 0:7, 0:7], 28, (0, 0))
    for given in itertools.permutations([cut, whole, other]):
        assert list(map(id, ranked(given, 72))) == [id(other), id(whole)]


def test_the_search_stays_within_the_given_shape():
    scene, encoding = random_pair(2)
    for shape in [(40, 96), (80, 33)]:
        volume = plain_volume(scene, encoding, 36)[:, : shape[0], : shape[1]]
        expected = np.unravel_index(int(volume.argmax()), volume.shape)
        candidates, _ = search(scene, encoding, 36, shape=shape)
        _, rotation, row, col = candidates[0].best()
        assert (rotation % 36, row, col) == expected
