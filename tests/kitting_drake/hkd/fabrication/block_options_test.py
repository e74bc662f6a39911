"""Options of the block: outer shape, fits of single tools, depths; also walls that are too thin."""

import dataclasses
import re
import subprocess
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import trimesh
from manifold3d import CrossSection, Manifold, Mesh64

from kitting_drake.common.errors import UserError
from kitting_drake.hkd.fabrication.design import Design, design_kit
from kitting_drake.hkd.fabrication.export import export_kit
from kitting_drake.hkd.fabrication.kit_request import KitRequest, error_notes, kit_parameters
from kitting_drake.hkd.fabrication.outside import FOOT, FOOT_HEIGHT, GAP, PITCH, grid_side
from kitting_drake.hkd.fabrication.thin_walls import undercut_notes, wall_notes
from kitting_drake.hkd.generation.part_models import load_named
from kitting_drake.hkd.kits.kit import make_kit
from kitting_drake.hkd.kits.layout import CavityPose, kit_cavities, layout_kit
from kitting_drake.hkd.kits.parameters import KitParameters
from kitting_drake.scenario.loader import load_scenario
from systems.bounds import check_bounds

PLATE, THICK, ROD = "plate_90x40x8", "plate_90x40x9", "rod_80x14"


def solid(path: Path) -> Manifold:
    mesh = trimesh.load_mesh(path)
    assert mesh.is_watertight
    assert len(mesh.split()) == 1
    return Manifold(Mesh64(np.array(mesh.vertices), mesh.faces.astype(np.uint64)))


def extent(section: CrossSection) -> tuple[float, float]:
    x_min, y_min, x_max, y_max = section.bounds()
    return x_max - x_min, y_max - y_min


@pytest.mark.parametrize(
    ("side", "bin_side"), [(20.0, 41.5), (41.5, 41.5), (41.6, 83.5), (167.5, 167.5)]
)
def test_sides_on_the_grid(side: float, bin_side: float):
    assert grid_side(side) == bin_side


def test_a_gridfinity_base(tmp_path: Path):
    made = export_kit(
        KitRequest((PLATE, ROD), tmp_path / "kit", gridfinity=True, bed_mm=(100.0, 100.0))
    )
    length, width, height = made.design.size_mm
    columns, rows = ((side + GAP) / PITCH for side in (length, width))
    assert columns == round(columns) and rows == round(rows)
    block = solid(tmp_path / "kit" / "kit.stl")
    np.testing.assert_allclose(
        block.bounding_box(), (0, 0, 0, length, width, height + FOOT_HEIGHT), atol=1e-4
    )
    for z, side in ((1e-3, FOOT[0][1]), (1.7, FOOT[1][1]), (4.749, FOOT[3][1])):
        feet = block.slice(z).decompose()
        assert len(feet) == round(columns * rows)
        for foot in feet:
            np.testing.assert_allclose(extent(foot), side, atol=0.01)
            middle = np.array(foot.bounds()).reshape(2, 2).mean(axis=0)
            np.testing.assert_allclose((middle + GAP / 2) % PITCH, PITCH / 2, atol=1e-3)
    # The block's corners are rounded, like those of a Gridfinity bin.
    corner = CrossSection.square((1.0, 1.0))
    assert (block.slice(30.0) ^ corner).is_empty()
    assert made.split is not None
    assert len(made.split.pieces) > 1


def test_the_outer_edges_have_a_chamfer(tmp_path: Path):
    made = export_kit(KitRequest((PLATE,), tmp_path / "kit", chamfer_mm=1.0))
    block = solid(tmp_path / "kit" / "kit.stl")
    length, width, height = made.design.size_mm
    for z, inset in ((0.25, 0.75), (20.0, 0.0), (height - 0.25, 0.75)):
        expected = (length - 2 * inset, width - 2 * inset)
        np.testing.assert_allclose(extent(block.slice(z)), expected, atol=0.01)


def test_a_fit_of_one_tool_is_printed_and_simulated(tmp_path: Path):
    def area(request: KitRequest) -> dict[str, float]:
        design = export_kit(request).design
        pairs = zip(design.kit.tools, design.cavities, strict=True)
        return {tool.name: cavity.outline.area() for tool, cavity in pairs}

    tools = (PLATE, ROD)
    snug = area(KitRequest(tools, tmp_path / "snug", clearance_mm=0.35))
    mixed = area(KitRequest(tools, tmp_path / "mixed", clearance_mm=0.35, fit_of=((ROD, 0.75),)))
    assert mixed[PLATE] == pytest.approx(snug[PLATE], rel=1e-3)
    grown = 2 * (0.080 + 0.014) * 0.0004
    assert mixed[ROD] - snug[ROD] == pytest.approx(grown, rel=0.06)
    kit = load_scenario(tmp_path / "mixed" / "scenario.yaml").task.kit
    assert kit.clearance_of == {ROD: 0.00075}
    assert kit.is_tight


def test_a_tool_may_stand_out():
    tools = [load_named(name) for name in (PLATE, ROD)]
    parameters = KitParameters(always_nested=True, stand_out=0.004)
    for tool, pose in zip(tools, layout_kit(tools, parameters).poses, strict=True):
        assert pose.z + tool.height == pytest.approx(parameters.height + 0.004)
    # A tool that stands out fits into a block of 12 mm.
    layout_kit(tools, KitParameters(always_nested=True, stand_out=0.004, height=0.012))
    with pytest.raises(UserError, match=r"'plate_90x40x8' is 8\.0 mm high.* by at most 4\.0 mm"):
        layout_kit(tools, KitParameters(always_nested=True, stand_out=0.005))


def two_plates(wall: float, compensation: float = 0.0) -> Design:
    """Two cavities of 94 by 44 mm, with a wall of `wall` (m) between them."""
    parameters = KitParameters(length=0.12, width=0.12, always_nested=True, lead_in=0.0)
    offset = 0.022 + wall / 2
    poses = [CavityPose(0.0, sign * offset, 0.042) for sign in (-1, 1)]
    kit = make_kit([load_named(name) for name in (PLATE, THICK)], parameters, poses)
    return design_kit(kit, compensation=compensation)


def test_walls_thinner_than_the_nozzle_are_reported():
    assert not wall_notes(two_plates(0.002), 0.0004)
    thin = two_plates(0.002, compensation=0.00085)
    (note,) = wall_notes(thin, 0.0004)
    found = re.fullmatch(
        rf"the wall between '{PLATE}' and '{THICK}' is (\S+) mm thin at \((\S+), (\S+)\), less "
        r"than the nozzle's 0\.4 mm",
        note,
    )
    assert found is not None
    assert float(found[1]) == pytest.approx(0.3, abs=0.03)
    assert (float(found[2]), float(found[3])) == pytest.approx((60.0, 60.0), abs=0.2)
    assert not wall_notes(thin, 0.00025)
    (note,) = wall_notes(two_plates(0.002, compensation=0.0011), 0.0004)
    assert note.startswith(f"there is no wall between '{PLATE}' and '{THICK}' at (60.0, 60.0)")


def test_an_undercut_is_reported_with_its_tool():
    kit = make_kit([load_named(PLATE)], KitParameters(always_nested=True))
    design = design_kit(kit)
    length, width, height = design.size_mm
    block = Manifold.cube((length, width, height))
    middle = (length / 2, width / 2)
    cavity = Manifold.cube((20, 20, 30), True).translate((*middle, height - 10))
    assert not undercut_notes(block - cavity, design)
    bulge = Manifold.cube((26, 20, 5), True).translate((*middle, height - 15))
    (note,) = undercut_notes(block - cavity - bulge, design)
    assert f"'{PLATE}'" in note
    assert f"{height - 12.5:.1f})" in note


@pytest.mark.parametrize(
    ("options", "token"),
    [
        (("--bed", "10", "200"), "--bed 10 is out of range: give 50 to 2000"),
        (("--bed", "nan", "200"), "--bed nan"),
        (("--joint_play_mm", "3"), "--joint_play_mm 3 is out of range"),
        (("--fit_of", "hammer=loose"), "the kit has no tool 'hammer'"),
        (("--fit_of", "rod_80x14=tight"), "FIT is snug, easy, loose or"),
        (("--fit_of", "rod_80x14=90"), "--fit_of rod_80x14=90 is out of range"),
        (("--stand_out_mm", "-1"), "--stand_out_mm -1 is out of range"),
        (("--stand_out_mm", "12"), "stand out by at most 10.0 mm"),
        (("--nozzle_mm", "0"), "--nozzle_mm 0 is out of range"),
        (("--chamfer_mm", "2.5", "--wall_mm", "4"), "--chamfer_mm 2.5 is more than half"),
        (("--base", "gridfinity", "--block_mm", "100", "80", "50"), "give 125.5 83.5"),
        (("--copies", "3"), "--beside and --copies need --sheet"),
        (("--sheet", "90", "30"), "--sheet 30 is out of range"),
        (("--sheet", "90", "60"), "does not fit on a sheet of 90 by 60 mm"),
        (
            ("--sheet", "600", "400", "--beside", "missing"),
            "missing is not a folder that `hkd kit`",
        ),
    ],
)
def test_bad_input_is_answered_in_one_sentence(
    options: tuple[str, ...],
    token: str,
    verb: Callable[..., subprocess.CompletedProcess[str]],
    tmp_path: Path,
):
    done = verb("hkd", "kit", ROD, "--output", tmp_path / "kit", *options)
    assert done.returncode == 2
    assert token in done.stderr.strip().splitlines()[-1]
    assert not (tmp_path / "kit").exists()


def test_the_fit_of_a_tool_has_a_range():
    check_bounds(KitParameters(clearance_of={ROD: 0.001}))
    with pytest.raises(ValueError, match=r"^clearance_of\.rod_80x14 must be between 0 and 0\.01"):
        check_bounds(KitParameters(clearance_of={ROD: 0.02}))


def test_cavities_by_name_keep_the_default_elsewhere():
    tools = [load_named(name) for name in (PLATE, ROD)]
    plain = KitParameters(always_nested=True)
    named = KitParameters(always_nested=True, clearance_of={"another": 0.001})
    poses = layout_kit(tools, plain).poses
    for one, other in zip(
        kit_cavities(tools, plain, poses), kit_cavities(tools, named, poses), strict=True
    ):
        assert one.outline.area() == other.outline.area()


@pytest.mark.parametrize(
    ("asked", "fit_of", "expected"),
    [(0.35, (), 0.85), (1.8, (), 2.0), (3.0, (), 3.0), (0.35, ((ROD, 0.15),), 0.15)],
)
def test_a_traced_tool_gets_room_for_the_error_of_its_outline(
    asked: float, fit_of: tuple, expected: float, tmp_path: Path
):
    tool = dataclasses.replace(load_named(ROD), outline_error=0.0005)
    request = KitRequest((ROD,), tmp_path, clearance_mm=asked, fit_of=fit_of)
    parameters = kit_parameters(request, {ROD: tool})
    assert parameters.clearance_of[ROD] == pytest.approx(1e-3 * expected)
    assert bool(error_notes(request, [tool])) == (not fit_of)
