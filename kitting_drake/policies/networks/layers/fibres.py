"""The fibre of a feature field: its representation at each pixel, and how it is stored.

Fields of irreps are stored as *samples* of the function that their coefficients describe, and a
pointwise nonlinearity acts on the samples directly (see `steerable.py`). This is plain linear
algebra: inference needs no group library.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray


class Fibre(Protocol):
    """The representation of one field, and how its vectors are stored."""

    def __hash__(self) -> int: ...

    @property
    def size(self) -> int:
        """The dimension of the representation."""

    @property
    def channels(self) -> int:
        """The number of stored channels of one field."""

    def synthesis(self) -> NDArray[np.float64]:
        """Returns the matrix (channels, size) that maps a vector of the representation to the
        stored channels."""

    def analysis(self) -> NDArray[np.float64]:
        """Returns the left inverse (size, channels) of `synthesis`, which projects onto the
        irreps."""

    def invariant(self) -> NDArray[np.float64]:
        """Returns the weights (channels,) of the rotation-invariant sum of the channels. The sum is
        the coefficient of frequency 0, scaled as in escnn's FourierELU."""


@dataclass(frozen=True)
class Scalar:
    """The trivial representation rho_0: a scalar field."""

    size: int = 1
    channels: int = 1

    def synthesis(self) -> NDArray[np.float64]:
        return np.eye(1)

    def analysis(self) -> NDArray[np.float64]:
        return np.eye(1)

    def invariant(self) -> NDArray[np.float64]:
        return np.ones(1)


@dataclass(frozen=True)
class Irreps:
    """A direct sum of irreps of SO(2), equation 4 of the paper.

    If all frequencies are even, this is a field of the quotient SO(2)/C_2.
    """

    frequencies: tuple[int, ...]
    """The frequency j of each irrep rho_j, ascending."""
    samples: int = 0
    """The number of evenly spaced samples by which the band-limited function is stored. If it is 0,
    the coefficients themselves are stored."""

    def __post_init__(self) -> None:
        if list(self.frequencies) != sorted(set(self.frequencies)) or min(self.frequencies) < 0:
            raise ValueError(
                f"frequencies must be non-negative and ascending, not {self.frequencies}"
            )
        if 0 < self.samples <= 2 * max(self.frequencies):
            raise ValueError(
                f"{self.samples} samples cannot hold frequency {max(self.frequencies)}: "
                f"at least {2 * max(self.frequencies) + 1} are needed"
            )

    @property
    def size(self) -> int:
        return sum(2 if j else 1 for j in self.frequencies)

    @property
    def channels(self) -> int:
        return self.samples or self.size

    def synthesis(self) -> NDArray[np.float64]:
        if not self.samples:
            return np.eye(self.size)
        angles = 2 * np.pi * np.arange(self.samples) / self.samples
        columns = fourier_basis(angles, self.frequencies)
        # Scale the orthogonal columns to equal norms, as escnn's FourierPointwise does.
        columns[:, [0] if self.frequencies[0] == 0 else []] /= math.sqrt(2)
        return columns * math.sqrt(2 / self.size)

    def analysis(self) -> NDArray[np.float64]:
        return np.asarray(np.linalg.pinv(self.synthesis()), dtype=float)

    def invariant(self) -> NDArray[np.float64]:
        if not self.samples:
            raise ValueError("invariant() needs samples: give the fibre a number of samples")
        return np.full(self.samples, math.sqrt(self.size) / self.samples)


@dataclass(frozen=True)
class Regular:
    """The regular representation of C_N, or of the quotient C_N / C_q, on N / q channels."""

    order: int
    quotient: int = 1

    def __post_init__(self) -> None:
        if self.order < 1 or self.quotient < 1 or self.order % self.quotient:
            raise ValueError(
                f"C_{self.order} has no subgroup of {self.quotient} elements: the quotient must "
                "divide the order"
            )

    @property
    def size(self) -> int:
        return self.order // self.quotient

    @property
    def channels(self) -> int:
        return self.size

    def synthesis(self) -> NDArray[np.float64]:
        return np.eye(self.size)

    def analysis(self) -> NDArray[np.float64]:
        return np.eye(self.size)

    def invariant(self) -> NDArray[np.float64]:
        return np.full(self.size, 1 / math.sqrt(self.size))


def fourier_basis(angles: NDArray[np.float64], frequencies: Sequence[int]) -> NDArray[np.float64]:
    """Returns the basis of equation 5 at given angles.

    Args:
        angles: (n,), in radians.
        frequencies: the frequencies j, ascending.

    Returns:
        (n, d): a column of cosines for each frequency, followed by sines if the frequency is
        not 0.
    """
    columns = []
    for j in frequencies:
        columns.append(np.cos(j * angles))
        if j:
            columns.append(np.sin(j * angles))
    return np.stack(columns, axis=1)
