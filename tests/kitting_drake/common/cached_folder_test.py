import os
import time
from pathlib import Path

import pytest

from kitting_drake.common import cached_folder as cache_module
from kitting_drake.common.cached_folder import cached_folder, prune


def test_prune_keeps_the_newest_and_the_young(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(cache_module, "KEPT_ENTRIES", 3)
    now = time.time()
    hour = cache_module.YOUNGEST_REMOVED

    def write(folder: Path) -> None:
        (folder / "file").write_text("content")

    for name, age in (("a", 9), ("b", 8), ("c", 7), ("d", 6), ("e", 0.5), (".making-x", 2)):
        folder = tmp_path / name
        folder.mkdir()
        write(folder)
        os.utime(folder, (now - age * hour,) * 2)
    # Using folder `a` makes it the newest: its time of use becomes the present.
    cached_folder(tmp_path / "a", ["file"], write)
    prune(tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == {"a", "e", "d"}
    monkeypatch.setattr(cache_module, "KEPT_ENTRIES", 1)
    prune(tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == {"a", "e"}
