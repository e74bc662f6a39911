"""Simple parts: their models, their grasps, and their kits."""

import itertools
from pathlib import Path

import numpy as np
import pytest
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph
from pydrake.systems.framework import DiagramBuilder

from kitting_drake.common.errors import UserError
from kitting_drake.hkd.generation.part_kinds import PART_KINDS, design_part
from kitting_drake.hkd.generation.part_models import load_named, sized_part
from kitting_drake.hkd.grasps.grip import find_grip
from kitting_drake.hkd.kits.layout import layout_kit
from kitting_drake.hkd.kits.parameters import KitParameters
from kitting_drake.hkd.tools.tool import LONGEST_MM
from systems.hand_geometry import MAX_OPENING, PAD_LENGTH


@pytest.mark.parametrize("kind", PART_KINDS)
def test_a_part_is_what_its_name_says(kind: str):
    tool = load_named(kind)
    dimensions = PART_KINDS[kind].default
    assert tool.name == f"{kind}_{'x'.join(f'{value:g}' for value in dimensions)}"
    assert load_named(tool.name) == tool
    corners = tool.triangles.reshape(-1, 3)
    size = corners.max(axis=0) - corners.min(axis=0)
    assert size == pytest.approx([tool.length, tool.width, tool.height], abs=2e-5)
    assert max(size) == pytest.approx(1e-3 * max(dimensions), rel=0.03)
    assert corners[:, 2].min() == pytest.approx(0, abs=1e-6)
    assert np.abs(corners[:, :2].max(axis=0) + corners[:, :2].min(axis=0)).max() < 1e-5


@pytest.mark.parametrize("kind", PART_KINDS)
def test_jaws_close_on_what_a_parts_grasp_says(kind: str):
    """A large ring is held by its rim: one pad is inside the ring, the other outside."""
    for length, shares in itertools.product((0.015, 0.04, 0.35), ((0.0, 0.0), (1.0, 1.0))):
        tool = sized_part(kind, length, shares)
        grasp = tool.grasp
        assert 0.003 <= grasp.width < MAX_OPENING - 0.009
        assert 0.0039 < tool.height < 0.048
        if kind == "ring" and tool.length > 0.07:
            middle = np.hypot(grasp.x, grasp.y)
            assert middle + grasp.width / 2 == pytest.approx(tool.length / 2, abs=1e-4)
            continue
        grip = find_grip(tool.triangles, grasp.x, grasp.y, grasp.theta, PAD_LENGTH)
        assert grip is not None
        assert grip.top >= grasp.surface_height - 1e-5
        if kind not in ("bolt", "bracket", "socket"):
            assert abs(grip.middle) < 3e-4
            assert grip.width == pytest.approx(grasp.width, abs=3e-4)


def test_a_part_has_one_link_in_contact_along_its_outline():
    builder = DiagramBuilder()
    plant, _ = AddMultibodyPlantSceneGraph(builder, 0.01)
    tools = [load_named(name) for name in ("ring_100x80x10", "board", "socket")]
    for tool in tools:
        (model,) = Parser(plant).AddModels(str(tool.sdf))
        (body,) = plant.GetBodyIndices(model)
        assert plant.get_body(body).default_mass() == pytest.approx(tool.mass, rel=1e-3)
    assert len(plant.GetCollisionGeometriesForBody(plant.GetBodyByName("tool", model))) == 2


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("ring_100x30x10", "a bore of 30 mm is too narrow"),
        ("plate_100x90x10", "the jaws hold 3 to 70 mm"),
        ("plate_50x20x2", "the hand needs at least 4 mm"),
        ("ring_40x20", "outer x inner x height in mm"),
        (f"rod_{LONGEST_MM + 1:g}x10", "must be 2 to 350 mm"),
    ],
)
def test_impossible_parts_are_refused(name: str, message: str):
    with pytest.raises(UserError, match=message):
        load_named(name)


def test_a_folder_is_no_part(tmp_path: Path):
    with pytest.raises(UserError, match="there is no tool 'rings'"):
        load_named("rings", tmp_path)


def test_parts_fit_into_a_kit():
    parts = [sized_part(kind, 0.03, (0.5, 0.5)) for kind in PART_KINDS]
    layout = layout_kit(parts, KitParameters())
    assert layout.parameters.length * layout.parameters.width < 0.2**2


def test_designs_are_symmetric_as_they_say():
    for kind, known in PART_KINDS.items():
        design = design_part(kind, known.default)
        whole = sum((part.solid for part in design.parts[1:]), design.parts[0].solid)
        outline = whole.project()
        turned = outline.rotate(360 / design.symmetry)
        different = (outline - turned).area() + (turned - outline).area()
        assert different < 0.02 * outline.area() + 1e-6, kind
