"""Toolsets: the four tools, one per category, that share a kit (section IV-B.2 of the paper)."""

import numpy as np

from kitting_drake.common.errors import UserError
from kitting_drake.hkd.tools.tool import CATEGORIES, load_tool, tool_names

PAPER_SPLITS = ("train", "test")
"""The splits of the paper's dataset (section IV-B.1): forty tools to train, twenty to test."""
SPLITS = (*PAPER_SPLITS, "fresh")
"""All splits. Append new ones at the end: a split's place in this tuple is part of its seed.

The ten `fresh` tools are not in the paper's data set. They are reserved for a final test, and
nothing is trained or tuned with them.
"""
TOOLSET_COUNT = 100
"""The number of toolsets of a split, unless the split has fewer combinations."""
TOOLSETS_SEED = 2024
"""The seed of the random draw of toolsets."""


def tool_pools(split: str) -> dict[str, list[str]]:
    """Returns the names of a split's tools by category, in the order of `CATEGORIES`."""
    pools: dict[str, list[str]] = {category: [] for category in CATEGORIES}
    for name in tool_names():
        tool = load_tool(name)
        if tool.split == split:
            pools[tool.category].append(name)
    return pools


def toolsets(split: str) -> list[tuple[str, ...]]:
    """Returns the toolsets of a split, each in the order of `CATEGORIES`.

    There are `TOOLSET_COUNT` different toolsets, or fewer if the tools have fewer combinations.
    The draw is deterministic.

    Raises:
        UserError: a category has no tool in the split.
    """
    pools = list(tool_pools(split).values())
    sizes = [len(pool) for pool in pools]
    combinations = int(np.prod(sizes))
    if not combinations:
        raise UserError(f"there are no {split} toolsets: a category has no {split} tool")
    rng = np.random.default_rng([TOOLSETS_SEED, SPLITS.index(split)])
    chosen = rng.permutation(combinations)[:TOOLSET_COUNT]
    return [
        tuple(pool[index] for pool, index in zip(pools, indices, strict=True))
        for indices in zip(*np.unravel_index(chosen, sizes), strict=True)
    ]
