import pytest

from kitting_drake.common.errors import UserError
from kitting_drake.hkd.kits.block import build_block
from kitting_drake.hkd.kits.clearance import measure_clearance
from kitting_drake.hkd.kits.layout import kit_cavities
from kitting_drake.hkd.kits.parameters import KitParameters
from kitting_drake.hkd.tools import toolsets as toolsets_module
from kitting_drake.hkd.tools.tool import CATEGORIES, load_tool
from kitting_drake.hkd.tools.toolsets import SPLITS, TOOLSET_COUNT, tool_pools, toolsets


def test_ten_tools_of_each_category_to_train_with_and_five_to_test():
    sizes = {split: [len(pool) for pool in tool_pools(split).values()] for split in SPLITS}
    assert sizes == {"train": [10] * 4, "test": [5] * 4}


@pytest.mark.parametrize("split", SPLITS)
def test_toolsets_are_a_hundred_different_ones_of_their_own_split(split: str):
    drawn = toolsets(split)
    assert len(set(drawn)) == len(drawn) == TOOLSET_COUNT
    for names in drawn:
        tools = [load_tool(name) for name in names]
        assert tuple(tool.category for tool in tools) == CATEGORIES
        assert {tool.split for tool in tools} == {split}
    # Every tool has its turn.
    assert {name for names in drawn for name in names} == {
        name for pool in tool_pools(split).values() for name in pool
    }


def test_a_split_that_lacks_a_category_is_told(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(toolsets_module, "tool_names", lambda: ["claw_hammer"])
    with pytest.raises(UserError, match="no train toolsets"):
        toolsets("train")


def test_clearance_is_what_the_kit_was_asked_for():
    tools = [load_tool(name) for name in toolsets("test")[0]]
    for asked in (0.002, 0.003):
        parameters = KitParameters(clearance=asked)
        block = build_block(kit_cavities(tools, parameters), parameters)
        for tool in tools:
            clearance = measure_clearance(block, tool, parameters)
            assert clearance.median == pytest.approx(asked, abs=0.0003)
            assert clearance.minimum > asked - 0.0003


def test_a_tool_that_does_not_fit_has_no_clearance():
    tools = [load_tool("claw_hammer")]
    parameters = KitParameters()
    block = build_block(kit_cavities([load_tool("soft_face_mallet")], parameters), parameters)
    with pytest.raises(ValueError, match="does not fit"):
        measure_clearance(block, tools[0], parameters)
