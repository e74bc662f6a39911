"""Cross-entropy losses over pixels, orientations or both (section V-C.1 of the paper).

A label between two pixels or orientations becomes a soft label, interpolated linearly between its
neighbours: the mean of the optimal prediction is then the label. A label on a pixel is one-hot, as
in the paper.

Networks that can stop have one more class, "nothing to pick", with the constant logit
`NOTHING_LOGIT`. The cross-entropy over all classes then splits into the cross-entropy over the
pixels and the `presence_loss` of the log-odds that there is something to pick.
"""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from torch import Tensor

from kitting_drake.policies.networks.layers.correlation import (
    COARSE_ROTATIONS,
    coarse_volume,
    rotation_angles,
    window,
)

NOTHING_LOGIT = math.log(160 * 320)
"""The logit of "nothing to pick". Untrained networks, whose logits are nearly zero, then predict
even odds for an image of the paper's size."""

_WINDOW = 17
"""The side, in pixels, of the window around a label in which the full correlation is computed."""
_FINE_REACH = math.radians(10)
"""The full correlation is computed at rotations that differ from a label's rotation by at most
this, in radians."""


def interpolate_label(
    position: float, count: int, *, cyclic: bool = False
) -> list[tuple[int, float]]:
    """Converts a fractional position to (index, weight) pairs by linear interpolation.

    Args:
        position: the position, in bins.
        count: the number of bins.
        cyclic: whether the bins wrap around. Otherwise the weight of a position beyond the bins
            goes to the outermost bin.
    """
    first = math.floor(position)
    share = position - first
    ends = [(first, 1 - share), (first + 1, share)]
    if cyclic:
        return [(index % count, weight) for index, weight in ends if weight > 0]
    return [(min(max(index, 0), count - 1), weight) for index, weight in ends if weight > 0]


def soft_label(*axes: list[tuple[int, float]], like: Tensor) -> Tensor:
    """Returns the outer product of one interpolated label per axis, in the shape of `like`."""
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
    """Returns the cross-entropy of a softmax over all entries of `logits`, for a label of the same
    shape."""
    return logits.flatten().logsumexp(0) - (label * logits).sum()


def log_odds(logits: Tensor, orientations: int = 1) -> Tensor:
    """Returns the log-odds that there is something to pick.

    Args:
        logits: the logits of all actions, (rows, cols), or (orientations, rows, cols) if they are
            predicted jointly.
        orientations: the number of possible orientations if `logits` are joint, else 1. The odds
            are divided by it, so that untrained networks predict even odds.
    """
    return logits.flatten().logsumexp(0) - math.log(orientations) - NOTHING_LOGIT


def presence_loss(odds: Tensor, *, present: bool) -> Tensor:
    """Returns the cross-entropy of the classes "something to pick" and "nothing to pick".

    Args:
        odds: the result of `log_odds`.
        present: whether there is something to pick.
    """
    return F.softplus(-odds if present else odds)


def position_loss(logits: Tensor, *pixels: tuple[float, float]) -> Tensor:
    """Returns the cross-entropy over the pixels of the pick position f_p.

    Args:
        logits: (rows, cols) logits of the pixels.
        pixels: the labels (row, col), which may be fractional; all are equally likely.
    """
    rows, cols = logits.shape
    labels = [
        soft_label(interpolate_label(row, rows), interpolate_label(col, cols), like=logits)
        for row, col in pixels
    ]
    return cross_entropy(logits, torch.stack(labels).mean(0))


def angle_loss(logits: Tensor, theta: float, orientations: int) -> Tensor:
    """Returns the cross-entropy over the orientations of the pick angle f_theta, modulo pi.

    Args:
        logits: (N / 2,) logits of the angles 2 pi i / N.
        theta: the angle of the label, in radians.
        orientations: N, the number of orientations in a full turn.
    """
    bins = theta / (math.tau / orientations)
    label = soft_label(interpolate_label(bins, orientations // 2, cyclic=True), like=logits)
    return cross_entropy(logits, label)


def place_loss(
    scene: Tensor,
    encoding: Tensor,
    pixel: tuple[float, float],
    rotation: float,
    orientations: int,
    generator: torch.Generator,
) -> Tensor:
    """Returns an estimate of the cross-entropy over all pixels and rotations of f_place (equation
    8).

    Near the label the full correlation is computed. Elsewhere each cell of the coarse volume stands
    for the pixels and rotations that it covers. The coarse volume has an additional cross-entropy
    loss of its own, because the search at inference starts from it.

    Args:
        scene: (1, channels, rows, cols), phi(o_t).
        encoding: (1, channels, side, side), psi(c).
        pixel: the label (row, col).
        rotation: the rotation of the label, in radians.
        orientations: N, the number of orientations in a full turn.
        generator: draws how far the window and the coarse rotations are offset from the label.
    """
    draws = torch.rand(3, generator=generator).tolist()
    coarse_angles = rotation_angles(COARSE_ROTATIONS, scene, draws[0])
    coarse = coarse_volume(scene, encoding, coarse_angles)
    coarse_bin = rotation / (math.tau / COARSE_ROTATIONS) - draws[0]
    label = soft_label(
        interpolate_label(coarse_bin, COARSE_ROTATIONS, cyclic=True),
        interpolate_label(pixel[0] / 2, coarse.shape[1]),
        interpolate_label(pixel[1] / 2, coarse.shape[2]),
        like=coarse,
    )
    coarse_loss = cross_entropy(coarse, label)

    step = math.tau / orientations
    first = math.ceil((rotation - _FINE_REACH) / step)
    first = min(first, math.floor(rotation / step))
    last = max(math.floor((rotation + _FINE_REACH) / step), math.floor(rotation / step) + 1)
    margin = _WINDOW // 2
    # Offset the window at random, such that the label lies in its central half.
    top = round(pixel[0]) - margin + round((draws[1] - 0.5) * margin)
    left = round(pixel[1]) - margin + round((draws[2] - 0.5) * margin)
    angles = torch.arange(first, last + 1, dtype=scene.dtype, device=scene.device) * step
    fine = window(scene, encoding, angles, (top, left), (_WINDOW, _WINDOW))
    label = soft_label(
        interpolate_label(rotation / step - first, len(angles)),
        interpolate_label(pixel[0] - top, _WINDOW),
        interpolate_label(pixel[1] - left, _WINDOW),
        like=fine,
    )

    # Coarse cells represent everything outside the window.
    stands_for = math.log(4 * orientations / COARSE_ROTATIONS)
    covered = _covered(coarse, coarse_angles - rotation, (top, left))
    outside = (coarse + stands_for).masked_fill(covered, -torch.inf)
    everything = torch.cat([fine.flatten(), outside.flatten()]).logsumexp(0)
    return coarse_loss + everything - (label * fine).sum()


def _covered(coarse: Tensor, differences: Tensor, corner: tuple[int, int]) -> Tensor:
    """Returns a mask (n, rows, cols) of the coarse cells inside the window around a label.

    Args:
        coarse: (n, rows, cols) scores at half the resolution.
        differences: (n,) rotations of the cells minus that of the label, in radians.
        corner: the window's first pixel (row, col).
    """
    row = torch.arange(coarse.shape[1], device=coarse.device) * 2 - corner[0]
    col = torch.arange(coarse.shape[2], device=coarse.device) * 2 - corner[1]
    away = torch.remainder(differences + math.pi, math.tau) - math.pi
    return (
        (away.abs() < _FINE_REACH)[:, None, None]
        & ((row >= 0) & (row < _WINDOW))[None, :, None]
        & ((col >= 0) & (col < _WINDOW))[None, None, :]
    )


def joint_loss(
    logits: Tensor, *labels: tuple[list[tuple[int, float]], tuple[float, float]]
) -> Tensor:
    """Returns the joint cross-entropy over orientations and pixels, as in the Transporter.

    Args:
        logits: (orientations, rows, cols).
        labels: the labels, all equally likely. Each is a pair of an interpolated orientation (see
            `interpolate_label`) and a pixel (row, col).
    """
    _, rows, cols = logits.shape
    parts = [
        soft_label(bins, interpolate_label(row, rows), interpolate_label(col, cols), like=logits)
        for bins, (row, col) in labels
    ]
    return cross_entropy(logits, torch.stack(parts).mean(0))
