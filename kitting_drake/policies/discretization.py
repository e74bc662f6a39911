"""The group discretization operation of the paper (section III-B.2), and what lies beyond it.

The number of orientations N is a property of the question, not of the network: the same
coefficients answer at any N that the band limit allows, and at none, by the maximum of the series.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from kitting_drake.policies.fibres import fourier_basis


def discretization_matrix(
    orientations: int, frequencies: Sequence[int], *, quotient: int = 1
) -> NDArray[np.float64]:
    """Q of the paper, the matrix of Dis from SO(2) to C_N (equations 5, 6) or of its quotient form.

    Args:
        orientations: N, the bins over a full turn.
        frequencies: j of the irreps, ascending.
        quotient: 2 for SO(2)/C_2 to C_N/C_2: only bins 0 to N/2 - 1 are asked for, and every
            frequency must be even. The angles are 2 pi i / N all the same.

    Returns:
        (N / quotient, d).

    Raises:
        ValueError: N is not a multiple of `quotient`, a frequency does not live on the quotient, or
            N / quotient is smaller than d, which aliases (Nyquist).
    """
    if orientations < 1 or orientations % quotient:
        raise ValueError(f"{orientations} orientations are not a multiple of {quotient}")
    odd = [j for j in frequencies if j % quotient]
    if odd:
        raise ValueError(f"frequency {odd[0]} is not one of SO(2)/C_{quotient}")
    bins = orientations // quotient
    size = sum(2 if j else 1 for j in frequencies)
    # The band limit within the quotient's own period.
    needed = max(size, 2 * (max(frequencies) // quotient) + 1)
    if bins < needed:
        raise ValueError(
            f"{orientations} orientations alias a function of frequencies up to "
            f"{max(frequencies)}: at least {needed * quotient} are needed (Nyquist)"
        )
    angles = 2 * np.pi * np.arange(bins) / orientations
    return fourier_basis(angles, frequencies)


def discretize(
    coefficients: Tensor, orientations: int, frequencies: Sequence[int], *, quotient: int = 1
) -> Tensor:
    """Dis (equation 6): an irrep vector to a regular one.

    Args:
        coefficients: (..., d).
        orientations: as for `discretization_matrix`.
        frequencies: likewise.
        quotient: likewise.

    Returns:
        (..., N / quotient): the function at the angles 2 pi i / N.
    """
    matrix = discretization_matrix(orientations, frequencies, quotient=quotient)
    return coefficients @ torch.from_numpy(matrix).to(coefficients).T


def series_maximum(coefficients: NDArray[np.float64], frequencies: Sequence[int]) -> float:
    """The angle at which a Fourier series is largest: no bins at all.

    Args:
        coefficients: (d,), in the order of `fourier_basis`.
        frequencies: ascending.

    Returns:
        Radians in [0, 2 pi); of several equal maxima (a quotient has them) the first.
    """
    # What has a period of a part of a turn is looked at over that part.
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
        # Newton's steps, none beyond the neighbouring samples.
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
    # Zero from below is zero.
    best %= math.tau
    return 0.0 if math.tau - best < 1e-9 else best / period


def _complex_weights(
    coefficients: NDArray[np.float64], frequencies: Sequence[int]
) -> NDArray[np.complex128]:
    """w_j with f(angle) = sum of Re(w_j exp(i j angle))."""
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
