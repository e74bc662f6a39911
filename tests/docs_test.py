"""The examples of the docs run, and the docs quote them verbatim."""

import json
import re
import runpy
from pathlib import Path

import pytest

from kitting_drake.scenario import load_scenario

DOCS = Path(__file__).resolve().parents[1] / "docs"
EXAMPLE = DOCS / "examples" / "own_policy.py"


@pytest.mark.usefixtures("rendering")
def test_own_policy_example(tmp_path: Path):
    text = EXAMPLE.read_text()
    assert len(text.splitlines()) <= 60
    assert text in (DOCS / "architecture.md").read_text()
    log = runpy.run_path(str(EXAMPLE))["main"](tmp_path / "force.png")
    times, force = log.sample_times(), log.data()[2]
    # The carried screwdriver of 70 g weighs 0.7 N. Then the hand presses it onto the table.
    assert -0.8 < force[(times > 1.7) & (times < 2.2)].mean() < -0.5
    assert force.max() > 2.0
    assert (tmp_path / "force.png").stat().st_size > 5000


def test_own_task_example(tmp_path: Path):
    text = (DOCS / "architecture.md").read_text()
    (code,) = re.findall(r"```python\n(import dataclasses\n.+?)```", text, re.DOTALL)
    (tmp_path / "tower.py").write_text(code)
    (tag,) = re.findall(r"^`task: (!PythonTask {class: tower:.+})`", text, re.MULTILINE)
    (tmp_path / "tower.yaml").write_text(f"Tower: {{task: {tag}}}")
    scenario = load_scenario(tmp_path / "tower.yaml")
    scene = scenario.task.make_scene(grid=scenario.heightmap.grid(), seed=0, base=tmp_path)
    assert [goal.poses[0].translation()[2] for goal in scene.goals] == [0, 0.05]
    # One cell of the tutorial is the example's class.
    cells = json.loads((DOCS / "tutorial.ipynb").read_text())["cells"]
    start = code.index("from kitting_drake.")
    assert code[start:].rstrip() in ["".join(cell["source"]) for cell in cells]
