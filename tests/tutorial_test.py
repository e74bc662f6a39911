"""The cells of docs/tutorial.ipynb run one after another, and the notebook stores no outputs."""

import ast
import json
import os
import re
import tempfile
from pathlib import Path
from typing import Any

import pytest

NOTEBOOK = Path(__file__).resolve().parents[1] / "docs" / "tutorial.ipynb"


def code_cells() -> list[dict[str, Any]]:
    cells = json.loads(NOTEBOOK.read_text())["cells"]
    return [cell for cell in cells if cell["cell_type"] == "code"]


def source(cell: dict[str, Any]) -> str:
    return "".join(cell["source"])


def test_the_cells_are_short_and_compile_and_store_no_outputs():
    assert NOTEBOOK.stat().st_size < 30_000
    cells = code_cells()
    assert len(cells) > 10
    for number, cell in enumerate(cells):
        assert not cell["outputs"]
        assert cell["execution_count"] is None
        assert len(cell["source"]) <= 30
        compile(source(cell), f"cell {number}", "exec")


def test_the_imports_of_the_cells_work():
    for cell in code_cells():
        for statement in ast.parse(source(cell)).body:
            if isinstance(statement, ast.Import | ast.ImportFrom):
                exec(ast.unparse(statement), {})


def test_the_pictures_exist():
    pictures = re.findall(r"!\[[^\]]+\]\(([^)]+)\)", NOTEBOOK.read_text())
    assert len(pictures) == 3
    assert all((NOTEBOOK.parent / picture).is_file() for picture in pictures)


@pytest.mark.slow
@pytest.mark.usefixtures("rendering")
def test_the_cells_run_in_a_folder_outside_the_tree(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    import matplotlib

    matplotlib.use("Agg")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    # The notebook also runs `python -m kitting_drake.hkd`, which must find this checkout.
    tree = str(NOTEBOOK.parents[1])
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([tree, os.environ.get("PYTHONPATH", "")]))
    names: dict[str, Any] = {"__name__": "__main__"}
    for number, cell in enumerate(code_cells()):
        exec(compile(source(cell), f"cell {number}", "exec"), names)
    printed = capsys.readouterr().out
    assert printed.count(" kitted, ADD-S") == 4
    assert "{'claw_hammer': True, 'my_spanner': True}" in printed
    assert "actions begun: 1\n" in printed
    assert "success rate 100% in 2 actions" in printed
    assert set(os.listdir(tmp_path)) == {Path(names["folder"]).name}
