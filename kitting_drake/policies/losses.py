"""Cross-entropies over pixels, bins and both (section V-C.1 of the paper).

A label between pixels or bins is spread over its neighbours in proportion (linearly), so that the
most likely *place between them* is the label; a label on a pixel is one-hot, as in the paper.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from kitting_drake.policies.correlation import (
    COARSE_TURNS,
    coarse_volume,
    turns,
    window,
)

_WINDOW = 17
"""Side of the window of the plain correlation around a label, in pixels."""
_FINE_REACH = math.radians(10)
"""How far from the label's turn the window reaches."""


def spread(position: float, count: int, *, cyclic: bool = False) -> list[tuple[int, float]]:
    """A position between whole numbers as (index, weight) pairs of its neighbours.

    Args:
        position: in units of the bins.
        count: how many bins there are; weight outside goes to the outermost.
        cyclic: whether bin `count` is bin 0.
    """
    first = math.floor(position)
    share = position - first
    ends = [(first, 1 - share), (first + 1, share)]
    if cyclic:
        return [(index % count, weight) for index, weight in ends if weight > 0]
    return [(min(max(index, 0), count - 1), weight) for index, weight in ends if weight > 0]


def soft_label(*axes: list[tuple[int, float]], like: Tensor) -> Tensor:
    """The outer product of several spread positions, shaped as `like`."""
    label = torch.zeros_like(like)
    corners: list[tuple[tuple[int, ...], float]] = [((), 1.0)]
    for axis in axes:
        corners = [
            ((*index, bin_), weight * share) for index, weight in corners for bin_, share in axis
        ]
    for index, weight in corners:
        label[index] += weight
    return label


def cross_entropy(logits: Tensor, label: Tensor) -> Tensor:
    """Of a distribution over all entries of `logits`, against one shaped alike."""
    return logits.flatten().logsumexp(0) - (label * logits).sum()


def position_loss(logits: Tensor, *pixels: tuple[float, float]) -> Tensor:
    """Cross-entropy over the pixels of f_p.

    Args:
        logits: (rows, cols).
        pixels: the labels (row, col), between pixels or on one, equally likely.
    """
    rows, cols = logits.shape
    labels = [soft_label(spread(row, rows), spread(col, cols), like=logits) for row, col in pixels]
    return cross_entropy(logits, torch.stack(labels).mean(0))


def angle_loss(logits: Tensor, theta: float, orientations: int) -> Tensor:
    """Cross-entropy over the bins of f_theta, a half turn being none.

    Args:
        logits: (N / 2,), at the angles 2 pi i / N.
        theta: the label, in radians.
        orientations: N.
    """
    bins = theta / (math.tau / orientations)
    label = soft_label(spread(bins, orientations // 2, cyclic=True), like=logits)
    return cross_entropy(logits, label)


def place_loss(
    scene: Tensor,
    encoding: Tensor,
    pixel: tuple[float, float],
    turn: float,
    orientations: int,
    generator: torch.Generator,
) -> Tensor:
    """Cross-entropy over all pixels and turns of f_place (equation 8), estimated.

    Near the label every bin is computed; everywhere else the coarse volume's cells stand for the
    bins that they cover. The coarse volume has a cross-entropy of its own, as the search at
    inference starts from it.

    Args:
        scene: (1, channels, rows, cols), phi(o_t).
        encoding: (1, channels, side, side), psi(c).
        pixel: the label (row, col).
        turn: the label, in radians.
        orientations: N.
        generator: where the window and the coarse turns lie about the label is drawn.
    """
    draws = torch.rand(3, generator=generator).tolist()
    phase = draws[0]
    coarse = coarse_volume(scene, encoding, turns(COARSE_TURNS, scene, phase))
    coarse_bin = turn / (math.tau / COARSE_TURNS) - phase
    label = soft_label(
        spread(coarse_bin, COARSE_TURNS, cyclic=True),
        spread(pixel[0] / 2, coarse.shape[1]),
        spread(pixel[1] / 2, coarse.shape[2]),
        like=coarse,
    )
    coarse_loss = cross_entropy(coarse, label)

    step = math.tau / orientations
    first = math.ceil((turn - _FINE_REACH) / step)
    first = min(first, math.floor(turn / step))
    last = max(math.floor((turn + _FINE_REACH) / step), math.floor(turn / step) + 1)
    margin = _WINDOW // 2
    # The label lies anywhere in the middle half of the window.
    top = round(pixel[0]) - margin + round((draws[1] - 0.5) * margin)
    left = round(pixel[1]) - margin + round((draws[2] - 0.5) * margin)
    angles = torch.arange(first, last + 1, dtype=scene.dtype, device=scene.device) * step
    fine = window(scene, encoding, angles, (top, left), (_WINDOW, _WINDOW))
    label = soft_label(
        spread(turn / step - first, len(angles)),
        spread(pixel[0] - top, _WINDOW),
        spread(pixel[1] - left, _WINDOW),
        like=fine,
    )

    # Coarse cells stand for the bins outside the window.
    stands_for = math.log(4 * orientations / COARSE_TURNS)
    row = torch.arange(coarse.shape[1], device=scene.device) * 2 - top
    col = torch.arange(coarse.shape[2], device=scene.device) * 2 - left
    away = torch.remainder(turns(COARSE_TURNS, scene, phase) - turn + math.pi, math.tau) - math.pi
    covered = (
        (away.abs() < _FINE_REACH)[:, None, None]
        & ((row >= 0) & (row < _WINDOW))[None, :, None]
        & ((col >= 0) & (col < _WINDOW))[None, None, :]
    )
    outside = (coarse + stands_for).masked_fill(covered, -torch.inf)
    everything = torch.cat([fine.flatten(), outside.flatten()]).logsumexp(0)
    return coarse_loss + everything - (label * fine).sum()


def joint_loss(
    logits: Tensor, *labels: tuple[list[tuple[int, float]], tuple[float, float]]
) -> Tensor:
    """Cross-entropy over bins and pixels at once, as the Transporter's f_pick has it.

    Args:
        logits: (bins, rows, cols).
        labels: for each its bins as (index, weight) pairs (see `spread`) and its pixel (row, col);
            all equally likely.
    """
    _, rows, cols = logits.shape
    parts = [
        soft_label(bins, spread(row, rows), spread(col, cols), like=logits)
        for bins, (row, col) in labels
    ]
    return cross_entropy(logits, torch.stack(parts).mean(0))
