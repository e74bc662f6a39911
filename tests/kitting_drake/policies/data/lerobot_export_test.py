"""Frames as a LeRobotDataset: read back by pyarrow and by LeRobot itself.

LeRobot needs other versions of numpy and torch than this project, and therefore its own
environment: KITTING_LEROBOT_PYTHON is the path of its interpreter.
"""

import io
import json
import os
import subprocess
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from kitting_drake.common.errors import UserError
from kitting_drake.policies.data import lerobot_export
from kitting_drake.policies.data.frames import (
    EpisodeFrames,
    FrameSettings,
    encode_png,
    read_frames,
    reduce_image,
)
from kitting_drake.policies.data.lerobot_export import export_lerobot, require_export

NAMES = ("x", "y", "z", "yaw", "gripper")
LENGTHS = [4, 2, 3]
IMAGE = "observation.images.front"
LEROBOT = os.environ.get("KITTING_LEROBOT_PYTHON")


@pytest.fixture
def parquet() -> ModuleType:
    """`pyarrow.parquet`; skips the test if it is not installed."""
    pytest.importorskip("pyarrow", exc_type=ImportError)
    return pytest.importorskip("pyarrow.parquet")


def pictures(seed: int, count: int) -> NDArray[np.uint8]:
    return np.random.default_rng(seed).integers(0, 256, (count, 6, 8, 3), np.uint8)


def frames(seed: int, count: int) -> EpisodeFrames:
    rng = np.random.default_rng(seed)
    return EpisodeFrames(
        seed=seed,
        fps=16,
        names=NAMES,
        state=rng.random((count, 5), np.float32),
        action=rng.random((count, 5), np.float32),
        reward=rng.random(count, np.float32),
        success=np.arange(count) == count - 1,
        images={"front": [encode_png(image) for image in pictures(seed, count)]},
    )


@pytest.fixture
def sources(tmp_path: Path) -> list[Path]:
    paths = []
    for seed, count in enumerate(LENGTHS):
        paths.append(tmp_path / f"seed_{seed}.npz")
        frames(seed, count).save(paths[-1])
    return paths


def expected() -> dict[str, NDArray[Any]]:
    """The frames that the dataset must hold, computed independently of the tested code."""
    episodes = [frames(seed, count) for seed, count in enumerate(LENGTHS)]
    return {
        "image": np.concatenate([pictures(seed, count) for seed, count in enumerate(LENGTHS)]),
        "state": np.concatenate([item.state for item in episodes]),
        "action": np.concatenate([item.action for item in episodes]),
        "frame_index": np.concatenate([np.arange(count) for count in LENGTHS]),
        "episode_index": np.repeat(np.arange(len(LENGTHS)), LENGTHS),
        "index": np.arange(sum(LENGTHS)),
        "next.reward": np.concatenate([item.reward for item in episodes]),
        "next.done": np.concatenate([np.arange(n) == n - 1 for n in LENGTHS]),
    }


def test_frames_are_read_as_they_were_saved(tmp_path: Path):
    saved = frames(5, 4)
    saved.save(tmp_path / "frames.npz")
    read = read_frames(tmp_path / "frames.npz")
    assert read.images == saved.images
    assert (read.seed, read.fps, read.names) == (5, 16, NAMES)
    for name in ("state", "action", "reward", "success"):
        np.testing.assert_array_equal(getattr(read, name), getattr(saved, name))
    (tmp_path / "frames.npz").write_bytes(b"PK")
    with pytest.raises(UserError, match="is damaged"):
        read_frames(tmp_path / "frames.npz")


def test_images_are_reduced_but_never_enlarged():
    image = np.zeros((480, 640, 3), np.uint8)
    image[:4, :4] = 100
    small = reduce_image(image, FrameSettings(width=160))
    assert small.shape == (120, 160, 3)
    assert (small[0, 0] == 100).all() and not small[1:].any()
    assert reduce_image(small, FrameSettings(width=640)) is small
    with pytest.raises(UserError, match="fps is 5: use 10 to 30"):
        FrameSettings(fps=5)


def test_all_frames_are_in_the_files(sources: list[Path], tmp_path: Path, parquet: ModuleType):
    folder = tmp_path / "lerobot"
    export_lerobot(sources, folder, "kit", robot="FloatingHand", about={"episode_seeds": [0, 1, 2]})
    assert sorted(str(p.relative_to(folder)) for p in folder.rglob("*") if p.is_file()) == [
        "data/chunk-000/file-000.parquet",
        "meta/episodes/chunk-000/file-000.parquet",
        "meta/info.json",
        "meta/kitting_drake.json",
        "meta/stats.json",
        "meta/tasks.parquet",
    ]
    table = parquet.read_table(folder / "data/chunk-000/file-000.parquet")
    info = json.loads((folder / "meta/info.json").read_text())
    assert table.column_names == list(info["features"])
    assert str(table.schema.field("action").type) == "fixed_size_list<element: float>[5]"
    truth = expected()
    for index, row in enumerate(table.to_pylist()):
        image = np.asarray(Image.open(io.BytesIO(row[IMAGE]["bytes"])))
        np.testing.assert_array_equal(image, truth["image"][index])
        np.testing.assert_array_equal(np.float32(row["action"]), truth["action"][index])
        np.testing.assert_array_equal(np.float32(row["observation.state"]), truth["state"][index])
        for name in ("next.reward", "next.done", "frame_index", "episode_index", "index"):
            assert row[name] == truth[name][index], name
        assert row["timestamp"] == row["frame_index"] / 16
        assert row["task_index"] == 0
    assert (info["codebase_version"], info["fps"]) == ("v3.0", 16)
    assert (info["total_episodes"], info["total_frames"], info["total_tasks"]) == (3, 9, 1)
    assert info["robot_type"] == "FloatingHand"
    assert info["features"][IMAGE]["shape"] == [6, 8, 3]
    assert info["features"]["action"]["names"] == list(NAMES)
    episodes = parquet.read_table(folder / "meta/episodes/chunk-000/file-000.parquet").to_pylist()
    assert [item["length"] for item in episodes] == LENGTHS
    assert [item["dataset_to_index"] for item in episodes] == [4, 6, 9]
    tasks = parquet.read_table(folder / "meta/tasks.parquet")
    assert tasks.to_pylist() == [{"task_index": 0, "task": "kit"}]
    assert tasks.schema.pandas_metadata["index_columns"] == ["task"]
    record = json.loads((folder / "meta/kitting_drake.json").read_text())
    assert record["episode_seeds"] == [0, 1, 2]


def test_the_statistics(sources: list[Path], tmp_path: Path, parquet: ModuleType):
    folder = tmp_path / "lerobot"
    export_lerobot(sources, folder, "kit")
    found = json.loads((folder / "meta/stats.json").read_text())
    truth = expected()
    samples = {
        IMAGE: truth["image"].reshape(-1, 3) / 255,
        "observation.state": truth["state"].astype(float),
        "action": truth["action"].astype(float),
    }
    for name, values in samples.items():
        assert found[name]["count"] == [9]
        for key in ("min", "max", "mean", "std"):
            shape = (-1, 1, 1) if "image" in name else (-1,)
            wanted = getattr(values, key)(axis=0).reshape(shape)
            np.testing.assert_allclose(found[name][key], wanted, rtol=1e-9, atol=1e-12)


def test_many_frames_are_split_into_files(
    sources: list[Path], tmp_path: Path, parquet: ModuleType, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(lerobot_export, "_MEGABYTES", 1e-6)
    monkeypatch.setattr(lerobot_export, "_FILES_PER_CHUNK", 2)
    folder = tmp_path / "lerobot"
    export_lerobot(sources, folder, "kit")
    files = sorted(folder.glob("data/*/*"))
    assert [str(item.relative_to(folder / "data")) for item in files] == [
        "chunk-000/file-000.parquet",
        "chunk-000/file-001.parquet",
        "chunk-001/file-000.parquet",
    ]
    assert [parquet.read_table(item).num_rows for item in files] == LENGTHS


def test_an_existing_export_is_kept_and_other_folders_are_not_overwritten(
    sources: list[Path], tmp_path: Path, parquet: ModuleType
):
    folder = tmp_path / "lerobot"
    export_lerobot(sources, folder, "stack them")
    before = folder.stat()
    export_lerobot(sources, folder, "stack them")
    assert folder.stat() == before
    for others, task in ((sources[:2], "stack them"), (sources, "kit them")):
        with pytest.raises(UserError, match="lerobot exists but"):
            export_lerobot(others, folder, task)
    with pytest.raises(UserError, match="lerobot already exists"):
        require_export(folder)
    require_export(tmp_path / "other")


def test_a_stopped_export_leaves_nothing(
    sources: list[Path], tmp_path: Path, parquet: ModuleType, monkeypatch: pytest.MonkeyPatch
):
    def stop(*_: object) -> None:
        raise KeyboardInterrupt

    scratch = tmp_path / ".lerobot.scratch" / "data"
    scratch.mkdir(parents=True)
    (scratch / "of_a_killed_process").touch()
    with monkeypatch.context() as patch:
        patch.setattr(lerobot_export, "_write_tasks", stop)
        with pytest.raises(KeyboardInterrupt):
            export_lerobot(sources, tmp_path / "lerobot", "kit")
    assert sorted(tmp_path.iterdir()) == sources
    export_lerobot(sources, tmp_path / "lerobot", "kit")
    assert not list(tmp_path.rglob("of_a_killed_process"))


def test_impossible_exports_raise_user_errors(
    sources: list[Path], tmp_path: Path, parquet: ModuleType
):
    with pytest.raises(UserError, match="no episodes"):
        export_lerobot([], tmp_path / "lerobot", "kit")
    with pytest.raises(UserError, match=r"cannot write .*Not a directory"):
        export_lerobot(sources, sources[0] / "lerobot", "kit")
    other = frames(9, 2)
    other.fps = 20
    other.save(tmp_path / "other.npz")
    with pytest.raises(UserError, match=r"other\.npz: fps is 20, but 16 in the first episode"):
        export_lerobot([*sources, tmp_path / "other.npz"], tmp_path / "lerobot", "kit")


def test_without_pyarrow_the_error_names_the_package(
    sources: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    # None in sys.modules makes the import fail.
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    calls = (
        lambda: require_export(tmp_path),
        lambda: export_lerobot(sources, tmp_path / "x", "kit"),
    )
    for call in calls:
        with pytest.raises(UserError, match=r"package pyarrow: pip install .pyarrow"):
            call()


@pytest.mark.skipif(not LEROBOT, reason="KITTING_LEROBOT_PYTHON is not set")
def test_lerobot_reads_what_was_written(sources: list[Path], tmp_path: Path, parquet: ModuleType):
    export_lerobot(sources, tmp_path / "lerobot", "kit")
    np.savez(tmp_path / "expected.npz", **expected())
    reader = Path(__file__).parents[1] / "lerobot_reader.py"
    done = subprocess.run(
        [str(LEROBOT), str(reader), str(tmp_path / "lerobot"), str(tmp_path / "expected.npz")],
        # Neither the Hub nor this project's packages may be used.
        env={"PATH": os.environ["PATH"], "HF_HUB_OFFLINE": "1", "HF_HOME": str(tmp_path / "hub")},
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == 0, done.stderr
    result = json.loads(done.stdout.splitlines()[-1])
    assert (result["frames"], result["episodes"], result["fps"]) == (9, 3, 16)
    assert set(result["differences"].values()) == {0}, result
    assert result["statistics_difference"] < 1e-6
    assert result["second_episode"] == [4, 5]
    # ACT and diffusion policies read actions in chunks. No value of the chunks is wrong.
    assert result["next_actions"] == 0
