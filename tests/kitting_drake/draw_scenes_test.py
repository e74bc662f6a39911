import json
import sys
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from kitting_drake import draw_scenes
from kitting_drake.common.errors import UserError
from kitting_drake.common.provenance import source_digest
from kitting_drake.common.rendering import can_render
from kitting_drake.policies.data.static_scenes import (
    StaticScene,
    StaticScenes,
    read_static_scenes,
    write_static_scenes,
)
from systems.signals import PixelGrid

GRID = PixelGrid()
OURS = {"kitting_drake": "0.1"}

pytestmark = pytest.mark.skipif(not can_render(), reason="images cannot be rendered here")


def run(monkeypatch: pytest.MonkeyPatch, *arguments: str) -> int:
    monkeypatch.setattr(sys, "argv", ["draw_scenes", *arguments])
    return draw_scenes.main()


class AtOnce:
    """A worker that immediately writes twenty scenes of its seed."""

    def capacity(self) -> int:
        return 1

    def run(self, _, path: Path, seed: int, drawn_by: dict[str, str]) -> int:
        rng = np.random.default_rng(seed)
        scene = StaticScene(rng.integers(9, size=GRID.shape, dtype=np.uint16), np.zeros((0, 8)))
        write_static_scenes(path, StaticScenes(GRID, (scene,) * 20, seed, drawn_by))
        return 20

    def stop(self) -> None: ...


def test_draws_missing_batches_and_other_seeds_differ(tmp_path: Path):
    console = Console(quiet=True)
    parts = draw_scenes._Parts(tmp_path, 0, OURS)
    parts.draw(40, AtOnce(), console)
    parts.path(0).unlink()
    again = draw_scenes._Parts(tmp_path, 0, OURS)
    again.draw(20, AtOnce(), console)
    assert parts.path(0).exists()
    other = tmp_path / "other"
    other.mkdir()
    draw_scenes._Parts(other, 1, OURS).draw(20, AtOnce(), console)
    (one,) = read_static_scenes(other / "batch_000000.h5").scenes[:1]
    (two,) = read_static_scenes(parts.path(1)).scenes[:1]
    assert (one.height != two.height).any()


def test_assembles_scenes_with_the_ends_of_batches(tmp_path: Path):
    parts = draw_scenes._Parts(tmp_path / "parts", 0, OURS)
    parts.draw(50, AtOnce(), Console(quiet=True))
    parts.assemble(50, tmp_path / "scenes.h5")
    assert read_static_scenes(tmp_path / "scenes.h5").batch_ends == (20, 40, 50)


def test_batches_of_another_seed_or_version_are_refused(tmp_path: Path):
    draw_scenes._Parts(tmp_path, 0, OURS).draw(20, AtOnce(), Console(quiet=True))
    for seed, drawn_by in [(1, OURS), (0, {"kitting_drake": "0.2"})]:
        with pytest.raises(UserError, match=r"batch_000000\.h5 was drawn with another seed"):
            draw_scenes._Parts(tmp_path, seed, drawn_by)
    path = tmp_path / "batch_000000.h5"
    path.write_bytes(path.read_bytes()[:1000])
    with pytest.raises(UserError, match=r"cannot read .*: delete it"):
        draw_scenes._Parts(tmp_path, 0, OURS)
    path.rename(tmp_path / "batch_000000 (1).h5")
    with pytest.raises(UserError, match="has an unexpected name"):
        draw_scenes._Parts(tmp_path, 0, OURS)


def test_a_folder_of_another_seed_or_version_is_refused(tmp_path: Path, monkeypatch):
    settings = tmp_path / "settings.json"
    ours = draw_scenes._drawn_by()
    claimed = {"seed": 0, **ours}
    for other, message in [
        ({"seed": 7}, "seed is 0, but 7 in them"),
        ({"code": "1"}, f"{ours['code']}, but 1 in them"),
        ({"catalogue": "2"}, f"{ours['catalogue']}, but 2 in them"),
    ]:
        settings.write_text(json.dumps(claimed | other))
        with pytest.raises(UserError, match=message):
            run(monkeypatch, "--scenes", "1", "--quiet", "--output", str(tmp_path))
        assert json.loads(settings.read_text()) == claimed | other


def test_digests_cover_cameras_encoding_and_designs(tmp_path: Path, monkeypatch):
    before = draw_scenes._drawn_by()
    catalogue = tmp_path / "catalogue.yaml"
    catalogue.write_text("tools: {}\n")
    monkeypatch.setattr(draw_scenes, "_CATALOGUE", catalogue)
    assert draw_scenes._drawn_by()["catalogue"] != before["catalogue"]
    for name in ("kitting_drake.scenario", "kitting_drake.policies.data.static_scenes"):
        others = [item for item in draw_scenes._DRAWN_BY if item != name]
        assert source_digest(*others) != before["code"]


def test_an_empty_batch_is_kept(tmp_path: Path):
    parts = draw_scenes._Parts(tmp_path, 0, OURS)
    write_static_scenes(parts.path(0), StaticScenes(GRID, (), 0, OURS))
    assert read_static_scenes(parts.path(0)).scenes == ()
    again = draw_scenes._Parts(tmp_path, 0, OURS)
    again.draw(20, AtOnce(), Console(quiet=True))
    assert len(again.assemble(20, tmp_path / "scenes.h5")) == 20


@pytest.mark.slow
def test_drawing_resumes_and_repeats(tmp_path: Path, monkeypatch):
    one, other = tmp_path / "one", tmp_path / "other"
    flags = ("--seed", "3", "--workers", "2", "--quiet", "--output")
    assert run(monkeypatch, "--scenes", "5", *flags, str(one)) == 0
    few = read_static_scenes(one / "scenes.h5")
    assert len(few.scenes) == 5
    assert run(monkeypatch, "--scenes", "45", *flags, str(one)) == 0
    assert run(monkeypatch, "--scenes", "45", *flags, str(other)) == 0
    more, again = (read_static_scenes(path / "scenes.h5") for path in (one, other))
    assert len(more.scenes) == 45
    for a, b in zip(more.scenes, again.scenes, strict=True):
        assert (a.height == b.height).all()
        assert (a.actions == b.actions).all()
    assert all((a.height == b.height).all() for a, b in zip(few.scenes, more.scenes, strict=False))
