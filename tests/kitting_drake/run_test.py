import base64
import json
import os
import re
import shutil
import signal
import subprocess
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest
import torch
import yaml
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource
from safetensors.torch import save_file

from kitting_drake import run as running
from kitting_drake.common.errors import UserError
from kitting_drake.common.paths import SCENARIOS
from kitting_drake.episode import EpisodeObserver, ModeChange
from kitting_drake.scenario import load_scenario
from kitting_drake.scenario.policies import Learned
from systems.pick_place_parameters import Mode

ROOT = Path(__file__).resolve().parents[2]
Verb = Callable[..., subprocess.CompletedProcess[str]]

# Other programs read these keys.
KEYS = {
    "scenario",
    "policy",
    "seed",
    "objects",
    "success_rate",
    "strict_success_rate",
    "actions",
    "actions_taken",
    "missed_grasps",
    "dropped_objects",
    "stopped_actions",
    "left_over",
    "stop_reason_right",
    "sim_seconds",
    "wall_seconds",
    "point_contact_pairs",
    "failure",
    "timed_out",
    "stop_reason",
}
OBJECT_KEYS = {
    "name",
    "category",
    "add_s_mm",
    "success",
    "strict_success",
    "position_error_mm",
    "angle_error_deg",
    "height_error_mm",
    "cause",
}


ONE_OF_EACH_KIND = {"kits:OneTool", "ravens:AlignBoxCorner", "kitting_unseen:ShapeMatching"}
"""The scenarios that are run by default; the others are slow tests, but `schema_test` loads all."""


def shipped() -> list[Any]:
    """The path and name of every scenario of every file under scenarios/, as test parameters."""
    return [
        pytest.param(
            path,
            key.value,
            id=f"{path.stem}:{key.value}",
            marks=[]
            if path.parent == SCENARIOS and f"{path.stem}:{key.value}" in ONE_OF_EACH_KIND
            else [pytest.mark.slow],
        )
        for path in sorted(SCENARIOS.rglob("*.yaml"))
        for key, _ in yaml.compose(path.read_text(), Loader=yaml.SafeLoader).value
    ]


@pytest.mark.parametrize(("path", "name"), shipped())
def test_shipped_scenarios_run(
    path: Path,
    name: str,
    tmp_path: Path,
    verb: Verb,
    request: pytest.FixtureRequest,
):
    scenario = load_scenario(path, name)
    if scenario.policy.needs_observation:
        request.getfixturevalue("rendering")
    flags = ("--scenario_text", "{time_limit: 1.0}", "--no-meshcat", "--output", tmp_path / "out")
    diagram = tmp_path / "kitting.dot"
    done = verb("run", path, "--scenario_name", name, "--seed", 3, *flags, "--graphviz", diagram)
    assert done.returncode == 0
    shown = done.stdout
    left = {"results.json", *(["decisions"] if isinstance(scenario.policy, Learned) else [])}
    assert {item.name for item in (tmp_path / "out").iterdir()} == left
    results = json.loads((tmp_path / "out" / "results.json").read_text())
    assert results.keys() >= KEYS
    assert results["seed"] == 3
    assert results["policy"] == scenario.policy.name
    assert path.stem in results["scenario"]
    assert results["timed_out"]
    assert results["sim_seconds"] == pytest.approx(1.0)
    assert results["wall_seconds"] > 0
    assert results["point_contact_pairs"] == 0
    assert results["success_rate"] == results["strict_success_rate"] == 0
    scene = scenario.task.make_scene(grid=scenario.heightmap.grid(), seed=3, base=path.parent)
    counted = [scene.objects[index] for index in scene.goal_objects]
    assert [item["name"] for item in results["objects"]] == [item.name for item in counted]
    for item in results["objects"]:
        assert item.keys() >= OBJECT_KEYS
        assert item["name"] in shown  # The printed table has each object.
        assert item["success"] or item["cause"] in scenario.task.causes
    assert diagram.read_text().startswith("digraph")
    for system in ("plant", "policy", "planner", "controller", "monitor"):
        assert system in diagram.read_text()


def test_files_outside_the_folder_are_named(verb: Verb, tmp_path: Path):
    out, log, diagram = tmp_path / "out", tmp_path / "log.npz", tmp_path / "out" / "kitting.dot"
    flags = ("--scenario_text", "{time_limit: 0.1}", "--no-meshcat", "--output", out)
    done = verb("run", "scenarios/kitting_oracle.yaml", *flags, "--log", log, "--graphviz", diagram)
    assert done.returncode == 0
    assert done.stdout.endswith(f"files: {out}/, {log}\n")


def test_quiet_prints_nothing(verb: Verb, tmp_path: Path):
    flags = ("--scenario_text", "{time_limit: 0.1}", "--no-meshcat", "--output", tmp_path)
    done = verb("run", "scenarios/kitting_oracle.yaml", "--quiet", *flags)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


def test_ctrl_c_leaves_complete_files(verb: Verb, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """SIGINT comes at a fixed moment of the episode, so that the test is deterministic."""
    run_chosen = running.run_chosen

    def interrupt(event: ModeChange) -> None:
        if event.mode == Mode.DESCEND and not event.is_last:
            os.kill(os.getpid(), signal.SIGINT)

    def run_and_interrupt(*arguments: Any, observers: Sequence[EpisodeObserver], **options: Any):
        return run_chosen(*arguments, observers=[*observers, interrupt], **options)

    monkeypatch.setattr(running, "run_chosen", run_and_interrupt)
    # Background jobs of a shell ignore Ctrl-C by default.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        done = verb("run", "scenarios/kitting_oracle.yaml", "--output", tmp_path)
    finally:
        signal.signal(signal.SIGINT, before)
    assert done.returncode == 130, done.stderr
    assert "Traceback" not in done.stderr
    assert sorted(path.name for path in tmp_path.iterdir()) == ["replay.html", "results.json"]
    results = json.loads((tmp_path / "results.json").read_text())
    assert results.keys() >= KEYS
    assert results["interrupted"] is True
    assert [action["outcome"] for action in results["actions_taken"]] == ["unfinished"]
    assert 0.3 < results["sim_seconds"] < 3.0
    replay = (tmp_path / "replay.html").read_text()
    assert replay.rstrip().endswith("</html>")
    commands = b"".join(map(base64.b64decode, re.findall(r"base64,([A-Za-z0-9+/=]+)", replay)))
    assert b"claw_hammer" in commands
    assert b"set_animation" in commands


@pytest.mark.parametrize(
    ("flags", "words"),
    [
        (["--graphviz", "cell.jpg"], "--graphviz writes .svg, .png, .pdf and .dot"),
        (["--seed", "-1"], "'-1' is not a whole number"),
        (["--video", "/proc/none/film.gif"], "cannot write into /proc/none"),
    ],
)
def test_invalid_flags_are_refused(verb: Verb, tmp_path: Path, flags: list[str], words: str):
    done = verb(
        "run", "scenarios/kitting_oracle.yaml", "--no-meshcat", "--output", tmp_path, *flags
    )
    assert done.returncode == 2
    assert words in done.stderr
    assert "Traceback" not in done.stderr
    assert not list(tmp_path.iterdir())


def test_a_folder_named_like_the_replay_is_refused_early(verb: Verb, tmp_path: Path):
    (tmp_path / "replay.html").mkdir()
    done = verb("run", "scenarios/kitting_oracle.yaml", "--no-meshcat", "--output", tmp_path)
    assert (done.returncode, done.stdout) == (2, "")
    assert "replay.html is a folder" in done.stderr


def test_errors_of_graphviz_are_reported(tmp_path: Path, monkeypatch):
    broken = tmp_path / "dot"
    broken.write_text("#!/bin/sh\necho 'Format: pdf not recognized' >&2\nexit 1\n")
    broken.chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path), prepend=":")
    builder = DiagramBuilder()
    builder.AddSystem(ConstantVectorSource([0.0]))
    with pytest.raises(UserError, match=r"dot cannot write cell\.pdf: Format: pdf not recognized"):
        running.draw_diagram(builder.Build(), Path("cell.pdf"))


def test_a_wrong_path_does_not_find_a_shipped_scenario(verb: Verb, tmp_path: Path):
    done = verb("run", "no/such/kitting_oracle.yaml", "--no-meshcat", "--output", tmp_path)
    assert done.returncode == 2
    assert "cannot read the scenario no/such/kitting_oracle.yaml" in done.stderr


def test_a_policy_that_raises_is_a_failure(verb: Verb, tmp_path: Path):
    scenario = tmp_path / "mine.yaml"
    scenario.write_text('Mine: {policy: !PythonPolicy {function: "my_policy:act"}}\n')
    (tmp_path / "my_policy.py").write_text("def act(observation):\n    return observation + 1\n")
    (tmp_path / "out").mkdir()
    replay = tmp_path / "out" / "replay.html"
    replay.write_text("of an earlier run")
    done = verb("run", scenario, "--no-meshcat", "--output", tmp_path / "out")
    assert done.returncode == 1
    results = json.loads((tmp_path / "out" / "results.json").read_text())
    assert results["failure"].startswith("TypeError: unsupported operand")
    assert results["success_rate"] == 0.0
    assert not replay.exists()


LEARNED = """
Mine:
  time_limit: 0.6
  task: !ArrangedKitting {}
  policy: !Learned {weights: policy.safetensors}
  cameras:
    front: !Pinhole {width: 320, height: 240, focal_length: 225.0}
"""


@pytest.fixture
def learned(tmp_path: Path) -> Path:
    """A scenario file that needs a weights file in the same folder, which is not there yet."""
    path = tmp_path / "mine.yaml"
    path.write_text(LEARNED)
    return path


@pytest.mark.usefixtures("rendering")
def test_saves_a_picture_of_each_decision(
    verb: Verb, learned: Path, weights_file: Path, tmp_path: Path
):
    shutil.copy(weights_file, tmp_path)
    out = tmp_path / "out"
    old = out / "decisions" / "decision_07.png"
    old.parent.mkdir(parents=True)
    old.touch()
    done = verb("run", learned, "--no-meshcat", "--output", out)
    assert done.returncode == 0, done.stderr
    assert [path.name for path in old.parent.iterdir()] == ["decision_01.png"]
    assert (out / "decisions" / "decision_01.png").read_bytes().startswith(b"\x89PNG")
    results = json.loads((out / "results.json").read_text())
    assert (results["policy"], results["failure"]) == ("learned", None)
    # The tool and its recess are seen, so even untrained networks act; the time limit ends the run.
    assert (results["stop_reason"], results["actions"]) == ("time", 1)


@pytest.mark.parametrize(
    ("content", "sentence"),
    [
        (None, "cannot read the weights {weights}: there is no such file"),
        ("text", "cannot read the weights {weights}: it is not a complete safetensors file"),
        ("foreign", "{weights} is not a policy of this program: give a file that `train` wrote"),
    ],
)
@pytest.mark.usefixtures("rendering")
def test_invalid_weights_are_refused(
    learned: Path,
    content: str | None,
    sentence: str,
    verb: Verb,
):
    weights = learned.with_name("policy.safetensors")
    if content == "text":
        weights.write_text("not weights\n")
    elif content == "foreign":
        save_file({"weight": torch.zeros(3)}, weights)
    out = learned.with_name("out")
    done = verb("run", learned, "--no-meshcat", "--output", out, "--quiet")
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr == f"error: {learned}: {sentence.format(weights=weights)}\n"
    assert not list(out.iterdir())
