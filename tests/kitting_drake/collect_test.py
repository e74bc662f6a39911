import dataclasses
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import h5py
import numpy as np
import pytest
from rich.console import Console

import kitting_drake.collect as collecting
from kitting_drake.common.errors import UserError
from kitting_drake.common.files import alone_in
from kitting_drake.common.processes import LocalWorkers, ProcessCrashed
from kitting_drake.common.seeds import DEMONSTRATION_SEEDS, TEST_SEEDS, VALIDATION_SEEDS, seeds_from
from kitting_drake.episode.collection import Collection, next_seed
from kitting_drake.policies.data.demonstrations import (
    Demonstration,
    Origin,
    Rejection,
    read_contents,
    read_demonstrations,
)
from kitting_drake.policies.data.frames import EpisodeFrames
from kitting_drake.policies.data.recorded import DemonstrationStep
from systems.signals import Observation, PickPlaceAction, PixelGrid, PlanarPose

ROOT = Path(__file__).resolve().parents[2]
QUIET = Console(quiet=True)
GRID = PixelGrid(rows=3, cols=4)
ORIGIN = Origin("mine", {"time_limit": 1.0}, GRID, 10, {"drake": "1.51.1"})
BAD = {11, 14, 15}


class Oracle:
    """Returns demonstrations at once, without a simulation, and records the requested seeds.

    The seeds in BAD are rejected. After `killed_after` seeds, it raises KeyboardInterrupt.
    """

    def __init__(self, killed_after: int = 1000) -> None:
        self.asked: list[int] = []
        self._killed_after = killed_after

    def __call__(self, seed: int) -> Demonstration | Rejection | ProcessCrashed:
        if len(self.asked) == self._killed_after:
            raise KeyboardInterrupt
        self.asked.append(seed)
        # Some seeds take longer, so that later ones end before them.
        time.sleep(0.02 * (seed % 3 == 1))
        if seed in BAD:
            return Rejection(seed, 0.5, f"{seed} is bad")
        image = np.random.default_rng(seed).random((4, *GRID.shape), np.float32)
        action = PickPlaceAction(PlanarPose(seed), PlanarPose(0, seed))
        step = DemonstrationStep.of(Observation(image, GRID), action, name="a", category="b")
        return Demonstration(seed, 1.0, (step,))


def collect(folder: Path, count: int, oracle: Oracle | None = None, workers: int = 1) -> Oracle:
    oracle = oracle or Oracle()
    Collection(folder, ORIGIN).collect(count, oracle, workers=LocalWorkers(workers), console=QUIET)
    return oracle


def content(folder: Path) -> dict[str, object]:
    """All attributes and data sets of a demonstrations file, by name."""
    found: dict[str, object] = {}

    def note(name: str, item: h5py.Group | h5py.Dataset) -> None:
        found.update({f"{name}@{key}": value for key, value in item.attrs.items()})
        if isinstance(item, h5py.Dataset):
            found[name] = (item.dtype, item.shape, item[()].tobytes())
            if item.dtype == h5py.string_dtype():
                found[name] = item.asstr()[()].tolist()

    with h5py.File(folder / "demonstrations.h5") as file:
        note("", file)
        file.visititems(note)
    return found


def test_ranges_of_seeds_are_disjoint():
    kinds = (TEST_SEEDS, DEMONSTRATION_SEEDS, VALIDATION_SEEDS)
    assert len({seed for seeds in kinds for seed in seeds}) == 30_000
    assert seeds_from(10_003) == range(10_003, 20_000)
    assert seeds_from(50_000)[-1] == 2**32 - 1


@pytest.mark.parametrize(
    ("accepted", "rejected", "working", "expected"),
    [
        ([], [], [], 10),
        ([], [], [10, 11], 12),
        ([10], [], [11, 12], None),
        # One seed was rejected, while another is in progress.
        ([10], [11], [12], 13),
        # A killed run left a gap.
        ([10, 12], [], [], 11),
        ([10, 12, 13], [], [], 11),
        ([10, 12, 13], [], [11], None),
        ([10, 11, 12], [], [], None),
    ],
)
def test_the_next_seed(accepted, rejected, working, expected):
    assert next_seed(range(10, 20), 3, accepted, rejected, working) == expected


def test_too_few_seeds_are_refused():
    with pytest.raises(UserError, match="only seeds 10 to 12"):
        next_seed(range(10, 13), 4, [], [], [])
    with pytest.raises(UserError, match="only seeds 10 to 12"):
        next_seed(range(10, 13), 3, [10, 12], [11], [])
    assert next_seed(range(10, 13), 3, [10, 11, 12], [], []) is None


def test_an_oracle_that_always_fails_ends_collecting():
    with pytest.raises(UserError, match="failed on 20 seeds in a row, 11 to 30"):
        next_seed(range(10, 99), 3, [10], range(11, 31), [])
    assert next_seed(range(10, 99), 3, [10], range(11, 30), []) == 30


@pytest.mark.parametrize("workers", [1, 3])
def test_collects_the_first_seeds_that_are_not_rejected(tmp_path: Path, workers: int):
    collect(tmp_path, 4, workers=workers)
    assert [item.name for item in tmp_path.iterdir()] == ["demonstrations.h5"]
    read = read_demonstrations(tmp_path / "demonstrations.h5")
    assert read.origin == ORIGIN
    assert [item.seed for item in read.demonstrations] == [10, 12, 13, 16]
    assert [item.seed for item in read.rejected] == [11, 14, 15]
    assert read.rejected[0] == Rejection(11, 0.5, "11 is bad")
    assert [item.steps[0].pick.x for item in read.demonstrations] == [10, 12, 13, 16]


@pytest.mark.parametrize("workers", [1, 3])
@pytest.mark.parametrize(
    "after",
    [pytest.param(n, marks=[] if n in (1, 4, 6) else [pytest.mark.slow]) for n in range(1, 7)],
)
def test_resumes_a_stopped_run(tmp_path: Path, after: int, workers: int):
    collect(tmp_path / "whole", 4)
    with pytest.raises(KeyboardInterrupt):
        collect(tmp_path / "stopped", 4, Oracle(killed_after=after), workers)
    parts = tmp_path / "stopped" / "parts"
    kept = {int(path.stem.removeprefix("seed_")) for path in parts.glob("seed_*")}
    # Simulate a kill while files are being written.
    for name in (".seed_00000099.h5.scratch", ".seed_00000099.json.x1"):
        parts.mkdir(parents=True, exist_ok=True)
        (parts / name).write_text("half")
    oracle = collect(tmp_path / "stopped", 4, workers=workers)
    assert sorted(oracle.asked) == sorted(set(range(10, 17)) - kept)
    assert content(tmp_path / "stopped") == content(tmp_path / "whole")
    assert not parts.exists()


def test_removes_parts_left_by_a_killed_process(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    collect(tmp_path / "whole", 4)
    with monkeypatch.context() as patch:
        patch.setattr(Collection, "_remove_parts", lambda *_: None)
        collect(tmp_path, 4)
    assert (tmp_path / "parts").exists()
    assert Collection(tmp_path, ORIGIN).assembled == 4
    assert not (tmp_path / "parts").exists()
    assert collect(tmp_path, 4).asked == []
    assert content(tmp_path) == content(tmp_path / "whole")


def test_adds_demonstrations_to_a_finished_run(tmp_path: Path):
    collect(tmp_path / "whole", 5)
    collect(tmp_path / "extended", 2)
    assert collect(tmp_path / "extended", 5).asked == [13, 14, 15, 16, 17]
    assert content(tmp_path / "extended") == content(tmp_path / "whole")


def test_fewer_demonstrations_after_a_stop_keep_the_parts(tmp_path: Path):
    collect(tmp_path / "whole", 2)
    with pytest.raises(KeyboardInterrupt):
        collect(tmp_path / "stopped", 9, Oracle(killed_after=6))
    assert collect(tmp_path / "stopped", 2).asked == []
    assert content(tmp_path / "stopped") == content(tmp_path / "whole")
    assert collect(tmp_path / "stopped", 4).asked == [16]


def test_rejections_of_other_seeds_are_ignored(tmp_path: Path):
    """A stopped run of other seeds left its rejections in the folder."""
    (tmp_path / "parts").mkdir()
    rejected = {"seed": 3, "score": 0.0, "reason": "of another run"}
    (tmp_path / "parts" / "seed_00000003.json").write_text(json.dumps(rejected))
    collect(tmp_path, 2)
    assert 3 not in [item.seed for item in read_contents(tmp_path / "demonstrations.h5").rejected]


def test_a_file_of_another_origin_is_refused(tmp_path: Path):
    collect(tmp_path, 1)
    with pytest.raises(UserError, match="another scenario"):
        Collection(tmp_path, dataclasses.replace(ORIGIN, scenario={"time_limit": 2.0}))
    with pytest.raises(UserError, match="begins with seed 10: give --seed 10 or another"):
        Collection(tmp_path, dataclasses.replace(ORIGIN, first_seed=12))


class Mortal(Oracle):
    """An oracle whose process dies the first `deaths` times that it is asked for seed 12."""

    def __init__(self, deaths: int, exit_code: int) -> None:
        super().__init__()
        self._deaths, self._exit_code = deaths, exit_code

    def __call__(self, seed: int) -> Demonstration | Rejection | ProcessCrashed:
        outcome = super().__call__(seed)
        dies = seed == 12 and self.asked.count(12) <= self._deaths
        return ProcessCrashed(self._exit_code) if dies else outcome


@pytest.mark.parametrize("exit_code", [1, -signal.SIGKILL])
def test_a_process_that_dies_is_retried_once(tmp_path: Path, exit_code: int):
    collect(tmp_path / "whole", 2)
    assert collect(tmp_path, 2, Mortal(1, exit_code)).asked == [10, 11, 12, 12]
    assert content(tmp_path) == content(tmp_path / "whole")


def test_a_seed_that_crashes_twice_is_rejected(tmp_path: Path):
    collect(tmp_path, 2, Mortal(2, -signal.SIGSEGV))
    rejected = read_demonstrations(tmp_path / "demonstrations.h5").rejected
    assert rejected[-1] == Rejection(12, 0.0, "its process ended with exit code -11")


def test_a_seed_killed_from_outside_is_not_rejected(tmp_path: Path):
    with pytest.raises(UserError, match="seed 12 was killed twice"):
        collect(tmp_path, 2, Mortal(2, -signal.SIGKILL))
    assert collect(tmp_path, 2).asked == [12]


class Recorder:
    """Replaces `LocalWorkers.run`: the oracle demonstrates immediately, with three frames."""

    def __init__(self) -> None:
        self.recorded: list[int] = []

    def run(self, function, chosen, seed, log, settings):
        found, frames = Oracle()(seed), None
        if settings is not None and isinstance(found, Demonstration):
            self.recorded.append(seed)
            zeros = np.zeros((3, 5), np.float32)
            ends = np.array([False, False, True])
            names = tuple("abcde")
            frames = EpisodeFrames(seed, settings.fps, names, zeros, zeros, zeros[:, 0], ends)
        return found, frames


def arguments(folder: Path, *more: object) -> list[str]:
    return ["collect", "scenarios/kitting_oracle.yaml", "--output", str(folder), *map(str, more)]


def test_without_rendering_prints_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.chdir(ROOT)
    monkeypatch.setattr("kitting_drake.common.rendering.can_render", lambda: False)
    monkeypatch.setattr(sys, "argv", arguments(tmp_path))
    with pytest.raises(SystemExit) as left:
        collecting.run_command(collecting.main)
    assert left.value.code == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("error: rendering needs the system library libEGL")


def test_a_scenario_without_cameras_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(ROOT)
    scenario = tmp_path / "blind.yaml"
    scenario.write_text("Blind: {cameras: {}}\n")
    monkeypatch.setattr(sys, "argv", ["collect", str(scenario), "--output", str(tmp_path / "out")])
    with pytest.raises(UserError, match=r"blind\.yaml: cameras is empty"):
        collecting.main()
    # Nothing was written, so the corrected scenario can use the same folder.
    assert not (tmp_path / "out" / "scenario.json").exists()


def test_a_folder_in_use_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(ROOT)
    monkeypatch.setattr(sys, "argv", arguments(tmp_path))
    with alone_in(tmp_path), pytest.raises(UserError, match="another process is writing to"):
        collecting.main()


def test_a_finished_collection_is_not_repeated(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.chdir(ROOT)
    monkeypatch.setattr(collecting, "require_rendering", lambda: None)
    monkeypatch.setattr(collecting, "build_any_chosen", lambda *_, **__: None)
    monkeypatch.setattr(LocalWorkers, "run", Recorder().run)
    monkeypatch.setattr(sys, "argv", arguments(tmp_path, "--demos", 3, "--seed", 10))
    assert collecting.main() == 0
    assert "holds 3 demonstrations, 1 seed rejected; " in capsys.readouterr().out
    path = tmp_path / "demonstrations.h5"
    before = path.stat()
    monkeypatch.setattr(sys, "argv", arguments(tmp_path, "--demos", 2, "--seed", 10))
    assert collecting.main() == 0
    assert capsys.readouterr().out.startswith("nothing to do: ")
    assert path.stat() == before
    monkeypatch.setattr(sys, "argv", [*arguments(tmp_path), "--scenario_text", "{time_limit: 2}"])
    with pytest.raises(UserError, match="another scenario"):
        collecting.main()
    monkeypatch.setattr(collecting, "files_digest", lambda _: "another digest")
    monkeypatch.setattr(sys, "argv", arguments(tmp_path, "--demos", 3, "--seed", 10))
    with pytest.raises(
        UserError, match=r"another scenario, tools or version \(task_digest is another"
    ):
        collecting.main()


def test_demonstrations_are_exported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    pytest.importorskip("pyarrow", exc_type=ImportError)
    monkeypatch.chdir(ROOT)
    # The oracle's images must have the scenario's grid.
    monkeypatch.setattr(sys.modules[__name__], "GRID", PixelGrid())
    monkeypatch.setattr(collecting, "require_rendering", lambda: None)
    monkeypatch.setattr(collecting, "build_any_chosen", lambda *_, **__: None)
    recorder = Recorder()
    monkeypatch.setattr(LocalWorkers, "run", recorder.run)

    def main(demos: int, *more: str) -> str:
        monkeypatch.setattr(sys, "argv", arguments(tmp_path, "--demos", demos, "--seed", 10, *more))
        assert collecting.main() == 0
        return capsys.readouterr().out

    main(1)
    assert not (tmp_path / "lerobot").exists()
    # The first export records the demonstration again, because its frames are missing.
    # The second export changes nothing.
    told = main(1, "--export", "lerobot")
    assert told.startswith("nothing to collect: ")
    assert told.endswith(f"as a LeRobotDataset: {tmp_path / 'lerobot'}/\n")
    assert recorder.recorded == [10]
    before = (tmp_path / "lerobot").stat()
    main(1, "--export", "lerobot")
    assert (tmp_path / "lerobot").stat() == before
    # An export of other demonstrations is refused before collecting.
    with pytest.raises(UserError, match="lerobot already exists"):
        main(2, "--export", "lerobot")
    with pytest.raises(UserError, match=r"frames holds the files of another recording \(fps is 20"):
        main(2, "--export", "lerobot", "--fps", "20")
    assert len(read_demonstrations(tmp_path / "demonstrations.h5").demonstrations) == 1
    shutil.rmtree(tmp_path / "lerobot")
    # Seed 11 is rejected, so it gets no frames.
    assert "holds 2 demonstrations" in main(2, "--export", "lerobot")
    assert recorder.recorded == [10, 12]
    info = json.loads((tmp_path / "lerobot" / "meta" / "info.json").read_text())
    assert (info["total_episodes"], info["total_frames"], info["fps"]) == (2, 6, 16)
    for flags in (["--fps", "60"], ["--cameras", "rear"]):
        with pytest.raises(UserError, match=r"fps is 60: use 10 to 30|no camera 'rear'"):
            main(2, "--export", "lerobot", *flags)


ONE_TOOL = """
OneTool:
  task: !Kitting
    tools: [claw_hammer]
"""


@pytest.mark.slow
@pytest.mark.usefixtures("rendering")
def test_a_repeatedly_killed_run_collects_the_same_file(verb_process, tmp_path: Path):
    scenario = tmp_path / "one_tool.yaml"
    scenario.write_text(ONE_TOOL)
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    counts = ("--demos", 12, "--workers", 2)
    done = verb_process("collect", scenario, *counts, "--output", whole)
    assert done.returncode == 0, done.stderr
    command = [sys.executable, "-m", "kitting_drake.collect", scenario, *counts]
    rng = random.Random(0)
    # Kill the run as soon as it has kept `more` further seeds. If `more` is 0, kill it at a random
    # time, at the latest when it has kept one more.
    for more in (0, 1, 0, 2, 1, 0, 1, 2):
        process = subprocess.Popen(
            [*map(str, command), "--output", killed], cwd=ROOT, stdout=subprocess.DEVNULL
        )
        parts = killed / "parts"
        goal = len(list(parts.glob("seed_*"))) + max(more, 1)
        end = time.monotonic() + (120.0 if more else rng.uniform(0.5, 9.0))
        while len(list(parts.glob("seed_*"))) < goal and time.monotonic() < end:
            assert process.poll() is None
            time.sleep(0.01)
        os.kill(process.pid, signal.SIGKILL)
        process.wait()
        assert len(list(parts.glob("seed_*"))) >= goal - (not more)
    done = verb_process("collect", scenario, *counts, "--output", killed)
    assert done.returncode == 0, done.stderr
    assert sorted(item.name for item in killed.glob("[!.]*")) == [
        "demonstrations.h5",
        "scenario.json",
    ]
    assert content(killed) == content(whole)
    read = read_demonstrations(killed / "demonstrations.h5")
    assert [item.seed for item in read.demonstrations] == list(range(10000, 10012))
    claimed = json.loads((killed / "scenario.json").read_text())
    assert claimed.pop("task_digest").startswith("sha256 ")
    assert claimed == read.origin.scenario | {"versions": read.origin.versions}
