"""`correlation` in numpy, for inference where there is no torch: see `onnx_runner`.

The same search with the same constants; `tests/kitting_drake/policies/onnx_test.py` compares them.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import fft

Array = NDArray[np.float32]

KERNEL = 65
COARSE_ROTATIONS = 48
_REACH = 4
_CANDIDATES = 6
_BLUR = 0.66


@dataclass(frozen=True)
class Window:
    """A window of the plain correlation around one of its peaks: see `correlation.Candidate`."""

    scores: Array
    """(n, rows, cols), for n successive rotations."""
    first_bin: int
    corner: tuple[int, int]

    def best(self) -> NDArray[np.float64]:
        """(rotation in bins, row, col) of the largest score, of which the first."""
        return self.origin + np.array(np.unravel_index(self.scores.argmax(), self.scores.shape))

    def known_neighbours(self) -> int:
        """How many scores there are of the largest's own cell and those next to it, of 27."""
        at = np.unravel_index(self.scores.argmax(), self.scores.shape)
        return math.prod(
            min(int(i) + 2, n) - max(int(i) - 1, 0)
            for i, n in zip(at, self.scores.shape, strict=True)
        )

    @property
    def origin(self) -> NDArray[np.float64]:
        """(rotation in bins, row, col) of the first score."""
        return np.array([self.first_bin, *self.corner], float)


def search(scene: Array, encoding: Array, orientations: int, shape: tuple[int, int]) -> Window:
    """The window of the largest score of the correlation (equation 8) at N orientations.

    Args:
        scene: (channels, rows, cols), phi(o_t), odd sides.
        encoding: (channels, side, side), psi(c), odd sides.
        orientations: N.
        shape: the rows and cols, from the first ones on, that are searched.
    """
    rows, cols = shape
    angles = np.arange(COARSE_ROTATIONS) * (math.tau / COARSE_ROTATIONS)
    kernels = lift(_halve(encoding), angles, KERNEL // 2 + 1)
    volume = _correlate(_halve(scene), kernels)[:, : rows // 2 + 1, : cols // 2 + 1]
    of_cell: dict[tuple[int, ...], Window] = {}
    for rotation, row, col in _peaks(volume):
        first = math.floor((rotation - 1) * orientations / COARSE_ROTATIONS)
        last = math.ceil((rotation + 1) * orientations / COARSE_ROTATIONS)
        top, left = max(2 * row - _REACH, 0), max(2 * col - _REACH, 0)
        bottom, right = min(2 * row + _REACH + 1, rows), min(2 * col + _REACH + 1, cols)
        fine = np.arange(first, last + 1) * (math.tau / orientations)
        scores = _window(
            scene, lift(encoding, fine, KERNEL), (top, left), (bottom - top, right - left)
        )
        found = Window(scores, first, (top, left))
        best = found.best().astype(int)
        cell = (int(best[0]) % orientations, *best[1:].tolist())
        # Of those that share their largest score, the one that knows most of its neighbours.
        kept = of_cell.setdefault(cell, found)
        if found.known_neighbours() > kept.known_neighbours():
            of_cell[cell] = found
    return max(of_cell.values(), key=lambda item: float(item.scores.max()))


def lift(encoding: Array, angles: NDArray[np.float64], size: int) -> Array:
    """R_N (equation 7): (n, channels, size, size), rotated about the middle, bilinearly sampled,
    zero outside.

    Args:
        encoding: (channels, side, side), of odd side.
        angles: (n,), counter-clockwise, in radians.
        size: the side of what is kept around the middle, odd, in pixels.
    """
    side, reach = encoding.shape[-1], size // 2
    row, col = np.meshgrid(*(np.arange(-reach, reach + 1.0),) * 2, indexing="ij")
    cos, sin = (f(angles)[:, None, None] for f in (np.cos, np.sin))
    # Each pixel is taken from where the inverse rotation brings it. A frame of zeros stands for
    # all that is outside.
    framed = np.pad(encoding, ((0, 0), (1, 1), (1, 1)))
    source = [cos * row + sin * col, cos * col - sin * row]
    at = [np.clip(values + side // 2 + 1, 0, side + 0.999) for values in source]
    low = [np.floor(values).astype(int) for values in at]
    part = [values - floor for values, floor in zip(at, low, strict=True)]
    result = np.zeros((encoding.shape[0], len(angles), size, size))
    for down in (0, 1):
        for across in (0, 1):
            weight = np.abs(1 - down - part[0]) * np.abs(1 - across - part[1])
            result += weight * framed[:, low[0] + down, low[1] + across]
    return np.moveaxis(result, 1, 0).astype(np.float32)


def _halve(image: Array) -> Array:
    """(channels, (rows + 1) / 2, (cols + 1) / 2): antialiased, every other pixel."""
    taps = np.exp(-(np.arange(-2, 3) ** 2) / (2 * _BLUR**2))
    taps = taps / taps.sum()
    for axis in (1, 2):
        padded = np.pad(image, [(0, 0) if k != axis else (2, 2) for k in range(3)])
        length = image.shape[axis]
        image = sum(
            tap * np.take(padded, range(k, k + length, 2), axis) for k, tap in enumerate(taps)
        )
    return image.astype(np.float32)


def _correlate(scene: Array, kernels: Array) -> Array:
    """(n, rows, cols): the coarse volume, scaled to approximate the plain correlation."""
    rows, cols = scene.shape[1:]
    reach = kernels.shape[-1] // 2
    shape = [fft.next_fast_len(side + 2 * reach, real=True) for side in (rows, cols)]
    conjugate = fft.rfft2(np.pad(scene, ((0, 0), (reach, reach), (reach, reach))), shape).conj()
    volume = np.empty((len(kernels), rows, cols), np.float32)
    for index, kernel in enumerate(kernels):
        total = (conjugate * fft.rfft2(kernel, shape)).sum(axis=0)
        volume[index] = fft.irfft2(total.conj(), shape)[:rows, :cols]
    return volume * np.float32(4 / KERNEL)


def _window(scene: Array, kernels: Array, corner: tuple[int, int], shape: tuple[int, int]) -> Array:
    """(n, *shape): the plain correlation from a corner (row, col) on."""
    reach = KERNEL // 2
    padded = np.pad(scene, ((0, 0), (reach, reach), (reach, reach)))
    bottom, right = (start + side + 2 * reach for start, side in zip(corner, shape, strict=True))
    part = padded[:, corner[0] : bottom, corner[1] : right]
    columns = np.lib.stride_tricks.sliding_window_view(part, KERNEL, axis=1)
    views = np.lib.stride_tricks.sliding_window_view(columns, KERNEL, axis=2)
    flat = np.moveaxis(views, 0, 2).reshape(shape[0] * shape[1], -1)
    scores = kernels.reshape(len(kernels), -1) @ flat.T
    return scores.reshape(len(kernels), *shape) / np.float32(KERNEL)


def _peaks(volume: Array) -> Iterator[tuple[int, int, int]]:
    """(rotation, row, col) of the largest values, largest first, none next to another."""
    remaining, best = volume.copy(), volume.max(axis=0)
    for _ in range(_CANDIDATES):
        row, col = (int(i) for i in np.unravel_index(best.argmax(), best.shape))
        rotation = int(remaining[:, row, col].argmax())
        around = [(rotation + step) % len(volume) for step in (-1, 0, 1)]
        rows, cols = slice(max(row - 1, 0), row + 2), slice(max(col - 1, 0), col + 2)
        remaining[around, rows, cols] = -math.inf
        best[rows, cols] = remaining[:, rows, cols].max(axis=0)
        yield rotation, row, col
