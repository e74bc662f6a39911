import errno
import re
from pathlib import Path

import pytest

from kitting_drake.common.errors import MachineError
from kitting_drake.common.paths import MODELS
from kitting_drake.hkd.generation import generate
from kitting_drake.hkd.generation.catalogue import CatalogueError, load_catalogue
from kitting_drake.hkd.generation.generate import generate_tool
from kitting_drake.hkd.tools.tool import tool_names

CATALOGUE = MODELS / "tools" / "catalogue.yaml"
ENTRIES = load_catalogue(CATALOGUE)


def test_the_catalogue_lists_the_committed_tools():
    assert sorted(entry.name for entry in ENTRIES) == tool_names()


# Tools that are tested by default; testing all tools takes a minute.
QUICK = ["angle_wrench", "phillips_screwdriver"]


def without_noise(sdf: bytes) -> str:
    """A model's text with tiny numbers as 0, because rounding depends on the machine."""

    def clean(number: re.Match[str]) -> str:
        return "0" if abs(float(number[0])) < 1e-15 else number[0]

    return re.sub(r"-?\d+(\.\d+)?e-\d+", clean, sdf.decode())


def without_order(obj: bytes) -> list[tuple[str, ...]]:
    """The corners of all faces with their normals, in a canonical order.

    The order in the file depends on rounding, so it differs between machines.
    """
    lines = obj.decode().splitlines()
    points, normals = ([line for line in lines if line.startswith(kind)] for kind in ("v ", "vn "))
    faces = []
    for line in lines:
        if line.startswith("f "):
            # The files of collision hulls have no normals.
            pairs = [corner.partition("//")[::2] for corner in line.split()[1:]]
            corners = [points[int(v) - 1] + (normals[int(n) - 1] if n else "") for v, n in pairs]
            first = corners.index(min(corners))
            faces.append((*corners[first:], *corners[:first]))
    assert faces
    return sorted(faces)


@pytest.mark.parametrize(
    "entry",
    [
        pytest.param(entry, id=entry.name, marks=[] if entry.name in QUICK else pytest.mark.slow)
        for entry in ENTRIES
    ],
)
def test_generating_gives_the_committed_files(entry, tmp_path: Path):
    report = generate_tool(entry, tmp_path / entry.name)
    made = {path.name: path.read_bytes() for path in (tmp_path / entry.name).iterdir()}
    kept = {path.name: path.read_bytes() for path in (MODELS / "tools" / entry.name).iterdir()}
    assert made.keys() == kept.keys()
    for name in kept:
        if name.endswith(".sdf"):
            assert without_noise(made[name]) == without_noise(kept[name]), name
        elif name.endswith(".obj"):
            assert without_order(made[name]) == without_order(kept[name]), name
        else:
            assert made[name] == kept[name], name
    # The collision hulls match the visual shape to a fraction of the clearance.
    assert max(report.outside_mm, report.inside_mm) < 0.35
    assert abs(report.bottom_error_mm) < 0.1
    assert abs(report.grip_error_mm) < 0.2


def test_a_failed_write_keeps_the_old_tool(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    folder = tmp_path / "claw_hammer"
    folder.mkdir()
    (folder / "old").write_text("")

    def full(*_: object) -> int:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(generate.meshes, "write_convex_obj", full)
    entry = next(entry for entry in ENTRIES if entry.name == "claw_hammer")
    with pytest.raises(MachineError, match="No space left on device"):
        generate_tool(entry, folder)
    assert [path.name for path in tmp_path.iterdir()] == ["claw_hammer"]
    assert [path.name for path in folder.iterdir()] == ["old"]


@pytest.mark.parametrize(
    ("text", "token"),
    [
        ("tools: {", "catalogue.yaml"),
        ("[]", "`tools`"),
        ("tools: [{name: spade}]", "tool spade must have the fields"),
        (
            "tools: [{name: a, category: spade, split: train, length_mm: 1, grasp: {}}]",
            "tool a: category 'spade'",
        ),
        (
            "tools: [{name: a, category: hammer, split: train, length_mm: 1, grasp: {q: 1}}]",
            "tool a must have the fields",
        ),
    ],
)
def test_an_invalid_catalogue_is_rejected(tmp_path: Path, text: str, token: str):
    (tmp_path / "catalogue.yaml").write_text(text)
    with pytest.raises(CatalogueError, match=token):
        load_catalogue(tmp_path / "catalogue.yaml")
