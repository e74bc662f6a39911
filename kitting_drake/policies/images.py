"""Pixels: crops, and the augmentation of a labelled image.

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

_BEND = 0.2
"""Standard deviation of both coefficients of a bend."""
_FARTHEST_BENT = 1.4
"""No bend grows from here on, in half sides of the crop: the distance of its corners."""


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
    motion: Motion | None = None
    """How the scene was moved, if it was."""
    bends: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 2)))
    """(1 + n, 2): how the object of each pick may be bent, see `bent_crop`; or none."""

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

    def bent_crop(self, index: int, pixel: tuple[int, int], side: int) -> Image:
        """(channels, side, side) around a pixel near pick 0 or one of the others, its object bent.

        Under a bend (a, b) what is seen at u along the gripper, in half sides of the crop from the
        pick, lay a u^2 + b u^3 half sides further across it. At the pick nothing moves and nothing
        turns: the label stays exact, while the object's far ends say less about it.
        """
        reach = side // 2
        picks = np.vstack([self.pick, self.other_picks])
        axes = rotation(np.append(self.pick_theta, self.other_thetas)[index])
        offsets = np.arange(-reach, reach + 1)
        grid = np.stack(np.meshgrid(offsets, offsets, indexing="ij"), axis=-1) + pixel
        along, across = np.moveaxis((grid - picks[index]) @ axes, -1, 0)
        u = np.clip(along / reach, -_FARTHEST_BENT, _FARTHEST_BENT)
        square, cube = self.bends[index]
        across = across + reach * (square * u**2 + cube * u**3)
        bent = np.stack([along, across], axis=-1) @ axes.T + picks[index]
        if self.motion is None:
            return nearest(self.image, bent)
        rows, cols = self.image.shape[1:]
        inside = ((bent > -0.5) & (bent < (rows - 0.5, cols - 0.5))).all(axis=-1)
        return nearest(self.motion.image, self.motion.before(bent)) * inside


@dataclass(frozen=True)
class Motion:
    """A turn of an image about its middle, and then a shift."""

    image: Image
    """As it was before."""
    angle: float
    """Counter-clockwise, in radians."""
    shift: NDArray[np.float64]
    """(row, col), in pixels."""

    @property
    def middle(self) -> NDArray[np.float64]:
        """(row, col) of the image's."""
        return (np.array(self.image.shape[1:]) - 1) / 2

    def after(self, pixels: NDArray[np.float64]) -> NDArray[np.float64]:
        """(..., 2): where positions (..., 2) of the image come to lie."""
        return (pixels - self.middle) @ rotation(self.angle).T + self.middle + self.shift

    def before(self, pixels: NDArray[np.float64]) -> NDArray[np.float64]:
        """(..., 2): its inverse."""
        return (pixels - self.middle - self.shift) @ rotation(self.angle) + self.middle


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


def nearest(image: Image, source: NDArray[np.float64]) -> Image:
    """An image's pixels at other places: the nearest, as a blend of two heights is one that no
    scene has.

    Args:
        image: (channels, rows, cols).
        source: (n, m, 2): the position (row, col) that each new pixel comes from.

    Returns:
        (channels, n, m); zero, as if unseen, where that is outside the image.
    """
    rows, cols = image.shape[1:]
    row, col = np.rint(source).astype(int).transpose(2, 0, 1)
    inside = (row >= 0) & (row < rows) & (col >= 0) & (col < cols)
    return image[:, row.clip(0, rows - 1), col.clip(0, cols - 1)] * inside


def move(sample: LabelledImage, angle: float, shift: NDArray[np.float64]) -> LabelledImage:
    """The scene turned about the image's middle and then shifted; the labels move exactly.

    Args:
        sample: what to move.
        angle: counter-clockwise, in radians.
        shift: (row, col), in pixels.
    """
    motion = Motion(sample.image, angle, np.asarray(shift, float))
    rows, cols = sample.image.shape[1:]
    target = np.stack(np.meshgrid(np.arange(rows), np.arange(cols), indexing="ij"), axis=-1)
    return dataclasses.replace(
        sample,
        image=nearest(sample.image, motion.before(target)),
        pick=motion.after(sample.pick),
        pick_theta=sample.pick_theta + angle,
        place=motion.after(sample.place),
        other_picks=motion.after(sample.other_picks),
        other_thetas=sample.other_thetas + angle,
        motion=motion,
    )


def augment(
    sample: LabelledImage, random: np.random.Generator, *, rigid: bool = False
) -> LabelledImage:
    """A random SE(2) motion of the scene that keeps both labels inside the image, and bends.

    The turn is normal with 60 degrees, the shift with a sixth of the image's sides; both are drawn
    again while a label is outside. A sample for which a hundred draws are not enough stays where it
    is. Pick angles are learned from the objects as they are and from bent ones (see `bent_crop`):
    those to come will have handles of other shapes.

    Args:
        sample: what to augment.
        random: for all draws.
        rigid: as the paper, bend nothing.
    """
    rows, cols = sample.image.shape[1:]
    result = sample
    for _ in range(100):
        angle = random.normal(0.0, math.radians(60))
        shift = random.normal(0.0, (rows / 6, cols / 6))
        ends = Motion(sample.image, angle, shift).after(np.stack([sample.pick, sample.place]))
        if (ends >= 0).all() and (ends <= (rows - 1, cols - 1)).all():
            result = move(sample, angle, shift)
            break
    if rigid:
        return result
    bends = random.normal(0.0, _BEND, (1 + len(sample.other_picks), 2))
    return dataclasses.replace(result, bends=bends)
