import itertools
import json
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from kitting_drake.common.errors import UserError
from kitting_drake.reporting.summary import summarise
from kitting_drake.results import read_summaries, results_page
from kitting_drake.scenario.command_line import ChosenScenario
from kitting_drake.scenario.schema import QuantisedOracle, Scenario

OURS = {
    "method": "so2",
    "preset": "small",
    "orientations": 180,
    "demonstrations": 100,
    "steps": 1234,
}
Make = Callable[..., dict[str, Any]]


@pytest.fixture
def folder(made_up_episode: Make, tmp_path: Path) -> Path:
    """Two summaries: of the oracle rounded to N = 36, and of a network."""
    scenario = Scenario(policy=QuantisedOracle(orientations=36))
    chosen = ChosenScenario(scenario, Path("mine.yaml"), "mine", None)
    episodes = [made_up_episode(seed, [1.0, 9.0, 1.0, 1.0]) for seed in range(5)]
    rounded = summarise(episodes, chosen, wall_seconds_total=1.0)
    episodes = [made_up_episode(seed, [1.0, 1.0, 2.0, 1.0]) for seed in range(100, 110)]
    learned = summarise(episodes, chosen, wall_seconds_total=1.0) | {"policy_details": OURS}
    (tmp_path / "rounded.json").write_text(json.dumps(rounded))
    (tmp_path / "ours.json").write_text(json.dumps(learned))
    return tmp_path


def page(folder: Path) -> str:
    return results_page(read_summaries(folder), "results")


def tables(page: str) -> list[list[list[str]]]:
    """The cells of every table, without its rule."""
    found: list[list[list[str]]] = []
    before = ""
    for line in page.splitlines():
        if line.startswith("|"):
            if not before.startswith("|"):
                found.append([])
            if not line.startswith("| --"):
                found[-1].append([cell.strip() for cell in line.strip("|").split("|")])
        before = line
    return found


def test_success_by_method_and_orientations(folder: Path):
    seen, *_ = tables(page(folder))
    assert seen[0] == [
        "method",
        "preset",
        "demonstrations",
        *(f"N = {n}" for n in (36, 72, 120, 180)),
    ]
    rows = {tuple(row[:3]): row[3:] for row in seen[1:]}
    assert rows["SO(2)-equivariant (ours)", "small", "100"] == [*"---", "100.0 (91.2 to 100.0), 10"]
    assert rows["SO(2)-equivariant (ours)", "small", "10"] == [*"----"]
    assert rows["Equivariant Transporter", "", "100"] == [*"----"]
    assert rows["oracle, rounded", "", ""] == ["75.0 (53.1 to 88.8), 5", *"---"]
    assert rows["oracle, exact", "", ""] == [*"----"]
    assert rows["*paper*, ours", "", "100"] == ["", "", "", "96.5"]
    unseen = tables(page(folder))[4]
    assert ["*paper*, ours", "", "100", "", "", "", "87.25"] in unseen


def test_the_most_tested_network_and_all_causes(folder: Path):
    text = page(folder)
    assert (
        "### By category: SO(2)-equivariant (ours), N = 180, 100 demonstrations, preset small"
        in text
    )
    _, placed, answered, causes, *_ = tables(text)
    assert [row[0] for row in placed[1:]] == ["hammer", "pliers", "wrench", "screwdriver", "all"]
    assert placed[3][2] == "2.00, 2.00"
    assert answered[3][1:] == ["1.00, 1.00", "2.00, 2.00", "4.00, 4.00", "6.00, 6.00"]
    jammed = causes[0].index("jammed")
    proud = causes[0].index("kitted, but proud")
    assert [(*row[:3], row[jammed], row[proud]) for row in causes[1:]] == [
        (
            "SO(2)-equivariant (ours), N = 180, 100 demonstrations, preset small",
            "100 to 109",
            "40",
            "0",
            "0",
        ),
        ("oracle, rounded, N = 36", "0 to 4", "20", "5", "0"),
    ]


def test_what_an_older_summary_did_not_count_is_not_zero(folder: Path):
    summary = json.loads((folder / "rounded.json").read_text())
    del summary["doubts"]
    (folder / "rounded.json").write_text(json.dumps(summary))
    *_, last = tables(page(folder))[3]
    assert last[-2:] == ["?", "?"]


@pytest.mark.parametrize("method", ["so2", "transporter"])
@pytest.mark.parametrize(
    ("continuous", "trained", "marks"), [(True, 180, " \\*"), (False, 36, " †")]
)
def test_marks_tell_how_a_run_departs(
    folder: Path, method: str, continuous: bool, trained: int, marks: str
):
    summary = json.loads((folder / "ours.json").read_text())
    summary["policy_details"] |= {
        "method": method,
        "continuous": continuous,
        "trained_orientations": trained,
    }
    (folder / "ours.json").write_text(json.dumps(summary))
    assert f"100.0 (91.2 to 100.0), 10{marks} |" in page(folder)


def test_every_file_is_listed(folder: Path):
    files = tables(page(folder))[-1]
    assert [row[0] for row in files[1:]] == [
        "[ours.json](results/ours.json)",
        "[rounded.json](results/rounded.json)",
    ]
    assert files[1][3:6] == ["1234", "10", "100 to 109"]


def test_runs_that_differ_only_in_training_are_all_told(folder: Path):
    summary = json.loads((folder / "ours.json").read_text())
    summary["success_rate"] = 0.5
    (folder / "ours_again.json").write_text(json.dumps(summary))
    text = page(folder)
    assert "100.0 (91.2 to 100.0), 10<br>50.0 (91.2 to 100.0), 10" in text


def test_tables_are_aligned(folder: Path):
    lines = page(folder).splitlines()
    for first, second in itertools.pairwise(lines):
        if first.startswith("|") and second.startswith("|"):
            assert len(first) == len(second)


def spoil(path: Path, **fields: Any) -> None:
    path.write_text(json.dumps(json.loads(path.read_text()) | fields))


def test_files_that_cannot_be_used_are_named(folder: Path):
    ours = folder / "ours.json"
    for details, words in (
        ({"method": "magic"}, "policy_details.method must be one of so2, .* not 'magic'"),
        ("so2", "policy_details.method must be one of"),
        ({"method": "so2", "orientations": 36}, "policy_details.demonstrations must be a whole"),
    ):
        spoil(ours, policy_details=details)
        with pytest.raises(UserError, match=rf"ours\.json: {words}"):
            read_summaries(folder)
    ours.write_text("{}")
    with pytest.raises(UserError, match=r"ours\.json lacks 'task': it must be a summary\.json"):
        read_summaries(folder)
    ours.write_text("{")
    with pytest.raises(UserError, match=r"ours\.json cannot be read"):
        read_summaries(folder)
    with pytest.raises(UserError, match=r"no \.json files in .*none"):
        read_summaries(folder / "none")


def test_the_verb(folder: Path, verb: Callable[..., subprocess.CompletedProcess[str]]):
    done = verb("results", "--results", folder, "--output", folder / "docs" / "results.md")
    assert done.returncode == 0, done.stderr
    assert "2 summaries" in done.stdout
    written = (folder / "docs" / "results.md").read_text()
    assert written == results_page(read_summaries(folder), "..")
    done = verb("results", "--results", folder / "none")
    assert done.returncode == 2
    assert done.stderr.startswith("error: there are no .json files")
