import itertools
import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from kitting_drake import results
from kitting_drake.common.errors import UserError
from kitting_drake.common.paths import SCENARIOS
from kitting_drake.evaluation.summary import summarise
from kitting_drake.reproduction.page.harder_scenes import harder_scenes_table
from kitting_drake.reproduction.page.protocol_page import protocol_page
from kitting_drake.reproduction.page.results_page import results_page
from kitting_drake.reproduction.page.robustness import robustness_table, with_figures
from kitting_drake.reproduction.page.run_table import (
    EPISODES,
    TABLE,
    add_run,
    read_summaries,
    remove_runs,
)
from kitting_drake.reproduction.page.runs import Run, read_evaluation, read_runs
from kitting_drake.reproduction.paper.cell_results import cell_results
from kitting_drake.reproduction.paper.efficiency import read_efficiency
from kitting_drake.reproduction.paper.learning_rates import read_rates
from kitting_drake.reproduction.paper.paper_sections import fresh_tools, paper_sections
from kitting_drake.reproduction.paper.protocol_sections import protocol_sections
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
CLEAN = {"commit": "0123456789"}
"""Replaces the commit of the checkout, which may have uncommitted changes."""
SEEN, UNSEEN = PAPER_TASKS
OWN = SCENARIOS.parent / "docs" / "results"
"""The folder of the project's results."""


def write(
    folder: Path,
    name: str,
    scenario: Scenario,
    errors_mm: list[float],
    seeds: range = range(5),
    **fields: Any,
) -> None:
    """Adds a run with the same errors in every episode; `fields` replace fields of its summary."""
    episodes = [make_episode(seed, errors_mm) for seed in seeds]
    chosen = replace(CHOSEN, scenario=scenario)
    summary = summarise(episodes, chosen, ADD_S, wall_seconds_total=1.0)
    add_run(folder, name, summary | CLEAN | fields)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder with two runs: the oracle, quantized to N = 36, and networks."""
    quantized = Scenario(policy=QuantizedOracle(orientations=36))
    write(tmp_path, "quantized", quantized, [1.0, 9.0, 1.0, 1.0])
    objects = [make_object(name, 1.0) for name in ("cup", "bolt", "ring")]
    protruding = make_object("block", 2.0, height_error_mm=3.0)
    episodes = [make_result(seed, [*objects, protruding]).as_dict() for seed in range(100, 110)]
    learned = summarise(episodes, CHOSEN, ADD_S, wall_seconds_total=1.0)
    add_run(tmp_path, "ours", learned | CLEAN | {"policy_details": OURS})
    return tmp_path


def spoil(folder: Path, name: str, **fields: Any) -> None:
    """Replaces fields of a run's summary in a folder."""
    summary = read_summaries(folder)[name] | fields
    remove_runs(folder, [name])
    add_run(folder, name, summary)


def page(folder: Path) -> str:
    return protocol_page(read_runs(folder), "results")


def tables(page: str) -> dict[str, list[list[list[str]]]]:
    """The tables below each heading, as lists of rows of cells, without the lines of dashes."""
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
    """The success rates of a task for each N, by method, preset and number of demonstrations."""
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
    assert rows["*paper*, its own method", "", "100"] == ["", "", "", "- / 96.5"]
    assert UNSEEN not in page(folder)


def test_a_users_policy_has_one_row(folder: Path):
    own = Scenario(policy=PythonPolicy(function="json:loads"))
    write(folder, "own", own, [1.0, 1.0])
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
        # The type of the task is that of a task of the paper, but a setting differs.
        (DENSE, None, "`heightmap.resolution: 0.002`"),
        (Scenario(task=ToolsetKitting(split="train")), None, '`task.split: "train"`'),
        (Scenario(task=ToolsetKitting(split="fresh")), None, '`task.split: "fresh"`'),
        # This is not a task of the paper.
        (Scenario(task=ArrangedKitting()), None, ""),
        (Scenario(task=ArrangedKitting(), time_limit=9.0), None, "`time_limit: 9.0`"),
    ],
)
def test_a_run_is_the_papers_only_if_nothing_but_the_policy_differs(
    scenario: Scenario, task: str | None, departures: str, tmp_path: Path
):
    write(tmp_path, "run", scenario, [1.0, 1.0])
    (run,) = read_runs(tmp_path)
    assert (run.paper_task, run.departures_text) == (task, departures)
    text = page(tmp_path)
    if task is None:
        (others,) = tables(text)["Other runs"]
        assert [row[0] for row in others[1:]] == ["run"]
        assert others[1][3] == departures
        assert not any(title in heading for title in PAPER_TASKS for heading in tables(text))
    else:
        assert "Other runs" not in tables(text)
        assert "-" not in successes(text, task)["oracle, exact", "", ""]


def test_a_field_that_a_run_did_not_have_is_a_difference(tmp_path: Path):
    """A run that lacks a field may have used a value other than the default."""
    write(tmp_path, "run", Scenario(task=ToolsetKitting()), [1.0])
    found = read_summaries(tmp_path)["run"]["resolved_scenario"]
    del found["task"]["random_lengths"]
    spoil(tmp_path, "run", resolved_scenario=found)
    (run,) = read_runs(tmp_path)
    assert (run.paper_task, run.departures) == (None, ["task.random_lengths: not there"])


@pytest.mark.parametrize(
    ("lower_speed", "departures"), [(0.08, []), (0.07, ["planner.lower_speed: 0.07"])]
)
def test_runs_from_before_contact_forces_were_limited_are_of_the_same_task(
    lower_speed: float, departures: list[str], tmp_path: Path
):
    write(tmp_path, "run", Scenario(task=Kitting()), [1.0])
    found = read_summaries(tmp_path)["run"]["resolved_scenario"]
    for name in ("force_limit", "contact_speed", "touch_speed", "slow_margin"):
        del found["planner"][name]
    for name in ("start", "tray", "faces", "kits", "riser", "tilt_deg", "tool_mass"):
        del found["task"][name]
    found["planner"] |= {"lower_speed": lower_speed, "minimum_width": 0.0015}
    spoil(tmp_path, "run", resolved_scenario=found)
    (run,) = read_runs(tmp_path)
    assert run.departures == departures


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
def test_marks_show_differences_from_the_paper(
    folder: Path, continuous: bool, trained: int, marks: str
):
    details = OURS | {"continuous": continuous, "trained_orientations": trained}
    spoil(folder, "ours", policy_details=details)
    assert f"100.0 (91.2 to 100.0), 10{marks} |" in page(folder)


def test_every_run_is_listed(folder: Path):
    assert "[a table of runs](results/runs.csv)" in page(folder)
    (files,) = tables(page(folder))["Runs"]
    assert [row[0] for row in files[1:]] == ["ours", "quantized"]
    assert files[1][3:6] == ["1234", "10", "100 to 109"]


def test_runs_that_differ_only_in_training_have_own_rows(folder: Path):
    add_run(folder, "ours_again", read_summaries(folder)["ours"] | {"strict_success_rate": 0.5})
    cell = successes(page(folder), SEEN)["SO(2)-equivariant (ours)", "small", "100"][-1]
    first, second = cell.split("<br>")
    assert (first.split()[0], second.split()[0]) == ("75.0", "50.0")


def test_tables_are_aligned(folder: Path):
    for first, second in itertools.pairwise(page(folder).splitlines()):
        if first.startswith("|") and second.startswith("|"):
            assert len(first) == len(second)


def test_without_runs_there_is_a_page(tmp_path: Path):
    text = protocol_page([], "results")
    assert tables(text).keys() == {"Which seeds were inspected"}
    assert text.endswith("There are none yet.\n")
    with pytest.raises(UserError, match=r"there is no .*runs\.csv: add a run to it"):
        read_runs(tmp_path)


def test_errors_name_the_invalid_run(folder: Path, tmp_path: Path):
    for details, words in (
        ("so2", "'policy_details' is empty or of the wrong type \\('so2'\\): it must be"),
        ({"method": "so2", "orientations": 36}, "policy_details.demonstrations must be a whole"),
    ):
        spoil(folder, "ours", policy_details=details)
        with pytest.raises(UserError, match=rf"runs\.csv, run 'ours': {words}"):
            read_runs(folder)
    good = read_summaries(folder)["quantized"]
    path = tmp_path / "summary.json"
    for field, value in (
        ("resolved_scenario", None),
        ("resolved_scenario", {"task": {}}),
        ("seeds", 3),
        ("seeds", []),
        ("ci95", None),
        ("success_rate", "all"),
        ("causes", None),
        ("categories", []),
    ):
        path.write_text(json.dumps(good | {field: value}))
        with pytest.raises(UserError, match=rf"summary\.json.*({field}|seeds|must be a summary)"):
            read_evaluation(path)
    path.write_text("{}")
    with pytest.raises(UserError, match=r"lacks 'task': it must be a summary\.json of evaluate"):
        read_evaluation(tmp_path)
    for content in ("{", None):
        path.write_text(content) if content else path.unlink()
        with pytest.raises(UserError, match=r"summary\.json cannot be read"):
            read_evaluation(path)


def command(monkeypatch: pytest.MonkeyPatch, folder: Path, *words: str) -> str:
    """Runs `results`; returns the text of the protocol that it writes."""
    output = folder / "docs" / "results.md"
    arguments = ["results", "--results", str(folder), "--output", str(output), *words]
    monkeypatch.setattr(sys, "argv", arguments)
    assert results.main() == 0
    assert output.read_text().startswith("# Results\n")
    return output.with_name("protocol.md").read_text()


def test_the_command(folder: Path, monkeypatch: pytest.MonkeyPatch, capsys):
    assert command(monkeypatch, folder) == protocol_page(read_runs(folder), "..")
    assert capsys.readouterr().out.startswith("2 runs: ")


def test_a_run_is_added_and_removed(folder: Path, monkeypatch: pytest.MonkeyPatch):
    before = {path: path.read_bytes() for path in (folder / TABLE, folder / EPISODES)}
    summary = read_summaries(folder)["ours"]
    evaluated = folder / "evaluated"
    evaluated.mkdir()
    (evaluated / "summary.json").write_text(json.dumps(summary))
    text = command(monkeypatch, folder, "--add", "mine", str(evaluated), "--quiet")
    (files,) = tables(text)["Runs"]
    assert [row[0] for row in files[1:]] == ["mine", "ours", "quantized"]
    assert read_summaries(folder)["mine"] == summary
    # Adding the run again changes nothing. Another run of the same name is refused.
    command(monkeypatch, folder, "--add", "mine", str(evaluated), "--quiet")
    (evaluated / "summary.json").write_text(json.dumps(summary | {"outcomes": []}))
    with pytest.raises(UserError, match="already has a run 'mine': give another name"):
        command(monkeypatch, folder, "--add", "mine", str(evaluated))
    with pytest.raises(UserError, match=r"'unseen_so2_180_100' does not fit the cell"):
        command(monkeypatch, folder, "--add", "unseen_so2_180_100", str(evaluated))
    command(monkeypatch, folder, "--remove", "mine", "--quiet")
    assert {path: path.read_bytes() for path in before} == before
    with pytest.raises(UserError, match="has no run 'mine' to remove"):
        command(monkeypatch, folder, "--remove", "mine")


def test_a_run_that_cannot_be_repeated_is_in_no_table(
    folder: Path, monkeypatch: pytest.MonkeyPatch
):
    spoil(folder, "ours", commit="0123456789abcdef, 9876543210fedcba+")
    text = command(monkeypatch, folder, "--quiet")
    assert ("SO(2)-equivariant (ours)", "small", "100") not in successes(text, SEEN)
    assert [row[0] for row in tables(text)["Runs"][0][1:]] == ["quantized"]
    ((_, row),) = tables(text)["Not reproducible"]
    assert (row[0], row[-1]) == ("ours", "0123456789abcdef<br>9876543210fedcba+")


def test_a_run_that_cannot_be_repeated_fills_no_cell(folder: Path, monkeypatch: pytest.MonkeyPatch):
    name = "unseen_so2_180_100"
    good = read_summaries(OWN)[name]
    evaluated = folder / "evaluated"
    evaluated.mkdir()
    for fields, said in (
        ({"commit": "f00d+"}, r"from commit f00d\+, with uncommitted changes; commit the changes"),
        ({"commit": None}, "its episodes are from an unknown commit"),
        ({"policy_digest": None}, "lacks policy_digest, the digest of its weights"),
    ):
        (evaluated / "summary.json").write_text(json.dumps(good | fields))
        with pytest.raises(UserError, match=said):
            command(monkeypatch, folder, "--add", name, str(evaluated))
        assert name not in read_summaries(folder)
    (evaluated / "summary.json").write_text(json.dumps(good))
    command(monkeypatch, folder, "--add", name, str(evaluated), "--quiet")
    assert read_summaries(folder)[name]["policy_digest"] == good["policy_digest"]


@pytest.fixture(scope="module")
def own_runs() -> list[Run]:
    return read_runs(OWN)


def test_own_runs_are_consistent(own_runs: list[Run]):
    """Runs whose scenarios have fields that were renamed later are assigned to their cells, too."""
    for run in own_runs:
        rates = [item["success_rate"] for item in run.summary.get("outcomes", ())]
        assert not rates or np.mean(rates) == pytest.approx(run.summary["success_rate"])
    cells, others, set_aside = cell_results(own_runs, read_rates(OWN))
    assert len(cells) > 50
    assert all("+" in run.summary["commit"] for run in set_aside)
    assert len([run for run in others if run.paper_task]) == 9
    known = [run for run in others if run.name.startswith("robust_friction")]
    assert {item for run in known for item in run.departures} == {
        "task.tries: 2",
        *(f"variation.friction: {value}" for value in (0.15, 0.3, 0.5)),
    }


@pytest.mark.slow
def test_own_pages_are_up_to_date(own_runs: list[Run]):
    rates = read_rates(OWN)
    divided = cell_results(own_runs, rates)
    cells, others, set_aside = divided
    again = divided.to_run_again
    sections = paper_sections(cells, read_efficiency(OWN), again)
    page = results_page(others, "results", fresh_tools(cells, again), sections)
    assert page == (OWN.parent / "results.md").read_text()
    assert len(page.encode()) < 20_000
    protocol = protocol_page(others, "results", protocol_sections(cells, rates, again), set_aside)
    assert protocol == (OWN.parent / "protocol.md").read_text()
    robustness = (OWN.parent / "robustness.md").read_text()
    assert with_figures(robustness, robustness_table(others)) == robustness
    harder = harder_scenes_table(others)
    assert with_figures(robustness, harder, "harder scenes") == robustness
