"""Which seeds are for what: what a policy has learned from is not what it is tested on."""

ALL_SEEDS = range(2**32)
"""All seeds that there are."""

TEST_SEEDS = range(10_000)
"""Seeds of test episodes."""

DEMONSTRATION_SEEDS = range(10_000, 20_000)
"""Seeds of demonstrations to learn from."""

VALIDATION_SEEDS = range(20_000, 30_000)
"""Seeds of the demonstrations by which a checkpoint is chosen."""


def seeds_from(first: int) -> range:
    """The seeds from one on, to the end of those of its kind."""
    for seeds in (TEST_SEEDS, DEMONSTRATION_SEEDS, VALIDATION_SEEDS):
        if first in seeds:
            return range(first, seeds.stop)
    return range(first, ALL_SEEDS.stop)
