"""Decisions on frames from files equal those in the simulated cell, and need no Drake."""

import dataclasses
import io
import json
import re
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from kitting_drake import decide as decide_command
from kitting_drake.common.errors import UserError
from kitting_drake.policies.choices import choose_by_networks
from kitting_drake.policies.factory import load_learned_policy
from kitting_drake.policies.matching.inventory import Inventory
from kitting_drake.policies.matching.recovery import recovery_action
from kitting_drake.policies.matching.regions.segmentation import segment
from kitting_drake.policies.matching.shape_matching import Matched, ShapeMatchingPolicy
from kitting_drake.policies.stages import Recovery
from kitting_drake.real_camera import (
    BenchRobot,
    Choice,
    Frame,
    ShapeMatching,
    decide,
    load_policy,
    read_frames,
)
from kitting_drake.real_camera.calibrations.calibration import (
    Calibration,
    read_calibration,
    write_calibration,
)
from kitting_drake.real_camera.checking.kit_block import Block
from kitting_drake.scenario import load_scenario
from kitting_drake.scenario.cameras import LookAt, camera_pose
from kitting_drake.scenario.schema import Scenario
from systems.pick_place_parameters import PickPlaceParameters
from systems.signals import Observation, PickPlaceAction, PixelGrid, PlanarPose
from tests.kitting_drake.policies.matching.regions.visibility_test import kit_and_bar
from tests.kitting_drake.real_camera.frames import (
    ROOT,
    Rendered,
    calibration_of,
    cast,
    difference,
    render,
    true_action,
    write_frames,
)

Verb = Callable[..., subprocess.CompletedProcess[str]]

TRUE = calibration_of(Scenario())
BLOCK = Block((0.20, 0.15, 0.05), (0.45, -0.2, 1.1))


def rendered(seed: int, policy: str) -> Rendered:
    path = ROOT / "scenarios" / "kitting_unseen.yaml"
    return render(load_scenario(path, None, f"{{policy: {policy}}}"), seed)


def check_against_cell(seed: int, folder: Path, orientations: int = 180) -> None:
    """Checks that the generalist makes the same decision on frames from files as in the cell.

    With depths as .npy the decisions are bit-identical; as .png (whole mm) they are about equal.
    """
    found = rendered(seed, f'!Learned {{weights: "", orientations: {orientations}}}')
    write_calibration(folder / "calibration.yaml", found.calibration)
    calibration = read_calibration(folder / "calibration.yaml")
    exact = read_frames([write_frames(folder / "npy", found.frames)], calibration)
    policy = load_policy(least_confidence=0.0, orientations=orientations)
    decision = decide(exact, calibration, policy)
    np.testing.assert_array_equal(decision.observation.image, found.observation.image)
    np.testing.assert_array_equal(decision.observation.valid, found.observation.valid)
    assert decision.action == found.action
    assert 0 <= decision.choice.confidence <= 1
    # With depth rounded to millimetres, the policy may be surer of another tool. The clearance is
    # 2 mm.
    stepped = read_frames([write_frames(folder / "png", found.frames, "png")], calibration)
    other = decide(stepped, calibration, policy).action
    _, true = true_action(found, other)
    assert (difference(other, true) < (1e-6, 1.5, 0.7)).all()


@pytest.fixture(scope="module")
def scene(rendering: None) -> Rendered:
    return rendered(1501, "!ShapeMatching {}")


def test_recovers_by_the_stages_of_the_cell(weights_file: Path):
    few: dict[str, Any] = {"orientations": 36, "recover": True}
    here = load_policy(weights_file, **few).loaded.function
    parameters = PickPlaceParameters()
    there = load_learned_policy(weights_file, parameters, insertion=True, **few).function
    assert here._stages == there._stages
    assert any(isinstance(stage, Recovery) for stage in here._stages)


@pytest.mark.slow
@pytest.mark.parametrize("high", [0.008, 0.04])
def test_recovers_when_the_cell_does(high: float, scene: Rendered):
    """A slightly protruding tool is pressed; one that protrudes more is taken out at the end."""
    seen = scene.observation
    fixture = segment(seen).fixture
    rows, cols = np.nonzero(fixture)
    image = seen.image.copy()
    top = float(np.median(seen.height[fixture]))
    row, col = int(rows.mean()), cols.min() + 3
    image[3, row : row + 4, col : col + 26] = top + high
    seen = dataclasses.replace(seen, image=image, edge_height=None)
    assert recovery_action(Inventory.of(seen), PickPlaceParameters()) is not None
    # Few orientations are faster.
    few: dict[str, Any] = {"orientations": 36, "recover": True}
    cells = load_learned_policy(None, PickPlaceParameters(), insertion=True, **few)
    chosen = next(load_policy(**few, least_confidence=0.0).choices(seen))
    assert chosen.action == next(choose_by_networks(cells, 0.0)(seen, ())).action
    assert chosen.action.press == (high < 0.01)
    assert (chosen.confidence is None) == chosen.action.press


@pytest.mark.usefixtures("rendering")
@pytest.mark.parametrize("seed", [1503])
def test_decisions_on_files_equal_those_in_the_cell(seed: int, tmp_path: Path):
    # Few orientations are faster.
    check_against_cell(seed, tmp_path, orientations=36)


@pytest.mark.slow
@pytest.mark.usefixtures("rendering")
@pytest.mark.parametrize("seed", range(1500, 1520))
def test_decisions_on_twenty_scenes_equal_those_in_the_cell(seed: int, tmp_path: Path):
    check_against_cell(seed, tmp_path)


def test_shape_matching_equals_that_in_the_cell(scene: Rendered):
    decision = decide(scene.frames, scene.calibration, ShapeMatching())
    assert decision.action == scene.action
    record = decision.as_dict()
    assert not record["stop"]
    assert 0 < record["confidence"] <= 1
    heights = [record["pick"]["z"], record["pick"]["hover_z"], record["travel"]["empty_z"]]
    assert heights == sorted(heights)
    place = record["place"]
    assert place["lowest_z"] <= place["z"] < place["hover_z"]
    # A failed grasp is not repeated.
    second = decide(scene.frames, scene.calibration, ShapeMatching(), [decision.action.pick])
    assert difference(second.action, decision.action)[0] > 9
    with Image.open(io.BytesIO(decision.draw())) as picture:
        assert picture.format == "PNG"


def test_a_higher_table_raises_the_action(scene: Rendered):
    """In a base frame whose origin is 0.3 m below the table, the same action is 0.3 m higher."""
    calibration = scene.calibration
    raised = dataclasses.replace(
        calibration,
        grid=dataclasses.replace(calibration.grid, z_min=0.3, z_max=calibration.grid.z_max + 0.3),
        cameras=tuple(
            dataclasses.replace(
                camera, X_BC=camera.X_BC + 0.3 * np.outer([0, 0, 1, 0], [0, 0, 0, 1])
            )
            for camera in calibration.cameras
        ),
    )
    low = decide(scene.frames, calibration, ShapeMatching()).as_dict()
    high = decide(scene.frames, raised, ShapeMatching()).as_dict()
    for part, key in (("pick", "z"), ("pick", "hover_z"), ("place", "z"), ("place", "lowest_z")):
        assert high[part][key] == pytest.approx(low[part][key] + 0.3, abs=1e-5)
    assert high["pick"]["x"] == pytest.approx(low["pick"]["x"], abs=1e-4)


# The command without Drake.

_NO_DRAKE = """
import runpy, sys
sys.modules["pydrake"] = None
sys.argv[0] = "decide"
try:
    runpy.run_module("kitting_drake.decide", run_name="__main__")
finally:
    print("torch" in sys.modules, file=sys.stderr)
"""


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = write_frames(tmp_path_factory.mktemp("bench"), cast(TRUE, BLOCK))
    write_calibration(folder / "calibration.yaml", TRUE)
    return folder


@pytest.fixture
def bench(written: Path, tmp_path: Path) -> Path:
    """A folder with frames of a block on a table, and their calibration."""
    return shutil.copytree(written, tmp_path, dirs_exist_ok=True)


@pytest.fixture
def refusal(bench: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., str]:
    """A function that runs `decide` in this process, expects it to fail, and returns the error."""

    def run(*flags: object) -> str:
        arguments = [bench, "--camera", bench / "calibration.yaml", "--output", bench / "out"]
        monkeypatch.setattr(sys, "argv", ["decide", *map(str, [*arguments, *flags])])
        with pytest.raises(UserError) as raised:
            decide_command.main()
        return str(raised.value)

    return run


def command(bench: Path, *flags: object) -> subprocess.CompletedProcess[str]:
    """Decides on the frames of a folder in a process without Drake."""
    arguments = [bench, "--camera", bench / "calibration.yaml", "--output", bench / "out"]
    return run_without_drake(*arguments, *flags)


def run_without_drake(*arguments: object) -> subprocess.CompletedProcess[str]:
    """Runs `decide` in a process without Drake. Stderr ends with whether torch was loaded."""
    return subprocess.run(
        [sys.executable, "-c", _NO_DRAKE, *map(str, arguments)],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=300,
    )


def test_the_command_stops_where_nothing_fits(bench: Path, verb: Verb):
    arguments = [bench, "--camera", bench / "calibration.yaml", "--output", bench / "out"]
    done = verb("decide", *arguments, "--shape_matching")
    assert done.returncode == 0, done.stderr
    record = json.loads((bench / "out" / "action.json").read_text())
    assert record["stop"] is True
    assert "pick" not in record
    assert (bench / "out" / "decision.png").stat().st_size > 10_000


SAMPLE = ROOT / "models" / "sample_frame"


def test_writes_the_trajectory_of_a_robot_or_says_what_is_out_of_reach(tmp_path: Path, verb: Verb):
    """The first decision is made by a process that loads neither Drake nor torch."""
    robot, out = tmp_path / "robot.yaml", tmp_path / "out"
    arguments = [SAMPLE, "--camera", SAMPLE / "calibration.yaml", "--output", out]
    arguments += ["--shape_matching", "--robot", robot, "--rate", 500]
    robot.write_text("{model: fr3, base: [0, 0, 0]}")
    done = run_without_drake(*arguments)
    assert (done.returncode, done.stderr.strip()) == (0, "False"), done.stderr
    record = json.loads((out / "action.json").read_text())
    assert record["result"] == "pick and place"
    content = json.loads((tmp_path / "out" / record["trajectory"]).read_text())
    message = content["joint_trajectory"]
    assert message["joint_names"] == [f"fr3_joint{number}" for number in range(1, 8)]
    assert set(message["points"][0]) == {
        *("positions", "velocities", "accelerations", "time_from_start")
    }
    assert message["points"][501]["time_from_start"] == {"sec": 1, "nanosec": 2_000_000}
    assert max(content["limits_used"].values()) <= 1.0
    assert [it["name"] for it in content["segments"] if it["guarded"]] == ["descend", "lower"]
    rows = (tmp_path / "out" / "trajectory.csv").read_text().splitlines()
    assert len(rows) == 1 + len(message["points"])
    assert rows[0].startswith("time_from_start,position_fr3_joint1,")
    # If the arm cannot reach the pick, no trajectory is written.
    robot.write_text("{base: [-0.3, 0.9, 0], home: [-0.3, 0.5, 0.4, 0]}")
    assert verb("decide", *arguments).returncode == 0
    record = json.loads((out / "action.json").read_text())
    assert (record["result"], record["stop"]) == ("not sure", True)
    assert re.match(r"the pick at \(0.480, 0.22\d\) m is out of the arm's reach", record["reason"])
    assert {path.name for path in (tmp_path / "out").iterdir()} == {"action.json", "decision.png"}


@pytest.mark.slow
def test_networks_need_no_drake(tmp_path: Path, weights_file: Path):
    # Networks act only if they see a kit. Untrained ones are not sure, so allow any confidence.
    bench = shutil.copytree(SAMPLE, tmp_path / "bench")
    flags = ("--orientations", 36, "--least_confidence", 0)
    done = command(bench, "--weights", weights_file, *flags)
    assert (done.returncode, done.stderr.strip()) == (0, "True"), done.stderr
    record = json.loads((bench / "out" / "action.json").read_text())
    assert set(record["pick"]) == {"x", "y", "z", "yaw", "jaw_opening", "hover_z"}
    assert 0 <= record["confidence"] <= 1


@pytest.mark.slow
def test_the_check_needs_no_drake(bench: Path):
    done = command(bench, "--check", "--kit_size_mm", 200, 150, 50)
    assert (done.returncode, done.stderr.strip()) == (0, "False"), done.stderr
    record = json.loads((bench / "out" / "check.json").read_text())
    for camera in record["cameras"].values():
        assert camera["tilt_deg"] < 0.01
        assert camera["block"]["scale"] == pytest.approx([1, 1, 1], abs=0.01)
    assert "noise" in done.stdout
    read_calibration(bench / "out" / "corrected.yaml")


@pytest.mark.parametrize(
    ("pose", "message"),
    [
        ((0.5, "nan", 0), "--kit_pose takes three finite numbers"),
        ((500, 0, 0), r"--kit_pose: \(500, 0\) m is outside the workspace"),
        ((0.5, 0, 90), "--kit_pose: the yaw 90"),
    ],
)
def test_an_invalid_block_is_refused(pose: tuple, message: str, refusal: Callable[..., str]):
    flags = ("--check", "--kit_size_mm", 200, 150, 50, "--kit_pose", *pose)
    assert re.match(message, refusal(*flags))


def test_invalid_input_prints_one_line(bench: Path, verb: Verb):
    arguments = [bench, "--camera", bench / "calibration.yaml", "--output", bench / "out"]
    (bench / "left_depth.npy").unlink()
    (bench / "out").mkdir()
    (bench / "out" / "action.json").write_text('{"policy": "generalist", "seconds": 0.3}')
    (bench / "out" / "check.json").write_text("{}")
    assert verb("decide", *arguments, "--check").returncode == 2
    assert [path.name for path in (bench / "out").iterdir()] == ["action.json"]
    done = verb("decide", *arguments, "--shape_matching")
    # The action of an earlier frame is removed.
    assert not list((bench / "out").iterdir())
    assert done.returncode == 2
    assert done.stderr.startswith("error: camera left: ")
    assert "neither left_depth.npy nor" in done.stderr
    assert "Traceback" not in done.stderr


def test_does_not_overwrite_the_action_of_a_demonstration(bench: Path, refusal: Callable[..., str]):
    (bench / "out").mkdir()
    kept = bench / "out" / "action.json"
    for text in ('{"pick": {}, "place": {}, "object": "hammer"}', "{", "[]"):
        kept.write_text(text)
        sentence = refusal("--shape_matching")
        assert "action.json was not written by decide" in sentence
        assert kept.read_text() == text


@pytest.mark.parametrize("flags", [("--orientations", 36), ("--no_outlines",)])
def test_flags_of_networks_exclude_shape_matching(refusal: Callable[..., str], flags: tuple):
    sentence = refusal("--shape_matching", *flags)
    assert sentence.startswith(f"{flags[0]} cannot be combined with --shape_matching")


@pytest.mark.parametrize(
    ("flags", "sentence"),
    [
        (("--rate", 500), "--rate needs --robot"),
        (("--robot", "robot.yaml", "--check"), "--robot cannot be combined with --check"),
    ],
)
def test_flags_of_robots(flags: tuple, sentence: str, refusal: Callable[..., str]):
    assert refusal(*flags) == sentence


# Invalid frames.


def spoil(change: Callable[[np.ndarray], np.ndarray]) -> Callable[[Path], None]:
    def apply(folder: Path) -> None:
        path = folder / "front_depth.npy"
        np.save(path, change(np.load(path)))

    return apply


def as_png(scale: float) -> Callable[[Path], None]:
    def apply(folder: Path) -> None:
        depth = np.load(folder / "front_depth.npy")
        (folder / "front_depth.npy").unlink()
        Image.fromarray(np.rint(scale * depth).astype(np.uint16)).save(folder / "front_depth.png")

    return apply


def small_colour(folder: Path) -> None:
    Image.new("RGB", (320, 240)).save(folder / "front_color.png")


def archive(folder: Path) -> None:
    with (folder / "front_depth.npy").open("wb") as file:
        np.savez(file, depth=np.ones((480, 640)))


def broken(folder: Path) -> None:
    (folder / "front_depth.npy").write_bytes(b"not numbers")


def broken_header(folder: Path) -> None:
    path = folder / "front_depth.npy"
    path.write_bytes(path.read_bytes().replace(b"{'descr'", b"{('descr'", 1))


def broken_chunk(folder: Path) -> None:
    """A PNG whose second chunk is damaged, as by a faulty disk."""
    path = folder / "front_color.png"
    image = np.random.default_rng(0).integers(0, 255, (480, 640, 3), np.uint8)
    Image.fromarray(image).save(path)
    content = bytearray(path.read_bytes())
    second = content.index(b"IDAT", content.index(b"IDAT") + 4)
    content[second : second + 4] = b"\x00\x01\x02\x03"
    path.write_bytes(bytes(content))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (broken_header, "npy file of numbers"),
        (broken_chunk, "front_color.png is damaged: broken PNG file"),
        (spoil(lambda depth: depth[:240]), "is 640x240 pixels, but .* calibrated at 640x480"),
        (small_colour, "front_color.png is 320x240 pixels"),
        (spoil(lambda depth: np.dstack([depth] * 3)), "must have one channel, not 3"),
        (broken, "npy file of numbers"),
        (archive, r"is an archive of arrays \(.npz\)"),
    ],
)
def test_invalid_frames_are_refused(bench: Path, change: Callable[[Path], None], message: str):
    change(bench)
    with pytest.raises(UserError, match=message) as raised:
        decide(read_frames([bench], TRUE), TRUE, ShapeMatching())
    assert "\n" not in str(raised.value)


def test_a_frame_with_a_channel_axis_is_refused():
    """Depth images of Drake have a last axis of one channel."""
    frames = cast(TRUE)
    frames["left"] = Frame(frames["left"].color, frames["left"].depth[..., None])
    with pytest.raises(UserError, match=r"the shape \(height, width\), not \(480, 640, 1\)"):
        decide(frames, TRUE, ShapeMatching())


def test_depths_of_32_bits_do_not_overflow(tmp_path: Path):
    front = Calibration((dataclasses.replace(TRUE.cameras[0], depth_scale=1e-5),), TRUE.grid)
    frames = cast(front)
    write_frames(tmp_path, frames)
    (tmp_path / "front_depth.npy").unlink()
    steps = np.rint(1e5 * frames["front"].depth).astype(np.int32)
    assert steps.max() > 2**16
    Image.fromarray(steps).save(tmp_path / "front_depth.png", "TIFF")
    found = read_frames([tmp_path], front)["front"].depth
    np.testing.assert_allclose(found, frames["front"].depth, atol=1e-5)


@pytest.mark.parametrize(
    ("camera", "grid", "message"),
    [
        ({"max_depth": 0.3}, {}, "no depth is between its min_depth 0.01 and max_depth 0.3"),
        ({}, {"rows": 1, "cols": 1}, "the workspace is too small"),
    ],
)
def test_frames_without_usable_depth_are_refused(
    camera: dict[str, float], grid: dict[str, int], message: str
):
    cameras = (dataclasses.replace(TRUE.cameras[0], **camera), *TRUE.cameras[1:])
    blind = Calibration(cameras, dataclasses.replace(TRUE.grid, **grid))
    decision = decide(cast(TRUE), blind, ShapeMatching())
    assert decision.result == "calibration" and message in decision.reason


def test_missing_depths_are_unseen_pixels():
    """Cameras mark missing depth as zero or NaN."""
    front = Calibration(TRUE.cameras[:1], TRUE.grid)
    frames = cast(front, BLOCK)
    depth = frames["front"].depth.copy()
    depth[300:320], depth[320:340] = 0, np.nan
    seen = decide({"front": Frame(frames["front"].color, depth)}, front, ShapeMatching())
    whole = decide(frames, front, ShapeMatching())
    assert 500 < (whole.observation.valid & ~seen.observation.valid).sum() < 12000


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (spoil(lambda depth: 1000 * depth), "seem to be millimetres"),
        (as_png(1.0), "seem to be metres"),
        (as_png(4000.0), "depth_scale: 0.00025 would agree"),
        (spoil(lambda depth: 0 * depth), "depth of camera front is zero or NaN"),
        (spoil(lambda depth: np.nan * depth), "depth of camera front is zero or NaN"),
    ],
)
def test_implausible_depths_are_no_action(
    bench: Path, change: Callable[[Path], None], message: str
):
    change(bench)
    decision = decide(read_frames([bench], TRUE), TRUE, ShapeMatching())
    assert decision.result == "calibration" and decision.action.stop
    assert message in decision.reason and "\n" not in decision.reason


def test_a_mostly_unseen_table_is_refused():
    front = Calibration(TRUE.cameras[:1], TRUE.grid)
    color, depth = (getattr(cast(front)["front"], name).copy() for name in ("color", "depth"))
    assert decide({"front": Frame(color, depth)}, front, ShapeMatching()).action.stop
    depth[:, 200:] = 0
    decision = decide({"front": Frame(color, depth)}, front, ShapeMatching())
    assert decision.result == "not seen" and "of the pixels in view are measured" in decision.reason


def test_a_near_camera_that_sees_mostly_a_kit_is_accepted():
    down = dataclasses.replace(
        TRUE.cameras[0],
        X_BC=np.array([[0.0, -1, 0, 0.5], [-1, 0, 0, 0], [0, 0, -1, 0.3], [0, 0, 0, 1]]),
    )
    near = Calibration((down,), TRUE.grid)
    frames = cast(near, Block((0.24, 0.22, 0.05), (0.5, 0.0, 0.0)))
    # The kit occludes part of the table.
    assert decide(frames, near, ShapeMatching()).seen > 0.8


def turned(camera: str, X: np.ndarray) -> Calibration:
    cameras = tuple(
        dataclasses.replace(item, X_BC=X) if item.name == camera else item for item in TRUE.cameras
    )
    return dataclasses.replace(TRUE, cameras=cameras)


FRONT = TRUE.cameras[0].X_BC
AWAY = FRONT @ np.diag([1.0, -1, -1, 1])
OPTICAL = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
STEEP = camera_pose(LookAt(position=[1.2, 0, 0.6], target=[0.5, 0, 0])).GetAsMatrix4()
ASIDE = FRONT + np.outer([0, 1, 0, 0], [0, 0, 0, 3.0])


@pytest.mark.parametrize(
    ("pose", "message"),
    [
        (AWAY, "looks upwards"),
        (ASIDE, r"looks at \(0.25, 3.00\) m on the table"),
        (np.linalg.inv(STEEP), "is it the pose of the base in the camera"),
        (np.linalg.inv(TRUE.cameras[1].X_BC), "the rotation of the pose is wrong by"),
        (FRONT @ np.linalg.inv(OPTICAL), "give that of the optical frame"),
        (FRONT - np.outer([0, 0, 1, 0], [0, 0, 0, 1.0]), "below the table"),
    ],
)
def test_a_camera_with_a_wrong_pose_is_refused(pose: np.ndarray, message: str):
    decision = decide(cast(TRUE), turned("front", pose), ShapeMatching())
    assert decision.result == "calibration" and decision.action.stop
    assert re.search(f"camera front .*{message}", decision.reason)


def test_frames_may_be_pairs_of_files(bench: Path):
    names = ("front", "left", "right")
    files = [bench / f"{name}_{what}" for name in names for what in ("depth.npy", "color.png")]
    found = read_frames(files, TRUE)
    np.testing.assert_array_equal(found["left"].depth, np.load(bench / "left_depth.npy"))
    with pytest.raises(UserError, match="has 3 cameras"):
        read_frames(files[:2], TRUE)
    with pytest.raises(UserError, match="are both colour"):
        read_frames([files[1]] * 6, TRUE)
    with pytest.raises(UserError, match="there is no file"):
        read_frames([bench / "nowhere"], TRUE)


def test_without_outlines_the_networks_certainty_counts(scene: Rendered):
    """The confidence is then the product of the networks' probabilities.

    Without `least_confidence`, no decision is refused.
    """
    (found,) = load_policy(fit_outlines=False, orientations=36).choices(scene.observation)
    assert not found.action.stop
    assert found.confidence == pytest.approx(np.prod(list(found.parts.values())))
    (strict,) = load_policy(fit_outlines=False, orientations=36, least_confidence=0.999).choices(
        scene.observation
    )
    assert strict.action.stop and strict.action.reason == "not sure"
    # Other objects are not known, so no other pick is proposed.
    assert strict.confidence == found.confidence


UNSURE, SURE, STOP, PRESS = "unsure", "sure", "stop", "press"


@pytest.mark.parametrize(
    ("proposed", "answers"),
    [
        ([SURE, UNSURE], [0]),
        ([UNSURE, SURE], [1]),
        ([UNSURE, UNSURE, SURE], [2]),
        ([SURE, UNSURE, SURE], [0, 2]),
        ([SURE, UNSURE, UNSURE, SURE], [0]),
        ([SURE, PRESS], [0]),
        ([UNSURE, UNSURE, UNSURE, SURE], []),
        ([UNSURE, STOP], []),
        ([UNSURE, PRESS], []),
        ([STOP], [0]),
        ([PRESS, SURE], [0]),
    ],
)
def test_another_object_is_proposed_if_the_first_is_unsure(
    proposed: list[str], answers: list[int], monkeypatch: pytest.MonkeyPatch
):
    """If none is sure, the answer is a refusal with the highest confidence. A stop, or an action
    without a confidence, is an answer only if it comes first."""
    (good,) = ShapeMatchingPolicy(PickPlaceParameters()).proposals(kit_and_bar(None))
    assert good.geometry is not None
    poor = good.geometry | {"fit": 2.0, "cost": 5.0, "reverse": 5.0}
    made = []
    for number, kind in enumerate(proposed):
        action = dataclasses.replace(
            good.action, pick=PlanarPose(0.01 * number), stop=kind == STOP, press=kind == PRESS
        )
        facts = {UNSURE: poor, SURE: good.geometry}.get(kind)
        made.append(Matched(action, facts))
    monkeypatch.setattr(ShapeMatchingPolicy, "proposals", lambda *arguments: iter(made))
    chosen = list(ShapeMatching().choices(kit_and_bar(None)))
    if not answers:
        (refusal,) = chosen
        assert refusal.action == PickPlaceAction(stop=True, reason="not sure")
        assert refusal.confidence is not None and refusal.confidence < 0.9
    else:
        assert [item.action for item in chosen] == [made[number].action for number in answers]


@dataclasses.dataclass(frozen=True)
class Offers:
    """A policy that is sure of several picks, with the same place."""

    picks: tuple[PlanarPose, ...]
    name = "offers"

    def check_grid(self, grid: PixelGrid) -> None:
        pass

    def choices(
        self, observation: Observation, failed_picks: Sequence[PlanarPose] = ()
    ) -> Iterator[Choice]:
        for pick in self.picks:
            yield Choice(PickPlaceAction(pick, PlanarPose(0.5, 0.1)), 0.95)


def test_the_robot_acts_on_the_first_object_that_it_reaches(scene: Rendered):
    far, near = PlanarPose(0.5, 2.0), PlanarPose(0.5, -0.1)
    arguments = cast(TRUE), TRUE
    decision = decide(*arguments, Offers((far, near, PlanarPose(0.4))), robot=BenchRobot())
    assert decision.result == "pick and place" and decision.action.pick == near
    assert decision.trajectory is not None
    decision = decide(*arguments, Offers((far, far)), robot=BenchRobot())
    assert decision.result == "not sure" and "reach" in decision.reason
    assert decision.action.stop and decision.trajectory is None
    assert decide(*arguments, Offers((far, near))).action.pick == far


def test_networks_need_their_own_pixel_size(weights_file: Path):
    coarse = dataclasses.replace(TRUE, grid=dataclasses.replace(TRUE.grid, resolution=0.004))
    policy = load_policy(weights_file, orientations=36)
    with pytest.raises(UserError, match=r"workspace\.resolution is 0.004 m"):
        decide(cast(TRUE), coarse, policy)
