import argparse
import dataclasses
import json
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest

from kitting_drake.common.paths import SCENARIOS
from kitting_drake.scenario import Scenario
from kitting_drake.scenario.choosing import (
    ChosenScenario,
    choose_scenario,
    output_folder,
    scenario_parser,
)


def parse(*flags: object) -> argparse.Namespace:
    return scenario_parser("run", "").parse_args(list(map(str, flags)))


def write(folder: Path, text: str) -> Path:
    path = folder / "mine.yaml"
    path.write_text(text)
    return path


def test_described_holds_every_field(tmp_path: Path):
    path = write(tmp_path, "A: {time_limit: 2.0}\nB: {task: !ToolsetKitting {split: train}}\n")
    text = "{policy: !Learned {weights: w}, cameras: {top: !LookAt {width: 99}}}"
    chosen = choose_scenario(parse(path, "--scenario_name", "B", "--scenario_text", text))
    assert (chosen.name, chosen.policy, chosen.base) == ("mine:B", "learned", tmp_path)
    described = chosen.described
    assert described["policy"] == {
        "_tag": "!Learned",
        "weights": "w",
        "orientations": 180,
        "continuous": True,
        "fit_outlines": True,
        "recover": False,
        "avoid_failed_picks": True,
        "least_confidence": 0.0,
    }
    task = described["task"]
    assert (task["_tag"], task["split"], task["spacing"]) == ("!ToolsetKitting", "train", 0.008)
    assert task["kit"]["height"] == 0.05
    assert described["cameras"]["top"]["_tag"] == "!LookAt"
    assert described["cameras"]["front"]["_tag"] == "!Pinhole"
    assert described["planner"]["search"]["amplitude"] == 0.12
    # The description has all fields, and JSON preserves it.
    assert described.keys() == {item.name for item in dataclasses.fields(Scenario)}
    assert described["planner"].keys() - {"_tag"} == {
        item.name for item in dataclasses.fields(chosen.scenario.planner)
    }
    assert json.loads(json.dumps(described)) == described


def test_different_scenarios_have_different_descriptions():
    """Commands compare descriptions to detect a folder of another scenario."""
    one, other = (
        ChosenScenario(scenario, Path("a.yaml"), "a", None).described
        for scenario in (Scenario(), Scenario(time_limit=2.0))
    )
    assert one != other
    assert {key for key in one if one[key] != other[key]} == {"time_limit"}


def test_shipped_scenarios_are_found_from_anywhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    for path in ("kitting_oracle.yaml", "scenarios/kitting_oracle.yaml"):
        chosen = choose_scenario(parse(path))
        assert chosen.path == SCENARIOS / "kitting_oracle.yaml"
        assert chosen.name == "kitting_oracle"
    for path in ("paper/kitting_seen.yaml", "scenarios/paper/kitting_seen.yaml"):
        assert choose_scenario(parse(path)).path == SCENARIOS / "paper" / "kitting_seen.yaml"


def test_the_other_scenarios_of_a_file_are_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    path = write(tmp_path, "A: {}\nx-common: {}\nB: {}\nC: {}\n")
    assert choose_scenario(parse(path)).name == "mine"
    assert capsys.readouterr().out == (
        f"note: this is A, the first scenario in {path}; --scenario_name chooses B or C\n"
    )
    choose_scenario(parse(path, "--scenario_name", "B"))
    choose_scenario(parse(path, "--quiet"))
    choose_scenario(parse(write(tmp_path, "A: {}\nx-common: {}\n")))
    assert capsys.readouterr().out == ""


def test_output_folder():
    assert output_folder(parse("a.yaml", "--output", "here"), "a:B") == Path("here")
    assert output_folder(parse("a.yaml"), "a:B") == Path("output/a-B")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("A: {planner: {hom: 1}}", "planner.hom is an unknown field: did you mean 'home'?"),
        ("A: {task: !Kitting {tools: [spoon]}}", "mine.yaml: task.tools: there is no tool 'spoon'"),
    ],
)
def test_invalid_input_prints_one_line(
    tmp_path: Path,
    verb: Callable[..., subprocess.CompletedProcess[str]],
    text: str,
    words: str,
):
    done = verb("run", write(tmp_path, text), "--no-meshcat", "--output", tmp_path / "out")
    assert done.returncode == 2
    assert done.stdout == ""
    assert done.stderr.startswith("error: ")
    assert words in done.stderr
    assert done.stderr.count("\n") == 1
    assert not list(tmp_path.glob("out/*"))
