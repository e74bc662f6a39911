import math

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from kitting_drake.policies.networks.layers.discretization import (
    discretization_matrix,
    discretize,
)
from kitting_drake.policies.networks.layers.fourier_series import series_maximum

PAPER = tuple(range(7))
QUOTIENT = (0, 2, 4, 6, 8, 10, 12)


def random_series(seed: int, frequencies: tuple[int, ...]) -> NDArray[np.float64]:
    size = sum(2 if j else 1 for j in frequencies)
    return np.random.default_rng(seed).normal(size=size)


def value(
    coefficients: NDArray[np.float64], frequencies: tuple[int, ...], angle: NDArray[np.float64]
) -> NDArray[np.float64]:
    """The sum of the series of equation 5 at some angles, added term by term."""
    rest = list(coefficients)
    total = np.zeros_like(angle)
    for j in frequencies:
        total += rest.pop(0) * np.cos(j * angle)
        if j:
            total += rest.pop(0) * np.sin(j * angle)
    return total


def rotated(
    coefficients: NDArray[np.float64], frequencies: tuple[int, ...], angle: float
) -> NDArray[np.float64]:
    """The coefficients after rho_irrep(angle) of equations 1 and 4."""
    result = coefficients.copy()
    index = 0
    for j in frequencies:
        if j:
            cos, sin = math.cos(j * angle), math.sin(j * angle)
            result[index : index + 2] = np.array([[cos, -sin], [sin, cos]]) @ result[index:][:2]
        index += 2 if j else 1
    return result


@pytest.mark.parametrize("frequencies", [(0,), (0, 1), PAPER, (0, 2, 5), (1, 3)])
def test_discretizes_equation_5(frequencies: tuple[int, ...]):
    coefficients = random_series(0, frequencies)
    for orientations in (36, 180):
        angles = 2 * np.pi * np.arange(orientations) / orientations
        values = discretization_matrix(orientations, frequencies) @ coefficients
        np.testing.assert_allclose(values, value(coefficients, frequencies, angles), atol=1e-12)


def test_the_quotient_has_the_angles_below_pi():
    coefficients = random_series(0, QUOTIENT)
    full = discretization_matrix(36, QUOTIENT) @ coefficients
    half = discretization_matrix(36, QUOTIENT, quotient=2) @ coefficients
    np.testing.assert_allclose(half, full[:18], atol=1e-12)
    np.testing.assert_allclose(half, full[18:], atol=1e-12)


def test_as_many_orientations_as_coefficients_suffice():
    assert np.linalg.matrix_rank(discretization_matrix(13, PAPER)) == 13
    assert np.linalg.matrix_rank(discretization_matrix(26, QUOTIENT, quotient=2)) == 13


@pytest.mark.parametrize(
    ("orientations", "frequencies", "quotient", "message"),
    [
        (12, PAPER, 1, r"12 orientations alias .* up to 6: at least 13 are needed \(Nyquist\)"),
        (6, (0, 5), 1, r"6 orientations alias .* up to 5: at least 11 are needed \(Nyquist\)"),
        (24, QUOTIENT, 2, r"24 orientations alias .* up to 12: at least 26 are needed \(Nyquist\)"),
        (36, (0, 2, 3), 2, r"frequency 3 .* SO\(2\)/C_2"),
        (37, QUOTIENT, 2, "37 orientations are not a multiple of 2"),
        (0, PAPER, 1, "0 orientations"),
    ],
)
def test_rejects_invalid_arguments(
    orientations: int, frequencies: tuple[int, ...], quotient: int, message: str
):
    with pytest.raises(ValueError, match=message):
        discretization_matrix(orientations, frequencies, quotient=quotient)


@pytest.mark.parametrize(("frequencies", "quotient"), [(PAPER, 1), (QUOTIENT, 2)])
def test_a_rotation_by_k_bins_shifts_the_distribution_by_k(
    frequencies: tuple[int, ...], quotient: int
):
    coefficients = random_series(1, frequencies)
    matrix = discretization_matrix(72, frequencies, quotient=quotient)
    for k in (1, 5, 35, 71):
        moved = matrix @ rotated(coefficients, frequencies, 2 * np.pi * k / 72)
        np.testing.assert_allclose(moved, np.roll(matrix @ coefficients, k), atol=1e-11)


def test_one_vector_is_discretized_at_every_n():
    coefficients = torch.from_numpy(np.stack([random_series(seed, PAPER) for seed in range(4)]))
    coarse, fine = (discretize(coefficients, n, PAPER) for n in (36, 720))
    assert coarse.shape == (4, 36)
    torch.testing.assert_close(coarse, fine[:, ::20], atol=1e-12, rtol=0)


def test_keeps_gradients_and_type():
    coefficients = torch.ones(13, requires_grad=True)
    values = discretize(coefficients, 36, PAPER)
    assert values.dtype == torch.float32
    (gradient,) = torch.autograd.grad(values[9], coefficients)
    expected = discretization_matrix(36, PAPER)[9]
    np.testing.assert_allclose(gradient.numpy(), expected, atol=1e-6)


def dense_maximum(coefficients: NDArray[np.float64], frequencies: tuple[int, ...]) -> float:
    """The angle of a series' maximum, by a search on a dense grid that is refined three times."""
    centre, reach = np.pi, np.pi
    for _ in range(4):
        angles = np.linspace(centre - reach, centre + reach, 2_001)
        centre = angles[np.argmax(value(coefficients, frequencies, angles))]
        reach /= 200
    return float(centre)


# With frequencies (1, 4), some seeds give series that have two nearly equal maxima.
@pytest.mark.parametrize("frequencies", [(0, 1), PAPER, QUOTIENT, (1, 4)])
def test_the_maximum_equals_that_of_a_dense_search(frequencies: tuple[int, ...]):
    period = math.tau / math.gcd(*frequencies)
    for seed in range(50):
        coefficients = random_series(seed, frequencies)
        found = series_maximum(coefficients, frequencies)
        expected = dense_maximum(coefficients, frequencies)
        assert 0 <= found < math.tau
        assert abs(math.remainder(found - expected, period)) < 1e-6, seed


def test_the_first_of_equal_maxima_is_returned():
    for seed in range(100):
        coefficients = random_series(seed, QUOTIENT)
        assert 0 <= series_maximum(coefficients, QUOTIENT) < np.pi
    for angle in (0.0, 1e-9, 0.003, np.pi / 2, np.pi - 0.003):
        peak = rotated(np.array([0.0, 1, 0]), (0, 2), angle)
        assert series_maximum(peak, (0, 2)) == pytest.approx(angle, abs=1e-7)


def test_the_maximum_of_a_constant_series_is_at_zero():
    assert series_maximum(np.array([1.0, 0, 0]), (0, 1)) == 0
