"""Lifting and cross-correlation: the placing module's last step (equations 7 and 8 of the paper).

`cross_correlation` computes the full correlation. `search` finds the largest values without
computing all of them. First it computes a coarse volume by FFT, at half the resolution and a fixed
number of rotations. Then it evaluates the full correlation only around the coarse volume's best
cells. Its cost barely grows with the number of orientations N.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from scipy.fft import next_fast_len
from torch import Tensor
from torch.autograd.function import once_differentiable

from kitting_drake.policies.networks.layers.steerable import BlurPool

KERNEL = 65
"""The side of the correlated part of the crop's encoding, in pixels."""
COARSE_ROTATIONS = 48
"""The number of rotations of the coarse volume."""
_REACH = 4
"""The full correlation is evaluated up to this far, in pixels, from the pixel of a coarse cell."""


def lift(encoding: Tensor, angles: Tensor, size: int) -> Tensor:
    """Rotates an encoding about its centre with bilinear sampling, R_N of equation 7.

    Args:
        encoding: (1, channels, side, side); the side is odd, so the centre is a pixel.
        angles: (n,), counter-clockwise, in radians.
        size: the side of the central part to keep, odd, in pixels.

    Returns:
        (n, channels, size, size).
    """
    side = encoding.shape[-1]
    reach = size // 2
    offsets = torch.arange(-reach, reach + 1, dtype=encoding.dtype, device=encoding.device)
    row, col = torch.meshgrid(offsets, offsets, indexing="ij")
    cos, sin = torch.cos(angles)[:, None, None], torch.sin(angles)[:, None, None]
    # The (col, row) that the rotation moves to each pixel of the result. `grid_sample` expects it
    # in the range from -1 to 1.
    source = torch.stack([cos * col - sin * row, cos * row + sin * col], dim=-1)
    grid = source * (2 / (side - 1))
    stack = encoding.expand(len(angles), -1, -1, -1)
    return F.grid_sample(stack, grid, mode="bilinear", padding_mode="zeros", align_corners=True)


def cross_correlation(scene: Tensor, kernels: Tensor) -> Tensor:
    """Computes the cross-correlation of equation 8 directly, divided by `KERNEL`.

    Args:
        scene: (1, channels, rows, cols), phi(o_t).
        kernels: (n, channels, size, size) of odd size, R_N(psi(c)).

    Returns:
        (n, rows, cols): the score of placing the centre of each kernel at each pixel.
    """
    reach = kernels.shape[-1] // 2
    return F.conv2d(scene, kernels, padding=reach)[0] / KERNEL


def cross_correlation_fft(scene: Tensor, kernels: Tensor) -> Tensor:
    """Computes the cross-correlation of equation 8 by fast Fourier transforms. The result equals
    that of `cross_correlation`."""
    reach = kernels.shape[-1] // 2
    return _FourierCorrelation.apply(F.pad(scene[0], 4 * (reach,)), kernels) / KERNEL


class _FourierCorrelation(torch.autograd.Function):
    """Cross-correlation without padding, by fast Fourier transforms.

    Its gradients also use transforms of real signals, and the transforms skip rows that are zero or
    not needed. Autograd through `torch.fft` would do three times the work.
    """

    @staticmethod
    def forward(ctx: Any, scene: Tensor, kernels: Tensor) -> Tensor:
        """Maps a scene (channels, rows, cols) and kernels (n, channels, height, width) to
        (n, rows - height + 1, cols - width + 1)."""
        rows, cols = scene.shape[-2:]
        shape = (next_fast_len(rows, real=True), next_fast_len(cols, real=True))
        conjugate = _spectrum(scene, shape).conj_physical()
        spectra = _spectrum(kernels, shape)
        total = conjugate[0] * spectra[:, 0]
        for channel in range(1, len(conjugate)):
            total.addcmul_(conjugate[channel], spectra[:, channel])
        ctx.save_for_backward(conjugate, spectra)
        ctx.shapes = shape, scene.shape[-2:], kernels.shape[-2:]
        height, width = kernels.shape[-2:]
        return _first_lags(total, shape, (rows - height + 1, cols - width + 1))

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, Tensor]:
        """Returns the gradients with respect to the scene and the kernels."""
        conjugate, spectra = ctx.saved_tensors
        shape, scene_shape, kernel_shape = ctx.shapes
        spectrum = _spectrum(gradient, shape)
        total = torch.zeros_like(conjugate)
        for part, kernel in zip(spectrum, spectra, strict=True):
            total.addcmul_(part, kernel)
        rows, cols = scene_shape
        return (
            torch.fft.irfft2(total.mT, s=shape)[:, :rows, :cols],
            _first_lags(conjugate * spectrum[:, None], shape, kernel_shape),
        )


def _spectrum(signals: Tensor, shape: tuple[int, int]) -> Tensor:
    """Returns the transposed `torch.fft.rfft2` of signals that are zero-padded to a shape."""
    along_rows = torch.fft.rfft(signals, n=shape[1]).mT
    # Because of the transpose each transform reads and writes contiguous memory.
    return torch.fft.fft(F.pad(along_rows, (0, shape[0] - signals.shape[-2])))


def _first_lags(spectra: Tensor, shape: tuple[int, int], lags: tuple[int, int]) -> Tensor:
    """Computes the first entries of correlations from their spectra.

    Args:
        spectra: the transposed complex conjugates of the correlations' spectra.
        shape: rows and cols of the transforms.
        lags: the number of rows and cols to compute.
    """
    # The inverse transform of a conjugate is the conjugate of the transform.
    along_cols = torch.fft.fft(spectra, norm="forward")[..., : lags[0]]
    conjugate = along_cols.mT.contiguous().conj_physical_()
    return torch.fft.irfft(conjugate, n=shape[1])[..., : lags[1]]


def rotation_angles(count: int, like: Tensor, phase: float = 0.0) -> Tensor:
    """Returns evenly spaced angles (count,) over a full rotation, in radians.

    Args:
        count: the number of angles.
        like: a tensor of the same type and on the same device.
        phase: the first angle, in steps.
    """
    steps = torch.arange(count, dtype=like.dtype, device=like.device) + phase
    return steps * (math.tau / count)


_halve = BlurPool()


def coarse_volume(scene: Tensor, encoding: Tensor, angles: Tensor) -> Tensor:
    """Computes the correlation at half the resolution, scaled to approximate the full correlation.

    Args:
        scene: (1, channels, rows, cols) with odd sides.
        encoding: (1, channels, side, side).
        angles: (n,) rotations, counter-clockwise, in radians.

    Returns:
        (n, (rows + 1) / 2, (cols + 1) / 2); cell (i, j) corresponds to pixel (2 i, 2 j).
    """
    halve = _halve.to(scene.device)
    kernels = lift(halve(encoding), angles, KERNEL // 2 + 1)
    return 4 * cross_correlation_fft(halve(scene), kernels)


def window(
    scene: Tensor, encoding: Tensor, angles: Tensor, corner: tuple[int, int], shape: tuple[int, int]
) -> Tensor:
    """Computes a window of the full correlation with the rotated encoding of a crop.

    Args:
        scene: (1, channels, rows, cols).
        encoding: (1, channels, side, side).
        angles: (n,) rotations, counter-clockwise, in radians.
        corner: the window's first pixel (row, col); the scene is zero outside its image.
        shape: the window's rows and cols.

    Returns:
        (n, *shape).
    """
    return kernel_window(scene, lift(encoding, angles, KERNEL), corner, shape)


def kernel_window(
    scene: Tensor, kernels: Tensor, corner: tuple[int, int], shape: tuple[int, int]
) -> Tensor:
    """Computes a window of the full correlation with given kernels.

    Args:
        scene: (1, channels, rows, cols).
        kernels: (n, channels, KERNEL, KERNEL).
        corner: the window's first pixel (row, col).
        shape: the window's rows and cols.

    Returns:
        (n, *shape).
    """
    reach = KERNEL // 2
    rows, cols = scene.shape[-2:]
    vertical = _overlap(corner[0] - reach, shape[0] + 2 * reach, rows)
    horizontal = _overlap(corner[1] - reach, shape[1] + 2 * reach, cols)
    part = scene[:, :, vertical[0], horizontal[0]]
    padded = F.pad(part, (*horizontal[1], *vertical[1]))
    if kernels.requires_grad:
        # With such a large kernel, the gradients of conv2d would take three times as long.
        return _FourierCorrelation.apply(padded[0], kernels) / KERNEL
    # The U-nets' outputs are channels_last, a format in which conv2d with such a large kernel is
    # much slower.
    return F.conv2d(padded.contiguous(), kernels.contiguous())[0] / KERNEL


def _overlap(start: int, length: int, side: int) -> tuple[slice, tuple[int, int]]:
    """Cuts a span of `length` pixels, from the pixel `start` on, out of an axis of `side` pixels.

    Returns:
        The slice of the axis, and the numbers of pixels to pad before and after it, because the
            span may extend beyond the axis.
    """
    first = min(max(start, 0), side)
    last = min(max(start + length, first), side)
    before = min(max(-start, 0), length)
    return slice(first, last), (before, length - before - (last - first))


@dataclass(frozen=True)
class Candidate:
    """A window of the full correlation around one of its peaks."""

    scores: Tensor
    """(n, rows, cols): the scores at n successive rotations."""
    first_bin: int
    """The rotation of `scores[0]`, in bins. Rotations are cyclic, so it may be negative or exceed
    N."""
    corner: tuple[int, int]
    """The pixel (row, col) of `scores[:, 0, 0]` in the scene. The window is within the scene."""

    def best(self) -> tuple[float, int, int, int]:
        """Returns the largest score with its position, as (score, rotation bin, row, col)."""
        rotation, row, col = _argmax(self.scores)
        score = float(self.scores[rotation, row, col])
        return score, self.first_bin + rotation, self.corner[0] + row, self.corner[1] + col

    def known_neighbours(self) -> int:
        """Returns how many of the 3 x 3 x 3 cells around the maximum lie within the window."""
        at = _argmax(self.scores)
        return math.prod(
            min(i + 2, n) - max(i - 1, 0) for i, n in zip(at, self.scores.shape, strict=True)
        )


def ranked(candidates: Iterable[Candidate], orientations: int) -> list[Candidate]:
    """Sorts candidates, best first, and keeps one for each position and rotation of a maximum.

    Overlapping windows may have the same maximum, possibly at the edge of one of them. The window
    with the most neighbours of the maximum is kept, because sub-pixel refinement needs them.

    Args:
        candidates: windows around the peaks of the coarse volume.
        orientations: N, the number of orientations in a full turn.
    """
    of_cell: dict[tuple[int, int, int], Candidate] = {}
    for candidate in candidates:
        _, rotation, row, col = candidate.best()
        cell = rotation % orientations, row, col
        if cell in of_cell and of_cell[cell].known_neighbours() >= candidate.known_neighbours():
            continue
        of_cell[cell] = candidate
    return sorted(of_cell.values(), key=lambda item: -item.best()[0])


def _argmax(volume: Tensor) -> tuple[int, int, int]:
    rotation, row, col = np.unravel_index(int(volume.argmax()), volume.shape)
    return int(rotation), int(row), int(col)


def peaks(volume: Tensor, count: int) -> Iterator[tuple[int, int, int]]:
    """Yields (rotation, row, col) of the largest values of a volume, largest first. No two are
    adjacent.

    Args:
        volume: (n, rows, cols), over a full rotation.
        count: the number of peaks.
    """
    remaining = volume.clone()
    best = volume.amax(0)
    for _ in range(count):
        _, row, col = _argmax(best[None])
        rotation = int(remaining[:, row, col].argmax())
        around = [(rotation + step) % len(volume) for step in (-1, 0, 1)]
        rows, cols = slice(max(row - 1, 0), row + 2), slice(max(col - 1, 0), col + 2)
        remaining[around, rows, cols] = -math.inf
        best[rows, cols] = remaining[:, rows, cols].amax(0)
        yield rotation, row, col


def finer_bins(rotation: int, coarse: int, orientations: int) -> tuple[int, int]:
    """Returns the first and the last fine bin of the range between the two neighbours of a coarse
    rotation.

    Args:
        rotation: the coarse rotation, in coarse bins.
        coarse: the number of coarse bins in a full turn.
        orientations: N, the number of fine bins in a full turn.
    """
    first = math.floor((rotation - 1) * orientations / coarse)
    return first, math.ceil((rotation + 1) * orientations / coarse)


def window_around(
    pixel: tuple[int, int], shape: tuple[int, int]
) -> tuple[tuple[int, int], tuple[int, int]]:
    """Returns the corner (row, col) and shape (rows, cols) of the window around a pixel, clipped to
    the image.

    Args:
        pixel: (row, col).
        shape: the image's rows and cols.
    """
    top, left = max(pixel[0] - _REACH, 0), max(pixel[1] - _REACH, 0)
    bottom, right = min(pixel[0] + _REACH + 1, shape[0]), min(pixel[1] + _REACH + 1, shape[1])
    return (top, left), (bottom - top, right - left)


def search(
    scene: Tensor,
    encoding: Tensor,
    orientations: int,
    *,
    shape: tuple[int, int] | None = None,
    candidates: int = 6,
) -> tuple[list[Candidate], Tensor]:
    """Finds the peaks of the full correlation at N orientations.

    Args:
        scene: (1, channels, rows, cols), odd sides, phi(o_t).
        encoding: (1, channels, side, side), psi(c).
        orientations: N, the number of orientations in a full turn.
        shape: how many rows and cols of the scene to search; all by default.
        candidates: the number of coarse peaks to refine.

    Returns:
        Windows around the peaks, best first, and the coarse volume (COARSE_ROTATIONS, about
            rows / 2, about cols / 2).
    """
    rows, cols = shape or scene.shape[-2:]
    volume = coarse_volume(scene, encoding, rotation_angles(COARSE_ROTATIONS, scene))
    volume = volume[:, : rows // 2 + 1, : cols // 2 + 1]
    found = []
    for rotation, row, col in peaks(volume, candidates):
        first, last = finer_bins(rotation, COARSE_ROTATIONS, orientations)
        corner, size = window_around((2 * row, 2 * col), (rows, cols))
        bins = torch.arange(first, last + 1, dtype=scene.dtype, device=scene.device)
        angles = bins * (math.tau / orientations)
        found.append(Candidate(window(scene, encoding, angles, corner, size), first, corner))
    return ranked(found, orientations), volume
