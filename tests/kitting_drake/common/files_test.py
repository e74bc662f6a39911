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


def test_writes_and_replaces_in_a_new_folder(tmp_path: Path):
    path = tmp_path / "new" / "deep" / "results.json"
    write_json(path, {"a": 1})
    write_atomically(path, "short")
    assert path.read_text() == "short"
    assert [item.name for item in path.parent.iterdir()] == [path.name]


def test_what_was_there_stays_whole_when_writing_fails(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    path = tmp_path / "results.json"
    write_atomically(path, "before")

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "replace", full)
    with pytest.raises(UserError, match=r"cannot write .*results\.json: No space left"):
        write_atomically(path, "after")
    assert path.read_text() == "before"
    assert list(tmp_path.iterdir()) == [path]


def test_a_folder_that_cannot_be_is_told_before_the_run(tmp_path: Path):
    (tmp_path / "file").write_text("")
    with pytest.raises(UserError, match=r"cannot write into .*/file/out: Not a directory"):
        require_folder(tmp_path / "file" / "out")


def test_only_another_process_in_the_folder_is_told_of(tmp_path: Path):
    told = pytest.raises(UserError, match="another process is at work")
    with alone_in(tmp_path), told, alone_in(tmp_path):
        pass
    # What goes wrong inside is not taken for it.
    with pytest.raises(BlockingIOError), alone_in(tmp_path):
        raise BlockingIOError
    with alone_in(tmp_path):
        pass
    (tmp_path / ".lock").unlink()
    (tmp_path / ".lock").mkdir()
    with pytest.raises(MachineError, match=r"cannot write .*\.lock"), alone_in(tmp_path):
        pass


def test_a_line_for_which_there_is_no_room_is_told():
    with pytest.raises(MachineError, match="cannot write /dev/full: No space left"):
        append_line(Path("/dev/full"), {"seed": 1})


def test_a_line_that_was_being_written_is_cut_off(tmp_path: Path):
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


def test_a_folder_is_that_of_one_thing(tmp_path: Path):
    claim_folder(tmp_path, "settings.json", {"steps": 3, "type": "float32"}, of="run")
    claim_folder(tmp_path, "settings.json", {"steps": 3, "type": "float32"}, of="run")
    with pytest.raises(UserError, match=r"another run \(type is bfloat16, there float32\)"):
        claim_folder(tmp_path, "settings.json", {"steps": 3, "type": "bfloat16"}, of="run")
    with pytest.raises(UserError, match=r"another run \(type, steps were in the order steps, type"):
        claim_folder(tmp_path, "settings.json", {"type": "float32", "steps": 3}, of="run")
    # As of a field that there was not yet, or is no more.
    known = {"steps": 3, "type": "float32"}
    with pytest.raises(UserError, match=r"another run \(there is no seed there\)"):
        claim_folder(tmp_path, "settings.json", {**known, "seed": None}, of="run")
    with pytest.raises(UserError, match=r"another run \(there is a type there\)"):
        claim_folder(tmp_path, "settings.json", {"steps": 3}, of="run")
    with pytest.raises(UserError, match=r"holds settings\.json of something else"):
        claim_folder(tmp_path, "scenario.json", {}, of="scenario")
    (tmp_path / "settings.json").write_text('{"steps": ')
    with pytest.raises(UserError, match=r"settings\.json is damaged"):
        claim_folder(tmp_path, "settings.json", {}, of="run")
