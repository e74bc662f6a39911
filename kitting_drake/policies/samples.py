"""What a demonstration says about each observation in it."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kitting_drake.policies.config import NetworkConfig
from kitting_drake.policies.demonstrations import Demonstration
from kitting_drake.policies.images import Image, LabelledImage
from systems.signals import PickPlaceAction, PixelGrid


@dataclass(frozen=True)
class Scene:
    """One observation, and all that an expert might do next."""

    image: Image
    targets: tuple[LabelledImage, ...]
    """First what the expert did. What it did later it might have done at once: an object that it
    picks later lies where it lay."""


def scenes(demonstrations: Iterable[Demonstration], grid: PixelGrid) -> list[Scene]:
    """Every observation of some demonstrations."""
    result = []
    for demonstration in demonstrations:
        actions = [PickPlaceAction(step.pick, step.place) for step in demonstration.steps]
        for index, step in enumerate(demonstration.steps):
            image = step.image
            targets = tuple(
                LabelledImage.from_action(image, action, grid) for action in actions[index:]
            )
            result.append(Scene(image, targets))
    return result


def labelled_images(observed: Iterable[Scene], *, taken_only: bool) -> list[LabelledImage]:
    """What there is to learn from.

    Args:
        observed: the observations.
        taken_only: as the paper, one sample for each observation, of the action that was taken;
            else one for each possible action, which knows of the others.
    """
    samples = []
    for scene in observed:
        if taken_only:
            samples.append(scene.targets[0])
            continue
        for target in scene.targets:
            others = [other for other in scene.targets if other is not target]
            samples.append(
                dataclasses.replace(
                    target,
                    other_picks=np.array([item.pick for item in others]).reshape(-1, 2),
                    other_thetas=np.array([item.pick_theta for item in others]),
                )
            )
    return samples


def normalisation(observed: list[Scene]) -> dict[str, float]:
    """The fields of a `NetworkConfig` that say how its inputs are distributed."""
    colour, colour_deviation = _moments(scene.image[:3] for scene in observed)
    height, height_deviation = _moments(scene.image[3] for scene in observed)
    default = NetworkConfig()
    return {
        "colour_mean": colour,
        "colour_deviation": colour_deviation or default.colour_deviation,
        "height_mean": height,
        "height_deviation": height_deviation or default.height_deviation,
    }


def _moments(images: Iterable[NDArray[np.float32]]) -> tuple[float, float]:
    """Mean and standard deviation of all pixels of some images of one shape, one in memory."""
    means, squares = [], []
    for image in images:
        means.append(image.mean(dtype=float))
        squares.append(np.square(image, dtype=float).mean())
    mean = float(np.mean(means))
    variance = float(np.mean(squares)) - mean**2
    # Of pixels that are all alike, rounding is left over.
    return mean, math.sqrt(variance) if variance > 1e-12 else 0.0
