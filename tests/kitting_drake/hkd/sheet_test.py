from pathlib import Path

import numpy as np
import pytest

from kitting_drake.hkd import sheet
from kitting_drake.hkd.sheet import Subject, tool_subject, write_sheet
from kitting_drake.hkd.tools.tool import load_tool


def test_an_interrupted_sheet_continues_where_it_stopped(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    subjects = [tool_subject(load_tool(name)) for name in ("claw_hammer", "s_wrench")]
    drawn: list[str] = []

    def render(subject: Subject) -> np.ndarray:
        if len(drawn) == 1 and interrupts:
            raise KeyboardInterrupt
        drawn.append(subject.title)
        return np.full((60, 90, 3), 200, np.uint8)

    monkeypatch.setattr(sheet, "render_subject", render)
    interrupts = True
    with pytest.raises(KeyboardInterrupt):
        write_sheet(subjects, 2, tmp_path / "sheet.png")
    assert not (tmp_path / "sheet.png").exists()
    interrupts = False
    write_sheet(subjects, 2, tmp_path / "sheet.png")
    assert drawn == ["claw hammer", "s wrench"]
    assert (tmp_path / "sheet.png").exists()
