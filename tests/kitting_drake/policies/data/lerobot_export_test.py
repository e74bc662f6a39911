"""Demonstrations as a LeRobotDataset: all frames read back by pyarrow and by LeRobot itself.

LeRobot needs other versions of numpy and torch than this project, and therefore its own
environment: KITTING_LEROBOT_PYTHON is the path of its interpreter.
"""

import dataclasses
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
from kitting_drake.policies.data.demonstrations import Demonstration, Origin, write_demonstrations
from kitting_drake.policies.data.lerobot_export import (
    ACTION,
    COLOUR,
    HEIGHT,
    export_lerobot,
    require_export,
)
from kitting_drake.policies.data.recorded import DemonstrationStep, FinalObservation
from systems.signals import Observation, PickPlaceAction, PixelGrid, PlanarPose

GRID = PixelGrid(rows=5, cols=7)
ORIGIN = Origin("mine", {"task": {"_tag": "!StackBlockPyramid"}}, GRID, 10, {"drake": "1.51.1"})
LEROBOT = os.environ.get("KITTING_LEROBOT_PYTHON")


@pytest.fixture
def parquet() -> ModuleType:
    """`pyarrow.parquet`; skips the test if it is not installed."""
    pytest.importorskip("pyarrow", exc_type=ImportError)
    return pytest.importorskip("pyarrow.parquet")


def observation(rng: np.random.Generator) -> Observation:
    image = rng.random((4, *GRID.shape), np.float32)
    # Values that a 16-bit image or millimetres would lose.
    image[3, 0] = np.array([0.0, -0.0, 1e-40, 1e-30, 0.05 + 1e-8, -1e-4, 123.4], np.float32)
    return Observation(image, GRID)


def demonstration(seed: int, steps: int, *, final: bool) -> Demonstration:
    rng = np.random.default_rng(seed)
    return Demonstration(
        seed,
        1.0,
        tuple(
            DemonstrationStep.of(
                observation(rng),
                PickPlaceAction(PlanarPose(*rng.random(3)), PlanarPose(*rng.random(3) * 4)),
                name=f"wrench_{number}",
                category="wrench",
            )
            for number in range(steps)
        ),
        FinalObservation.of(observation(rng)) if final else None,
    )


EPISODES = (
    demonstration(10, 3, final=True),
    demonstration(12, 2, final=False),
    demonstration(13, 1, final=True),
)
LENGTHS = [4, 2, 2]


@pytest.fixture
def source(tmp_path: Path) -> Path:
    path = tmp_path / "demonstrations.h5"
    write_demonstrations(path, ORIGIN, EPISODES)
    return path


def expected() -> dict[str, NDArray[Any]]:
    """The frames, computed independently of the tested code."""
    rows: list[dict[str, Any]] = []
    for number, episode in enumerate(EPISODES):
        last = [episode.final] if episode.final else []
        for index, seen in enumerate([*episode.steps, *last]):
            stops = index == len(episode.steps)
            step = episode.steps[-1] if stops else episode.steps[index]
            rows.append(
                {
                    "colour": np.asarray(seen.rgb),
                    "height": np.asarray(seen.height)[None],
                    "action": np.array(
                        [*step.pick.as_array(), *step.place.as_array(), stops], np.float32
                    ),
                    "object": "" if stops else step.object,
                    "category": "" if stops else "wrench",
                    "next.done": index == LENGTHS[number] - 1,
                    "frame_index": index,
                    "episode_index": number,
                    "index": len(rows),
                }
            )
    columns = {name: np.stack([row[name] for row in rows]) for name in rows[0]}
    return {**columns, "task": np.array("stack block pyramid")}


def test_all_frames_are_in_the_files(source: Path, tmp_path: Path, parquet: ModuleType):
    folder = tmp_path / "lerobot"
    export_lerobot(source, folder)
    assert sorted(str(p.relative_to(folder)) for p in folder.rglob("*") if p.is_file()) == [
        "data/chunk-000/file-000.parquet",
        "meta/episodes/chunk-000/file-000.parquet",
        "meta/info.json",
        "meta/kitting_drake.json",
        "meta/stats.json",
        "meta/tasks.parquet",
    ]
    assert sorted(item.name for item in tmp_path.iterdir()) == ["demonstrations.h5", "lerobot"]
    table = parquet.read_table(folder / "data/chunk-000/file-000.parquet")
    info = json.loads((folder / "meta/info.json").read_text())
    assert table.column_names == list(info["features"])
    assert str(table.schema.field("action").type) == "fixed_size_list<element: float>[7]"
    truth = expected()
    for index, row in enumerate(table.to_pylist()):
        colour = np.asarray(Image.open(io.BytesIO(row[COLOUR]["bytes"])))
        height = np.asarray(Image.open(io.BytesIO(row[HEIGHT]["bytes"])))
        assert height.dtype == np.float32
        np.testing.assert_array_equal(np.moveaxis(colour, -1, 0), truth["colour"][index])
        assert height.tobytes() == truth["height"][index].tobytes()
        np.testing.assert_array_equal(np.float32(row["action"]), truth["action"][index])
        for name in ("object", "category", "next.done", "frame_index", "episode_index", "index"):
            assert row[name] == truth[name][index], name
        assert row["timestamp"] == row["frame_index"]
        assert row["task_index"] == 0


def test_the_metadata_of_the_frames(source: Path, tmp_path: Path, parquet: ModuleType):
    folder = tmp_path / "lerobot"
    export_lerobot(source, folder)
    info = json.loads((folder / "meta/info.json").read_text())
    assert info["codebase_version"] == "v3.0"
    assert (info["total_episodes"], info["total_frames"], info["total_tasks"]) == (3, 8, 1)
    assert info["splits"] == {"train": "0:3"}
    assert info["fps"] > 0
    assert info["features"][COLOUR]["shape"] == [5, 7, 3]
    assert info["features"][HEIGHT]["info"] == {"is_depth_map": True, "depth_unit": "m"}
    episodes = parquet.read_table(folder / "meta/episodes/chunk-000/file-000.parquet").to_pylist()
    assert [item["episode_index"] for item in episodes] == [0, 1, 2]
    assert [item["length"] for item in episodes] == LENGTHS
    assert [item["dataset_from_index"] for item in episodes] == [0, 4, 6]
    assert [item["dataset_to_index"] for item in episodes] == [4, 6, 8]
    assert all(item["tasks"] == ["stack block pyramid"] for item in episodes)
    tasks = parquet.read_table(folder / "meta/tasks.parquet")
    assert tasks.to_pylist() == [{"task_index": 0, "task": "stack block pyramid"}]
    assert tasks.schema.pandas_metadata["index_columns"] == ["task"]
    record = json.loads((folder / "meta/kitting_drake.json").read_text())
    assert record["episode_seeds"] == [10, 12, 13]
    assert PixelGrid(**record["grid"]) == GRID
    assert record["scenario"] == ORIGIN.scenario


def test_the_statistics(source: Path, tmp_path: Path, parquet: ModuleType):
    folder = tmp_path / "lerobot"
    export_lerobot(source, folder)
    found = json.loads((folder / "meta/stats.json").read_text())
    assert not {"object", "category"} & set(found)
    truth = expected()
    samples = {
        COLOUR: np.moveaxis(truth["colour"], 1, -1).reshape(-1, 3) / 255,
        HEIGHT: truth["height"].reshape(-1, 1).astype(float),
        "action": truth["action"].astype(float),
        "index": truth["index"][:, None].astype(float),
    }
    episodes = parquet.read_table(folder / "meta/episodes/chunk-000/file-000.parquet").to_pylist()
    for name, values in samples.items():
        assert found[name]["count"] == [8]
        for key in ("min", "max", "mean", "std"):
            shape = (-1, 1, 1) if "image" in name else (-1,)
            wanted = getattr(values, key)(axis=0).reshape(shape)
            np.testing.assert_allclose(found[name][key], wanted, rtol=1e-9, atol=1e-12)
        # The quantiles of the first episode are exact.
        first = values[: len(values) * 4 // 8]
        for key, share in (("q01", 0.01), ("q50", 0.5), ("q99", 0.99)):
            stored = np.ravel(episodes[0][f"stats/{name}/{key}"])
            np.testing.assert_allclose(stored, np.quantile(first, share, axis=0))


def test_many_frames_are_split_into_files(
    source: Path, tmp_path: Path, parquet: ModuleType, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(lerobot_export, "_MEGABYTES", 1e-6)
    monkeypatch.setattr(lerobot_export, "_FILES_PER_CHUNK", 2)
    folder = tmp_path / "lerobot"
    export_lerobot(source, folder)
    files = sorted(folder.glob("data/*/*"))
    assert [str(item.relative_to(folder / "data")) for item in files] == [
        "chunk-000/file-000.parquet",
        "chunk-000/file-001.parquet",
        "chunk-001/file-000.parquet",
    ]
    assert [parquet.read_table(item).num_rows for item in files] == LENGTHS
    episodes = parquet.read_table(folder / "meta/episodes/chunk-000/file-000.parquet").to_pylist()
    places = [(item["data/chunk_index"], item["data/file_index"]) for item in episodes]
    assert places == [(0, 0), (0, 1), (1, 0)]


def test_actions_have_the_layout_of_the_environments():
    pytest.importorskip("gymnasium")
    from kitting_drake.gym import spaces

    assert spaces.ACTION == ACTION


def test_an_existing_export_is_kept_and_other_folders_are_not_overwritten(
    source: Path, tmp_path: Path, parquet: ModuleType
):
    folder = tmp_path / "lerobot"
    export_lerobot(source, folder, "stack them")
    before = folder.stat()
    export_lerobot(source, folder, "stack them")
    assert folder.stat() == before
    # Fewer demonstrations, and the same number with another action.
    step = EPISODES[-1].steps[0]
    other = dataclasses.replace(step, pick=dataclasses.replace(step.pick, x=step.pick.x + 0.001))
    changed = dataclasses.replace(EPISODES[-1], steps=[other, *EPISODES[-1].steps[1:]])
    for episodes in (EPISODES[:2], [*EPISODES[:-1], changed]):
        write_demonstrations(source, ORIGIN, episodes)
        with pytest.raises(UserError, match=r"lerobot exists.*demonstrations\.h5"):
            export_lerobot(source, folder, "stack them")
    with pytest.raises(UserError, match="lerobot exists"):
        require_export(folder)
    require_export(tmp_path / "other")


def test_a_stopped_export_leaves_nothing(
    source: Path, tmp_path: Path, parquet: ModuleType, monkeypatch: pytest.MonkeyPatch
):
    def stop(*_: object) -> None:
        raise KeyboardInterrupt

    scratch = tmp_path / ".lerobot.scratch" / "data"
    scratch.mkdir(parents=True)
    (scratch / "of_a_killed_process").touch()
    with monkeypatch.context() as patch:
        patch.setattr(lerobot_export, "_write_tasks", stop)
        with pytest.raises(KeyboardInterrupt):
            export_lerobot(source, tmp_path / "lerobot")
    assert [item.name for item in tmp_path.iterdir()] == ["demonstrations.h5"]
    export_lerobot(source, tmp_path / "lerobot")
    assert not list(tmp_path.rglob("of_a_killed_process"))


def test_impossible_exports_raise_user_errors(source: Path, tmp_path: Path, parquet: ModuleType):
    with pytest.raises(UserError, match="there is no file"):
        export_lerobot(tmp_path / "none.h5", tmp_path / "lerobot")
    with pytest.raises(UserError, match=r"cannot write .*Not a directory"):
        export_lerobot(source, source / "lerobot")
    write_demonstrations(source, ORIGIN, [])
    with pytest.raises(UserError, match="no demonstrations"):
        export_lerobot(source, tmp_path / "lerobot")


def test_without_pyarrow_the_error_names_the_package(
    source: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    # None in sys.modules makes the import fail.
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    for call in (lambda: require_export(tmp_path), lambda: export_lerobot(source, tmp_path / "x")):
        with pytest.raises(UserError, match=r"package pyarrow: pip install .pyarrow"):
            call()


@pytest.mark.parametrize(
    ("scenario", "task"),
    [
        ({"task": {"_tag": "!ArrangedKitting"}}, "arranged kitting"),
        ({"task": "bench"}, "bench"),
        ({}, "mine"),
    ],
)
def test_the_task_in_words(scenario: dict[str, Any], task: str):
    assert lerobot_export._task(dataclasses.replace(ORIGIN, scenario=scenario)) == task


@pytest.mark.skipif(not LEROBOT, reason="KITTING_LEROBOT_PYTHON is not set")
def test_lerobot_reads_what_was_written(source: Path, tmp_path: Path, parquet: ModuleType):
    export_lerobot(source, tmp_path / "lerobot")
    np.savez(tmp_path / "expected.npz", **expected())
    reader = Path(__file__).with_name("lerobot_reader.py")
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
    print(result)
    assert (result["frames"], result["episodes"]) == (8, 3)
    assert set(result["differences"].values()) == {0}, result
    assert result["depth_keys"] == [HEIGHT]
    assert result["statistics_difference"] < 1e-6
    assert result["second_episode"] == [4, 5]
    assert result["next_action"] == 0
