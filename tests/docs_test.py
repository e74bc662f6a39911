"""The examples of the docs run, and the docs quote them verbatim."""

import runpy
from pathlib import Path

import pytest

DOCS = Path(__file__).resolve().parents[1] / "docs"
EXAMPLE = DOCS / "examples" / "own_policy.py"


@pytest.mark.usefixtures("rendering")
def test_own_policy_example(tmp_path: Path):
    text = EXAMPLE.read_text()
    assert len(text.splitlines()) <= 60
    assert text in (DOCS / "architecture.md").read_text()
    log = runpy.run_path(str(EXAMPLE))["main"](tmp_path / "force.png")
    times, force = log.sample_times(), log.data()[2]
    # The hand carries a screwdriver of 70 g, then presses it onto the table.
    assert -0.8 < force[(times > 2.1) & (times < 2.7)].mean() < -0.5
    assert force.max() > 2.0
    assert (tmp_path / "force.png").stat().st_size > 5000
