import errno
import io
import json
import math
import os
import re
import shutil
import subprocess
import xml.etree.ElementTree as ElementTree
import zipfile
from collections.abc import Callable, Iterable
from pathlib import Path

import ezdxf
import numpy as np
import pytest
import trimesh
from manifold3d import CrossSection, FillRule, JoinType, Manifold, Mesh64
from numpy.typing import NDArray
from PIL import Image
from scipy.spatial import cKDTree

from kitting_drake.common.errors import UserError
from kitting_drake.hkd.fabrication.design import design_kit
from kitting_drake.hkd.fabrication.export import export_kit
from kitting_drake.hkd.fabrication.kit_request import KitRequest
from kitting_drake.hkd.fabrication.notches import _is_wall_between
from kitting_drake.hkd.importing.importer import ImportRequest, import_tool
from kitting_drake.hkd.kits.block import Cavity
from kitting_drake.hkd.kits.kit import make_kit
from kitting_drake.hkd.kits.parameters import KitParameters
from kitting_drake.hkd.tools.tool import load_tool, tool_names
from kitting_drake.scenario.loader import load_scenario
from kitting_drake.scenario.robots import FrankaArm
from systems.signals import PixelGrid

FOUR = ("claw_hammer", "slip_joint_pliers", "combination_wrench", "flat_screwdriver")
SPANNER = """<svg xmlns="http://www.w3.org/2000/svg" width="200mm" height="80mm" \
viewBox="0 0 400 160"><path d="M 60 60 h 240 c 20 -30 60 -30 70 0 v 30 c -10 30 -50 30 -70 0 h \
-240 c -20 20 -40 0 -40 -15 c 0 -15 20 -35 40 -15 z"/></svg>"""


@pytest.fixture(scope="module")
def own_tool(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a tool imported from an outline."""
    folder = tmp_path_factory.mktemp("own")
    (folder / "spanner.svg").write_text(SPANNER)
    request = ImportRequest(
        folder / "spanner.svg", "wrench", output=folder / "tools", height_mm=12.0
    )
    return import_tool(request, time_limit=None).directory


@pytest.fixture(scope="module")
def bar(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a rectangular tool; a tight block leaves no room for notches or labels."""
    folder = tmp_path_factory.mktemp("bar")
    (folder / "bar.svg").write_text(
        '<svg xmlns="http://www.w3.org/2000/svg" width="160mm" height="14mm" viewBox="0 0 160 14">'
        '<rect width="160" height="14"/></svg>'
    )
    request = ImportRequest(folder / "bar.svg", "bar", output=folder, height_mm=10.0)
    return import_tool(request, time_limit=None).directory


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory, own_tool: Path) -> Path:
    """The folder of a kit with two copies of a user's tool and one of the project's tools."""
    folder = tmp_path_factory.mktemp("plain") / "kit"
    export_kit(KitRequest((str(own_tool), "claw_hammer", str(own_tool)), folder))
    return folder


@pytest.fixture(scope="module")
def full(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a kit with notches and labels."""
    folder = tmp_path_factory.mktemp("full") / "kit"
    export_kit(KitRequest(FOUR, folder, notches=True, labels=True))
    return folder


def stl(folder: Path) -> trimesh.Trimesh:
    return trimesh.load_mesh(folder / "kit.stl")


def solid(folder: Path) -> Manifold:
    """The printed block, in mm."""
    mesh = stl(folder)
    return Manifold(Mesh64(np.array(mesh.vertices), mesh.faces.astype(np.uint64)))


def record(folder: Path) -> dict:
    return json.loads((folder / "kit.json").read_text())


def polylines(folder: Path, *kinds: str) -> list[tuple[float, NDArray]]:
    """Depth and points (n, 2), in mm, of the DXF's closed polylines of the given kinds."""
    document = ezdxf.readfile(folder / "cavities.dxf")
    assert document.header["$INSUNITS"] == 4
    found = []
    for entity in document.modelspace():
        match = re.fullmatch(r"([A-Z]+)_([0-9.]+)_MM_DEEP", entity.dxf.layer)
        if match and match[1] in kinds:
            assert entity.closed
            found.append((float(match[2]), np.array(entity.get_points("xy"))))
    return found


def points_along(segments: Iterable[NDArray], step: float) -> NDArray:
    """Points (n, 2) on segments (2, 2), at most a step apart."""
    points = []
    for a, b in segments:
        count = max(2, int(np.ceil(np.linalg.norm(b - a) / step)) + 1)
        points.append(a + np.linspace(0, 1, count)[:, None] * (b - a))
    return np.concatenate(points)


def edges(loops: Iterable[NDArray]) -> list[NDArray]:
    return [np.array(edge) for p in loops for edge in zip(p, np.roll(p, -1, axis=0), strict=True)]


def hausdorff(one: list[NDArray], other: list[NDArray]) -> float:
    """The Hausdorff distance, in mm."""
    a, b = points_along(one, 0.02), points_along(other, 0.02)
    return float(max(cKDTree(a).query(b)[0].max(), cKDTree(b).query(a)[0].max()))


def walls_of_block(folder: Path, z: float) -> list[NDArray]:
    """The edges (mm) of the cavities in a horizontal slice of the printed block."""
    length, width, _ = record(folder)["block"]
    loops = [np.array(loop) for loop in solid(folder).slice(z).to_polygons()]
    outside = np.array([length, width])
    return edges(loop for loop in loops if not np.allclose(np.ptp(loop, axis=0), outside))


def wall_distances(folder: Path) -> tuple[float, float]:
    """The distances of the STL's walls from the SDFormat's and the DXF's, in mm.

    Each is the largest Hausdorff distance over two slices of each cavity: near its floor and below
    the bevel.
    """
    made = record(folder)
    length, width, height = made["block"]
    sides = trimesh.load_mesh(folder / "sdf" / "contact_sides.obj", process=False)
    corner = np.array([length, width]) / 2
    top = height - 1e3 * made["kit_parameters_m"]["lead_in"]
    outlines = polylines(folder, "CAVITIES")
    to_sdf, to_dxf = 0.0, 0.0
    floors = sorted({height - depth for depth, _ in outlines})
    for floor in floors:
        for z in (floor + 0.15, top - 0.15):
            # A slice in the plane of any cavity's floor is ambiguous.
            while min(abs(z - other) for other in floors) < 0.02:
                z += 0.03
            walls = walls_of_block(folder, z)
            cut = trimesh.intersections.mesh_plane(sides, (0, 0, 1), (0, 0, 1e-3 * z))
            simulated = list(1e3 * cut[:, :, :2] + corner)
            drawn = edges(points for deep, points in outlines if height - deep < z)
            to_sdf = max(to_sdf, hausdorff(walls, simulated))
            to_dxf = max(to_dxf, hausdorff(walls, drawn))
    return to_sdf, to_dxf


def test_the_printed_walls_match_simulation_and_drawing(plain: Path):
    assert stl(plain).is_watertight
    to_sdf, to_dxf = wall_distances(plain)
    # Points are 0.02 mm apart, so deviations below 0.01 mm cannot be told from zero.
    assert max(to_sdf, to_dxf) < 0.015


def test_all_files_show_the_same_block_in_millimetres(full: Path):
    length, width, height = record(full)["block"]
    mesh = stl(full)
    assert mesh.is_watertight
    assert len(mesh.split()) == 1
    np.testing.assert_allclose(mesh.bounds, [[0, 0, 0], [length, width, height]], atol=1e-4)
    with zipfile.ZipFile(full / "kit.3mf") as archive:
        model = ElementTree.fromstring(archive.read("3D/3dmodel.model"))
    space = {"m": "http://schemas.microsoft.com/3dmanufacturing/core/2015/02"}
    assert model.get("unit") == "millimeter"
    vertices = [[float(v.get(k)) for k in "xyz"] for v in model.iterfind(".//m:vertex", space)]
    faces = [
        [int(t.get(k)) for k in ("v1", "v2", "v3")] for t in model.iterfind(".//m:triangle", space)
    ]
    other = trimesh.Trimesh(vertices, faces)
    assert other.is_watertight
    assert other.volume == pytest.approx(mesh.volume, rel=1e-6)
    svg = ElementTree.parse(full / "cavities.svg").getroot()
    assert svg.get("width") == f"{length:g}mm"
    assert svg.get("viewBox") == f"0 0 {length:g} {width:g}"
    drawn = {
        (entity.dxf.layer, round(x, 4), round(width - y, 4))
        for entity in ezdxf.readfile(full / "cavities.dxf").modelspace()
        for x, y in entity.get_points("xy")
    }
    assert drawn == {
        (group.get("id"), round(float(x), 4), round(float(y), 4))
        for group in svg.iterfind("{*}g")
        for path in group.iterfind("{*}path")
        for x, y in re.findall(r"[ML] (\S+) (\S+)", path.get("d"))
    }
    Image.open(io.BytesIO((full / "kit.png").read_bytes())).verify()


def test_the_solid_is_cut_exactly_as_drawn(full: Path):
    block, height = solid(full), record(full)["block"][2]
    drawn = polylines(full, "CAVITIES", "NOTCHES")
    assert {depth for depth, _ in polylines(full, "LABELS")} == {0.6}
    # Compare slices below the letters and bevels, down to the deepest floor.
    for z in np.arange(1.5, max(depth for depth, _ in drawn), 4.3):
        open_there = CrossSection()
        for depth, points in drawn:
            if depth > z:
                open_there += CrossSection([points])
        length, width, _ = record(full)["block"]
        expected = CrossSection.square((length, width)) - open_there
        assert xor(block.slice(height - z), expected) < 0.05
    letters = CrossSection([points for _, points in polylines(full, "LABELS")], FillRule.EvenOdd)
    assert letters.area() > 200
    assert (block.slice(height - 0.55) ^ letters).area() < 0.01
    assert (block.slice(height - 0.65) ^ letters).area() == pytest.approx(letters.area(), rel=1e-3)


def xor(one: CrossSection, other: CrossSection) -> float:
    return (one - other).area() + (other - one).area()


def test_notches_keep_their_distance():
    kit = make_kit([load_tool(name) for name in FOUR], KitParameters(always_nested=True))
    design = design_kit(kit, notches=True)
    notches = [recess for recess in design.recesses if recess.kind == "notch"]
    assert {notch.tool for notch in notches} == set(FOUR)
    length, width, _ = kit.size
    for index, notch in enumerate(notches):
        for tool, cavity in zip(kit.tools, design.cavities, strict=True):
            if tool.name != notch.tool:
                assert (notch.outline ^ cavity.rim.offset(0.0029, JoinType.Round)).is_empty()
        for other in notches[:index]:
            assert (notch.outline ^ other.outline.offset(0.0029, JoinType.Round)).is_empty()
        x_min, y_min, x_max, y_max = notch.outline.bounds()
        assert max(-x_min, x_max) < length / 2 - 0.0029
        assert max(-y_min, y_max) < width / 2 - 0.0029


@pytest.mark.parametrize("apart", [0.001, 0.004])
@pytest.mark.parametrize("inside", [False, True])
def test_notches_of_one_tool_have_a_wall_between_them(apart: float, inside: bool):
    """Two notches need a wall of 3 mm between them, except within the cavity, which is open."""
    one = CrossSection.square((0.02, 0.02))
    other = one.translate((0.02 + apart, 0.0))
    side = 0.1 if inside else 0.01
    cavity = Cavity(CrossSection.square((side, side)), floor=0.03, top=0.05, lead_in=0.001)
    assert _is_wall_between(one, other, cavity, 0.003) == (inside or apart > 0.003)


def test_a_note_on_a_missing_notch_and_a_label_on_the_floor(bar: Path, tmp_path: Path):
    request = KitRequest((str(bar),), tmp_path, wall_mm=2.0, notches=True, labels=True)
    made = export_kit(request)
    design = made.design
    assert len(design.notes) == 1
    assert "notch" in design.notes[0] and "'bar'" in design.notes[0]
    assert record(tmp_path)["notes"] == list(design.notes)
    (label,) = (recess for recess in design.recesses if recess.kind == "label")
    assert label.floor == pytest.approx(design.cavities[0].floor - 0.0006)
    assert (label.outline - design.cavities[0].outline).is_empty()


def test_the_scenario_loads_the_printed_kit_after_moving_the_folder(plain: Path, tmp_path: Path):
    moved = tmp_path / "moved"
    shutil.copytree(plain, moved)
    scenario = load_scenario(moved / "scenario.yaml")
    scene = scenario.task.make_scene(grid=PixelGrid(), seed=0, base=moved)
    assert [item.category for item in scene.objects].count("wrench") == 2
    assert all(moved in i.model.parents or "claw" in i.name for i in scene.objects)
    simulated = scene.fixtures[0].model.parent
    for file in (moved / "sdf").iterdir():
        assert file.read_bytes() == (simulated / file.name).read_bytes()


def test_a_block_of_given_size(tmp_path: Path):
    block = (230.0, 210.0, 30.0)
    export_kit(KitRequest(FOUR[2:], tmp_path / "kit", block_mm=block, clearance_mm=1.0))
    assert record(tmp_path / "kit")["block"] == list(block)
    np.testing.assert_allclose(stl(tmp_path / "kit").bounds[1], block, atol=1e-4)
    scenario = load_scenario(tmp_path / "kit" / "scenario.yaml")
    scene = scenario.task.make_scene(grid=PixelGrid(), seed=0, base=tmp_path / "kit")
    assert scene.goals[0].rim_height == pytest.approx(0.030)


@pytest.mark.parametrize("clearance", [0.1, pytest.param(0.2, marks=pytest.mark.slow)])
def test_a_small_clearance_is_kept(clearance: float, tmp_path: Path):
    request = KitRequest(("claw_hammer",), tmp_path / "kit", clearance_mm=clearance)
    design = export_kit(request).design
    kit = design.kit
    pose = kit.layout.poses[0]
    outline = kit.tools[0].footprint.rotate(math.degrees(pose.yaw)).translate((pose.x, pose.y))
    grown = outline.offset(0.8e-3 * clearance, JoinType.Round)
    assert (grown - design.cavities[0].outline).area() < 1e-10


def test_the_floor_below_a_tool_may_be_as_thin_as_a_wall(bar: Path, tmp_path: Path):
    height = 1e3 * load_tool(str(bar)).height
    export_kit(KitRequest((str(bar),), tmp_path, block_mm=(300.0, 300.0, height + 2.0)))


@pytest.mark.parametrize(
    ("options", "token"),
    [
        ({"tools": ("no_such_tool",)}, "no_such_tool"),
        ({"tools": FOUR * 4}, "not 16"),
        ({"tools": FOUR[:1], "block_mm": (120.0, 100.0, 50.0)}, "120 by 100 mm"),
        ({"tools": FOUR, "block_mm": (300.0, 300.0, 15.0)}, "15.0 mm"),
        ({"tools": FOUR, "block_mm": (300.0, 3e4, 50.0)}, "width of 30000"),
        ({"tools": FOUR, "clearance_mm": -1.0}, "--clearance_mm -1"),
        ({"tools": FOUR, "wall_mm": float("nan")}, "--wall_mm nan"),
    ],
)
def test_an_impossible_kit_leaves_nothing(options: dict, token: str, tmp_path: Path):
    with pytest.raises(UserError, match=re.escape(token)):
        export_kit(KitRequest(output=tmp_path / "new" / "kit", **options))
    assert not any(tmp_path.iterdir())


def test_a_kit_replaces_only_a_kit(plain: Path, tmp_path: Path):
    folder = tmp_path / "kit"
    shutil.copytree(plain, folder)
    export_kit(KitRequest(("claw_hammer",), folder))
    assert [tool["name"] for tool in record(folder)["tools"]] == ["claw_hammer"]
    assert not (folder / "tools").exists()
    assert [path.name for path in tmp_path.iterdir()] == ["kit"]
    (folder / "notes.txt").write_text("mine")
    with pytest.raises(UserError, match=r"notes\.txt"):
        export_kit(KitRequest(("claw_hammer",), folder))
    assert (folder / "notes.txt").read_text() == "mine"


def test_a_kit_that_cannot_be_moved_into_place_keeps_the_old_one(
    plain: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    folder = tmp_path / "kit"
    shutil.copytree(plain, folder)
    rename = os.rename

    def refuse(source: Path, target: Path) -> None:
        if target == folder and Path(source).name == "kit":
            raise OSError(errno.EBUSY, "Device or resource busy")
        rename(source, target)

    monkeypatch.setattr(os, "rename", refuse)
    with pytest.raises(UserError, match="Device or resource busy"):
        export_kit(KitRequest(("claw_hammer",), folder))
    assert len(record(folder)["tools"]) == 3
    assert [path.name for path in tmp_path.iterdir()] == ["kit"]


def test_the_command_suggests_a_tool_name(
    verb: Callable[..., subprocess.CompletedProcess[str]], tmp_path: Path
):
    done = verb("hkd", "kit", "claw_hamer", "--output", tmp_path / "kit")
    assert done.returncode == 2
    assert done.stderr.strip().splitlines()[-1].endswith("did you mean 'claw_hammer'?")


@pytest.mark.slow
def test_a_kit_for_an_arm_says_how_often_it_is_in_reach(
    verb: Callable[..., subprocess.CompletedProcess[str]],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
):
    monkeypatch.setattr("kitting_drake.hkd.__main__._SCENES", 3)
    robot, folder = tmp_path / "robot.yaml", tmp_path / "kit"
    robot.write_text("{model: panda, base: [-0.25, 0.5, 0], home: [0.3, 0.2, 0.4, 0]}")
    done = verb("hkd", "kit", "claw_hammer", "--output", folder, "--robot", robot)
    assert done.returncode == 0, done.stderr
    note = re.search(r"reaches all cavities and tools in (\d) of 3 scenes; (.*)", done.stdout)
    assert note is not None
    assert int(note[1]) < 3
    assert "claw_hammer at (" in note[2]
    scenario = load_scenario(folder / "scenario.yaml")
    assert scenario.robot == FrankaArm(model="panda", base=[-0.25, 0.5, 0.0])
    assert scenario.planner.home == [0.3, 0.2, 0.4, 0.0]


def test_no_kit_is_made_for_an_arm_in_the_workspace(
    verb: Callable[..., subprocess.CompletedProcess[str]], tmp_path: Path
):
    robot = tmp_path / "robot.yaml"
    robot.write_text("{base: [0.5, 0, 0]}")
    done = verb("hkd", "kit", "claw_hammer", "--output", tmp_path / "kit", "--robot", robot)
    assert done.returncode == 2
    assert "the arm's foot stands in the workspace" in done.stderr
    assert not (tmp_path / "kit").exists()


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(5))
def test_the_printed_walls_of_random_kits_match(seed: int, own_tool: Path, tmp_path: Path):
    rng = np.random.default_rng(seed)
    tools = [str(name) for name in rng.choice(tool_names(), rng.integers(2, 7))]
    for flags in (False, True):
        folder = tmp_path / str(flags)
        export_kit(KitRequest((*tools, str(own_tool)), folder, notches=flags, labels=flags))
        assert stl(folder).is_watertight
    assert max(wall_distances(tmp_path / "False")) < 0.1


@pytest.mark.slow
def test_the_written_scenario_succeeds(
    verb: Callable[..., subprocess.CompletedProcess[str]],
    rendering: None,
    plain: Path,
    tmp_path: Path,
):
    done = verb("run", plain / "scenario.yaml", "--no-meshcat", "--output", tmp_path)
    assert done.returncode == 0, done.stderr
    assert json.loads((tmp_path / "results.json").read_text())["strict_success_rate"] == 1.0


def test_compensation_widens_what_is_cut_but_not_what_is_simulated(bar: Path, tmp_path: Path):
    def cut(compensate_mm: float) -> tuple[float, dict[str, object]]:
        folder = tmp_path / f"{compensate_mm:g}"
        request = KitRequest((str(bar),), folder, clearance_mm=0.5, compensate_mm=compensate_mm)
        export_kit(request)
        drawing = ezdxf.readfile(folder / "cavities.dxf").modelspace()
        widths = [
            np.ptp(np.array(item.get_points("xy")), axis=0).min()
            for item in drawing.query("LWPOLYLINE")
            if item.dxf.layer.startswith("CAVITIES")
        ]
        return min(widths), json.loads((folder / "kit.json").read_text())

    (plain, record), (wider, compensated) = cut(0.0), cut(0.1)
    assert plain == pytest.approx(15.0, abs=0.06)
    assert wider - plain == pytest.approx(0.2, abs=0.005)
    assert record["kit_parameters_m"] == compensated["kit_parameters_m"]
    hole = trimesh.load_mesh(tmp_path / "0.1" / "test_piece.stl")
    assert hole.is_watertight and hole.volume == pytest.approx(8 * (32**2 - 20**2))
