import os
from pathlib import Path

import pytest

from kitting_drake.common.errors import MachineError, UserError
from kitting_drake.common.files import (
    alone_in,
    append_line,
    claim_folder,
    read_lines,
    require_folder,
    write_atomically,
    write_json,
)


def test_write_atomically_creates_the_folder_and_replaces(tmp_path: Path):
    path = tmp_path / "new" / "deep" / "results.json"
    write_json(path, {"a": 1})
    write_atomically(path, "short")
    assert path.read_text() == "short"
    assert [item.name for item in path.parent.iterdir()] == [path.name]


def test_a_file_is_unchanged_if_writing_fails(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    path = tmp_path / "results.json"
    write_atomically(path, "before")

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "replace", full)
    with pytest.raises(UserError, match=r"results\.json: No space left"):
        write_atomically(path, "after")
    assert path.read_text() == "before"
    assert list(tmp_path.iterdir()) == [path]


def test_require_folder_raises_for_an_impossible_folder(tmp_path: Path):
    (tmp_path / "file").write_text("")
    with pytest.raises(UserError, match="/file/out: Not a directory"):
        require_folder(tmp_path / "file" / "out")


def test_alone_in_raises_if_another_process_has_the_lock(tmp_path: Path):
    told = pytest.raises(UserError, match="another process")
    with alone_in(tmp_path), told, alone_in(tmp_path):
        pass
    # A BlockingIOError in the `with` block does not mean that the folder is locked.
    with pytest.raises(BlockingIOError), alone_in(tmp_path):
        raise BlockingIOError
    with alone_in(tmp_path):
        pass
    (tmp_path / ".lock").unlink()
    (tmp_path / ".lock").mkdir()
    with pytest.raises(MachineError, match=r"\.lock"), alone_in(tmp_path):
        pass


def test_append_line_raises_if_the_disk_is_full():
    with pytest.raises(MachineError, match="/dev/full: No space left"):
        append_line(Path("/dev/full"), {"seed": 1})


def test_read_lines_removes_a_partial_last_line(tmp_path: Path):
    path = tmp_path / "lines.jsonl"
    assert read_lines(path) == []
    append_line(path, {"seed": 1})
    with path.open("a") as file:
        file.write('{"seed": 2, "s')
    assert read_lines(path) == [{"seed": 1}]
    append_line(path, {"seed": 3})
    assert read_lines(path) == [{"seed": 1}, {"seed": 3}]
    path.write_text('{"seed": 1\n{"seed": 3}\n')
    with pytest.raises(UserError, match="is damaged"):
        read_lines(path)


def test_claim_folder_raises_for_another_runs_folder(tmp_path: Path):
    claim_folder(tmp_path, "settings.json", {"steps": 3, "type": "float32"}, of="run")
    claim_folder(tmp_path, "settings.json", {"steps": 3, "type": "float32"}, of="run")
    with pytest.raises(UserError, match=r"another run .*type is bfloat16, but float32"):
        claim_folder(tmp_path, "settings.json", {"steps": 3, "type": "bfloat16"}, of="run")
    with pytest.raises(UserError, match=r"another run .*type, steps .* order steps, type"):
        claim_folder(tmp_path, "settings.json", {"type": "float32", "steps": 3}, of="run")
    # The settings have an additional field or lack one.
    known = {"steps": 3, "type": "float32"}
    with pytest.raises(UserError, match=r"another run .*no seed"):
        claim_folder(tmp_path, "settings.json", {**known, "seed": None}, of="run")
    with pytest.raises(UserError, match=r"another run .*a type"):
        claim_folder(tmp_path, "settings.json", {"steps": 3}, of="run")
    with pytest.raises(UserError, match=r"other files.*settings\.json"):
        claim_folder(tmp_path, "scenario.json", {}, of="scenario")
    (tmp_path / "settings.json").write_text('{"steps": ')
    with pytest.raises(UserError, match=r"settings\.json"):
        claim_folder(tmp_path, "settings.json", {}, of="run")
