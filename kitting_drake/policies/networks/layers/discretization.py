"""The group discretization operation of the paper (section III-B.2), and its continuous limit.

The number of orientations N is not a property of the network. The same Fourier coefficients can be
discretized at any N that the band limit allows, and the maximum of the series needs no N at all.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from kitting_drake.policies.networks.layers.fibres import fourier_basis


def discretization_matrix(
    orientations: int, frequencies: Sequence[int], *, quotient: int = 1
) -> NDArray[np.float64]:
    """Returns the matrix Q of the paper, which discretizes a function on SO(2), or on a quotient of
    it, to N angles (equations 5 and 6).

    Args:
        orientations: N, the number of bins over a full rotation.
        frequencies: frequencies j of the irreps, ascending.
        quotient: order of the subgroup; 2 maps SO(2)/C_2 to C_N/C_2. The matrix then has only the
            bins 0 to N/2 - 1, at the angles 2 pi i / N, and every frequency must be even.

    Returns:
        (N / quotient, d), where d is the dimension of the irreps.

    Raises:
        ValueError: N or a frequency is not a multiple of `quotient`, or N / quotient is too small
            for the band limit and would alias (Nyquist).
    """
    if orientations < 1 or orientations % quotient:
        raise ValueError(f"{orientations} orientations are not a multiple of {quotient}")
    odd = [j for j in frequencies if j % quotient]
    if odd:
        raise ValueError(
            f"frequency {odd[0]} does not exist on SO(2)/C_{quotient}: use multiples of {quotient}"
        )
    bins = orientations // quotient
    size = sum(2 if j else 1 for j in frequencies)
    # One period of the quotient must have this many bins.
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
    """Maps a vector of irreps to a vector of the regular representation (Dis, equation 6 of the
    paper).

    Args:
        coefficients: (..., d) Fourier coefficients.
        orientations: N, the number of bins over a full rotation.
        frequencies: frequencies j of the irreps, ascending.
        quotient: order of the subgroup, see `discretization_matrix`.

    Returns:
        (..., N / quotient): the function at the angles 2 pi i / N.
    """
    matrix = discretization_matrix(orientations, frequencies, quotient=quotient)
    return coefficients @ torch.from_numpy(matrix).to(coefficients).T
