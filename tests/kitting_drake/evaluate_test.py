import dataclasses
import json
import math
import random
import shutil
import signal
import subprocess
import sys
import types
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

import kitting_drake.common.rendering as cameras
import kitting_drake.episode.chosen as chosen_module
import kitting_drake.evaluate as evaluation
from kitting_drake.common.errors import UserError
from kitting_drake.common.files import alone_in
from kitting_drake.common.paths import MODELS
from kitting_drake.common.processes import LocalWorkers, ProcessCrashed, Workers
from kitting_drake.episode import EpisodeResult
from kitting_drake.evaluation.summary import Episode, summarise
from kitting_drake.scenario.choosing import ChosenScenario
from kitting_drake.scenario.policies import Learned, PythonPolicy
from kitting_drake.scenario.schema import Heightmap, Scenario
from kitting_drake.tasks import Kitting
from systems.success import AddS

CHOSEN = ChosenScenario(Scenario(), Path("mine.yaml"), "mine", None)
ROOT = Path(__file__).resolve().parents[2]
QUIET = Console(quiet=True)


def fake_run(seed: int) -> Episode:
    return evaluation._lost_episode(CHOSEN, seed, "made up", 2.0)


def evaluate(
    chosen: ChosenScenario, seeds: Iterable[int], folder: Path, run: evaluation.Run = fake_run
) -> evaluation.Evaluation:
    return evaluation.evaluate(chosen, seeds, folder, run, workers=LocalWorkers(1), console=QUIET)


def test_resumes_a_stopped_run(tmp_path: Path):
    ran = []

    def run(seed: int) -> Episode:
        ran.append(seed)
        return fake_run(seed)

    evaluate(CHOSEN, [0, 1], tmp_path, run)
    path = tmp_path / "episodes.jsonl"
    # Simulate a kill while the third line is being written.
    path.write_text(path.read_text() + '{"seed": 2, "obj')
    done = evaluate(CHOSEN, range(4), tmp_path, run)
    assert ran == [0, 1, 2, 3]
    assert [item["seed"] for item in done.episodes] == [0, 1, 2, 3]
    assert [json.loads(line)["seed"] for line in path.read_text().splitlines()] == [0, 1, 2, 3]


@pytest.mark.parametrize("line", [b"{}", b"[1]", b'{"seed": 5}', b"\xff\xfe", b"{"])
def test_a_damaged_record_is_refused(line: bytes, tmp_path: Path):
    evaluate(CHOSEN, [0], tmp_path)
    path = tmp_path / "episodes.jsonl"
    path.write_bytes(path.read_bytes() + line + b"\n")
    with pytest.raises(UserError, match=r"episodes\.jsonl is damaged"):
        evaluate(CHOSEN, [0, 1], tmp_path)


def test_the_summary_reports_several_commits(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    for commit, seeds in (("first", [0]), ("second", [0, 1]), ("second", [0, 1])):
        monkeypatch.setattr(evaluation, "commit", lambda commit=commit: commit)
        episodes = evaluate(CHOSEN, seeds, tmp_path).episodes
    assert summarise(episodes, CHOSEN, AddS(), wall_seconds_total=1.0)["commit"] == "first, second"


def test_wall_clock_times_of_all_runs_add_up(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    now = 1000.0

    def run(seed: int) -> Episode:
        nonlocal now
        if seed == 2:
            raise KeyboardInterrupt
        now += 50.0
        return fake_run(seed)

    monkeypatch.setattr(evaluation.time, "perf_counter", lambda: now)

    def total(*seeds: int) -> float:
        return evaluate(CHOSEN, seeds, tmp_path, run).wall_seconds_total

    assert total(0) == 50.0
    with pytest.raises(KeyboardInterrupt):
        total(0, 1, 2)
    now += 7000.0
    # If a run was stopped, only the time up to the end of its last episode counts.
    assert total(0, 1) == 100.0
    (tmp_path / "wall_seconds.json").write_text("{")
    with pytest.raises(UserError, match=r"wall_seconds\.json is damaged: delete it"):
        total(0)


def test_a_folder_of_another_scenario_is_refused(tmp_path: Path):
    evaluate(CHOSEN, [0], tmp_path)
    other = ChosenScenario(Scenario(time_limit=1.0), Path("mine.yaml"), "mine", None)
    with pytest.raises(UserError, match="another scenario"):
        evaluate(other, [0], tmp_path)


def test_a_folder_of_other_weights_or_another_number_type_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    # Import torch lazily: workers import this file.
    import torch

    import kitting_drake.policies.networks.device as device

    weights = tmp_path / "policy.safetensors"
    scenario = Scenario(policy=Learned(weights=weights.name))
    chosen = ChosenScenario(scenario, tmp_path / "mine.yaml", "mine", None)
    folder = tmp_path / "out"
    folder.mkdir()
    shutil.copy(MODELS / "policies" / "kitting_seen.safetensors", weights)
    for seeds in ([0], [0, 1]):
        evaluate(chosen, seeds, folder)
    with monkeypatch.context() as elsewhere:
        elsewhere.setattr(device, "preferred_type", lambda: torch.float16)
        with pytest.raises(UserError, match=r"another scenario.*compute_type"):
            evaluate(chosen, [0, 1, 2], folder)
    shutil.copy(MODELS / "policies" / "generalist.safetensors", weights)
    with pytest.raises(UserError, match="another scenario"):
        evaluate(chosen, [0, 1, 2], folder)


def test_a_folder_of_other_code_or_input_files_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """The scenario's text stays the same, but a file that it uses changes."""
    monkeypatch.syspath_prepend(tmp_path)
    source = tmp_path / "policy_of_mine.py"
    tool = tmp_path / "my_tool"
    shutil.copytree(MODELS / "tools" / "claw_hammer", tool)
    scenario = Scenario(
        task=Kitting(tools=[str(tool)]),
        policy=PythonPolicy(function="policy_of_mine:act"),
    )
    chosen = ChosenScenario(scenario, tmp_path / "mine.yaml", "mine", None)
    folder = tmp_path / "out"
    folder.mkdir()

    def again() -> None:
        evaluate(chosen, [0], folder)

    source.write_text("def act(observation): ...\n")
    again()
    again()
    source.write_text("def act(observation): return 1\n")
    with pytest.raises(UserError, match="another scenario, policy or version"):
        again()
    source.write_text("def act(observation): ...\n")
    record = tool / "tool.yaml"
    record.write_text(record.read_text() + "# Another grasp.\n")
    with pytest.raises(UserError, match="another scenario, policy or version"):
        again()


def test_a_folder_in_use_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    scenario = tmp_path / "mine.yaml"
    scenario.write_text("Mine: {task: !ToolsetKitting {}}\n")
    folder = tmp_path / "out"
    folder.mkdir()
    monkeypatch.setattr(sys, "argv", ["evaluate", str(scenario), "--output", str(folder)])
    with alone_in(folder), pytest.raises(UserError, match="another process is writing to"):
        evaluation.main()


def test_a_process_that_dies_leaves_a_failed_episode(monkeypatch: pytest.MonkeyPatch):
    workers = LocalWorkers(1)
    monkeypatch.setattr(workers, "run", lambda *_: ProcessCrashed(-signal.SIGSEGV))
    lost = evaluation.run_in_worker(workers, CHOSEN, 7)
    assert lost.keys() == {field.name for field in dataclasses.fields(EpisodeResult)}
    assert lost["seed"] == 7
    assert lost["success_rate"] == 0.0
    assert str(-signal.SIGSEGV) in lost["failure"]


class Here(LocalWorkers):
    """Runs calls in this process, because a worker process takes seconds to start."""

    def run(self, function: Callable, *arguments: Any) -> Any:
        return function(*arguments)


def test_a_scene_that_cannot_be_built_is_a_failed_episode():
    scenario = Scenario(heightmap=Heightmap(rows=110, cols=110))
    chosen = dataclasses.replace(CHOSEN, scenario=scenario)
    lost = evaluation.run_in_worker(Here(1), chosen, 7)
    assert "there is no free space in the workspace" in lost["failure"]


def test_seeds_above_the_largest_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    scenario = tmp_path / "mine.yaml"
    scenario.write_text("Mine: {}\n")
    flags = ["--seed", str(2**32 - 1), "--episodes", "2", "--output", str(tmp_path / "out")]
    monkeypatch.setattr(sys, "argv", ["evaluate", str(scenario), *flags])
    with pytest.raises(UserError, match="the largest seed is 4294967295"):
        evaluation.main()
    assert not (tmp_path / "out").exists()


def test_evaluates_if_any_seed_can_be_built(monkeypatch: pytest.MonkeyPatch):
    def build(_: ChosenScenario, *, seed: int) -> tuple[None, int]:
        if seed < 2:
            raise UserError(f"no room with {seed}")
        return None, seed

    monkeypatch.setattr(chosen_module, "build_chosen", build)
    assert chosen_module.build_any_chosen(CHOSEN, range(9)) == 2
    with pytest.raises(UserError, match="no room with 0"):
        chosen_module.build_any_chosen(CHOSEN, range(2))


def test_missing_rendering_is_not_a_failed_episode(monkeypatch: pytest.MonkeyPatch):
    """Missing rendering must raise an error: a failed episode would count as done, and never be run
    again."""
    monkeypatch.setattr(cameras, "can_render", lambda: False)
    looks = PythonPolicy(function="systems.signals:PickPlaceAction")
    chosen = dataclasses.replace(CHOSEN, scenario=Scenario(policy=looks))
    with pytest.raises(UserError, match="rendering needs the system library"):
        evaluation.run_in_worker(Here(1), chosen, 7)


@pytest.mark.parametrize(("failures", "code"), [([None, "no"], 0), (["no", "no"], 1)])
def test_exit_code_when_all_episodes_fail(
    failures: list[str | None],
    code: int,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
):
    scenario = tmp_path / "mine.yaml"
    scenario.write_text("Mine: {}\n")

    def run(_: Workers, __: ChosenScenario, seed: int, log: Path | None) -> Episode:
        return fake_run(seed) | {"failure": failures[seed]}

    monkeypatch.setattr(evaluation, "run_in_worker", run)
    monkeypatch.setattr(evaluation, "draw_summary", lambda *_: None)
    flags = ["--episodes", "2", "--workers", "1", "--output", str(tmp_path / "out")]
    monkeypatch.setattr(sys, "argv", ["evaluate", str(scenario), *flags])
    assert evaluation.main() == code
    assert f"first failure: seed {failures.index('no')}: no" in capsys.readouterr().out


def test_notes_seeds_of_the_training_data(
    tmp_path: Path,
    weights_file: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
):
    scenario = tmp_path / "mine.yaml"
    scenario.write_text(f"Mine: {{policy: !Learned {{weights: {weights_file}}}}}\n")
    monkeypatch.setattr(evaluation, "run_in_worker", lambda _, __, seed, ___: fake_run(seed))
    # A stand-in for the built scenario, so that no networks are loaded.
    scene = types.SimpleNamespace(scene=types.SimpleNamespace(success=AddS()))
    monkeypatch.setattr(evaluation, "build_any_chosen", lambda *_: scene)
    monkeypatch.setattr(evaluation, "draw_summary", lambda *_: None)
    flags = ["--seed", "10001", "--episodes", "3", "--workers", "1"]
    monkeypatch.setattr(
        sys, "argv", ["evaluate", str(scenario), *flags, "--output", str(tmp_path / "out")]
    )
    evaluation.main()
    assert "the policy has learned from seeds 10001 to 10002" in capsys.readouterr().out
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["policy_details"]["method"] == "so2"
    assert summary["policy_digest"].startswith("sha256 ")


def test_a_process_killed_from_outside_is_retried_once(monkeypatch: pytest.MonkeyPatch):
    killed, lost = ProcessCrashed(-signal.SIGKILL), fake_run(7)
    answers = [killed, lost, killed, killed]
    workers = LocalWorkers(1)
    monkeypatch.setattr(workers, "run", lambda *_: answers.pop(0))
    assert evaluation.run_in_worker(workers, CHOSEN, 7) == lost
    with pytest.raises(UserError, match="seed 7 was killed twice"):
        evaluation.run_in_worker(workers, CHOSEN, 7)


@pytest.mark.parametrize("workers", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_two_short_episodes(workers: int, verb, tmp_path: Path):
    done = verb(
        "evaluate",
        *("scenarios/kits.yaml", "--scenario_name", "OneTool"),
        *("--episodes", 2, "--workers", workers, "--output", tmp_path),
        *("--scenario_text", "{time_limit: 0.2}"),
    )
    assert done.returncode == 0, done.stderr
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["episodes"] == 2
    assert summary["failed_episodes"] == 0
    assert summary["success_rate"] == 0.0
    assert math.isclose(summary["sim_seconds"], 0.4)
    assert summary["point_contact_pairs"] == 0
    assert summary["timed_out_episodes"] == 2
    assert summary["causes"]["timed out"] == 2
    assert summary["success_description"] == "ADD-S below 3.5 mm"
    assert summary["wall_seconds_total"] > 0
    assert (tmp_path / "summary.png").read_bytes().startswith(b"\x89PNG")
    assert "2 timed out" in done.stdout


@pytest.mark.slow
def test_a_repeatedly_killed_run_gives_the_same_episodes(
    tmp_path: Path, kill_at_random: Callable[..., None]
):
    scenario = tmp_path / "drawn.yaml"
    scenario.write_text("Drawn: {time_limit: 2.0, task: !ToolsetKitting {}}\n")
    whole, killed = tmp_path / "whole", tmp_path / "killed"

    def start(folder: Path, workers: int) -> subprocess.Popen[bytes]:
        flags = ("--episodes", 40, "--workers", workers, "--output", folder, "--quiet")
        command = [sys.executable, "-m", "kitting_drake.evaluate", scenario, *flags]
        return subprocess.Popen([str(word) for word in command], cwd=ROOT)

    def episodes(folder: Path) -> list[Episode]:
        lines = (folder / "episodes.jsonl").read_text().splitlines()
        found = [json.loads(line) | {"wall_seconds": 0} for line in lines]
        return sorted(found, key=lambda episode: episode["seed"])

    assert start(whole, 2).wait() == 0
    rng = random.Random(0)
    for _ in range(20):
        kill_at_random(start(killed, 2), killed / "episodes.jsonl", rng, changes=rng.randrange(2))
    assert start(killed, 1).wait() == 0
    assert episodes(killed) == episodes(whole)
    assert [episode["seed"] for episode in episodes(whole)] == list(range(40))
    # The episodes differ, and none is missing.
    assert len({json.dumps(episode["objects"]) for episode in episodes(whole)}) == 40
    assert not any(episode["failure"] for episode in episodes(whole))
    one, two = (json.loads((path / "summary.json").read_text()) for path in (killed, whole))
    for key in ("timed_out_episodes", "causes", "sim_seconds", "resolved_scenario"):
        assert one[key] == two[key]
