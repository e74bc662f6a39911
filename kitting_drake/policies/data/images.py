"""Labelled images, crops of them, and data augmentation.

As in `systems.signals.PixelGrid`, positions are continuous (row, col) with pixel centres at whole
numbers, and rotations are counter-clockwise.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from systems.signals import Observation, PickPlaceAction, PixelGrid, PlanarPose, wrap_to_pi

Image = NDArray[np.float32]
"""(4, rows, cols): red, green, blue in [0, 1] and height in metres."""

_CURVATURE_STD = 0.2
"""The standard deviation of each of the two coefficients of a random curvature (see
`curved_crop`)."""
_FARTHEST_CURVED = 1.4
"""The distance from the pick beyond which the displacements of a curved crop stop growing. The unit
is half the crop's side, so the crop's corners are about this far from the pick."""
_ROTATION_STD = math.radians(60)
"""The standard deviation of augmentation's rotations in radians, as in the authors' code."""
_SHIFT_STD = 1 / 6
"""The standard deviation of augmentation's shifts, as a share of the image's side along each axis.
Ravens uses the shorter side for both axes."""


class Pictured(Protocol):
    """Anything with an observed image, which may be computed on demand."""

    @property
    def image(self) -> Image:
        """The image, (4, rows, cols): red, green, blue in [0, 1] and height in metres."""


@dataclass(frozen=True)
class LabelledImage:
    """An observation and the expert's action in it, in pixels."""

    image: Image
    pick: NDArray[np.float64]
    """(row, col) of the pick."""
    pick_theta: float
    """The gripper's angle in radians; adding pi gives the same grasp."""
    place: NDArray[np.float64]
    """(row, col) of the place: the object's point at `pick` moves there."""
    rotation: float
    """The rotation of the object between pick and place, in radians."""
    other_picks: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 2)))
    """(n, 2): possible picks of other objects."""
    other_thetas: NDArray[np.float64] = field(default_factory=lambda: np.zeros(0))
    """(n,): the gripper's angles at `other_picks`, in radians."""
    motion: Motion | None = None
    """The motion that augmented the image; None without augmentation."""
    curvatures: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 2)))
    """(1 + n, 2): the curvature (a, b) in `curved_crop`, first for `pick`, then for each of
    `other_picks`; empty without curvature augmentation."""

    @classmethod
    def from_action(cls, image: Image, action: PickPlaceAction, grid: PixelGrid) -> LabelledImage:
        """Converts an action in the world to labels in pixels."""
        return cls(
            image=image,
            pick=grid.to_pixel((action.pick.x, action.pick.y)),
            pick_theta=action.pick.theta,
            place=grid.to_pixel((action.place.x, action.place.y)),
            rotation=action.place.theta - action.pick.theta,
        )

    def place_of(self, pixel: NDArray[np.float64]) -> NDArray[np.float64]:
        """Returns the (row, col) where the object's point at `pixel` is to go."""
        return self.place + rotation_matrix(self.rotation) @ (pixel - self.pick)

    def curved_crop(self, index: int, pixel: tuple[int, int], side: int) -> Image:
        """Returns a crop in which the object is bent (curvature augmentation).

        The unit of length is half the side of the crop. At the distance u from the pick along the
        gripper's angle, a curvature (a, b) shifts the image sideways by a u^2 + b u^3.
        Position and direction at the pick stay the same, so the label remains exact, while the
        object's far ends become less informative.

        Args:
            index: 0 for the pick, 1 + i for other pick i.
            pixel: the centre (row, col) of the crop, near the pick of this index.
            side: the side of the crop, odd, in pixels.

        Returns:
            (channels, side, side).
        """
        reach = side // 2
        picks = np.vstack([self.pick, self.other_picks])
        axes = rotation_matrix(np.append(self.pick_theta, self.other_thetas)[index])
        offsets = np.arange(-reach, reach + 1)
        grid = np.stack(np.meshgrid(offsets, offsets, indexing="ij"), axis=-1) + pixel
        along, across = np.moveaxis((grid - picks[index]) @ axes, -1, 0)
        u = np.clip(along / reach, -_FARTHEST_CURVED, _FARTHEST_CURVED)
        square, cube = self.curvatures[index]
        across = across + reach * (square * u**2 + cube * u**3)
        source = np.stack([along, across], axis=-1) @ axes.T + picks[index]
        if self.motion is None:
            return nearest(self.image, source)
        # Look up all pixels in the original image, so that it is resampled only once.
        rows, cols = self.image.shape[1:]
        inside = ((source > -0.5) & (source < (rows - 0.5, cols - 0.5))).all(axis=-1)
        return nearest(self.motion.image, self.motion.before(source)) * inside


def make_action(
    observation: Observation,
    pick: NDArray[np.float64],
    theta: float,
    place: NDArray[np.float64],
    rotation: float,
) -> PickPlaceAction:
    """Converts a prediction in pixels to an action in the world; the inverse of
    `LabelledImage.from_action`.

    The action has no surface heights, so the planner reads them from the observation.

    Args:
        observation: the heightmap o_t.
        pick: (row, col) at which the object is gripped.
        theta: the angle of the gripper at the pick, in radians.
        place: (row, col) to which the gripped point goes.
        rotation: the rotation of the object from pick to place, in radians.
    """
    grid = observation.grid
    pick_x, pick_y = grid.to_world(pick)
    place_x, place_y = grid.to_world(place)
    theta = wrap_to_pi(theta)
    return PickPlaceAction(
        pick=PlanarPose(float(pick_x), float(pick_y), theta),
        place=PlanarPose(float(place_x), float(place_y), theta + rotation),
    )


@dataclass(frozen=True)
class Motion:
    """An SE(2) motion of an image: a rotation about its centre followed by a shift."""

    image: Image
    """The image before the motion."""
    angle: float
    """The angle of the rotation, counter-clockwise, in radians."""
    shift: NDArray[np.float64]
    """The shift along rows and columns, in pixels."""

    @classmethod
    def draw(cls, image: Image, random: np.random.Generator) -> Motion:
        """Draws a random motion, whose angle and shift are normally distributed."""
        rows, cols = image.shape[1:]
        angle = random.normal(0.0, _ROTATION_STD)
        return cls(image, angle, random.normal(0.0, (rows * _SHIFT_STD, cols * _SHIFT_STD)))

    @property
    def middle(self) -> NDArray[np.float64]:
        """(row, col) of the image's centre."""
        return (np.array(self.image.shape[1:]) - 1) / 2

    def after(self, pixels: NDArray[np.float64]) -> NDArray[np.float64]:
        """Returns the positions (..., 2) of pixels after the motion."""
        rotated = (pixels - self.middle) @ rotation_matrix(self.angle).T
        return rotated + self.middle + self.shift

    def before(self, pixels: NDArray[np.float64]) -> NDArray[np.float64]:
        """Returns the positions (..., 2) of pixels before the motion; the inverse of `after`."""
        return (pixels - self.middle - self.shift) @ rotation_matrix(self.angle) + self.middle

    def moved_image(self) -> Image:
        """Returns the image after the motion. It has the same size."""
        rows, cols = self.image.shape[1:]
        target = np.stack(np.meshgrid(np.arange(rows), np.arange(cols), indexing="ij"), axis=-1)
        return nearest(self.image, self.before(target.astype(float)))


def rotation_matrix(angle: float) -> NDArray[np.float64]:
    """Returns the matrix (2, 2) that rotates (row, col) vectors counter-clockwise by an angle in
    radians."""
    cos, sin = math.cos(angle), math.sin(angle)
    return np.array([[cos, -sin], [sin, cos]])


def moved_pixels(
    pixels: NDArray[Any],
    pick: NDArray[np.float64],
    rotation: float,
    place: NDArray[np.float64],
) -> NDArray[np.int_]:
    """Returns where an object's pixels (n, 2) come to lie, rounded; they may be outside the image.

    Args:
        pixels: row and column of each pixel.
        pick: (row, col) at which the object is gripped.
        rotation: the rotation of the object, in radians.
        place: (row, col) to which the gripped point goes.
    """
    return np.rint(place + (pixels - pick) @ rotation_matrix(rotation).T).astype(int)


def crop(image: Image, centre: tuple[int, int], side: int) -> Image:
    """Returns the part (channels, side, side) of an image around the pixel `centre`. `side` must be
    odd. Pixels outside the image are zero (unseen)."""
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
    """Resamples an image by nearest neighbours, because interpolation would invent heights between
    objects.

    Args:
        image: (channels, rows, cols).
        source: (n, m, 2): the source position (row, col) of each new pixel.

    Returns:
        (channels, n, m); zero (unseen) if the source position is outside the image.
    """
    rows, cols = image.shape[1:]
    row, col = np.rint(source).astype(int).transpose(2, 0, 1)
    inside = (row >= 0) & (row < rows) & (col >= 0) & (col < cols)
    return image[:, row.clip(0, rows - 1), col.clip(0, cols - 1)] * inside


def move(sample: LabelledImage, angle: float, shift: NDArray[np.float64]) -> LabelledImage:
    """Returns a sample after a motion of its scene, with exact labels.

    Args:
        sample: the sample.
        angle: the angle of the rotation about the image's centre, counter-clockwise, in radians.
        shift: the shift along rows and columns, in pixels.
    """
    return _moved(sample, Motion(sample.image, angle, np.asarray(shift, float)))


def _moved(sample: LabelledImage, motion: Motion) -> LabelledImage:
    return dataclasses.replace(
        sample,
        image=motion.moved_image(),
        pick=motion.after(sample.pick),
        pick_theta=sample.pick_theta + motion.angle,
        place=motion.after(sample.place),
        other_picks=motion.after(sample.other_picks),
        other_thetas=sample.other_thetas + motion.angle,
        motion=motion,
    )


def reflect(sample: LabelledImage) -> LabelledImage:
    """Returns the mirror image of a sample, with reversed columns and the labels of the mirrored
    scene.

    For networks that are not equivariant to reflections, the mirror image is a new scene with new
    shapes.
    """
    last = sample.image.shape[2] - 1

    def mirrored(pixels: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.stack([pixels[..., 0], last - pixels[..., 1]], axis=-1)

    return dataclasses.replace(
        sample,
        image=np.ascontiguousarray(sample.image[:, :, ::-1]),
        pick=mirrored(sample.pick),
        pick_theta=-sample.pick_theta,
        place=mirrored(sample.place),
        rotation=-sample.rotation,
        other_picks=mirrored(sample.other_picks),
        other_thetas=-sample.other_thetas,
    )


def augment(
    sample: LabelledImage,
    random: np.random.Generator,
    *,
    curvature: bool = False,
    reflection: bool = False,
) -> LabelledImage:
    """Returns a sample after a random SE(2) motion of the scene that keeps the pick and the place
    inside the image.

    If a hundred draws give no such motion, the sample is not moved.

    Args:
        sample: the sample.
        random: the generator of all random draws.
        curvature: whether to draw curvatures as well (see `LabelledImage.curved_crop`), so that
            pick angles are learned from bent objects. This is not in the paper.
        reflection: whether to reflect the sample first, with a probability of one half. This is not
            in the paper.
    """
    if reflection and random.random() < 0.5:
        sample = reflect(sample)
    rows, cols = sample.image.shape[1:]
    result = sample
    for _ in range(100):
        motion = Motion.draw(sample.image, random)
        ends = motion.after(np.stack([sample.pick, sample.place]))
        if (ends >= 0).all() and (ends <= (rows - 1, cols - 1)).all():
            result = _moved(sample, motion)
            break
    if not curvature:
        return result
    curvatures = random.normal(0.0, _CURVATURE_STD, (1 + len(sample.other_picks), 2))
    return dataclasses.replace(result, curvatures=curvatures)
