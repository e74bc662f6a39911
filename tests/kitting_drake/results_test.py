import itertools
import json
import math
import subprocess
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from kitting_drake.common.errors import UserError
from kitting_drake.evaluation.summary import summarise
from kitting_drake.reproduction.page.results_page import results_page
from kitting_drake.reproduction.page.runs import read_runs
from kitting_drake.scenario.policies import PythonPolicy, QuantizedOracle
from kitting_drake.scenario.schema import Heightmap, Scenario
from kitting_drake.tasks import PAPER_TASKS, ArrangedKitting, Kitting, ToolsetKitting
from tests.kitting_drake.evaluation.episodes import (
    ADD_S,
    CHOSEN,
    make_episode,
    make_object,
    make_result,
)

OURS = {
    "method": "so2",
    "preset": "small",
    "orientations": 180,
    "demonstrations": 100,
    "steps": 1234,
}
SEEN, UNSEEN = PAPER_TASKS


def write(
    path: Path,
    scenario: Scenario,
    errors_mm: list[float],
    seeds: range = range(5),
    **fields: Any,
) -> None:
    """A summary of episodes that are all alike, some of its fields replaced."""
    episodes = [make_episode(seed, errors_mm) for seed in seeds]
    chosen = replace(CHOSEN, scenario=scenario)
    summary = summarise(episodes, chosen, ADD_S, wall_seconds_total=1.0) | fields
    path.write_text(json.dumps(summary))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Two summaries: of the oracle quantized to N = 36, and of a network."""
    quantized = Scenario(policy=QuantizedOracle(orientations=36))
    write(tmp_path / "quantized.json", quantized, [1.0, 9.0, 1.0, 1.0])
    objects = [make_object(name, 1.0) for name in ("cup", "bolt", "ring")]
    protruding = make_object("block", 2.0, height_error_mm=3.0)
    episodes = [make_result(seed, [*objects, protruding]).as_dict() for seed in range(100, 110)]
    learned = summarise(episodes, CHOSEN, ADD_S, wall_seconds_total=1.0)
    (tmp_path / "ours.json").write_text(json.dumps(learned | {"policy_details": OURS}))
    return tmp_path


def spoil(path: Path, **fields: Any) -> None:
    path.write_text(json.dumps(json.loads(path.read_text()) | fields))


def page(folder: Path) -> str:
    return results_page(read_runs(folder), "results")


def tables(page: str) -> dict[str, list[list[list[str]]]]:
    """The cells of every table, without its rule, by the heading that it is under."""
    found: dict[str, list[list[list[str]]]] = {}
    heading, before = "", ""
    for line in page.splitlines():
        if line.startswith("#"):
            heading = line.strip("# ")
        if line.startswith("|"):
            if not before.startswith("|"):
                found.setdefault(heading, []).append([])
            if not line.startswith("| --"):
                found[heading][-1].append([cell.strip() for cell in line.strip("|").split("|")])
        before = line
    return found


def successes(page: str, task: str) -> dict[tuple[str, ...], list[str]]:
    """A task's rates by method, preset and demonstrations."""
    (heading,) = (name for name in tables(page) if name.endswith(f"(`{task}`)"))
    (table,) = tables(page)[heading]
    assert table[0][3:] == [f"N = {n}" for n in (36, 72, 120, 180)]
    return {tuple(row[:3]): row[3:] for row in table[1:]}


def test_success_by_method_and_orientations_strict_first(folder: Path):
    rows = successes(page(folder), SEEN)
    assert rows["SO(2)-equivariant (ours)", "small", "100"] == [
        *"---",
        "75.0 (59.8 to 85.8) / 100.0 (91.2 to 100.0), 10",
    ]
    assert rows["oracle, quantized", "", ""] == [
        "75.0 (53.1 to 88.8) / 75.0 (53.1 to 88.8), 5",
        *"---",
    ]
    assert ("oracle, exact", "", "") not in rows
    assert rows["*paper*, ours", "", "100"] == ["", "", "", "- / 96.5"]
    assert UNSEEN not in page(folder)


def test_a_policy_of_ones_own_has_one_figure_for_all(folder: Path):
    own = Scenario(policy=PythonPolicy(function="json:loads"))
    write(folder / "own.json", own, [1.0, 1.0])
    own_row = successes(page(folder), SEEN)["python_policy", "", ""]
    assert own_row == ["100.0 (72.2 to 100.0) / 100.0 (72.2 to 100.0), 5"] * 4


EASY = Scenario(task=Kitting(success_threshold=0.01))
DENSE = Scenario(task=ToolsetKitting(split="test"), heightmap=Heightmap(resolution=0.002))


@pytest.mark.parametrize(
    ("scenario", "task", "departures"),
    [
        (Scenario(random_seed=7, target_realtime_rate=1.0), SEEN, ""),
        (Scenario(task=ToolsetKitting(split="test")), UNSEEN, ""),
        (EASY, None, "`task.success_threshold: 0.01`"),
        # Its task has the paper's title: not that alone makes it the paper's.
        (DENSE, None, "`heightmap.resolution: 0.002`"),
        (Scenario(task=ToolsetKitting(split="train")), None, '`task.split: "train"`'),
        (Scenario(task=ToolsetKitting(split="fresh")), None, '`task.split: "fresh"`'),
        (Scenario(task=ArrangedKitting()), None, ""),
        (Scenario(task=ArrangedKitting(), time_limit=9.0), None, "`time_limit: 9.0`"),
    ],
)
def test_a_run_is_the_papers_only_if_nothing_but_the_policy_differs(
    scenario: Scenario, task: str | None, departures: str, tmp_path: Path
):
    write(tmp_path / "run.json", scenario, [1.0, 1.0])
    (run,) = read_runs(tmp_path)
    assert (run.paper_task, run.departures_text) == (task, departures)
    text = page(tmp_path)
    if task is None:
        (others,) = tables(text)["Other runs"]
        assert [row[0] for row in others[1:]] == ["run.json"]
        assert others[1][3] == departures
        assert not any(title in heading for title in PAPER_TASKS for heading in tables(text))
    else:
        assert "Other runs" not in tables(text)
        assert "-" not in successes(text, task)["oracle, exact", "", ""]


def test_a_field_that_a_run_did_not_have_is_a_difference(tmp_path: Path):
    """A task that has since become harder is not the same task."""
    write(tmp_path / "run.json", Scenario(task=ToolsetKitting()), [1.0])
    found = json.loads((tmp_path / "run.json").read_text())["resolved_scenario"]
    del found["task"]["random_lengths"]
    spoil(tmp_path / "run.json", resolved_scenario=found)
    (run,) = read_runs(tmp_path)
    assert (run.paper_task, run.departures) == (None, ["task.random_lengths: not there"])


def test_the_most_tested_network_and_all_causes(folder: Path):
    found = tables(page(folder))
    placed, acted = found[
        "By category: SO(2)-equivariant (ours), N = 180, 100 demonstrations, preset small"
    ]
    assert [row[0] for row in placed[1:]] == ["block", "bolt", "cup", "ring", "all"]
    assert placed[1][1:4] == ["0.0 (0.0 to 27.8)", "100.0 (72.2 to 100.0)", "2.00, 2.00"]
    assert acted[1][1:] == ["1.00, 1.00", "2.00, 2.00", "4.00, 4.00", "6.00, 6.00"]
    (causes,) = found["Causes of failure"]
    columns = [0, 1, 2, causes[0].index("misplaced"), causes[0].index("success, but protruding")]
    assert [[row[column] for column in columns] for row in causes[1:]] == [
        [
            "SO(2)-equivariant (ours), N = 180, 100 demonstrations, preset small",
            *("100 to 109", "40", "0", "10"),
        ],
        ["oracle, quantized, N = 36", "0 to 4", "20", "5", "0"],
    ]


@pytest.mark.parametrize(
    ("continuous", "trained", "marks"), [(True, 180, " \\*"), (False, 36, " †")]
)
def test_marks_tell_how_a_run_departs(folder: Path, continuous: bool, trained: int, marks: str):
    details = OURS | {"continuous": continuous, "trained_orientations": trained}
    spoil(folder / "ours.json", policy_details=details)
    assert f"100.0 (91.2 to 100.0), 10{marks} |" in page(folder)


def test_every_file_is_listed(folder: Path):
    (files,) = tables(page(folder))["Files"]
    assert [row[0] for row in files[1:]] == [
        "[ours.json](results/ours.json)",
        "[quantized.json](results/quantized.json)",
    ]
    assert files[1][3:6] == ["1234", "10", "100 to 109"]


def test_runs_that_differ_only_in_training_are_all_told(folder: Path):
    (folder / "ours_again.json").write_text((folder / "ours.json").read_text())
    spoil(folder / "ours_again.json", strict_success_rate=0.5)
    cell = successes(page(folder), SEEN)["SO(2)-equivariant (ours)", "small", "100"][-1]
    first, second = cell.split("<br>")
    assert (first.split()[0], second.split()[0]) == ("75.0", "50.0")


def test_tables_are_aligned(folder: Path):
    for first, second in itertools.pairwise(page(folder).splitlines()):
        if first.startswith("|") and second.startswith("|"):
            assert len(first) == len(second)


def test_without_files_there_is_a_page(tmp_path: Path):
    text = page(tmp_path)
    assert tables(text) == {}
    assert text.endswith("There are none yet.\n")
    with pytest.raises(UserError, match=r"there is no folder .*none"):
        read_runs(tmp_path / "none")


def test_files_that_cannot_be_used_are_named(folder: Path):
    ours = folder / "ours.json"
    for details, words in (
        ("so2", "'policy_details' is 'so2': it must be"),
        ({"method": "so2", "orientations": 36}, "policy_details.demonstrations must be a whole"),
    ):
        spoil(ours, policy_details=details)
        with pytest.raises(UserError, match=rf"ours\.json: {words}"):
            read_runs(folder)
    spoil(ours, policy_details={"method": "oracle"})
    for field, value in (
        ("resolved_scenario", None),
        ("resolved_scenario", {"task": {}}),
        ("seeds", 3),
        ("seeds", ["a"]),
        ("ci95", None),
        ("success_rate", math.nan),
        ("success_rate", "all"),
        ("causes", None),
        ("categories", []),
    ):
        before = ours.read_text()
        spoil(ours, **{field: value})
        with pytest.raises(UserError, match=rf"ours\.json.*({field}|seeds|must be a summary)"):
            read_runs(folder)
        ours.write_text(before)
    ours.write_text("{}")
    with pytest.raises(UserError, match=r"ours\.json lacks 'task': it must be a summary\.json"):
        read_runs(folder)
    ours.write_text("{")
    with pytest.raises(UserError, match=r"ours\.json cannot be read"):
        read_runs(folder)


def test_the_command(folder: Path, verb: Callable[..., subprocess.CompletedProcess[str]]):
    done = verb("results", "--results", folder, "--output", folder / "docs" / "results.md")
    assert done.returncode == 0, done.stderr
    assert "2 summaries" in done.stdout
    written = (folder / "docs" / "results.md").read_text()
    assert written == results_page(read_runs(folder), "..")
    done = verb("results", "--results", folder / "none")
    assert done.returncode == 2
    assert done.stderr.startswith("error: there is no folder")
