import json
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest


@pytest.mark.slow
def test_the_command(verb: Callable[..., subprocess.CompletedProcess[str]], tmp_path: Path):
    done = verb("benchmark", "kits", "--kits", 1, "--output", tmp_path)
    assert done.returncode == 0, done.stderr
    assert "clearance, mm" in done.stdout
    measured = json.loads((tmp_path / "kits.json").read_text())
    assert measured["kits"] == 2
    # The kits' nominal clearance is 2 mm.
    assert 1.8 < measured["clearance_mm"]["minimum"] < measured["clearance_mm"]["median"] < 2.3
    assert measured["build_s"]["max"] > 0
