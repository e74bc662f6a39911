"""Converts frames and actions of a real bench to demonstrations."""

import dataclasses
import json
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from kitting_drake import demonstrate, train
from kitting_drake.common.errors import UserError
from kitting_drake.policies.data.demonstrations import Demonstrations, read_demonstrations
from kitting_drake.policies.data.learning import Learning
from kitting_drake.policies.data.training_data import read_training_data
from kitting_drake.real_camera import Frame, ShapeMatching, decide, read_frames
from kitting_drake.real_camera.calibrations.calibration import (
    Calibration,
    calibration_digest,
    read_calibration,
    with_poses,
    write_calibration,
)
from kitting_drake.real_camera.checking.kit_block import Block
from kitting_drake.real_camera.outside_demonstrations import (
    check_replaceable,
    convert,
    find_demonstrations,
)
from kitting_drake.scenario.schema import Scenario
from systems.signals import PixelGrid, PlanarPose
from tests.kitting_drake.real_camera.frames import ROOT, calibration_of, cast, write_frames

_CELL = calibration_of(Scenario())
BENCH = dataclasses.replace(
    _CELL, cameras=_CELL.cameras[:1], grid=PixelGrid(rows=40, cols=80, resolution=0.0125)
)
KITTING = Learning(later_picks_possible=True, curvature=True, reflection=True)
POSES = {
    "pick": {"x": 0.45, "y": -0.2, "yaw": 0.3, "z": 0.02, "jaw_opening": 0.08},
    "place": {"x": 0.6, "y": 0.25, "yaw": -1.2, "lowest_z": 0.0},
}


def write_step(folder: Path, shade: int, record: dict | None) -> None:
    """Writes a step: frames of a coloured block on the table, and the record of the action."""
    block = Block((0.15, 0.08, 0.04), (0.45, -0.2, 0.01 * shade))
    frames = {
        name: Frame(np.full_like(frame.color, shade), frame.depth)
        for name, frame in cast(BENCH, block).items()
    }
    write_frames(folder, frames)
    if record is not None:
        (folder / "action.json").write_text(json.dumps(record))


def pose(record: dict[str, float]) -> PlanarPose:
    return PlanarPose(record["x"], record["y"], record["yaw"])


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    tmp_path = tmp_path_factory.mktemp("demonstrations")
    root = tmp_path / "my bench"
    write_step(root / "demo1" / "step9", 10, {**POSES, "object": "red", "category": "wrench"})
    write_step(root / "demo1" / "step10", 20, {"stop": False, **POSES})
    write_step(root / "demo1" / "step11", 30, {"stop": True, "confidence": None})
    write_step(root / "demo2" / "step1", 40, POSES)
    write_calibration(tmp_path / "calibration.yaml", BENCH)
    (root / "notes.txt").write_text("Stray files are no demonstrations.")
    return tmp_path


@pytest.fixture
def folder(written: Path, tmp_path: Path) -> Path:
    """Two demonstrations. The first one has the steps 9, 10 and 11; the last of them is a stop."""
    return shutil.copytree(written, tmp_path, dirs_exist_ok=True) / "my bench"


@pytest.fixture
def command(folder: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., int]:
    """Runs `demonstrate` on the folder."""

    def run(*flags: object) -> int:
        arguments = [folder, "--camera", folder.parent / "calibration.yaml", "--quiet", *flags]
        monkeypatch.setattr(sys, "argv", ["demonstrate", *map(str, arguments)])
        return demonstrate.main()

    return run


def by_name(found: Demonstrations) -> Iterator[tuple[str, object]]:
    for item in found.demonstrations:
        yield ("demo1" if item.final else "demo2"), item


def test_the_file_holds_observations_of_decide_and_actions(
    folder: Path, command: Callable[..., int]
):
    assert command("--output", folder.parent / "out") == 0
    found = read_demonstrations(folder.parent / "out" / "demonstrations.h5")
    assert found.origin.scenario_name == "my bench"
    assert found.origin.grid == BENCH.grid
    assert found.origin.learning == KITTING
    items = dict(by_name(found))
    recorded = [*items["demo1"].steps, items["demo1"].final, *items["demo2"].steps]
    names = ["demo1/step9", "demo1/step10", "demo1/step11", "demo2/step1"]
    calibration = read_calibration(folder.parent / "calibration.yaml")
    for name, step in zip(names, recorded, strict=True):
        frames = read_frames([folder / name], calibration)
        seen = decide(frames, calibration, ShapeMatching()).observation
        np.testing.assert_array_equal(step.image[3], seen.height)
        # The file stores colours in 8 bits.
        np.testing.assert_allclose(step.image[:3], seen.rgb, atol=0.5 / 255 + 1e-6)
        if name != "demo1/step11":
            assert (step.pick, step.place) == (pose(POSES["pick"]), pose(POSES["place"]))
    assert [step.object for step in items["demo1"].steps] == ["red", "object"]
    assert [step.category for step in items["demo1"].steps] == ["wrench", ""]


def test_files_of_other_origin_are_not_replaced(folder: Path, command: Callable[..., int]):
    path = folder.parent / "mine.h5"
    path.write_text("before")
    with pytest.raises(UserError, match=r"mine\.h5 exists"):
        command("--output", path)
    assert path.read_text() == "before"
    path.unlink()
    assert command("--output", path) == command("--output", path) == 0
    with pytest.raises(UserError, match="holds demonstrations of my bench"):
        check_replaceable(path, folder.parent / "another bench")


def test_train_takes_the_file(folder: Path, command, monkeypatch: pytest.MonkeyPatch):
    path, output = folder.parent / "mine.h5", folder.parent / "training"
    assert command("--output", path, "--no_reflection", "--no_later_picks") == 0
    assert read_demonstrations(path).origin.learning == Learning(curvature=True)
    words = f"train --demos {path} --preset tiny --orientations 36 --steps 2 --quiet".split()
    monkeypatch.setattr(sys, "argv", [*words, "--output", str(output)])
    assert train.main() == 0
    assert (output / "policy.safetensors").is_file()


def test_seeds_identify_frames(folder: Path):
    """A demonstration's seed depends on its frames only, not on names or other demonstrations."""
    first, second = folder.parent / "first.h5", folder.parent / "second.h5"
    convert(folder, BENCH, KITTING, first)
    (folder / "demo2").rename(folder / "again")
    (folder / "demo1").rename(folder.parent / "left out")
    convert(folder, BENCH, KITTING, second)
    one, other = read_training_data(first), read_training_data(second)
    assert one.shares_scenes(other) == other.seeds[0]


_NO_DRAKE = """
import runpy, sys
sys.modules["pydrake"] = None
try:
    runpy.run_module("kitting_drake.demonstrate", run_name="__main__")
finally:
    print("torch" in sys.modules)
"""


@pytest.mark.parametrize("process", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_the_command_needs_neither_drake_nor_torch(
    process: bool,
    folder: Path,
    verb: Callable[..., subprocess.CompletedProcess[str]],
):
    """A second run, with invalid input, prints one line and keeps the file of the first run."""
    output = folder.parent / "out"
    words = [folder, "--camera", folder.parent / "calibration.yaml", "--output", output]
    if process:
        arguments = [sys.executable, "-c", _NO_DRAKE, *map(str, words)]
        done = subprocess.run(arguments, cwd=ROOT, capture_output=True, text=True, timeout=300)
        assert done.stdout.endswith("False\n")
    else:
        done = verb("demonstrate", *words)
    assert done.returncode == 0, done.stderr
    assert "holds 2 demonstrations with 3 steps in all; 1 of them" in done.stdout
    (folder / "demo2" / "step1" / "action.json").unlink()
    done = verb("demonstrate", *words)
    assert done.returncode == 2
    assert done.stderr.startswith("error: ") and done.stderr.count("\n") == 1
    assert len(read_demonstrations(output / "demonstrations.h5").demonstrations) == 2


# Invalid input.


def action(step: str, content: object) -> Callable[[Path], None]:
    def apply(folder: Path) -> None:
        text = content if isinstance(content, str) else json.dumps(content)
        (folder / step / "action.json").write_text(text)

    return apply


def without(step: str, name: str) -> Callable[[Path], None]:
    return lambda folder: (folder / step / name).unlink()


def at(x: float) -> dict:
    return {**POSES, "place": {"x": x, "y": 0.0, "yaw": 0.0}}


def small(folder: Path) -> None:
    Image.new("RGB", (320, 240)).save(folder / "demo2" / "step1" / "front_color.png")


def empty(folder: Path) -> None:
    (folder / "demo3").mkdir()


def copied(folder: Path) -> None:
    write_step(folder / "demo3" / "step1", 40, POSES)


def only_stop(folder: Path) -> None:
    write_step(folder / "demo3" / "step1", 50, {"stop": True})


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (without("demo1/step10", "action.json"), "step10 has no action.json"),
        (without("demo2/step1", "front_color.png"), "step demo2/step1: camera front: .*neither"),
        (action("demo1/step9", at(3.0)), r"step9/action.json: place at \(3, 0\) m is outside"),
        (action("demo1/step9", at(float("nan"))), "place.x must be a finite number"),
        (action("demo1/step9", "{"), "step9/action.json is not JSON"),
        (action("demo1/step9", [1]), "must be a mapping with pick and place"),
        (action("demo1/step9", {"pick": POSES["pick"]}), "place must have x, y and yaw"),
        (
            action("demo1/step9", {**POSES, "pick": {**POSES["pick"], "yaw": 17}}),
            "pick.yaw is 17, more than a full turn: give it in radians",
        ),
        (action("demo1/step9", {"stop": "yes"}), "stop must be true or false, not 'yes'"),
        (action("demo1/step9", {**POSES, "press": True}), "presses down"),
        (action("demo1/step9", {**POSES, "object": 3}), "object must be a string, not 3"),
        (action("demo1/step9", {**POSES, "object": "a\0b"}), "must have only printable characters"),
        (action("demo1/step9", {"stop": True}), "demo1/step9 says that nothing is left to do, but"),
        (action("demo1/step9", {**POSES, "calibration": "0"}), "clicked with another calibration"),
        (small, "demo2/step1: .* but camera front was calibrated at 640x480"),
        (empty, "demo3 has no steps"),
        (copied, "demo2 and demo3 hold the same frames"),
        (only_stop, "demo3 has only a last step"),
    ],
)
def test_invalid_demonstrations_are_refused(
    folder: Path, spoil: Callable[[Path], None], message: str
):
    """The error is one line, and the existing file is kept."""
    spoil(folder)
    path = folder.parent / "out" / "mine.h5"
    path.parent.mkdir()
    path.write_text("before")
    with pytest.raises(UserError, match=message) as raised:
        convert(folder, BENCH, KITTING, path)
    assert "\n" not in str(raised.value)
    assert [item.name for item in path.parent.iterdir()] == ["mine.h5"]
    assert path.read_text() == "before"


def test_folders_without_demonstrations_are_refused(tmp_path: Path):
    with pytest.raises(UserError, match="there is no folder"):
        find_demonstrations(tmp_path / "none")
    with pytest.raises(UserError, match="has no demonstrations"):
        find_demonstrations(tmp_path)


def test_calibrations_are_compared_by_value(tmp_path: Path):
    write_calibration(tmp_path / "same.yaml", BENCH)
    assert calibration_digest(read_calibration(tmp_path / "same.yaml")) == calibration_digest(BENCH)
    # If the same rotation is given in another form, the pose differs by rounding.
    other = with_poses(BENCH, {camera.name: camera.X_BC - 1e-15 for camera in BENCH.cameras})
    assert calibration_digest(other) == calibration_digest(BENCH)
    moved = with_poses(BENCH, {camera.name: camera.X_BC + 1e-5 for camera in BENCH.cameras})
    assert calibration_digest(moved) != calibration_digest(BENCH)
    lifted = Calibration(BENCH.cameras, dataclasses.replace(BENCH.grid, z_min=0.001))
    assert calibration_digest(lifted) != calibration_digest(BENCH)
