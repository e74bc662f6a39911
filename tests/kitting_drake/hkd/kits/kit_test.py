import dataclasses
import itertools
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
import trimesh
from manifold3d import CrossSection, Error, JoinType, Manifold, Mesh, OpType
from numpy.typing import NDArray

from kitting_drake.common.errors import UserError
from kitting_drake.hkd.kits import kit as kit_module
from kitting_drake.hkd.kits import nesting
from kitting_drake.hkd.kits.block import Cavity, build_block, contact_surfaces
from kitting_drake.hkd.kits.clearance import measure_clearance
from kitting_drake.hkd.kits.kit import make_kit
from kitting_drake.hkd.kits.layout import SLOTS, kit_cavities, layout_kit
from kitting_drake.hkd.kits.parameters import KitParameters
from kitting_drake.hkd.tools.scaling import scaled_tool
from kitting_drake.hkd.tools.tool import Tool, load_tool

NAMES = ["claw_hammer", "slip_joint_pliers", "combination_wrench", "flat_screwdriver"]
PARAMETERS = KitParameters()


@pytest.fixture(scope="module")
def tools() -> list[Tool]:
    return [load_tool(name) for name in NAMES]


@pytest.fixture(scope="module")
def cavities(tools: list[Tool]) -> list[Cavity]:
    return kit_cavities(tools, PARAMETERS)


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Sets an empty cache; returns its folder of kits."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    return tmp_path / "kitting_drake" / "kits"


def seated_outline(tool: Tool) -> CrossSection:
    return tool.footprint.translate(SLOTS[tool.category])


def grown(outline: CrossSection, distance: float) -> CrossSection:
    return outline.offset(distance, JoinType.Round, circular_segments=128)


def test_the_files_of_a_kit_are_watertight_and_connected(tools: list[Tool], cache: Path):
    kit = make_kit(tools, PARAMETERS)
    block = trimesh.load_mesh(kit.sdf.parent / "kit.obj")
    assert block.is_watertight
    assert block.is_winding_consistent
    assert len(block.split()) == 1


def test_the_block_is_watertight_and_connected(cavities: list[Cavity]):
    block = build_block(cavities, PARAMETERS)
    assert block.status() == Error.NoError
    assert len(block.decompose()) == 1
    bounds = np.array(block.bounding_box())
    np.testing.assert_allclose(bounds, [-0.14, -0.13, 0, 0.14, 0.13, 0.05], atol=1e-6)
    pits = sum(c.outline.area() * (c.top - c.floor) for c in cavities)
    bevels = sum(c.outline.to_polygons()[0].shape[0] > 0 for c in cavities)
    assert bevels == len(NAMES)
    # The bevels also remove volume: a triangle of 1 mm along about 2 m of rim.
    assert 0 < 0.28 * 0.26 * 0.05 - pits - block.volume() < 2e-6


def test_cavities_are_open_at_the_top_and_end_at_the_floor(
    tools: list[Tool], cavities: list[Cavity]
):
    block = build_block(cavities, PARAMETERS)
    for tool, cavity in zip(tools, cavities, strict=True):
        # The seated tool's top is flush with the block's.
        assert cavity.floor + tool.height == pytest.approx(PARAMETERS.height)
        shadow = seated_outline(tool)
        for height, free in ((cavity.floor + 1e-4, True), (cavity.floor - 1e-4, False)):
            inside = (block.slice(height) ^ shadow).area()
            assert inside == pytest.approx(0.0 if free else shadow.area(), abs=1e-8)


def test_the_clearance_is_kept_all_around(tools: list[Tool], cavities: list[Cavity]):
    for tool, cavity in zip(tools, cavities, strict=True):
        outline = seated_outline(tool)
        assert (grown(outline, 0.0019) - cavity.outline).area() < 1e-9, tool.name
        # Closing narrow notches does not affect the extremes, so the clearance is exact there.
        box, tool_box = np.array(cavity.outline.bounds()), np.array(outline.bounds())
        np.testing.assert_allclose(np.abs(box - tool_box), 0.002, atol=1.5e-4)
        # Along at least half of the wall, its distance from the tool is the clearance.
        points = np.concatenate(cavity.outline.to_polygons())
        middle = (points + np.roll(points, 1, axis=0)) / 2
        length = np.linalg.norm(points - np.roll(points, 1, axis=0), axis=1)
        near = [(box_at(p) ^ grown(outline, 0.00215)).area() > 0 for p in middle]
        assert length[near].sum() > 0.5 * length.sum(), tool.name


def box_at(point: NDArray) -> CrossSection:
    return CrossSection.square((1e-6, 1e-6), True).translate(tuple(point))


def test_clearance_is_a_parameter(tools: list[Tool]):
    wide = kit_cavities(tools[2:3], KitParameters(clearance=0.004))[0].outline
    narrow = kit_cavities(tools[2:3], KitParameters(clearance=0.001))[0].outline
    np.testing.assert_allclose(
        np.abs(np.array(wide.bounds()) - np.array(narrow.bounds())), 0.003, atol=2e-4
    )


def contact_surface(cavities: list[Cavity], parameters: KitParameters) -> tuple[NDArray, NDArray]:
    """The vertices and faces of the contact surface, whose parts are joined."""
    meshes = [
        trimesh.Trimesh(*part, process=False)
        for part in contact_surfaces(cavities, parameters).values()
    ]
    whole = trimesh.util.concatenate(meshes)
    return whole.vertices, whole.faces


@pytest.mark.parametrize("lead_in", [0.0, 0.001])
def test_the_contact_surface_has_the_walls_of_the_block(tools: list[Tool], lead_in: float):
    parameters = KitParameters(lead_in=lead_in)
    cavities = kit_cavities(tools, parameters)
    mesh = build_block(cavities, parameters).to_mesh()
    block = trimesh.Trimesh(np.asarray(mesh.vert_properties)[:, :3], mesh.tri_verts, process=False)
    contact = trimesh.Trimesh(*contact_surface(cavities, parameters), process=False)
    for mesh_ in (block, contact):
        assert np.isfinite(mesh_.face_normals).all()

    def facing(mesh_: trimesh.Trimesh, low: float, high: float) -> tuple[float, NDArray, NDArray]:
        """Area, moment and flux of the faces whose normals have z between `low` and `high`."""
        chosen = (mesh_.face_normals[:, 2] > low) & (mesh_.face_normals[:, 2] < high)
        area, centre = mesh_.area_faces[chosen], mesh_.triangles_center[chosen]
        return area.sum(), area @ centre, (area * mesh_.face_normals[chosen].T) @ centre

    for low, high in ((-0.1, 0.1), (0.1, 0.9)):  # Normals of walls, then of bevels.
        for one, other in zip(facing(block, low, high), facing(contact, low, high), strict=True):
            np.testing.assert_allclose(one, other, atol=2e-7)
    # The floors are at the block's heights and face up.
    up = contact.triangles[contact.face_normals[:, 2] > 0.99]
    heights = np.unique(np.round(up[:, :, 2], 9))
    expected = [*(cavity.floor for cavity in cavities), parameters.height]
    np.testing.assert_allclose(heights, np.unique(np.round(expected, 9)), atol=1e-9)
    top = up[np.isclose(up[:, :, 2], parameters.height).all(axis=1)]
    rims = sum(cavity.rim.area() for cavity in cavities)
    assert trimesh.Trimesh(**trimesh.triangles.to_kwargs(top)).area == pytest.approx(
        0.28 * 0.26 - rims, abs=1e-7
    )


@pytest.mark.parametrize(
    "names",
    [
        # Kits whose cavities' bounding rectangles overlap.
        ["chipping_hammer", "tin_snips", "s_wrench", "precision_screwdriver"],
        ["rip_claw_hammer_fibreglass", "diagonal_cutters", "square_drive_screwdriver"],
        pytest.param(
            ["claw_hammer", "t_handle_screwdriver", "tin_snips", "pipe_wrench", "soft_face_mallet"]
            * 2,
            marks=pytest.mark.slow,
        ),
    ],
)
@pytest.mark.parametrize("lead_in", [pytest.param(0.0, marks=pytest.mark.slow), 0.001])
def test_no_part_of_the_contact_surface_is_inside_a_cavity(names: list[str], lead_in: float):
    parameters = KitParameters(lead_in=lead_in)
    tools = [load_tool(name) for name in names]
    layout = layout_kit(tools, parameters)
    cavities = kit_cavities(tools, parameters, layout.poses)
    vertices, faces = contact_surface(cavities, layout.parameters)
    corners = vertices[faces]
    corners = corners[np.ptp(corners[:, :, 2], axis=1) < 1e-9]
    heights = corners[:, 0, 2]
    for cavity in cavities:
        inner = cavity.outline.offset(-1e-5, JoinType.Miter)

        def inside(chosen: NDArray, inner: CrossSection = inner) -> list[float]:
            triangles = [CrossSection.hull_points(corner[:, :2]) for corner in corners[chosen]]
            return [(triangle ^ inner).area() for triangle in triangles]

        assert max(inside(heights > cavity.floor + 1e-6)) < 1e-12
        # The triangles at the floor's height cover the cavity exactly once.
        floor = inside(np.abs(heights - cavity.floor) < 1e-9)
        assert sum(floor) == pytest.approx(inner.area(), rel=1e-6)


def test_a_kit_is_built_once(tools: list[Tool], cache: Path, monkeypatch: pytest.MonkeyPatch):
    first = make_kit(tools, PARAMETERS)
    assert first.sdf.is_file()
    assert first.sdf.is_relative_to(cache)

    def fail(*_: object) -> None:
        raise AssertionError("built again")

    with monkeypatch.context() as patch:
        patch.setattr(kit_module, "_write", fail)
        assert make_kit(tools, PARAMETERS).sdf == first.sdf
    # An empty file, as a crash can leave it, is written again.
    path = first.sdf.with_name("contact_sides.obj")
    content = path.read_bytes()
    path.write_bytes(b"")
    make_kit(tools, PARAMETERS)
    assert path.read_bytes() == content


def test_every_parameter_and_tool_changes_the_kit(tools: list[Tool], cache: Path):
    folders = {make_kit(tools[:2], PARAMETERS).sdf.parent}
    for name, value in (("height", 0.055), ("clearance", 0.0025), ("lead_in", 0.0)):
        changed = dataclasses.replace(PARAMETERS, **{name: value})
        folders.add(make_kit(tools[:2], changed).sdf.parent)
    folders.add(make_kit(tools[:1], PARAMETERS).sdf.parent)
    assert len(folders) == 5
    assert set(cache.iterdir()) == folders


def test_a_changed_mesh_makes_another_kit(tools: list[Tool], cache: Path, tmp_path: Path):
    tool = tools[3]
    meshes = []
    for path in tool.visual_meshes:
        meshes.append(tmp_path / path.name)
        meshes[-1].write_bytes(path.read_bytes())
    copy = dataclasses.replace(tool, visual_meshes=tuple(meshes))
    same = make_kit([tool], PARAMETERS).sdf
    assert make_kit([copy], PARAMETERS).sdf == same
    meshes[0].write_text(meshes[0].read_text() + "v 0.01 0.0 0.0\n")
    assert make_kit([copy], PARAMETERS).sdf != same


def test_concurrent_builds_of_the_same_kit_both_succeed(
    tools: list[Tool], cache: Path, monkeypatch: pytest.MonkeyPatch
):
    write, both = kit_module._write, threading.Barrier(2)

    def write_together(*arguments: object) -> None:
        write(*arguments)  # type: ignore[arg-type]
        both.wait(timeout=60)  # Both threads have written; neither has moved its kit yet.

    monkeypatch.setattr(kit_module, "_write", write_together)
    with ThreadPoolExecutor(2) as pool:
        kits = list(pool.map(lambda _: make_kit(tools[:1], PARAMETERS), range(2)))
    assert kits[0].sdf == kits[1].sdf
    assert list(cache.iterdir()) == [kits[0].sdf.parent]
    contact = {f"contact_{part}.obj" for part in ("sides", "floors", "top", "outside")}
    names = {"kit.sdf", "kit.obj", "block.obj", "cavities.obj", *contact, "layout.json"}
    assert {path.name for path in kits[0].sdf.parent.iterdir()} == names


@pytest.mark.parametrize("error", [OSError(28, "No space left on device"), KeyboardInterrupt()])
def test_a_failed_build_leaves_nothing(
    tools: list[Tool], cache: Path, monkeypatch: pytest.MonkeyPatch, error: BaseException
):
    with monkeypatch.context() as patch:
        texts = itertools.count()

        def fail_late(*_: object, **__: object) -> str:
            if next(texts) == 5:
                raise error
            return "half of a kit"

        patch.setattr(kit_module, "flat_obj", fail_late)
        with pytest.raises((type(error), UserError)):
            make_kit(tools[:1], PARAMETERS)
        assert list(cache.iterdir()) == []
    assert make_kit(tools[:1], PARAMETERS).sdf.is_file()


def test_an_unwritable_cache_is_a_user_error(
    tools: list[Tool], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    with pytest.raises(UserError, match="file"):
        make_kit(tools[:1], PARAMETERS)


@pytest.mark.parametrize(
    ("names", "parameters", "token"),
    [
        ([], {}, "not 0"),
        (["claw_hammer"] * 13, {}, "not 13"),
        (NAMES, {"height": 0.018}, "'claw_hammer' is 17.0 mm high"),
    ],
)
def test_an_impossible_kit_is_rejected(names: list[str], parameters: dict[str, float], token: str):
    with pytest.raises(UserError, match=token) as refusal:
        make_kit([load_tool(name) for name in names], KitParameters(**parameters))
    assert "\n" not in str(refusal.value)


# Slots and nesting.


def test_a_toolset_takes_the_slots_of_the_template(tools: list[Tool]):
    for count in (1, 2, 4):
        layout = layout_kit(tools[:count], PARAMETERS)
        assert layout.parameters == PARAMETERS
        for tool, pose in zip(tools[:count], layout.poses, strict=True):
            assert (pose.x, pose.y) == SLOTS[tool.category]
            assert (pose.z, pose.yaw) == (PARAMETERS.height - tool.height, 0.0)


SEVEN = [*NAMES, "claw_hammer", "t_handle_screwdriver", "tin_snips"]
TWELVE = [*SEVEN, "pipe_wrench", "soft_face_mallet", "s_wrench", "torx_screwdriver", "tin_snips"]


@pytest.mark.parametrize(
    ("names", "parameters"),
    [
        (["claw_hammer"], {"length": 0.15}),
        (["claw_hammer", "claw_hammer"], {}),
        (NAMES, {"minimum_wall": 0.025}),
        pytest.param(SEVEN, {}, marks=pytest.mark.slow),
        (SEVEN, {"nested_wall": 0.012, "lead_in": 0.0}),
        pytest.param(TWELVE, {}, marks=pytest.mark.slow),
        (["t_handle_screwdriver"] * 12, {}),
    ],
)
def test_nested_cavities_have_walls_and_room_for_the_fingers(
    names: list[str], parameters: dict[str, float]
):
    template = KitParameters(**parameters)
    tools = [load_tool(name) for name in names]
    layout = layout_kit(tools, template)
    wall = max(template.nested_wall, template.minimum_wall)
    block = CrossSection.square((layout.parameters.length, layout.parameters.width), True)
    rims, fingers = [], []
    for tool, pose in zip(tools, layout.poses, strict=True):
        assert pose.z == template.height - tool.height
        # Computed from the tool's outline, independently of the code under test.
        shape = tool.footprint.rotate(np.degrees(pose.yaw)).translate((pose.x, pose.y))
        rims.append(grown(shape, template.clearance + template.lead_in))
        turn = tool.grasp.theta + pose.yaw
        X = np.array([[np.cos(pose.yaw), -np.sin(pose.yaw)], [np.sin(pose.yaw), np.cos(pose.yaw)]])
        grasp = X @ (tool.grasp.x, tool.grasp.y) + (pose.x, pose.y)
        along = np.array([np.cos(turn), np.sin(turn)])
        across = np.array([-np.sin(turn), np.cos(turn)])
        boxes = []
        for side in (-1, 1):
            near, far = tool.grasp.width / 2, tool.grasp.width / 2 + 0.021
            corners = [
                grasp + side * v * across + u * along
                for v in (near, far)
                for u in (-0.0105, 0.0105)
            ]
            boxes.append(CrossSection.hull_points(np.array(corners)))
        fingers.append(boxes[0] + boxes[1])
    for i, rim in enumerate(rims):
        assert (grown(rim, wall - 1e-4) - block).area() < 1e-9
        for j, other in enumerate(rims):
            if i != j:
                assert (grown(rim, wall - 1e-4) ^ other).area() < 1e-9, (names[i], names[j])
                assert (fingers[i] ^ other).area() < 1e-9, (names[i], names[j])
    # The block is little larger than the cavities and the walls around them.
    bounds = np.array(CrossSection.batch_boolean(rims, OpType.Add).bounds())
    extents = bounds[2:] - bounds[:2]
    size = np.array([layout.parameters.length, layout.parameters.width])
    assert (size - extents - 2 * wall < 0.012).all()
    assert max(size) <= 0.42
    if len(names) > 6:
        assert sum(rim.area() for rim in rims) > 0.3 * size.prod()


def test_a_category_without_a_slot_is_nested(tools: list[Tool]):
    chisel = dataclasses.replace(tools[3], category="chisel")
    layout = layout_kit([tools[0], chisel], PARAMETERS)
    assert layout.parameters != PARAMETERS
    assert len(layout.poses) == 2


@pytest.mark.slow
def test_nested_kits_are_deterministic_and_watertight(cache: Path):
    tools = [load_tool(name) for name in SEVEN]
    kit = make_kit(tools, PARAMETERS)
    assert kit.layout == layout_kit(tools, PARAMETERS) == make_kit(tools, PARAMETERS).layout
    assert kit.size[2] == PARAMETERS.height
    block = trimesh.load_mesh(kit.sdf.parent / "kit.obj")
    assert block.is_watertight
    assert len(block.split()) == 1
    np.testing.assert_allclose(block.extents, kit.size, atol=1e-6)
    solid = Manifold(Mesh(block.vertices.astype(np.float32), block.faces.astype(np.uint32)))
    for tool, pose in zip(tools, kit.layout.poses, strict=True):
        assert measure_clearance(solid, tool, PARAMETERS, pose).minimum > 0.0017


def test_a_scaled_tool_has_another_kit(tools: list[Tool], cache: Path):
    scaled = scaled_tool(tools[0], 0.16)
    assert make_kit([scaled], PARAMETERS).sdf != make_kit([tools[0]], PARAMETERS).sdf
    cavity = kit_cavities([scaled], PARAMETERS)[0]
    x_min, _, x_max, _ = cavity.outline.bounds()
    assert x_max - x_min == pytest.approx(0.16 + 0.004, abs=4e-4)


def test_tools_that_fit_no_block_are_rejected(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(nesting, "LONGEST_SIDES", nesting.USUAL_SIDES)
    hammers = [scaled_tool(load_tool("claw_hammer"), 0.5)] * 5
    with pytest.raises(UserError, match=r"^'claw_hammer', "):
        layout_kit(hammers, KitParameters(height=0.1))


def test_a_damaged_layout_is_rejected(tools: list[Tool], cache: Path):
    kit = make_kit(tools[:1], PARAMETERS)
    (kit.sdf.parent / "layout.json").write_text("{")
    with pytest.raises(UserError, match=r"layout\.json"):
        make_kit(tools[:1], PARAMETERS)
