"""A kit is proved in simulation before it is cut."""

import json
from collections import Counter
from pathlib import Path

import pytest

from kitting_drake.common.errors import UserError
from kitting_drake.evaluation.kit_proof import KitProof, ToolProof, _verdict, prove_kit
from kitting_drake.hkd.fabrication.export import KitRequest, export_kit
from kitting_drake.hkd.proving import tools_to_prove
from kitting_drake.hkd.tools.tool import load_tool


def proof(clearance_mm: float, *kitted: int, cause: str = "insertion blocked") -> KitProof:
    tools = {
        name: ToolProof(name, count, 10, 12.0, Counter({cause: 10 - count}))
        for name, count in zip(("hammer", "pliers"), kitted, strict=True)
    }
    return KitProof(clearance_mm, tools)


def test_the_verdict_names_the_trouble_and_the_cure():
    assert _verdict(proof(0.35, 10, 10), []) == (
        "The kit fits: 20 of 20 tools were kitted at 0.35 mm a side, with at most 12 N."
    )
    bad = _verdict(proof(0.15, 4, 10), [proof(0.35, 6, 10), proof(0.55, 10, 10)])
    assert "the worst tool is hammer (6 of 10 failed, mostly insertion blocked)" in bad
    assert "0.55 mm would be enough: 20 of 20" in bad
    assert "is not enough either" in _verdict(proof(0.15, 4, 10), [proof(0.35, 6, 10)])


def test_wider_cavities_are_no_cure_for_tools_that_slip():
    assert proof(0.15, 4, 10).may_be_tight
    assert not proof(0.15, 10, 10).may_be_tight
    slips = proof(0.15, 4, 10, cause="slipped")
    assert not slips.may_be_tight
    assert "would not help. The hammer slips from the hand" in _verdict(slips, [])


@pytest.mark.slow
def test_a_kit_is_proved_and_can_be_made_again(tmp_path: Path):
    request = KitRequest(("claw_hammer",), tmp_path / "kit", clearance_mm=2.0)
    export_kit(request)
    seen: list[tuple[int, int]] = []
    verdict = prove_kit(tmp_path / "kit", 1, lambda _, done, total: seen.append((done, total)))
    assert verdict.startswith("The kit fits: 1 of 1 tools")
    assert seen == [(0, 1), (1, 1)]
    page = (tmp_path / "kit" / "proof.html").read_text()
    assert verdict in page and page.count("data:image/png") == 3
    assert json.loads((tmp_path / "kit" / "proof.json").read_text())["verdict"] == verdict
    export_kit(request)
    assert not (tmp_path / "kit" / "proof.html").exists()


def test_true_tools_are_named_for_the_tools_of_the_kit():
    tools = ("rod_80x14", "plate_90x40x8")
    assert tools_to_prove(tools, ()) == []
    rod, plate = tools_to_prove(tools, (("rod_80x14", "rod_81x14"),))
    assert load_tool(rod).name == "rod_81x14"
    assert load_tool(plate).name == "plate_90x40x8"
    with pytest.raises(UserError, match="the kit has no tool 'bar': give one of rod_80x14, plate"):
        tools_to_prove(tools, (("bar", "rod_81x14"),))


def test_a_kit_is_given_up_only_when_it_certainly_does_not_fit():
    clear = KitProof(0.15, {"rod": ToolProof("rod", 1, 4)})
    assert clear.is_hopeless
    few = KitProof(0.15, {"rod": ToolProof("rod", 0, 1)})
    many = KitProof(0.15, {"rod": ToolProof("rod", 37, 40)})
    assert not few.is_hopeless and not many.is_hopeless
