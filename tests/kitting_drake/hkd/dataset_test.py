import hashlib
import json
from pathlib import Path

import pytest
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph
from pydrake.systems.framework import DiagramBuilder

from kitting_drake.common.errors import UserError
from kitting_drake.hkd import dataset
from kitting_drake.hkd.tools.toolsets import PAPER_SPLITS, toolsets


@pytest.fixture
def few_kits(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(dataset, "toolsets", lambda split: toolsets(split)[:2])


@pytest.mark.usefixtures("few_kits")
def test_the_manifest_lists_all_files_with_checksums(tmp_path: Path):
    folder = tmp_path / "hkd"
    steps: list[tuple[int, int]] = []
    manifest = dataset.build_dataset(folder, lambda done, total: steps.append((done, total)))
    assert manifest == json.loads((folder / "manifest.json").read_text())
    assert steps == [(1, 4), (2, 4), (3, 4), (4, 4)]
    assert len(manifest["tools"]) == 60
    assert [kit["split"] for kit in manifest["kits"]] == [
        split for split in PAPER_SPLITS for _ in "12"
    ]
    listed = {"manifest.json"}
    for entry in manifest["tools"] + manifest["kits"]:
        for path, checksum in entry["sha256"].items():
            assert hashlib.sha256((folder / path).read_bytes()).hexdigest() == checksum
            listed.add(path)
    there = {p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.is_file()}
    assert there == listed


@pytest.mark.usefixtures("few_kits")
def test_models_load_after_the_folder_is_moved(tmp_path: Path):
    manifest = dataset.build_dataset(tmp_path / "built", lambda done, total: None)
    moved = (tmp_path / "built").rename(tmp_path / "moved")
    for entry in (manifest["tools"][0], manifest["kits"][0]):
        builder = DiagramBuilder()
        plant, scene_graph = AddMultibodyPlantSceneGraph(builder, 0.01)
        assert len(Parser(plant).AddModels(str(moved / entry["sdf"]))) == 1
        assert scene_graph.model_inspector().num_geometries() > 1


def test_a_folder_with_files_is_rejected_and_kept(tmp_path: Path):
    (tmp_path / "mine.txt").write_text("mine")
    with pytest.raises(UserError, match="not an empty folder"):
        dataset.build_dataset(tmp_path, lambda done, total: None)
    assert [path.name for path in tmp_path.iterdir()] == ["mine.txt"]


def test_a_failed_build_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    def fail(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(dataset, "write_json", fail)
    monkeypatch.setattr(dataset, "toolsets", lambda split: [])
    with pytest.raises(UserError, match="No space left"):
        dataset.build_dataset(tmp_path / "hkd", lambda done, total: None)
    assert not list(tmp_path.iterdir())
