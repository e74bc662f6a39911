import dataclasses
import json
import os
import random
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from kitting_drake import train as training
from kitting_drake.common.errors import UserError
from kitting_drake.common.files import alone_in
from kitting_drake.policies.data.demonstrations import (
    Demonstration,
    Learning,
    Origin,
    write_demonstrations,
)
from kitting_drake.policies.data.images import LabelledImage
from kitting_drake.policies.data.recorded import DemonstrationStep, FinalObservation
from kitting_drake.policies.data.static_scenes import StaticScene, StaticScenes, write_static_scenes
from kitting_drake.policies.data.training_data import read_training_data
from kitting_drake.policies.networks.factored import Networks
from kitting_drake.policies.networks.weights import card_seeds, load_networks, read_weights_file
from kitting_drake.policies.training import training_run
from kitting_drake.policies.training import training_step as steps
from kitting_drake.policies.training.training_step import Trainer
from systems.signals import Observation, PickPlaceAction, PixelGrid, PlanarPose

ROOT = Path(__file__).resolve().parents[2]
GRID = PixelGrid(rows=33, cols=49)
LEARNING = Learning(later_picks_possible=True, curvature=True)
ORIGIN = Origin(
    "mine",
    {"time_limit": 1.0, "task": {"_tag": "!Kitting", "tries": 1, "distractors": 0}},
    GRID,
    10,
    {},
    LEARNING,
)
ONE_THREAD = os.environ | {"OMP_NUM_THREADS": "1"}
LOSSES = {"pick_position", "pick_angle", "place"}


def demonstration(seed: int, *, final: bool = True) -> Demonstration:
    """A demonstration of two steps."""
    rng = np.random.default_rng(seed)
    steps = []
    for _ in range(2):
        pick, place = GRID.to_world(rng.uniform(5, 28, (2, 2)))
        theta, rotation = rng.uniform(-3, 3, 2)
        action = PickPlaceAction(PlanarPose(*pick, theta), PlanarPose(*place, theta + rotation))
        seen = Observation(rng.random((4, *GRID.shape), np.float32), GRID)
        steps.append(DemonstrationStep.of(seen, action, name="a", category="b"))
    empty = Observation(np.full((4, *GRID.shape), 0.5, np.float32), GRID)
    return Demonstration(seed, 1.0, tuple(steps), FinalObservation.of(empty) if final else None)


def write(path: Path, seeds: Iterable[int], origin: Origin = ORIGIN) -> Path:
    write_demonstrations(path, origin, map(demonstration, seeds))
    return path


@pytest.fixture(scope="module")
def demos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Demonstrations of the seeds 10 to 13."""
    return write(tmp_path_factory.mktemp("demos") / "demonstrations.h5", range(10, 14))


def words(demos: Path, folder: Path, *more: object) -> list[str]:
    """The arguments of `python -m kitting_drake.train` for a short run, and `more`."""
    # Few orientations are faster.
    flags = ("--preset", "tiny", "--orientations", 36, "--steps", 4)
    flags += ("--validate-every", 3, "--learning-rate", "0.01")
    return [str(word) for word in ("--demos", demos, "--output", folder, *flags, *more)]


def train(demos: Path, folder: Path, *more: object) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["train", *words(demos, folder, *more)])
        patch.setattr(training_run, "_CHECKPOINT_EVERY", 2)
        # Draw final observations often, so that some of the few steps have one.
        patch.setattr(steps, "_STOP_PROBABILITY", 0.5)
        assert training.main() == 0


@pytest.fixture(scope="module")
def trained(demos: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a finished run."""
    torch.set_num_threads(1)
    folder = tmp_path_factory.mktemp("trained")
    train(demos, folder)
    return folder


@pytest.fixture
def folder(trained: Path, tmp_path: Path) -> Path:
    """A copy of the finished run's folder."""
    return Path(shutil.copytree(trained, tmp_path / "run"))


def log(folder: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (folder / "log.jsonl").read_text().splitlines()]


def test_writes_weights_and_their_card(trained: Path):
    assert sorted(path.name for path in trained.iterdir()) == [
        ".lock",
        "checkpoint.pt",
        "log.jsonl",
        "policy.safetensors",
        "settings.json",
        "summary.json",
        "tensorboard",
    ]
    file = read_weights_file(trained / "policy.safetensors")
    assert (file.config.method, file.config.preset) == ("so2", "tiny")
    assert file.card["scenario"] == "mine"
    # A tenth of the demonstrations is held out for validation, but at least one.
    assert file.card["demonstrations"] == 3
    assert file.card["demonstration_seeds"] == [10, 11, 12]
    assert file.card["validation_seeds"] == [13]
    # Each demonstration has three samples: two from its first observation, in which both objects
    # are valid picks, and one from its second.
    assert file.card["samples"] == 3 * 3
    assert file.card["final_observations"] == 3
    assert not (file.card["taken_only"] or file.card["rigid"])
    assert file.config.stop
    threshold = file.card.pop("stop_threshold")
    assert isinstance(threshold, float)
    assert load_networks(trained / "policy.safetensors").stop_threshold == threshold
    summary = json.loads((trained / "summary.json").read_text())
    best = file.card.pop("validation")
    assert summary["best"] == best
    assert best["stop_threshold"] == threshold
    # Validation has two scenes and one final observation.
    assert 0 <= best["false_stops"] + best["missed_stops"] <= 3
    assert summary.items() >= file.card.items()
    assert summary["wall_seconds"] > 0


def test_from_starts_with_given_weights(
    trained: Path, demos: Path, tmp_path: Path, refused: Callable[..., str]
):
    start = trained / "policy.safetensors"
    few = ("--steps", 1, "--learning-rate", "1e-6")
    train(demos, tmp_path / "on", "--from", start, *few)
    old, new = (load_networks(path).state_dict() for path in (start, tmp_path / "on" / start.name))
    for name, values in old.items():
        torch.testing.assert_close(new[name], values, atol=1e-4, rtol=1e-3)
    card = read_weights_file(tmp_path / "on" / start.name).card
    assert len(card["start"]) == 64
    assert card_seeds(card) == {10, 11, 12, 13}
    assert list(card["start_learned"].values()) == [[10, 11, 12]]
    fewer = refused(demos, tmp_path / "no", "--from", start, "--demonstrations", 2)
    assert "was trained on seed 12, which is in the validation data" in fewer
    for flag, other, own in (("--orientations", 48, 36), ("--preset", "small", "tiny")):
        told = refused(demos, tmp_path / "no", "--from", start, flag, other)
        assert f"give {flag} {own}" in told
    finer = dataclasses.replace(ORIGIN, grid=dataclasses.replace(GRID, resolution=0.002))
    told = refused(
        write(tmp_path / "finer.h5", range(20, 24), finer), tmp_path / "no", "--from", start
    )
    assert "was trained with pixels of 0.003125 m" in told
    assert "finer.h5 has pixels of 0.002 m" in told


@pytest.mark.parametrize(
    "method", ["so2", pytest.param("equivariant_transporter", marks=pytest.mark.slow)]
)
def test_angle_only_with_another_n(demos: Path, tmp_path: Path, method: str):
    both = ("--method", method, "--steps", 1)
    train(demos, tmp_path / "first", *both, "--orientations", 36)
    first = tmp_path / "first" / "policy.safetensors"
    train(demos, tmp_path / "angle", *both, "--orientations", 48, "--angle-only", "--from", first)
    path = tmp_path / "angle" / first.name
    old, new = (load_networks(file).state_dict() for file in (first, path))
    shared = {name for name in old if not name.startswith("beta.")}
    for name in shared:
        torch.testing.assert_close(new[name], old[name], atol=1e-5, rtol=1e-4)
    others = old.keys() - shared
    assert others == new.keys() - shared
    # Only the Equivariant Transporter's angle network depends on N.
    alike = all(old[name].shape == new[name].shape for name in others)
    assert alike == (method == "so2")
    file = read_weights_file(path)
    assert file.config.orientations == 48
    assert file.card["angle_only"]
    assert not read_weights_file(first).card["angle_only"]
    assert set(log(path.parent)[-1]) == {"step", "pick_angle"}


@pytest.mark.slow
def test_angle_only_with_another_preset(demos: Path, tmp_path: Path, refused: Callable[..., str]):
    both = ("--method", "equivariant_transporter", "--orientations", 6)
    train(demos, tmp_path / "first", *both, "--preset", "small", "--steps", 1)
    first = tmp_path / "first" / "policy.safetensors"
    angle = ("--steps", 1, "--angle-only", "--from", first)
    train(demos, tmp_path / "angle", *both, *angle, "--preset", "matched")
    path = tmp_path / "angle" / first.name
    assert read_weights_file(path).config.preset == "matched"
    old, new = (load_networks(file).state_dict() for file in (first, path))
    for name in old:
        if name.startswith("beta."):
            assert old[name].numel() < new[name].numel()
        else:
            torch.testing.assert_close(new[name], old[name], atol=1e-5, rtol=1e-4)
    assert "has preset small: give --preset small" in refused(demos, tmp_path, *both, *angle)


@pytest.mark.parametrize(
    ("flags", "sentence"),
    [
        ((), "--angle-only needs --from"),
        (("--method", "transporter", "--from", "x"), "a transporter has no separate angle network"),
    ],
)
def test_angle_only_refuses_invalid_flags(
    demos: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], flags: tuple, sentence: str
):
    with pytest.MonkeyPatch.context() as patch, pytest.raises(SystemExit) as left:
        patch.setattr(sys, "argv", ["train", *words(demos, tmp_path, "--angle-only", *flags)])
        training.main()
    assert left.value.code == 2
    assert sentence in capsys.readouterr().err


def test_rotations_of_a_transporter(
    demos: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    both = ("--method", "transporter", "--orientations", 8, "--steps", 1)
    train(demos, tmp_path / "few", *both)
    train(demos, tmp_path / "all", *both, "--rotations", 8)
    few, all_ = (tmp_path / name / "policy.safetensors" for name in ("few", "all"))
    assert read_weights_file(few).card["rotations"] is None
    assert read_weights_file(all_).card["rotations"] == 8
    assert log(few.parent)[-1] != log(all_.parent)[-1]
    with pytest.MonkeyPatch.context() as patch, pytest.raises(SystemExit) as left:
        patch.setattr(sys, "argv", ["train", *words(demos, tmp_path, "--rotations", 8)])
        training.main()
    assert left.value.code == 2
    assert "--rotations is only for --method transporter" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("learning", "flags", "taken_only", "rigid", "reflection"),
    [
        pytest.param(Learning(), (), True, True, False, marks=pytest.mark.slow),
        (Learning(later_picks_possible=True), (), False, True, False),
        (Learning(curvature=True), (), True, False, False),
        (Learning(reflection=True), (), True, True, True),
        pytest.param(
            Learning(reflection=True), ("--rigid",), True, True, False, marks=pytest.mark.slow
        ),
        (LEARNING, ("--taken-only", "--rigid"), True, True, False),
    ],
)
def test_the_task_determines_labels_and_augmentation(
    learning: Learning,
    flags: tuple[str, ...],
    taken_only: bool,
    rigid: bool,
    reflection: bool,
    tmp_path: Path,
):
    path = tmp_path / "demonstrations.h5"
    items = [demonstration(seed, final=False) for seed in (10, 11)]
    write_demonstrations(path, dataclasses.replace(ORIGIN, learning=learning), items)
    train(path, tmp_path / "run", "--steps", 1, *flags)
    file = read_weights_file(tmp_path / "run" / "policy.safetensors")
    found = (file.card["taken_only"], file.card["rigid"], file.card["reflection"])
    assert found == (taken_only, rigid, reflection)
    assert file.card["samples"] == (2 if taken_only else 3)
    # Without final observations, the networks do not learn to stop.
    assert not file.config.stop
    assert file.card["stop_threshold"] is None
    assert "false_stops" not in file.card["validation"]


@pytest.mark.parametrize(
    ("losses", "best"), [pytest.param((2.0, 1.0), 4, marks=pytest.mark.slow), ((1.0, 2.0), 3)]
)
def test_losses_select_the_checkpoint_of_multimodal_tasks(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, losses: tuple[float, float], best: int
):
    origin = dataclasses.replace(ORIGIN, learning=Learning(many_answers=True))
    demos = write(tmp_path / "demonstrations.h5", range(10, 14), origin)
    told: list[int] = []

    def mean_loss(networks: Networks, samples: Sequence[LabelledImage]) -> float:
        assert len(samples) == 2
        told.append(len(told))
        return losses[told[-1]]

    monkeypatch.setattr(training_run, "mean_loss", mean_loss)
    train(demos, tmp_path / "run")
    card = read_weights_file(tmp_path / "run" / "policy.safetensors").card
    assert (card["validation"]["step"], card["validation"]["loss"]) == (best, min(losses))


def test_the_curves(trained: Path):
    lines = log(trained)
    assert [line["step"] for line in lines] == [2, 3, 4, 4]
    assert [line.keys() >= LOSSES for line in lines] == [True, False, False, True]
    assert [line.keys() >= {"cost_mm", "stop_threshold"} for line in lines] == [
        False,
        True,
        True,
        False,
    ]
    events = EventAccumulator(str(trained / "tensorboard"))
    events.Reload()
    tags = {tag for tag in events.Tags()["scalars"] if tag.startswith("loss/")}
    assert tags == {f"loss/{name}" for name in (*LOSSES, "stop")}
    for tag, key in (("loss/place", "place"), ("validation/displacement_mm", "displacement_mm")):
        points = [(event.step, event.value) for event in events.Scalars(tag)]
        logged = [(line["step"], pytest.approx(line[key])) for line in lines if key in line]
        assert points == logged


def test_a_finished_run_is_not_repeated(
    demos: Path, folder: Path, capsys: pytest.CaptureFixture[str]
):
    before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    # Simulate a kill between the last checkpoint and the summary.
    (folder / "summary.json").unlink()
    train(demos, folder)
    assert capsys.readouterr().out.startswith("all steps are done\n")
    assert {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()} == before


def tensors(folder: Path) -> dict[str, torch.Tensor]:
    return load_networks(folder / "policy.safetensors").state_dict()


def assert_same_outcome(folder: Path, other: Path) -> None:
    """Checks that two runs have bit-identical logs, weights and checkpoints."""
    assert (folder / "log.jsonl").read_text() == (other / "log.jsonl").read_text()
    one, two = tensors(folder), tensors(other)
    assert all(torch.equal(one[name], two[name]) for name in one.keys() | two.keys())
    one, two = (
        torch.load(path / "checkpoint.pt", weights_only=True)["trainer"]["networks"]
        for path in (folder, other)
    )
    assert all(torch.equal(one[name], two[name]) for name in one.keys() | two.keys())
    one, two = (json.loads((path / "summary.json").read_text()) for path in (folder, other))
    assert one | {"wall_seconds": 0} == two | {"wall_seconds": 0}


@pytest.mark.parametrize(
    "number", [pytest.param(signal.SIGINT, marks=pytest.mark.slow), signal.SIGTERM]
)
def test_signals_save_the_last_step(
    number: signal.Signals,
    demos: Path,
    trained: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
):
    step = Trainer.step

    def step_and_interrupt(self: Trainer, *arguments: Any) -> dict[str, float]:
        if self.step_count == 2:
            # The signal comes in the middle of a step, between two checkpoints.
            os.kill(os.getpid(), number)
        return step(self, *arguments)

    # Background jobs of a shell ignore Ctrl-C by default.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with monkeypatch.context() as patch:
            patch.setattr(Trainer, "step", step_and_interrupt)
            with pytest.raises(KeyboardInterrupt):
                train(demos, tmp_path)
    finally:
        signal.signal(signal.SIGINT, before)
    assert "stopped after step 3" in capsys.readouterr().out
    state = torch.load(tmp_path / "checkpoint.pt", weights_only=True)
    assert state["trainer"]["step_count"] == 3
    # Simulate a kill while a line is being written.
    with (tmp_path / "log.jsonl").open("a") as file:
        file.write('{"step": 9, "pla')
    train(demos, tmp_path)
    assert_same_outcome(tmp_path, trained)


@pytest.mark.slow
@pytest.mark.parametrize("stop", [1, 3])
def test_a_resumed_run_gives_the_same_weights(
    demos: Path, trained: Path, tmp_path: Path, stop: int, monkeypatch: pytest.MonkeyPatch
):
    step = Trainer.step

    def step_or_stop(self: Trainer, *arguments: Any) -> dict[str, float]:
        if self.step_count == stop:
            raise KeyboardInterrupt
        return step(self, *arguments)

    with monkeypatch.context() as patch:
        patch.setattr(Trainer, "step", step_or_stop)
        with pytest.raises(KeyboardInterrupt):
            train(demos, tmp_path)
    # Simulate a kill while a line is being written.
    with (tmp_path / "log.jsonl").open("a") as file:
        file.write('{"step": 9, "pla')
    train(demos, tmp_path)
    assert_same_outcome(tmp_path, trained)


@pytest.mark.parametrize("flag", ["--from", "--validation", "--demonstrations"])
def test_training_flags_need_demos(tmp_path: Path, capsys: pytest.CaptureFixture[str], flag: str):
    arguments = ["train", "--export", "onnx", "--output", str(tmp_path), flag, "3"]
    with pytest.MonkeyPatch.context() as patch, pytest.raises(SystemExit) as left:
        patch.setattr(sys, "argv", arguments)
        training.main()
    assert left.value.code == 2
    assert f"{flag} needs --demos" in capsys.readouterr().err


def test_validation_by_the_same_seeds_of_another_task(demos: Path, tmp_path: Path):
    origin = dataclasses.replace(ORIGIN, scenario={"task": {"_tag": "!StackBlockPyramid"}})
    validation = write(tmp_path / "validation.h5", range(10, 12), origin)
    train(demos, tmp_path / "run", "--validation", validation, "--steps", 1)
    card = read_weights_file(tmp_path / "run" / "policy.safetensors").card
    assert card["demonstration_seeds"] == [10, 11, 12, 13]
    assert card["validation_seeds"] == [10, 11]


NO_DRAKE = """
import sys
sys.modules["pydrake"] = None
from kitting_drake.train import main, run_command
run_command(main)
"""


@pytest.mark.slow
@pytest.mark.parametrize("method", ["transporter", "so2"])
def test_trains_where_drake_is_not_installed(demos: Path, tmp_path: Path, method: str):
    flags = words(demos, tmp_path, "--method", method, "--steps", 1, "--quiet")
    command = [sys.executable, "-c", NO_DRAKE, *flags]
    done = subprocess.run(command, cwd=ROOT, env=ONE_THREAD, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stdout == ""
    assert (tmp_path / "policy.safetensors").exists()


# Invalid input.


@pytest.fixture
def refused(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> Callable[..., str]:
    """Runs `train`, which must fail; returns the line that it prints."""

    def run(*arguments: Any) -> str:
        monkeypatch.setattr(sys, "argv", ["train", *words(*arguments)])
        with pytest.raises(SystemExit) as left:
            training.run_command(training.main)
        assert left.value.code == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert line.startswith("error: ")
        return line

    return run


@pytest.mark.parametrize(
    ("flags", "sentence"),
    [
        (("--demonstrations", 5), "demonstrations.h5 holds 4 demonstrations, not 5: collect more"),
        (("--demonstrations", 4), "4 for training leave none for validation"),
        (("--orientations", 24), "--orientations 24: 24 orientations alias"),
        (("--orientations", 37), "--orientations 37: orientations must be an even number, not 37"),
        (("--validation", "gone.h5"), "there is no file gone.h5"),
    ],
)
def test_refuses(
    demos: Path, tmp_path: Path, refused: Callable[..., str], flags: tuple, sentence: str
):
    assert sentence in refused(demos, tmp_path, *flags)
    # A refused run writes nothing into the folder.
    assert not list(tmp_path.iterdir())


VALIDATIONS = {
    "overlapping": (range(13, 15), ORIGIN, "share seed 13"),
    # Scenes do not depend on the time limit, the tries, or fields that older files lack.
    "the same tables": (
        range(13, 15),
        dataclasses.replace(
            ORIGIN,
            scenario={"time_limit": 2.0, "task": {"_tag": "!Kitting", "tries": 2, "new": 0}},
        ),
        "share seed 13",
    ),
    # Distractors do not change the tools.
    "the same tables with boxes": (
        range(13, 15),
        dataclasses.replace(ORIGIN, scenario={"task": {"_tag": "!Kitting", "distractors": 4}}),
        "share seed 13",
    ),
    "another grid": (
        [20],
        dataclasses.replace(ORIGIN, grid=dataclasses.replace(GRID, resolution=0.005)),
        "have different pixel grids",
    ),
    "empty": ([], ORIGIN, "validation.h5 holds no demonstrations"),
}


@pytest.mark.parametrize("case", VALIDATIONS)
def test_unsuitable_validation_demonstrations_are_refused(
    demos: Path, tmp_path: Path, refused: Callable[..., str], case: str
):
    seeds, origin, sentence = VALIDATIONS[case]
    path = write(tmp_path / "validation.h5", seeds, origin)
    assert sentence in refused(demos, tmp_path / "run", "--validation", path)


def test_validation_data_without_final_observations_are_refused(
    demos: Path, tmp_path: Path, refused: Callable[..., str]
):
    path = tmp_path / "validation.h5"
    write_demonstrations(path, ORIGIN, [demonstration(20, final=False)])
    told = refused(demos, tmp_path / "run", "--validation", path)
    assert "objects left to pick" in told


def static_scenes(path: Path, *counts: int, batch: int = 1) -> Path:
    """Writes scenes with the given numbers of actions, in batches of `batch`."""
    scenes = [StaticScene(np.zeros(GRID.shape, np.uint16), np.zeros((n, 8))) for n in counts]
    ends = (*range(batch, len(scenes), batch), len(scenes))
    write_static_scenes(path, StaticScenes(GRID, tuple(scenes), batch_ends=ends))
    return path


@pytest.mark.parametrize(
    ("batch", "count", "expected"),
    [
        # The training and validation scenes are not from the same batch.
        (8, None, (16, 4)),
        (8, 9, (9, 1)),
        (1, None, (19, 1)),
        # Validation starts at the next batch, with a tenth as many scenes as training.
        (5, 13, (13, 1)),
    ],
)
def test_validation_scenes_have_other_tools(
    tmp_path: Path, batch: int, count: int | None, expected: tuple[int, int]
):
    path = static_scenes(tmp_path / "scenes.h5", *range(1, 21), batch=batch)
    learned, kept = training._split(path, count, None)
    assert (learned.count, kept.count) == expected
    # Scene i has i + 1 actions.
    last, first = (len(data.items.scenes[i].actions) - 1 for data, i in ((learned, -1), (kept, 0)))
    assert last // batch < first // batch


def test_scenes_of_one_batch_cannot_be_split(tmp_path: Path, refused: Callable[..., str]):
    path = static_scenes(tmp_path / "scenes.h5", *range(1, 21), batch=20)
    told = refused(path, tmp_path / "run")
    assert "leave none for validation with other tools" in told


def test_data_without_picks_are_refused(tmp_path: Path, refused: Callable[..., str]):
    path = static_scenes(tmp_path / "scenes.h5", 1, 1, 0)
    told = refused(path, tmp_path / "run", "--demonstrations", 2)
    assert "for validation has an object to pick: draw more" in told
    path = static_scenes(tmp_path / "none.h5", 0, 0, 1)
    told = refused(path, tmp_path / "run", "--demonstrations", 2)
    assert "for training has an object to pick: draw more" in told


def test_taken_only_refuses_static_scenes(tmp_path: Path, refused: Callable[..., str]):
    path = static_scenes(tmp_path / "scenes.h5", *[1, 0] * 11)
    assert "--taken-only needs demonstrations" in refused(path, tmp_path / "run", "--taken-only")


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("height", np.zeros((3, 5, 5), np.uint16)),
        ("actions", np.full((2, 8), np.nan)),
        ("actions", np.zeros((2, 5))),
        ("actions", np.zeros((1, 8))),
        ("first", np.array([0, 2, 1, 2])),
    ],
)
def test_damaged_static_scenes_are_refused(
    tmp_path: Path, refused: Callable[..., str], name: str, values: np.ndarray
):
    path = static_scenes(tmp_path / "scenes.h5", 1, 1, 0)
    with h5py.File(path, "a") as file:
        del file[name]
        file[name] = values
    told = refused(path, tmp_path / "run")
    assert f"cannot read {path}: " in told


def test_validation_data_without_colours_are_refused(
    demos: Path, tmp_path: Path, refused: Callable[..., str]
):
    path = tmp_path / "scenes.h5"
    scene = StaticScene(np.zeros(GRID.shape, np.uint16), np.zeros((1, 8)))
    write_static_scenes(path, StaticScenes(GRID, (scene,)))
    assert "scenes.h5 has no colours" in refused(demos, tmp_path / "run", "--validation", path)


def test_export_of_a_transporter_is_refused_before_training(
    demos: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys
):
    flags = words(demos, tmp_path, "--export", "onnx", "--method", "transporter")
    monkeypatch.setattr(sys, "argv", ["train", *flags])
    with pytest.raises(SystemExit):
        training.main()
    assert "a transporter cannot be exported" in capsys.readouterr().err


def test_a_file_without_demonstrations_is_refused(tmp_path: Path, refused: Callable[..., str]):
    path = write(tmp_path / "empty.h5", [])
    assert "empty.h5 holds no demonstrations" in refused(path, tmp_path / "run")


@pytest.mark.parametrize("flags", [("--steps", 5), ("--seed", 1), ("--demonstrations", 2)])
def test_a_folder_of_another_run_is_refused(
    demos: Path, folder: Path, refused: Callable[..., str], flags: tuple
):
    before = (folder / "settings.json").read_bytes()
    assert f"{folder} holds the files of another training run" in refused(demos, folder, *flags)
    assert (folder / "settings.json").read_bytes() == before


@pytest.mark.parametrize(
    "other", [{"scenario": {"time_limit": 2.0}}, {"versions": {"kitting_drake": "0.0.1"}}]
)
def test_another_scenario_or_version_is_another_run(
    folder: Path, tmp_path: Path, refused: Callable[..., str], other: dict[str, Any]
):
    origin = dataclasses.replace(ORIGIN, **other)
    others = write(tmp_path / "others.h5", range(10, 14), origin)
    assert f"{folder} holds the files of another training run" in refused(others, folder)


def test_other_images_are_another_run(folder: Path, tmp_path: Path, refused: Callable[..., str]):
    """If the code has changed, demonstrations with the same seeds can have other images."""
    path = tmp_path / "others.h5"
    changed = demonstration(10)
    brighter = dataclasses.replace(changed.steps[0], height=changed.steps[0].height + 0.001)
    changed = dataclasses.replace(changed, steps=(brighter, *changed.steps[1:]))
    write_demonstrations(path, ORIGIN, [changed, *map(demonstration, range(11, 14))])
    assert f"{folder} holds the files of another training run" in refused(path, folder)


def test_a_folder_in_use_is_refused(demos: Path, folder: Path, refused: Callable[..., str]):
    with alone_in(folder):
        assert f"another process is writing to {folder}" in refused(demos, folder)


@pytest.mark.parametrize("content", [b"", b"not a checkpoint", "half", "foreign", "other networks"])
def test_a_damaged_checkpoint_is_refused(
    demos: Path, folder: Path, refused: Callable[..., str], content: bytes | str
):
    path = folder / "checkpoint.pt"
    whole = path.read_bytes()
    if isinstance(content, bytes):
        path.write_bytes(content)
    elif content == "half":
        path.write_bytes(whole[: len(whole) // 2])
    elif content == "foreign":
        torch.save({"weights": torch.zeros(3)}, path)
    else:
        state = torch.load(path, weights_only=True)
        state["trainer"]["networks"].popitem()
        torch.save(state, path)
    assert f"delete {folder}" in refused(demos, folder)


def test_a_nan_loss_ends_the_run(demos: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(Trainer, "step", lambda *_: {"place": float("nan")})
    with pytest.raises(UserError, match="no longer finite at step 0: lower --learning-rate"):
        train(demos, tmp_path)
    assert not (tmp_path / "checkpoint.pt").exists()


# Saves checkpoints often. Does not clip displacements: if they were clipped, all checkpoints would
# score alike.
KILLABLE = """
from kitting_drake import train
from kitting_drake.policies.training import training_run, validation
assert training_run._CHECKPOINT_EVERY
training_run._CHECKPOINT_EVERY = 3
validation._LOST = 1e9
train.run_command(train.main)
"""


@pytest.mark.slow
def test_a_repeatedly_killed_run_gives_the_same_weights(
    demos: Path, tmp_path: Path, kill_at_random: Callable[..., None]
):
    whole, killed = tmp_path / "whole", tmp_path / "killed"

    def start(folder: Path) -> subprocess.Popen[bytes]:
        flags = words(demos, folder, "--steps", 900, "--validate-every", 20, "--quiet")
        return subprocess.Popen([sys.executable, "-c", KILLABLE, *flags], cwd=ROOT, env=ONE_THREAD)

    assert start(whole).wait() == 0
    rng = random.Random(0)
    taken_up = 0
    for _ in range(20):
        taken_up += (killed / "checkpoint.pt").exists()
        kill_at_random(start(killed), killed / "log.jsonl", rng, changes=rng.randrange(4))
    assert taken_up > 10
    assert start(killed).wait() == 0
    assert_same_outcome(killed, whole)
    # The best checkpoint is not the first one.
    assert json.loads((whole / "summary.json").read_text())["best"]["step"] > 20


def test_shared_static_scenes_are_detected_by_content(tmp_path: Path):
    found = []
    for height in (0, 0, 7):
        scene = StaticScene(np.full(GRID.shape, height, np.uint16), np.zeros((1, 8)))
        path = tmp_path / f"{len(found)}.h5"
        write_static_scenes(path, StaticScenes(GRID, (scene,), 3, {"drake": "1"}))
        found.append(read_training_data(path).made_by)
    assert found[0] == found[1] != found[2]
