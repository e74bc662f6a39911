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


def test_the_catalogue_is_what_is_shipped():
    assert sorted(entry.name for entry in ENTRIES) == tool_names()


# One of each category by default; all of them take a minute.
QUICK = ["claw_hammer", "needle_nose_pliers", "angle_wrench", "phillips_screwdriver"]


def without_noise(sdf: bytes) -> str:
    """The text of a model in which what is zero but for rounding, on any machine, is zero."""

    def clean(number: re.Match[str]) -> str:
        return "0" if abs(float(number[0])) < 1e-15 else number[0]

    return re.sub(r"-?\d+(\.\d+)?e-\d+", clean, sdf.decode())


def without_order(obj: bytes) -> list[tuple[str, ...]]:
    """The corners of all faces, with their normals, in an order that is the same on any machine:
    of faces that are alike, rounding decides which comes first, and with which corner."""
    lines = obj.decode().splitlines()
    points, normals = ([line for line in lines if line.startswith(kind)] for kind in ("v ", "vn "))
    faces = []
    for line in lines:
        if line.startswith("f "):
            # Hulls have no normals.
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
    # What can be touched is what is seen, to a fraction of the clearance.
    assert max(report.outside_mm, report.inside_mm) < 0.35
    assert abs(report.bottom_error_mm) < 0.1
    assert abs(report.grip_error_mm) < 0.2


def test_a_tool_that_cannot_be_written_leaves_the_old_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    folder = tmp_path / "claw_hammer"
    folder.mkdir()
    (folder / "old").write_text("")

    def full(*_: object) -> int:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(generate.meshes, "write_convex_obj", full)
    entry = next(entry for entry in ENTRIES if entry.name == "claw_hammer")
    with pytest.raises(MachineError, match="claw_hammer: No space left on device"):
        generate_tool(entry, folder)
    assert [path.name for path in tmp_path.iterdir()] == ["claw_hammer"]
    assert [path.name for path in folder.iterdir()] == ["old"]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("tools: {", "catalogue.yaml"),
        ("[]", "has to hold a list named `tools`"),
        ("tools: [{name: spade}]", "tool spade: 'grasp'"),
        (
            "tools: [{name: a, category: spade, split: train, length_mm: 1, grasp: {}}]",
            "tool a: category 'spade' is none of hammer",
        ),
        (
            "tools: [{name: a, category: hammer, split: train, length_mm: 1, grasp: {q: 1}}]",
            "tool a: .*'q'",
        ),
    ],
)
def test_a_bad_catalogue_is_named(tmp_path: Path, text: str, message: str):
    (tmp_path / "catalogue.yaml").write_text(text)
    with pytest.raises(CatalogueError, match=message):
        load_catalogue(tmp_path / "catalogue.yaml")
