"""95 % confidence intervals of rates."""

import math
from collections.abc import Sequence

import numpy as np
from scipy import stats

_CONFIDENCE = 0.95
_ALIKE = 0.9
"""Where this share of scores is one and the same, the others do not tell how much scores vary."""


def proportion_interval(successes: int, trials: int) -> list[float]:
    """Wilson's score interval of a proportion, as [low, high]."""
    interval = stats.binomtest(successes, trials).proportion_ci(_CONFIDENCE, method="wilson")
    return [float(interval.low), float(interval.high)]


def mean_interval(scores: Sequence[float]) -> list[float]:
    """An interval of the mean of scores between 0 and 1, as [low, high].

    It is Student's; of scores that are all 0 or 1 it is Wilson's. Scores nearly all of which are
    alike do not tell how much they vary. Their interval is Wilson's too, as if each were a number
    of successes in one trial: no scores of that mean vary more.
    """
    count, mean = len(scores), float(np.mean(scores))
    values, counts = np.unique(np.round(scores, 9), return_counts=True)
    if set(values) <= {0.0, 1.0}:
        return proportion_interval(round(sum(scores)), count)
    if counts.max() >= _ALIKE * count:
        total = round(mean * count, 6)
        low, _ = proportion_interval(math.floor(total), count)
        _, high = proportion_interval(math.ceil(total), count)
        return [low, high]
    low, high = stats.t.interval(_CONFIDENCE, count - 1, loc=mean, scale=stats.sem(scores))
    return [max(0.0, float(low)), min(1.0, float(high))]
