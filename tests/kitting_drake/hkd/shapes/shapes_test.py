"""The project's flat shapes, and shapes of a folder."""

import math
from pathlib import Path

import numpy as np
import pytest
import trimesh
import yaml
from manifold3d import CrossSection

from kitting_drake.common.errors import UserError
from kitting_drake.hkd.kits.layout import cavity_outline
from kitting_drake.hkd.shapes.shape_outlines import ROUND, SHAPES, OutlinedShape
from kitting_drake.hkd.shapes.shape_tools import imported_shape, shape_files, shape_tool, shapes_of
from kitting_drake.hkd.tools.meshes import vertices_and_faces
from kitting_drake.hkd.tools.solids import without_holes
from kitting_drake.hkd.tools.tool import centroid
from kitting_drake.tasks import AssemblingKits

each_shape = pytest.mark.parametrize("shape", SHAPES, ids=lambda shape: shape.name)
BY_NAME = {shape.name: shape for shape in SHAPES}


def about_its_axis(shape: OutlinedShape) -> CrossSection:
    outline = shape.draw()
    x, y = centroid(outline)
    return outline.translate((-x, -y))


def write_prism(path: Path, outline: CrossSection, height: float) -> Path:
    vertices, faces = vertices_and_faces(outline.extrude(height))
    trimesh.Trimesh(vertices, faces, process=False).export(path)
    return path


def test_fourteen_shapes_for_training_and_six_for_tests():
    assert (len(shapes_of("train")), len(shapes_of("test"))) == (14, 6)
    assert len(BY_NAME) == 20


@each_shape
def test_a_shape_is_one_piece_of_the_right_size(shape: OutlinedShape):
    outline = shape.draw()
    x_min, y_min, x_max, y_max = outline.bounds()
    short, long = sorted((x_max - x_min, y_max - y_min))
    assert 30 <= short <= 61
    assert 45 <= long <= 76
    assert len(outline.decompose()) == 1


@each_shape
def test_the_declared_symmetry_is_the_shapes(shape: OutlinedShape):
    outline = about_its_axis(shape)

    def other(turn_deg: float) -> float:
        """The fraction of the rotated shape's area that lies outside the unrotated shape."""
        return float((outline.rotate(turn_deg) - outline).area() / outline.area())

    step = 360 / shape.symmetry
    assert other(step) < 0.005
    if shape.symmetry != ROUND:
        assert min(other(step / 2), other(step / 3)) > 0.03


@each_shape
def test_a_turned_shape_does_not_fit_its_cavity(shape: OutlinedShape):
    """If the cavity bridged too many notches of the outline, the shape would fit at any heading."""
    outline = about_its_axis(shape).scale((1e-3, 1e-3))
    cavity = cavity_outline(outline, AssemblingKits().kit)
    assert (outline - cavity).area() < 1e-9
    if shape.symmetry != ROUND:
        turned = outline.rotate(180 / shape.symmetry)
        assert (turned - cavity).area() > 0.01 * outline.area()


def test_the_hulls_of_a_ring_leave_its_hole_open():
    tool = shape_tool(BY_NAME["ring"])
    assert tool.symmetry == ROUND
    hulls = [trimesh.load_mesh(path) for path in tool.directory.glob("collision_*.obj")]
    covered = CrossSection()
    for hull in hulls:
        assert hull.bounds[:, 2] == pytest.approx([0.0, tool.height])
        covered += CrossSection.hull_points(1e3 * np.asarray(hull.vertices)[:, :2])
    assert (covered ^ CrossSection.circle(11.0, 96)).area() < 1e-6
    outer = without_holes(covered)
    assert outer.area() == pytest.approx(math.pi * 30.0**2, rel=0.02)


def test_a_mesh_is_scaled_as_in_ravens(tmp_path: Path):
    """A triangle with sides of 20 units is scaled to 60 mm. It is held by a corner and a side."""
    triangle = CrossSection(
        [20 / 3**0.5 * np.array([(1, 0), (-0.5, 0.75**0.5), (-0.5, -(0.75**0.5))])]
    )
    path = write_prism(tmp_path / "02.obj", triangle, 20.0)
    tool = imported_shape(path)
    assert (tool.name, tool.symmetry) == ("shape_02", 3)
    assert sorted((tool.length, tool.width)) == pytest.approx([0.030 * 3**0.5, 0.060], abs=1e-5)
    assert tool.height == pytest.approx(0.020)
    assert tool.grasp.width == pytest.approx(0.030 * 3**0.5, abs=5e-4)
    # The axis is at a third of the triangle's height, not in the middle of its bounding box.
    assert tool.axis == pytest.approx((-0.030 * 3**0.5 / 6, 0.0), abs=1e-5)
    assert imported_shape(path).directory == tool.directory
    record = yaml.safe_load((tool.directory / "tool.yaml").read_text())
    assert record["center_of_mass"][:2] == pytest.approx(tool.axis, abs=1e-5)


@pytest.mark.parametrize(
    ("size", "height", "part"),
    [
        ((200.0, 20.0), 20.0, "give another scale"),
        ((20.0, 20.0), 2.0, "give another scale"),
        ((0.8, 20.0), 40.0, "does not lie flat"),
        ((40.0, 40.0), 20.0, "cannot hold"),
    ],
)
def test_what_is_not_a_flat_shape_is_refused(
    tmp_path: Path, size: tuple[float, float], height: float, part: str
):
    path = write_prism(tmp_path / "plate.obj", CrossSection.square(size, True), height)
    with pytest.raises(UserError, match=part) as caught:
        imported_shape(path)
    assert str(path) in str(caught.value)


def test_a_folder_without_meshes_is_refused(tmp_path: Path):
    with pytest.raises(UserError, match="no meshes"):
        shape_files(tmp_path)
    with pytest.raises(UserError, match="no folder"):
        shape_files(tmp_path / "nowhere")
