"""Computes paired differences of two runs on the same seeds, and rates, with bootstrap intervals.

The interval of a difference is over episodes, and is too narrow where few episodes differ. The
interval of a rate is over tools, and is too narrow where few tools fail.
"""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

_RESAMPLES = 10_000
_TAILS = (2.5, 97.5)
"""The percentiles of a 95 % interval."""
_FEWEST_TOOLS = 3
"""A bootstrap over tools is informative if at least this many tools failed at least once, and at
least this many succeeded at least once."""

STRICT, OWN = "strict_success_rate", "success_rate"
"""The two rates of an episode: of strict success, and of success by the task's own measure."""


@dataclass(frozen=True)
class Estimate:
    """A number and its 95 % interval."""

    value: float
    low: float
    high: float


def paired_difference(
    first: Mapping[str, Any], second: Mapping[str, Any], rate: str
) -> Estimate | None:
    """Computes how much higher the first run's rate is than the second's, on their common seeds.

    The interval is a bootstrap over episodes. Each resampled episode has the rates of both runs, so
    scenes that are hard for both cancel. The interval does not include the variation between
    trainings of a method.

    Args:
        first: a summary with its `outcomes`.
        second: another summary.
        rate: `STRICT` or `OWN`.

    Returns:
        The mean difference over the common seeds; None if there are none.
    """
    return mean_paired_difference([(first, second)], rate)


def mean_paired_difference(
    pairs: Sequence[tuple[Mapping[str, Any], Mapping[str, Any]]], rate: str
) -> Estimate | None:
    """Computes how much better the first run of each pair is, on average over the pairs.

    Episodes are resampled jointly over all runs, because the runs share their scenes.

    Args:
        pairs: pairs of summaries, as in `paired_difference`.
        rate: `STRICT` or `OWN`.

    Returns:
        The mean difference over the common seeds; None if there are none.
    """
    runs = [
        [{item["seed"]: item[rate] for item in run["outcomes"]} for run in pair] for pair in pairs
    ]
    seeds = sorted(set.intersection(*(set(run) for pair in runs for run in pair)))
    if not seeds:
        return None
    differences = np.mean(
        [[mine[seed] - theirs[seed] for seed in seeds] for mine, theirs in runs], axis=0
    )
    rng = np.random.default_rng(0)
    drawn = rng.integers(len(seeds), size=(_RESAMPLES, len(seeds)))
    low, high = np.percentile(differences[drawn].mean(axis=1), _TAILS)
    return Estimate(float(differences.mean()), float(low), float(high))


def points_text(found: Estimate) -> str:
    """Formats a difference of rates in percentage points, with its interval or "none differs"."""
    if found.low == found.high == 0:
        return "+0.0 (none differs)"
    return f"{100 * found.value:+.1f} ({100 * found.low:+.1f} to {100 * found.high:+.1f})"


def over_tools(outcomes: Sequence[Mapping[str, Any]], rate: str) -> Estimate | None:
    """Computes the share of objects that succeed, with a bootstrap interval over tools.

    This interval applies to other tools of the same kind, unlike an interval over objects.

    Args:
        outcomes: the outcomes of a summary.
        rate: `STRICT` or `OWN`.

    Returns:
        The estimate; None if fewer than three tools failed at least once, or fewer than three
            succeeded at least once.
    """
    needed = 2 if rate == STRICT else 1
    counts: dict[str, list[bool]] = defaultdict(list)
    for episode in outcomes:
        for name, outcome in episode["objects"].items():
            counts[name].append(outcome >= needed)
    good: NDArray[np.float64] = np.array([sum(found) for found in counts.values()], float)
    all_of = np.array([len(found) for found in counts.values()], float)
    if min(np.sum(good < all_of), np.sum(good > 0)) < _FEWEST_TOOLS:
        return None
    share = float(good.sum() / all_of.sum())
    drawn = np.random.default_rng(0).integers(len(good), size=(_RESAMPLES, len(good)))
    shares = good[drawn].sum(axis=1) / all_of[drawn].sum(axis=1)
    low, high = np.percentile(shares, _TAILS)
    return Estimate(share, float(low), float(high))
