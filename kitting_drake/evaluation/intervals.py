"""Computes 95 % confidence intervals of rates."""

import math
from collections.abc import Sequence
from statistics import NormalDist

import numpy as np

_UPPER = 0.975
"""Quantile of the upper end of a two-sided 95 % interval."""
_Z = NormalDist().inv_cdf(_UPPER)
_ALIKE = 0.9
"""If at least this share of the scores is equal, their sample variance is unreliable."""


def proportion_interval(successes: int, trials: int) -> list[float]:
    """Wilson's score interval of a proportion, as [low, high]."""
    share = successes / trials
    scale = 1 + _Z**2 / trials
    middle = (share + _Z**2 / (2 * trials)) / scale
    reach = _Z / scale * math.sqrt((share * (1 - share) + _Z**2 / (4 * trials)) / trials)
    low = 0.0 if successes == 0 else middle - reach
    high = 1.0 if successes == trials else middle + reach
    return [low, high]


def mean_interval(scores: Sequence[float]) -> list[float]:
    """A 95 % interval of the mean of scores between 0 and 1, as [low, high].

    It is Student's interval. For scores that are all 0 or 1, or nearly all equal, it is Wilson's,
    with the sum of the scores as number of successes. This is conservative: scores of 0 and 1 have
    the largest variance for a given mean.
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
    # Import SciPy lazily.
    from scipy.special import stdtrit

    error = float(np.std(scores, ddof=1)) / math.sqrt(count)
    reach = float(stdtrit(count - 1, _UPPER)) * error
    return [max(0.0, mean - reach), min(1.0, mean + reach)]
