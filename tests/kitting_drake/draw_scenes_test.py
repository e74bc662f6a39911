import sys
from pathlib import Path

import pytest

from kitting_drake import draw_scenes
from kitting_drake.cell.cameras import can_render
from kitting_drake.policies.static_scenes import read_static_scenes

pytestmark = pytest.mark.skipif(not can_render(), reason="images cannot be rendered here")


def run(monkeypatch: pytest.MonkeyPatch, *arguments: str) -> int:
    monkeypatch.setattr(sys, "argv", ["draw_scenes", *arguments])
    return draw_scenes.main()


@pytest.mark.slow
def test_it_draws_and_goes_on_and_repeats_itself(tmp_path: Path, monkeypatch):
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
