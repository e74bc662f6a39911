import itertools

import pytest

from kitting_drake.hkd.tools.distinct import mean_surface_distance
from kitting_drake.hkd.tools.tool import CATEGORIES, load_tool, tool_names


def test_a_tool_is_no_distance_from_itself():
    tool = load_tool("claw_hammer")
    assert mean_surface_distance(tool, tool) < 0.0005


@pytest.mark.parametrize("name", [n for n in tool_names() if load_tool(n).split == "fresh"])
def test_a_fresh_tool_is_like_none_of_its_category(name: str):
    tool = load_tool(name)
    others = [load_tool(other) for other in tool_names() if other != name]
    distances = {
        other.name: mean_surface_distance(tool, other, count=1000, dense=30_000)
        for other in others
        if other.category == tool.category
    }
    nearest = min(distances, key=distances.__getitem__)
    # Points are sparser than below, and so a little further apart.
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
