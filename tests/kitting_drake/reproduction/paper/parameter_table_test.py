"""The table of parameters."""

import pytest

from kitting_drake.reproduction.paper.parameter_table import (
    COLUMNS,
    ORIGINAL,
    count_parameters,
    original_parameters,
    parameters_section,
)


def share(method: str, preset: str) -> float:
    """The number of parameters, divided by the number in the method's original networks."""
    return sum(count_parameters(method, preset).values()) / original_parameters(method)


def test_the_paper_preset_has_the_authors_sizes():
    found = count_parameters("so2", "paper")
    assert found == pytest.approx(ORIGINAL, rel=1e-3)
    # The paper gives 4.54 million per network, but the authors' angle network has 0.90 million at
    # N = 36.
    theirs = count_parameters("equivariant_transporter", "paper")
    assert [round(theirs[name] / 1e6, 2) for name in COLUMNS] == [4.54, 0.90, 4.54, 4.54]


def test_matched_baselines_keep_the_share_of_so2():
    assert count_parameters("so2", "matched") == count_parameters("so2", "small")
    ours = share("so2", "small")
    assert share("transporter", "small") < 0.4 * ours
    assert share("transporter", "matched") == pytest.approx(ours, rel=0.02)
    # The Equivariant Transporter's presets differ only in the angle network.
    small, matched = (
        count_parameters("equivariant_transporter", preset) for preset in ("small", "matched")
    )
    assert {name for name in COLUMNS if small[name] != matched[name]} == {"beta"}
    assert matched["beta"] >= count_parameters("so2", "small")["beta"]


def test_the_table_has_every_network():
    lines = [line for line in parameters_section().splitlines() if line.startswith("| ")]
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
    by_name = {tuple(row[:2]): row[2:] for row in rows}
    ours = by_name["SO(2)-equivariant (ours)", "small, matched"]
    assert ours == ["159,281", "102,696", "159,299", "159,299", "580,575", "1 / 24.9"]
    original = by_name["SO(2)-equivariant (ours)", "*original*"]
    assert original == ["4,537,185", "835,888", "4,537,185", "4,537,185", "14,447,443", ""]
    transporter = by_name["Transporter", "matched"]
    assert transporter == ["398,171", "-", "398,227", "398,227", "1,194,625", "1 / 24.7"]
    assert by_name["Transporter", "small"][-1] == "1 / 70.5"
    assert by_name["Equivariant Transporter", "matched"][1] == "102,912"
