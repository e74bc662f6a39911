"""Normalisation of the networks' inputs, by the mean and standard deviation of training images."""

import math

import numpy as np
from numpy.typing import NDArray

from kitting_drake.policies.data.samples import ObservedScene
from kitting_drake.policies.networks.architecture import NetworkConfig


def normalisation(observed: list[ObservedScene]) -> dict[str, float]:
    """Computes the normalisation fields of a `NetworkConfig` from observations."""
    # Use a generator, so that only one image at a time is in memory.
    images = (scene.recorded.image for scene in observed)
    moments = np.array([[_moments(image[:3]), _moments(image[3])] for image in images])
    default = NetworkConfig()
    (colour, colour_std), (height, height_std) = map(_mean_and_std, moments.transpose(1, 2, 0))
    return {
        "colour_mean": colour,
        "colour_std": colour_std or default.colour_std,
        "height_mean": height,
        "height_std": height_std or default.height_std,
    }


def _moments(values: NDArray[np.float32]) -> tuple[float, float]:
    """Returns the mean of some values and the mean of their squares."""
    return float(values.mean(dtype=float)), float(np.square(values, dtype=float).mean())


def _mean_and_std(moments: NDArray[np.float64]) -> tuple[float, float]:
    """Computes mean and standard deviation from the `_moments` of n arrays of equal size.

    Args:
        moments: (2, n) the means, and the means of the squares.
    """
    mean, square = moments.mean(axis=1)
    variance = float(square) - float(mean) ** 2
    # If all values are equal, rounding errors may make the variance slightly positive or negative.
    return float(mean), math.sqrt(variance) if variance > 1e-12 else 0.0
