import math
import shutil
from pathlib import Path

import pytest
import yaml

from kitting_drake.common.errors import UserError
from kitting_drake.common.paths import MODELS
from kitting_drake.hkd.annotate import measure_grasp, save_grasp, with_grasp
from kitting_drake.hkd.tools.tool import Tool, load_tool
from kitting_drake.tasks.kitting.kitting import Kitting
from systems.grasp import Grasp
from systems.signals import PixelGrid

CATALOGUE = (MODELS / "tools" / "catalogue.yaml").read_text()
GRASP = Grasp(x=-0.0205, y=0.0, theta=math.radians(0.5), width=0.02, surface_height=0.02)


@pytest.fixture
def models(tmp_path: Path) -> Path:
    """A copy of the models with one tool."""
    for name in ("package.xml", "tools/catalogue.yaml", "tools/flat_screwdriver"):
        target = tmp_path / "models" / name
        target.parent.mkdir(parents=True, exist_ok=True)
        copy = shutil.copytree if (MODELS / name).is_dir() else shutil.copy
        copy(MODELS / name, target)
    return tmp_path / "models"


def copied(models: Path) -> Tool:
    return load_tool(str(models / "tools" / "flat_screwdriver"))


@pytest.mark.parametrize("name", ["claw_hammer", "combination_wrench", "flat_screwdriver"])
def test_measure_grasp_agrees_with_the_generator(name: str):
    tool = load_tool(name)
    measured = measure_grasp(tool, tool.grasp.x, tool.grasp.y, tool.grasp.theta)
    assert measured is not None
    assert measured.width == pytest.approx(tool.grasp.width, abs=2e-4)
    assert measured.surface_height == pytest.approx(tool.grasp.surface_height, abs=2e-4)


def test_the_measured_grasp_is_centred_between_the_faces():
    tool = load_tool("claw_hammer")
    measured = measure_grasp(tool, tool.grasp.x, tool.grasp.y + 0.004, tool.grasp.theta)
    assert measured is not None
    assert measured.y == pytest.approx(tool.grasp.y, abs=2e-4)


def test_there_is_no_grasp_beside_a_tool():
    assert measure_grasp(load_tool("claw_hammer"), 0.2, 0.0, 0.0) is None


def test_with_grasp_changes_only_the_grasp():
    changed = with_grasp(CATALOGUE, "flat_screwdriver", GRASP)
    before, after = yaml.safe_load(CATALOGUE)["tools"], yaml.safe_load(changed)["tools"]
    for old, new in zip(before, after, strict=True):
        if old["name"] == "flat_screwdriver":
            assert new["grasp"] == {"x_mm": -20.5, "y_mm": 0.0, "theta_deg": 0.5}
            old["grasp"] = new["grasp"]
        assert old == new
    changed_lines = set(changed.splitlines()) - set(CATALOGUE.splitlines())
    assert len(changed_lines) == 1
    with pytest.raises(UserError, match="spoon"):
        with_grasp(CATALOGUE, "spoon", GRASP)


def test_saving_regenerates_a_tool_of_the_catalogue(models: Path):
    tool = copied(models)
    grasp = measure_grasp(tool, -0.03, 0.0, 0.0)
    assert grasp is not None
    save_grasp(tool, grasp, models)
    assert copied(models).grasp.x == pytest.approx(-0.03)


def test_a_rejected_grasp_changes_nothing(models: Path):
    off = Grasp(x=-0.03, y=0.004, theta=0.0, width=0.02, surface_height=0.02)
    with pytest.raises(UserError, match="not centred"):
        save_grasp(copied(models), off, models)
    assert (models / "tools" / "catalogue.yaml").read_text() == CATALOGUE
    assert copied(models).grasp == load_tool("flat_screwdriver").grasp


def test_saving_a_grasp_of_a_user_tool_changes_its_record(models: Path, tmp_path: Path):
    own = tmp_path / "flat_screwdriver"
    shutil.copytree(models / "tools" / "flat_screwdriver", own)
    tool = load_tool(str(own))
    save_grasp(tool, GRASP)
    assert load_tool(str(own)).grasp.x == pytest.approx(GRASP.x)
    assert load_tool(str(own)).mass == tool.mass


def test_a_grasp_too_wide_for_the_jaws_is_rejected(models: Path, tmp_path: Path):
    own = tmp_path / "flat_screwdriver"
    shutil.copytree(models / "tools" / "flat_screwdriver", own)
    tool = load_tool(str(own))
    along = measure_grasp(tool, 0.0, 0.0, math.pi / 2)
    assert along is not None
    with pytest.raises(UserError, match="65 mm"):
        save_grasp(tool, along)
    assert load_tool(str(own)).grasp == tool.grasp
    # If such a grasp is written into the record by hand, building a scene rejects it.
    record = yaml.safe_load((own / "tool.yaml").read_text())
    record["grasp"]["width"] = along.width
    (own / "tool.yaml").write_text(yaml.safe_dump(record))
    with pytest.raises(UserError, match="flat_screwdriver"):
        Kitting(tools=[str(own)]).make_scene(grid=PixelGrid(), seed=0, base=tmp_path)
