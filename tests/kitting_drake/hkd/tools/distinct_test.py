"""The tools of the dataset differ in shape, independent of their size."""

import functools
import itertools

import numpy as np
import pytest
from scipy.spatial import cKDTree

from kitting_drake.hkd.tools.tool import CATEGORIES, Tool, load_tool, tool_names

# The common length of compared tools, in the middle of the dataset's range.
_REFERENCE_LENGTH = 0.175


@functools.lru_cache(maxsize=64)
def scaled_points(tool: Tool, number: int, seed: int) -> np.ndarray:
    return tool.surface_points(number, seed) * (_REFERENCE_LENGTH / tool.length)


@functools.lru_cache(maxsize=32)
def dense_tree(tool: Tool, number: int) -> cKDTree:
    return cKDTree(scaled_points(tool, number, 1))


def mean_surface_distance(
    tool_a: Tool, tool_b: Tool, count: int = 4000, dense: int = 100_000
) -> float:
    """The symmetric mean distance of two tools' surfaces, in metres.

    The tools are scaled to a common length and aligned by their frames T. `count` points on each
    surface, sampled by area, are compared with the nearest of `dense` points on the other, and both
    means are averaged.
    """

    def one_way(source: Tool, target: Tool) -> float:
        distance, _ = dense_tree(target, dense).query(scaled_points(source, count, 0))
        return float(np.mean(distance))

    return 0.5 * (one_way(tool_a, tool_b) + one_way(tool_b, tool_a))


def test_the_distance_of_a_tool_from_itself_is_small():
    tool = load_tool("claw_hammer")
    assert mean_surface_distance(tool, tool) < 0.0005


FAST = ("fencing_pliers",)


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=[] if name in FAST else [pytest.mark.slow])
        for name in tool_names()
        if load_tool(name).split == "fresh"
    ],
)
def test_a_fresh_tool_is_unlike_all_others_of_its_category(name: str):
    tool = load_tool(name)
    others = [load_tool(other) for other in tool_names() if other != name]
    distances = {
        other.name: mean_surface_distance(tool, other, count=1000, dense=30_000)
        for other in others
        if other.category == tool.category
    }
    nearest = min(distances, key=distances.__getitem__)
    # This test samples fewer points than the next one. The measured distances are then larger, so
    # the limit is larger, too.
    assert distances[nearest] > 0.0016, nearest


@pytest.mark.slow
@pytest.mark.parametrize("category", CATEGORIES)
def test_no_two_tools_of_a_category_are_alike(category: str):
    tools = [tool for tool in map(load_tool, tool_names()) if tool.category == category]
    distances = {
        (a.name, b.name): mean_surface_distance(a, b) for a, b in itertools.combinations(tools, 2)
    }
    nearest = min(distances, key=distances.__getitem__)
    assert distances[nearest] > 0.0015, nearest
