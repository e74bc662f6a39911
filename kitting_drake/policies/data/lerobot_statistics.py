"""Computes the normalisation statistics of a LeRobotDataset (see `lerobot_export`).

They are those of `lerobot.datasets.compute_stats`, but from every pixel of an image instead of a
subset of the pixels.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

QUANTILES = {"q01": 0.01, "q10": 0.1, "q50": 0.5, "q90": 0.9, "q99": 0.99}


def statistics_of(values: NDArray[Any], *, image: bool) -> dict[str, NDArray[Any]]:
    """Returns LeRobot's statistics of a feature over all frames of an episode. For images they
    include all pixels.

    Args:
        values: (frames,), (frames, entries) or (frames, rows, cols, channels).
        image: whether the feature is an image. Its statistics then have the shape (channels, 1, 1),
            and 8-bit values are scaled to [0, 1].
    """
    flat = values.reshape(-1, values.shape[-1] if values.ndim > 1 else 1)
    samples = flat.astype(np.float64) / (255 if image and values.dtype == np.uint8 else 1)
    found = {
        "min": samples.min(axis=0),
        "max": samples.max(axis=0),
        "mean": samples.mean(axis=0),
        "std": samples.std(axis=0),
        **dict(zip(QUANTILES, np.quantile(samples, [*QUANTILES.values()], axis=0), strict=True)),
    }
    if image:
        found = {name: value[:, None, None] for name, value in found.items()}
    return {**found, "count": np.array([len(values)])}


def aggregate(episodes: Sequence[dict[str, NDArray[Any]]]) -> dict[str, Any]:
    """Returns the statistics of all episodes together, as LeRobot's `aggregate_stats` does.

    A quantile is the mean of the episodes' quantiles, weighted by their numbers of frames.
    """
    counts = np.array([item["count"][0] for item in episodes])
    stacked = {name: np.stack([item[name] for item in episodes]) for name in episodes[0]}

    def mean(value: NDArray[Any]) -> NDArray[Any]:
        return np.average(value, axis=0, weights=counts)

    variance = mean(stacked["std"] ** 2 + (stacked["mean"] - mean(stacked["mean"])) ** 2)
    found = {
        "min": stacked["min"].min(axis=0),
        "max": stacked["max"].max(axis=0),
        "mean": mean(stacked["mean"]),
        "std": np.sqrt(variance),
        "count": np.array([counts.sum()]),
        **{name: mean(stacked[name]) for name in QUANTILES},
    }
    return {name: value.tolist() for name, value in found.items()}
