"""Lifting and cross-correlation: the placing module's last step (equations 7 and 8 of the paper).

`cross_correlation` is the plain one. `search` gives its largest values without computing all of it:
a coarse volume, at half the resolution and a fixed number of turns, is correlated by FFT, and the
plain correlation is evaluated around the coarse volume's best cells only, at any N. Its cost hardly
grows with N.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from kitting_drake.policies.steerable import BlurPool

KERNEL = 65
"""Side of the part of the crop's encoding that is correlated, in pixels."""
COARSE_TURNS = 48
"""Turns of the coarse volume."""
_REACH = 4
"""How far around a coarse cell the search looks, in pixels."""


def lift(encoding: Tensor, angles: Tensor, size: int) -> Tensor:
    """R_N (equation 7): the encoding turned about its middle, bilinearly sampled.

    Args:
        encoding: (1, channels, side, side), of odd side: the middle is a pixel.
        angles: (n,), counter-clockwise, in radians.
        size: side of what is kept around the middle, odd, in pixels.

    Returns:
        (n, channels, size, size).
    """
    side = encoding.shape[-1]
    reach = size // 2
    offsets = torch.arange(-reach, reach + 1, dtype=encoding.dtype, device=encoding.device)
    row, col = torch.meshgrid(offsets, offsets, indexing="ij")
    cos, sin = torch.cos(angles)[:, None, None], torch.sin(angles)[:, None, None]
    # Where each pixel comes from: turned back. grid_sample wants (col, row) from -1 to 1.
    source = torch.stack([cos * col - sin * row, cos * row + sin * col], dim=-1)
    grid = source * (2 / (side - 1))
    stack = encoding.expand(len(angles), -1, -1, -1)
    return F.grid_sample(stack, grid, mode="bilinear", padding_mode="zeros", align_corners=True)


def cross_correlation(scene: Tensor, kernels: Tensor) -> Tensor:
    """Equation 8, plainly.

    Args:
        scene: (1, channels, rows, cols), phi(o_t).
        kernels: (n, channels, size, size) of odd size, R_N(psi(c)).

    Returns:
        (n, rows, cols): the score of bringing the middle of each kernel to each pixel.
    """
    reach = kernels.shape[-1] // 2
    return F.conv2d(scene, kernels, padding=reach)[0] / KERNEL


def cross_correlation_fft(scene: Tensor, kernels: Tensor) -> Tensor:
    """The same as `cross_correlation`, by fast Fourier transforms."""
    rows, cols = scene.shape[-2:]
    size = kernels.shape[-1]
    shape = (_fast_length(rows + size - 1), _fast_length(cols + size - 1))
    spectrum = torch.fft.rfft2(scene, s=shape) * torch.fft.rfft2(kernels, s=shape).conj()
    volume = torch.fft.irfft2(spectrum.sum(1), s=shape)
    return torch.roll(volume, (size // 2, size // 2), (1, 2))[:, :rows, :cols] / KERNEL


def _fast_length(length: int) -> int:
    """The next length of small prime factors."""
    while True:
        rest = length
        for factor in (2, 3, 5):
            while rest % factor == 0:
                rest //= factor
        if rest == 1:
            return length
        length += 1


def turns(count: int, like: Tensor, phase: float = 0.0) -> Tensor:
    """(count,): evenly spaced angles over a full turn, in radians, from `phase` of their step."""
    steps = torch.arange(count, dtype=like.dtype, device=like.device) + phase
    return steps * (math.tau / count)


_halve = BlurPool()


def coarse_volume(scene: Tensor, encoding: Tensor, angles: Tensor) -> Tensor:
    """The correlation of both at half the resolution, scaled to stand for the full one.

    Args:
        scene: (1, channels, rows, cols), odd sides.
        encoding: (1, channels, side, side).
        angles: (n,).

    Returns:
        (n, (rows + 1) / 2, (cols + 1) / 2): cell (i, j) is at pixel (2 i, 2 j).
    """
    halve = _halve.to(scene.device)
    kernels = lift(halve(encoding), angles, KERNEL // 2 + 1)
    return 4 * cross_correlation_fft(halve(scene), kernels)


def window(
    scene: Tensor, encoding: Tensor, angles: Tensor, corner: tuple[int, int], shape: tuple[int, int]
) -> Tensor:
    """A window of the plain correlation.

    Args:
        scene: (1, channels, rows, cols).
        encoding: (1, channels, side, side).
        angles: (n,).
        corner: the window's first pixel (row, col); may lie outside the scene, which is zero there.
        shape: its rows and cols.

    Returns:
        (n, *shape).
    """
    reach = KERNEL // 2
    rows, cols = scene.shape[-2:]
    vertical = _overlap(corner[0] - reach, shape[0] + 2 * reach, rows)
    horizontal = _overlap(corner[1] - reach, shape[1] + 2 * reach, cols)
    part = scene[:, :, vertical[0], horizontal[0]]
    padded = F.pad(part, (*horizontal[1], *vertical[1]))
    # So large a kernel is much slower in channels_last, as U-nets leave their outputs.
    kernels = lift(encoding, angles, KERNEL)
    return F.conv2d(padded.contiguous(), kernels.contiguous())[0] / KERNEL


def _overlap(start: int, length: int, side: int) -> tuple[slice, tuple[int, int]]:
    """What of a span lies on an axis of `side` pixels, and how much of it lies before and after."""
    first = min(max(start, 0), side)
    last = min(max(start + length, first), side)
    before = min(max(-start, 0), length)
    return slice(first, last), (before, length - before - (last - first))


@dataclass(frozen=True)
class Candidate:
    """The plain correlation around one of its peaks."""

    scores: Tensor
    """(n, rows, cols): of the window."""
    first_bin: int
    """The turn of `scores[0]`, in bins; may be negative or past the last: turns are cyclic."""
    corner: tuple[int, int]
    """The pixel (row, col) of `scores[:, 0, 0]`; all pixels lie in the scene."""

    def best(self) -> tuple[float, int, int, int]:
        """(score, bin, row, col) of the largest."""
        index = int(self.scores.argmax())
        rows, cols = self.scores.shape[1:]
        turn, rest = divmod(index, rows * cols)
        row, col = divmod(rest, cols)
        score = float(self.scores[turn, row, col])
        return score, self.first_bin + turn, self.corner[0] + row, self.corner[1] + col


def search(
    scene: Tensor,
    encoding: Tensor,
    orientations: int,
    *,
    shape: tuple[int, int] | None = None,
    candidates: int = 6,
) -> tuple[list[Candidate], Tensor]:
    """The peaks of the plain correlation at N orientations, best first, and the coarse volume.

    Args:
        scene: (1, channels, rows, cols), odd sides, phi(o_t).
        encoding: (1, channels, side, side), psi(c).
        orientations: N.
        shape: rows and cols to look in, from the first on; by default all.
        candidates: how many of the coarse volume's peaks are looked at.

    Returns:
        The candidates, and the coarse volume (COARSE_TURNS, about rows / 2, about cols / 2).
    """
    rows, cols = shape or scene.shape[-2:]
    volume = coarse_volume(scene, encoding, turns(COARSE_TURNS, scene))
    volume = volume[:, : rows // 2 + 1, : cols // 2 + 1]
    found = []
    remaining = volume.clone()
    for _ in range(candidates):
        index = int(remaining.argmax())
        turn, rest = divmod(index, remaining.shape[1] * remaining.shape[2])
        row, col = divmod(rest, remaining.shape[2])
        around = [(turn + step) % COARSE_TURNS for step in (-1, 0, 1)]
        remaining[around, max(row - 1, 0) : row + 2, max(col - 1, 0) : col + 2] = -math.inf
        first = math.floor((turn - 1) * orientations / COARSE_TURNS)
        last = math.ceil((turn + 1) * orientations / COARSE_TURNS)
        top, left = max(2 * row - _REACH, 0), max(2 * col - _REACH, 0)
        bottom, right = min(2 * row + _REACH + 1, rows), min(2 * col + _REACH + 1, cols)
        bins = torch.arange(first, last + 1, dtype=scene.dtype, device=scene.device)
        angles = bins * (math.tau / orientations)
        scores = window(scene, encoding, angles, (top, left), (bottom - top, right - left))
        found.append(Candidate(scores, first, (top, left)))
    return sorted(found, key=lambda item: -item.best()[0]), volume
