"""The group discretization operation of the paper (section III-B.2), and its continuous limit.

The number of orientations N is no property of the network: the same Fourier coefficients can be
discretized at any N that the band limit allows, and the maximum of the series needs no N at all.
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
        orientations: N, the number of bins over a full rotation.
        frequencies: j of the irreps, ascending.
        quotient: 2 for SO(2)/C_2 to C_N/C_2: the matrix has bins 0 to N/2 - 1 only, at the same
            angles 2 pi i / N, and every frequency must be even.

    Returns:
        (N / quotient, d).

    Raises:
        ValueError: N is not a multiple of `quotient`, a frequency is no multiple of it either, or N
            / quotient is smaller than d, which aliases (Nyquist).
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
    """Dis (equation 6): maps an irrep vector to a regular one.

    Args:
        coefficients: (..., d).
        orientations: as for `discretization_matrix`.
        frequencies: as for `discretization_matrix`.
        quotient: as for `discretization_matrix`.

    Returns:
        (..., N / quotient): the function at the angles 2 pi i / N.
    """
    matrix = discretization_matrix(orientations, frequencies, quotient=quotient)
    return coefficients @ torch.from_numpy(matrix).to(coefficients).T


def series_maximum(coefficients: NDArray[np.float64], frequencies: Sequence[int]) -> float:
    """The angle at which a Fourier series is largest, exactly and not only among N bins.

    Args:
        coefficients: (d,), in the order of `fourier_basis`.
        frequencies: ascending.

    Returns:
        Radians in [0, 2 pi): the first of several equal maxima, which there are on a quotient.
    """
    # A series of a shorter period, as on a quotient, is searched over one period.
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
        # Newton's method; no step leads beyond the neighbouring samples.
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
    # An angle just below a full rotation is zero, up to rounding.
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
