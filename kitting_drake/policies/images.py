"""Pixels: crops, and the SE(2) augmentation of a labelled image.

Positions are continuous (row, col) with pixel centres at whole numbers, turns are
counter-clockwise: both as `systems.signals.PixelGrid` has them. There is no other convention here.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from systems.signals import PickPlaceAction, PixelGrid

Image = NDArray[np.float32]
"""(4, rows, cols): red, green, blue in [0, 1] and height in metres."""


@dataclass(frozen=True)
class LabelledImage:
    """An observation and what the expert did, in pixels."""

    image: Image
    pick: NDArray[np.float64]
    """(row, col)."""
    pick_theta: float
    """Of the gripper, in radians; a half turn more is the same."""
    place: NDArray[np.float64]
    """(row, col) that the point under the gripper goes to."""
    turn: float
    """By how much the object turns on its way, in radians."""
    other_picks: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 2)))
    """(n, 2): where other objects might be picked instead."""
    other_thetas: NDArray[np.float64] = field(default_factory=lambda: np.zeros(0))
    """(n,): at which angles."""

    @classmethod
    def from_action(cls, image: Image, action: PickPlaceAction, grid: PixelGrid) -> LabelledImage:
        """The labels of an action."""
        return cls(
            image=image,
            pick=grid.to_pixel((action.pick.x, action.pick.y)),
            pick_theta=action.pick.theta,
            place=grid.to_pixel((action.place.x, action.place.y)),
            turn=action.place.theta - action.pick.theta,
        )

    def place_of(self, pixel: NDArray[np.float64]) -> NDArray[np.float64]:
        """(row, col) that another point of the object, now at `pixel`, goes to."""
        return self.place + rotation(self.turn) @ (pixel - self.pick)


def rotation(angle: float) -> NDArray[np.float64]:
    """(2, 2): turns (row, col) vectors counter-clockwise."""
    cos, sin = math.cos(angle), math.sin(angle)
    return np.array([[cos, -sin], [sin, cos]])


def crop(image: Image, centre: tuple[int, int], side: int) -> Image:
    """(channels, side, side) around a pixel, `side` odd; zero, as if unseen, outside the image."""
    channels, rows, cols = image.shape
    reach = side // 2
    result = np.zeros((channels, side, side), image.dtype)
    top, left = centre[0] - reach, centre[1] - reach
    r0, r1 = max(top, 0), min(top + side, rows)
    c0, c1 = max(left, 0), min(left + side, cols)
    if r0 < r1 and c0 < c1:
        result[:, r0 - top : r1 - top, c0 - left : c1 - left] = image[:, r0:r1, c0:c1]
    return result


def move(sample: LabelledImage, angle: float, shift: NDArray[np.float64]) -> LabelledImage:
    """The scene turned about the image's middle and then shifted; the labels move exactly.

    Args:
        sample: what to move.
        angle: counter-clockwise, in radians.
        shift: (row, col), in pixels.
    """
    rows, cols = sample.image.shape[1:]
    middle = np.array([(rows - 1) / 2, (cols - 1) / 2])
    turned = rotation(angle)
    back = turned.T
    target = np.stack(np.meshgrid(np.arange(rows), np.arange(cols), indexing="ij"), axis=-1)
    source = (target - middle - shift) @ back.T + middle
    # The nearest pixel: a blend of two heights is a height that no scene has.
    row, col = np.rint(source).astype(int).transpose(2, 0, 1)
    inside = (row >= 0) & (row < rows) & (col >= 0) & (col < cols)
    image = np.where(inside, sample.image[:, row.clip(0, rows - 1), col.clip(0, cols - 1)], 0)
    return dataclasses.replace(
        sample,
        image=image.astype(np.float32),
        pick=turned @ (sample.pick - middle) + middle + shift,
        pick_theta=sample.pick_theta + angle,
        place=turned @ (sample.place - middle) + middle + shift,
        other_picks=(sample.other_picks - middle) @ turned.T + middle + shift,
        other_thetas=sample.other_thetas + angle,
    )


def augment(sample: LabelledImage, random: np.random.Generator) -> LabelledImage:
    """A random SE(2) motion of the scene that keeps both labels inside the image.

    The turn is normal with 60 degrees, the shift with a sixth of the image's sides; both are drawn
    again while a label is outside. A sample for which a hundred draws are not enough stays.
    """
    rows, cols = sample.image.shape[1:]
    middle = np.array([(rows - 1) / 2, (cols - 1) / 2])
    for _ in range(100):
        angle = random.normal(0.0, math.radians(60))
        shift = random.normal(0.0, (rows / 6, cols / 6))
        ends = rotation(angle) @ (np.stack([sample.pick, sample.place], axis=1) - middle[:, None])
        ends = ends.T + middle + shift
        if (ends >= 0).all() and (ends <= (rows - 1, cols - 1)).all():
            return move(sample, angle, shift)
    return sample
