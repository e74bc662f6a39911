"""The table of runs: it gives back what it was given, and tells what is damaged."""

from pathlib import Path
from typing import Any

import pytest

from kitting_drake.common.errors import UserError
from kitting_drake.reproduction.page.run_table import (
    EPISODES,
    TABLE,
    add_run,
    read_summaries,
    remove_runs,
)

FIRST: dict[str, Any] = {
    "policy": "mine",
    "details": {"steps": 3, "rate": 0.1 + 0.2, "weights": None, "of": {"n": 1.0}, "none": {}},
    "seeds": [3, 4, 5],
    "ci95": [0.25, 1.0],
    "causes": {"missed grasp": 0, "never picked": 2},
    "outcomes": [{"seed": 3, "objects": {"hammer": 2}}],
    "resolved_scenario": {"task": {"_tag": "!Kitting"}},
}
SECOND: dict[str, Any] = {
    # Text that is a number, JSON or nothing, and keys that look like columns.
    "policy": 'a, "b"\nc',
    "details": {"steps": "3", "rate": "null", "weights": "", "of": {"a.b": 1}, "commit": "1e5"},
    "seeds": [9, 7],
    "ci95": "3-5",
    "causes": {"missed grasp": 0, "toppled": 1, "never picked": 0},
    "moving": True,
}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    add_run(tmp_path, "second", SECOND)
    add_run(tmp_path, "first", FIRST)
    return tmp_path


def test_runs_are_given_back_as_they_were(folder: Path):
    found = read_summaries(folder)
    assert found == {"first": FIRST, "second": SECOND}
    assert list(found) == ["first", "second"]
    assert [type(found["first"]["details"]["of"]["n"]), found["second"]["details"]["steps"]] == [
        float,
        "3",
    ]
    assert [list(run["causes"]) for run in found.values()] == [
        list(run["causes"]) for run in (FIRST, SECOND)
    ]


def test_a_row_a_run_and_columns_in_the_order_of_the_fields(folder: Path):
    heading, first, *_ = (folder / TABLE).read_text().splitlines()
    assert heading == (
        "run,policy,details.steps,details.rate,details.weights,details.of,details.commit,"
        "details.of.n,details.none,seeds,ci95,causes.missed grasp,causes.toppled,"
        "causes.never picked,moving"
    )
    assert first.startswith("first,mine,3,0.30000000000000004,null,")
    assert first.endswith(',3-5,"[0.25, 1.0]",0,,2,')


def test_the_same_runs_make_the_same_files_in_any_order(folder: Path):
    before = [(folder / name).read_bytes() for name in (TABLE, EPISODES)]
    remove_runs(folder, ["second"])
    add_run(folder, "second", SECOND)
    assert [(folder / name).read_bytes() for name in (TABLE, EPISODES)] == before


@pytest.mark.parametrize("name", [TABLE, EPISODES])
def test_a_file_that_was_cut_off_is_told(folder: Path, name: str):
    content = (folder / name).read_bytes()
    for end in (len(content) - 1, len(content) // 2, 10):
        (folder / name).write_bytes(content[:end])
        with pytest.raises(UserError, match=rf"{name} is damaged \(.*\): restore it"):
            read_summaries(folder)
    (folder / name).unlink()
    with pytest.raises(UserError, match=rf"{name} lacks the run 'first' that"):
        read_summaries(folder)


def test_a_table_that_was_spoiled_is_told(folder: Path):
    content = (folder / TABLE).read_text()
    lines = content.splitlines(keepends=True)
    for spoiled in (
        content.replace("run,policy", "name,policy"),
        content + lines[1],
        content.replace("first,mine", "first,mine,more"),
        content.replace("first,mine,", "first,"),
        content.replace("details.none", "policy.none"),
    ):
        (folder / TABLE).write_text(spoiled)
        with pytest.raises(UserError, match=r"runs\.csv is damaged"):
            read_summaries(folder)
    (folder / TABLE).write_text("".join(line for line in lines if not line.startswith("first")))
    with pytest.raises(UserError, match=r"runs\.csv lacks the run 'first' that episodes"):
        read_summaries(folder)
    # As after a write that was ended between the two files.
    add_run(folder, "first", FIRST)
    assert (folder / TABLE).read_text() == content
