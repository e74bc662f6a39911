import shutil
from pathlib import Path

import numpy as np
import pytest
import trimesh
import yaml
from pydrake.math import RigidTransform, RollPitchYaw

from kitting_drake.common.errors import UserError
from kitting_drake.common.paths import MODELS
from kitting_drake.hkd.tools.tool import Tool, load_tool, tool_names
from systems.placement import add_s


@pytest.fixture
def copy(tmp_path: Path) -> Path:
    """A tool's folder that may be spoilt."""
    return Path(shutil.copytree(MODELS / "tools" / "flat_screwdriver", tmp_path / "mine"))


def change(folder: Path, **fields: object) -> None:
    record = yaml.safe_load((folder / "tool.yaml").read_text())
    (folder / "tool.yaml").write_text(yaml.safe_dump({**record, **fields}))


@pytest.mark.parametrize("name", tool_names())
def test_record_and_meshes_of_shipped_tools_agree(name: str):
    tool = load_tool(name)
    points = tool.triangles.reshape(-1, 3)
    low, high = points.min(axis=0), points.max(axis=0)
    # The frame T: on the table, the origin amid the outline.
    np.testing.assert_allclose(high - low, [tool.length, tool.width, tool.height], atol=2e-4)
    np.testing.assert_allclose((high + low)[:2], 0, atol=2e-4)
    assert low[2] == pytest.approx(0, abs=2e-4)
    x_min, y_min, x_max, y_max = tool.footprint.bounds()
    np.testing.assert_allclose([x_min, y_min, x_max, y_max], [*low[:2], *high[:2]], atol=1e-6)
    assert 0.02 < tool.mass < 1.0
    # The grasp is on the tool and within the hand's opening.
    assert 0.005 < tool.grasp.width < 0.07
    assert low[0] < tool.grasp.x < high[0]
    assert 0 < tool.grasp.surface_height <= tool.height + 1e-6


def test_a_tool_by_path(copy: Path, tmp_path: Path):
    shipped = load_tool("flat_screwdriver")
    assert shipped.directory == MODELS / "tools" / "flat_screwdriver"
    # The model's file goes by the record's name, not by the folder's.
    for tool in (load_tool(str(copy)), load_tool("mine", tmp_path), load_tool("./mine", tmp_path)):
        assert tool.directory == copy
        assert tool.sdf.is_file()
        assert tool.grasp == shipped.grasp


def test_an_unknown_tool_is_told_with_the_known_ones(tmp_path: Path):
    with pytest.raises(UserError, match="no tool 'spoon', nor a folder"):
        load_tool("spoon", tmp_path)


@pytest.mark.parametrize("name", ["red_grip.obj", "flat_screwdriver.sdf"])
def test_a_missing_file_is_named(copy: Path, name: str):
    (copy / name).unlink()
    with pytest.raises(UserError, match=rf"lacks its file .*/mine/{name}"):
        load_tool(str(copy))


def test_a_record_without_symmetry_has_none(copy: Path):
    record = yaml.safe_load((copy / "tool.yaml").read_text())
    del record["symmetry"]
    (copy / "tool.yaml").write_text(yaml.safe_dump(record))
    assert load_tool(str(copy)).symmetry == 1
    change(copy, symmetry=2)
    assert load_tool(str(copy)).symmetry == 2


def test_a_path_is_not_a_name(copy: Path, tmp_path: Path):
    mine = copy.rename(tmp_path / "claw_hammer")
    assert load_tool("./claw_hammer", tmp_path).directory == mine


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"category": "A spoon"}, r"tool\.yaml: category 'A spoon' has to be a name"),
        ({"symmetry": 0}, r"tool\.yaml: symmetry is 0, and has to be 1 or more"),
        ({"width": float("nan")}, r"tool\.yaml: width is nan, and has to be positive"),
        ({"mass": -3.0}, r"tool\.yaml: mass is -3, and has to be positive"),
        ({"mass": "heavy"}, r"tool\.yaml is not a tool record"),
        ({"grasp": {"x": 0.0}}, r"tool\.yaml is not a tool record"),
        ({"grasp": None}, r"tool\.yaml is not a tool record"),
    ],
)
def test_a_broken_record_is_named(copy: Path, fields: dict[str, object], message: str):
    change(copy, **fields)
    with pytest.raises(UserError, match=message):
        load_tool(str(copy))


@pytest.mark.parametrize("text", ["", "[1]", "name: {", "name: screwdriver"])
def test_a_record_that_is_none_is_named(copy: Path, text: str):
    (copy / "tool.yaml").write_text(text)
    with pytest.raises(UserError, match=r"tool\.yaml is not a tool record"):
        load_tool(str(copy))


def test_surface_points_lie_on_the_surface_and_stay_the_same():
    tool = load_tool("combination_wrench")
    points = tool.surface_points(500)
    np.testing.assert_array_equal(points, load_tool("combination_wrench").surface_points(500))
    faces = np.arange(3 * len(tool.triangles)).reshape(-1, 3)
    mesh = trimesh.Trimesh(tool.triangles.reshape(-1, 3), faces, process=False)
    # Broad flats get their share whatever their triangles' number: compare mean heights by area.
    by_area = mesh.area_faces @ mesh.triangles_center / mesh.area
    np.testing.assert_allclose(points.mean(axis=0), by_area, atol=6e-3)
    _, distance, _ = trimesh.proximity.closest_point_naive(mesh, points[:20])
    assert distance.max() < 1e-9


def test_add_s_does_not_depend_on_how_finely_the_mesh_is_cut(tmp_path: Path):
    tool = load_tool("flat_screwdriver")
    fine = []
    for path in tool.visual_meshes:
        mesh = trimesh.load_mesh(path, process=False)
        # Only one end is cut finely: a score by vertices would be drawn there.
        end = np.flatnonzero(mesh.triangles_center[:, 0] > 0.02)
        if len(end):
            mesh = mesh.subdivide(end).subdivide()
        fine.append(tmp_path / path.name)
        mesh.export(fine[-1], include_normals=False)
    dense = Tool(**{**vars_of(tool), "visual_meshes": tuple(fine)})
    assert len(dense.triangles) > 2 * len(tool.triangles)
    X = RigidTransform(RollPitchYaw(0, 0, 0.05), [0.004, -0.002, 0.001])
    scores = [add_s(t.surface_points(2000), RigidTransform(), X) for t in (tool, dense)]
    assert scores[1] == pytest.approx(scores[0], rel=0.03)


def vars_of(tool: Tool) -> dict[str, object]:
    """The fields of a tool, without what it has computed since."""
    return {name: getattr(tool, name) for name in Tool.__dataclass_fields__}
