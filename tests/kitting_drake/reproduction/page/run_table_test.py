"""The table of runs restores its runs and detects damage."""

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
    # Some texts look like numbers or JSON, or are empty. Some keys look like columns of the table.
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


def test_runs_are_restored_exactly(folder: Path):
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


def test_there_is_a_row_for_each_run_and_columns_follow_the_fields(folder: Path):
    heading, first, *_ = (folder / TABLE).read_text().splitlines()
    assert heading == (
        "run,policy,details.steps,details.rate,details.weights,details.of,details.commit,"
        "details.of.n,details.none,seeds,ci95,causes.missed grasp,causes.toppled,"
        "causes.never picked,moving"
    )
    assert first.startswith("first,mine,3,0.30000000000000004,null,")
    assert first.endswith(',3-5,"[0.25, 1.0]",0,,2,')


def test_the_files_do_not_depend_on_the_order_of_adding(folder: Path):
    before = [(folder / name).read_bytes() for name in (TABLE, EPISODES)]
    remove_runs(folder, ["second"])
    add_run(folder, "second", SECOND)
    assert [(folder / name).read_bytes() for name in (TABLE, EPISODES)] == before


@pytest.mark.parametrize("name", [TABLE, EPISODES])
def test_a_truncated_file_is_an_error(folder: Path, name: str):
    content = (folder / name).read_bytes()
    for end in (len(content) - 1, len(content) // 2, 10):
        (folder / name).write_bytes(content[:end])
        with pytest.raises(UserError, match=f"{name} is damaged"):
            read_summaries(folder)
    (folder / name).unlink()
    with pytest.raises(UserError, match=f"{name} lacks the run 'first'"):
        read_summaries(folder)


def test_a_corrupt_table_is_an_error(folder: Path):
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
    with pytest.raises(UserError, match=r"runs\.csv lacks the run 'first'"):
        read_summaries(folder)
    # An interrupted `add_run` can leave this state; repeating it writes the missing line.
    add_run(folder, "first", FIRST)
    assert (folder / TABLE).read_text() == content
