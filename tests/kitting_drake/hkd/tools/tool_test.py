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
    """A copy of a tool's folder, which tests may change."""
    return Path(shutil.copytree(MODELS / "tools" / "flat_screwdriver", tmp_path / "mine"))


def change(folder: Path, **fields: object) -> None:
    record = yaml.safe_load((folder / "tool.yaml").read_text())
    (folder / "tool.yaml").write_text(yaml.safe_dump({**record, **fields}))


@pytest.mark.parametrize("name", tool_names())
def test_record_and_meshes_of_the_projects_tools_agree(name: str):
    tool = load_tool(name)
    points = tool.triangles.reshape(-1, 3)
    low, high = points.min(axis=0), points.max(axis=0)
    # In frame T the tool is on the table, and its footprint is centred.
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


def test_a_tool_loads_by_path(copy: Path, tmp_path: Path):
    shipped = load_tool("flat_screwdriver")
    assert shipped.directory == MODELS / "tools" / "flat_screwdriver"
    # The model's file is named after the tool, not after the copied folder.
    for tool in (load_tool(str(copy)), load_tool("mine", tmp_path), load_tool("./mine", tmp_path)):
        assert tool.directory == copy
        assert tool.sdf.is_file()
        assert tool.grasp == shipped.grasp


def test_an_unknown_tool_is_rejected(tmp_path: Path):
    with pytest.raises(UserError, match="'spoon'"):
        load_tool("spoon", tmp_path)


@pytest.mark.parametrize("name", ["red_grip.obj", "flat_screwdriver.sdf"])
def test_a_missing_file_is_named(copy: Path, name: str):
    (copy / name).unlink()
    with pytest.raises(UserError, match=f"mine/{name}"):
        load_tool(str(copy))


def test_symmetry_is_optional_in_a_record(copy: Path):
    record = yaml.safe_load((copy / "tool.yaml").read_text())
    del record["symmetry"]
    (copy / "tool.yaml").write_text(yaml.safe_dump(record))
    assert load_tool(str(copy)).symmetry == 1
    change(copy, symmetry=2)
    assert load_tool(str(copy)).symmetry == 2


def test_an_explicit_path_is_not_taken_for_a_name(copy: Path, tmp_path: Path):
    mine = copy.rename(tmp_path / "claw_hammer")
    assert load_tool("./claw_hammer", tmp_path).directory == mine


@pytest.mark.parametrize(
    ("fields", "token"),
    [
        ({"category": "A spoon"}, "category 'A spoon'"),
        ({"symmetry": 0}, "symmetry is 0"),
        ({"width": float("nan")}, "width is nan"),
        ({"mass": -3.0}, "mass is -3"),
        ({"mass": "heavy"}, "heavy"),
        ({"grasp": {"x": 0.0}}, "missing"),
        ({"grasp": None}, "None"),
    ],
)
def test_an_invalid_record_is_rejected(copy: Path, fields: dict[str, object], token: str):
    change(copy, **fields)
    with pytest.raises(UserError, match=rf"tool\.yaml.*{token}"):
        load_tool(str(copy))


@pytest.mark.parametrize("text", ["", "[1]", "name: {", "name: screwdriver"])
def test_a_file_that_is_not_a_record_is_rejected(copy: Path, text: str):
    (copy / "tool.yaml").write_text(text)
    with pytest.raises(UserError, match=r"tool\.yaml"):
        load_tool(str(copy))


def test_surface_points_are_on_the_surface_and_deterministic():
    tool = load_tool("combination_wrench")
    points = tool.surface_points(500)
    np.testing.assert_array_equal(points, load_tool("combination_wrench").surface_points(500))
    faces = np.arange(3 * len(tool.triangles)).reshape(-1, 3)
    mesh = trimesh.Trimesh(tool.triangles.reshape(-1, 3), faces, process=False)
    # Sampling is by area, not by triangle, so the mean agrees with the area-weighted one.
    by_area = mesh.area_faces @ mesh.triangles_center / mesh.area
    np.testing.assert_allclose(points.mean(axis=0), by_area, atol=6e-3)
    _, distance, _ = trimesh.proximity.closest_point_naive(mesh, points[:20])
    assert distance.max() < 1e-9


def test_add_s_does_not_depend_on_the_tessellation(tmp_path: Path):
    tool = load_tool("flat_screwdriver")
    fine = []
    for path in tool.visual_meshes:
        mesh = trimesh.load_mesh(path, process=False)
        # Refine the mesh at one end only: a score that counted vertices would change.
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
    """The fields of a tool, without its cached properties."""
    return {name: getattr(tool, name) for name in Tool.__dataclass_fields__}
