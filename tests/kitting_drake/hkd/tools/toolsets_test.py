import hashlib
import json
import math

import pytest

from kitting_drake.common.errors import UserError
from kitting_drake.common.paths import SCENARIOS
from kitting_drake.hkd.kits.block import build_block
from kitting_drake.hkd.kits.clearance import measure_clearance
from kitting_drake.hkd.kits.layout import kit_cavities
from kitting_drake.hkd.kits.parameters import KitParameters
from kitting_drake.hkd.tools import toolsets as toolsets_module
from kitting_drake.hkd.tools.tool import CATEGORIES, load_tool
from kitting_drake.hkd.tools.toolsets import SPLITS, TOOLSET_COUNT, tool_pools, toolsets


def test_the_splits_have_the_expected_numbers_of_tools():
    sizes = {split: [len(pool) for pool in tool_pools(split).values()] for split in SPLITS}
    assert sizes == {"train": [10] * 4, "test": [5] * 4, "fresh": [3, 2, 3, 2]}


@pytest.mark.parametrize("split", SPLITS)
def test_toolsets_are_distinct_and_of_one_split(split: str):
    """A split has a hundred toolsets, or all combinations if there are fewer."""
    drawn = toolsets(split)
    combinations = math.prod(len(pool) for pool in tool_pools(split).values())
    assert len(set(drawn)) == len(drawn) == min(TOOLSET_COUNT, combinations)
    for names in drawn:
        tools = [load_tool(name) for name in names]
        assert tuple(tool.category for tool in tools) == CATEGORIES
        assert {tool.split for tool in tools} == {split}
    # Every tool of the split occurs in some toolset.
    assert {name for names in drawn for name in names} == {
        name for pool in tool_pools(split).values() for name in pool
    }


@pytest.mark.parametrize(
    ("split", "digest"),
    [
        ("train", "1503670b669c29c4c9ccf241391387a10f3edcbfb54664db358da6b340807e0d"),
        ("test", "3ac90885e97a9654d2a294cc3191c67c05f90d461d1d2434d8d1f3bb6f3c2320"),
    ],
)
def test_the_papers_toolsets_do_not_change(split: str, digest: str):
    """Published demonstrations, weights and results depend on these toolsets."""
    assert hashlib.sha256(json.dumps(toolsets(split)).encode()).hexdigest() == digest


def test_no_scenario_names_a_fresh_tool():
    fresh = [name for pool in tool_pools("fresh").values() for name in pool]
    for path in SCENARIOS.rglob("*.yaml"):
        assert not [name for name in fresh if name in path.read_text()], path


def test_a_split_without_a_category_is_rejected(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(toolsets_module, "tool_names", lambda: ["claw_hammer"])
    with pytest.raises(UserError, match="train"):
        toolsets("train")


@pytest.mark.parametrize("asked", [pytest.param(0.002, marks=pytest.mark.slow), 0.003])
def test_the_measured_clearance_is_the_requested_one(asked: float):
    tools = [load_tool(name) for name in toolsets("test")[0]]
    parameters = KitParameters(clearance=asked)
    block = build_block(kit_cavities(tools, parameters), parameters)
    for tool in tools:
        clearance = measure_clearance(block, tool, parameters)
        assert clearance.median == pytest.approx(asked, abs=0.0003)
        assert clearance.minimum > asked - 0.0003


def test_the_clearance_of_a_tool_that_does_not_fit_is_an_error():
    tools = [load_tool("claw_hammer")]
    parameters = KitParameters()
    block = build_block(kit_cavities([load_tool("soft_face_mallet")], parameters), parameters)
    with pytest.raises(ValueError, match="claw_hammer"):
        measure_clearance(block, tools[0], parameters)
