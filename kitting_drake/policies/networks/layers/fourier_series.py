"""Finds the maximum of a Fourier series, which is the continuous limit of the discretization. This
module does not need torch."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from kitting_drake.policies.networks.layers.fibres import fourier_basis


def series_maximum(coefficients: NDArray[np.float64], frequencies: Sequence[int]) -> float:
    """Returns the angle at which a Fourier series is largest, without discretization.

    Args:
        coefficients: (d,), in the order of `fourier_basis`.
        frequencies: the frequencies of the series, ascending.

    Returns:
        The angle in [0, 2 pi), in radians. A series on a quotient has several equal maxima, of
            which the first is returned.
    """
    # On a quotient the period is shorter, so search only one period.
    period = math.gcd(*frequencies) or 1
    reduced = np.array(frequencies) // period
    count = 32 * max(int(reduced.max()), 1)
    values = fourier_basis(2 * np.pi * np.arange(count) / count, reduced.tolist()) @ coefficients
    peaks = np.flatnonzero((values >= np.roll(values, 1)) & (values >= np.roll(values, -1)))
    weights = _complex_weights(coefficients, frequencies)

    def evaluate(angle: float) -> NDArray[np.complex128]:
        return np.exp(1j * reduced * angle) * weights

    best, largest = 0.0, -math.inf
    for peak in peaks:
        # Apply Newton's method, in which no step goes beyond the neighbouring samples.
        angle = math.tau * float(peak) / count
        for _ in range(8):
            terms = evaluate(angle)
            slope = -(reduced * terms.imag).sum()
            curvature = -(reduced**2 * terms.real).sum()
            if curvature >= 0:
                break
            step = float(np.clip(-slope / curvature, -math.pi / count, math.pi / count))
            angle += step
            if abs(step) < 1e-12:
                break
        value = float(evaluate(angle).real.sum())
        if value > largest + 1e-12 * float(np.ptp(values)):
            best, largest = angle, value
    # Rounding can put an angle of zero just below a full rotation.
    best %= math.tau
    return 0.0 if math.tau - best < 1e-9 else best / period


def _complex_weights(
    coefficients: NDArray[np.float64], frequencies: Sequence[int]
) -> NDArray[np.complex128]:
    """Returns the weights w_j with which the series is the sum over j of Re(w_j exp(i j angle))."""
    weights = np.zeros(len(frequencies), complex)
    index = 0
    for position, j in enumerate(frequencies):
        if j:
            weights[position] = coefficients[index] - 1j * coefficients[index + 1]
            index += 2
        else:
            weights[position] = coefficients[index]
            index += 1
    return weights
