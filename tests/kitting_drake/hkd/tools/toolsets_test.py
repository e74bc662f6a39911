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


def test_ten_tools_of_each_category_to_train_with_five_to_test_and_ten_fresh_ones():
    sizes = {split: [len(pool) for pool in tool_pools(split).values()] for split in SPLITS}
    assert sizes == {"train": [10] * 4, "test": [5] * 4, "fresh": [3, 2, 3, 2]}


@pytest.mark.parametrize("split", SPLITS)
def test_toolsets_are_a_hundred_different_ones_of_their_own_split(split: str):
    """Or all that there are."""
    drawn = toolsets(split)
    combinations = math.prod(len(pool) for pool in tool_pools(split).values())
    assert len(set(drawn)) == len(drawn) == min(TOOLSET_COUNT, combinations)
    for names in drawn:
        tools = [load_tool(name) for name in names]
        assert tuple(tool.category for tool in tools) == CATEGORIES
        assert {tool.split for tool in tools} == {split}
    # Every tool has its turn.
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
def test_toolsets_of_the_paper_never_change(split: str, digest: str):
    """Demonstrations, weights and results are of these: a split that is added moves none."""
    assert hashlib.sha256(json.dumps(toolsets(split)).encode()).hexdigest() == digest


def test_fresh_tools_are_in_no_scenario_but_by_their_split():
    fresh = [name for pool in tool_pools("fresh").values() for name in pool]
    for path in SCENARIOS.rglob("*.yaml"):
        assert not [name for name in fresh if name in path.read_text()], path


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
