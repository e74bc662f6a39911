"""Ranges of seeds for different purposes. Policies are never tested on seeds that they were trained
on."""

ALL_SEEDS = range(2**32)
"""All valid seeds."""

TEST_SEEDS = range(10_000)
"""Seeds of test episodes."""

DEMONSTRATION_SEEDS = range(10_000, 20_000)
"""Seeds of training demonstrations."""

VALIDATION_SEEDS = range(20_000, 30_000)
"""Seeds of the demonstrations that are used to choose a checkpoint."""


def seeds_from(first: int) -> range:
    """The seeds from `first` to the end of its range: the test, demonstration or validation seeds,
    or else all seeds."""
    for seeds in (TEST_SEEDS, DEMONSTRATION_SEEDS, VALIDATION_SEEDS):
        if first in seeds:
            return range(first, seeds.stop)
    return range(first, ALL_SEEDS.stop)
