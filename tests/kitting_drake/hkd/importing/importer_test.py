import dataclasses
import hashlib
import os
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import trimesh
import yaml
from manifold3d import Manifold, OpType

from kitting_drake.common.errors import UserError
from kitting_drake.hkd.annotate import save_grasp
from kitting_drake.hkd.importing import importer
from kitting_drake.hkd.importing.fit import true_length
from kitting_drake.hkd.importing.importer import ImportRequest, import_tool
from kitting_drake.hkd.importing.materials import OTHER_DENSITY
from kitting_drake.hkd.importing.prepare import Prepared
from kitting_drake.hkd.importing.reading.mesh_files import read_mesh
from kitting_drake.hkd.importing.repair import NOMINAL_MM, make_solid
from kitting_drake.hkd.importing.resting_pose import resting_tilt
from kitting_drake.hkd.importing.tool_frame import size
from kitting_drake.hkd.kits.layout import layout_kit
from kitting_drake.hkd.kits.parameters import KitParameters
from kitting_drake.hkd.tools.collision import closed, furthest
from kitting_drake.hkd.tools.meshes import vertices_and_faces
from kitting_drake.hkd.tools.tool import load_tool, user_tool_names

ROOT = Path(__file__).resolve().parents[4]
REAL = Path(os.environ.get("KITTING_REAL_TOOLS", ROOT.parent / "shared" / "real_tools"))


def mallet() -> trimesh.Trimesh:
    """A mallet, 175 mm long, with a flat bottom: a handle and a head. Its unit is mm."""
    handle = Manifold.cube((170, 20, 12), True).translate((0, 0, -2))
    head = Manifold.cube((26, 50, 16), True).translate((77, 5, 0))
    vertices, faces = vertices_and_faces(handle + head)
    return trimesh.Trimesh(vertices, faces, process=False)


def exported(mesh: trimesh.Trimesh, path: Path) -> Path:
    mesh.export(path)
    return path


def bring(path: Path, folder: Path, **options: object) -> importer.ImportReport:
    """Runs an import in this process."""
    request = ImportRequest(path, options.pop("category", "hammer"), output=folder, **options)
    return import_tool(request, time_limit=None)


def solid_of(mesh: trimesh.Trimesh) -> tuple[Manifold, list[str]]:
    """The solid of a mesh, scaled as by the importer, and the notes on its repairs."""
    scale = NOMINAL_MM / mesh.extents.max()
    return make_solid(scale * (mesh.vertices - mesh.bounds.mean(axis=0)), mesh.faces)


def left_in(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir()) if folder.exists() else []


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> importer.ImportReport:
    """The mallet, imported without changes."""
    folder = tmp_path_factory.mktemp("plain")
    return bring(exported(mallet(), folder / "mallet.stl"), folder / "tools")


def test_a_tool_has_the_shape_and_mass_of_its_mesh(plain: importer.ImportReport):
    tool = load_tool(str(plain.directory))
    assert (tool.name, tool.category, tool.split) == ("mallet", "hammer", "user")
    assert (tool.length, tool.width, tool.height) == pytest.approx((0.175, 0.050, 0.016), abs=1e-5)
    # The head counts as the working end, which is made of steel.
    head = 1e-9 * 26 * 50 * 16
    handle = 1e-9 * mallet().volume - head
    assert tool.mass == pytest.approx(7850 * head + 1200 * handle, rel=0.05)
    assert plain.record["center_of_mass"][0] > 0.05
    assert tool.grasp.width == pytest.approx(0.020, abs=2e-4)
    points = tool.triangles.reshape(-1, 3)
    np.testing.assert_allclose(points.min(axis=0)[2], 0, atol=1e-6)
    np.testing.assert_allclose((points.min(axis=0) + points.max(axis=0))[:2], 0, atol=1e-6)


def test_a_new_category(tmp_path: Path):
    mesh = exported(mallet(), tmp_path / "mallet.stl")
    tool = load_tool(str(bring(mesh, tmp_path / "tools", category="carvers_mallet").directory))
    assert tool.category == "carvers_mallet"
    assert tool.mass == pytest.approx(mallet().volume * 1e-9 * OTHER_DENSITY, rel=1e-4)
    with pytest.raises(UserError, match="category 'Carver'"):
        bring(mesh, tmp_path / "tools", category="Carver", name="other")
    assert left_in(tmp_path / "tools") == ["mallet"]


def test_collision_hulls_are_few_convex_and_accurate(plain: importer.ImportReport):
    pieces = [
        trimesh.load_mesh(path, process=False) for path in plain.directory.glob("collision_*.obj")
    ]
    assert len(pieces) == plain.collision_hulls <= 4
    assert all(piece.is_watertight and piece.is_convex for piece in pieces)
    together = Manifold.batch_boolean(
        [Manifold.hull_points(np.asarray(piece.vertices)) for piece in pieces],
        OpType.Add,
    )
    tool = load_tool(str(plain.directory))
    # Compare outlines whose narrow notches are closed, as in cavities with a clearance of 2 mm.
    shadow = closed(together.project().scale((1e3, 1e3)), 2.0)
    outline = closed(tool.footprint.scale((1e3, 1e3)), 2.0)
    deviation = max(furthest(shadow, outline), furthest(outline, shadow))
    assert deviation <= 0.35
    assert 1e3 * plain.record["imported"]["outline_deviation"] == pytest.approx(deviation, abs=0.1)


def test_drake_loads_the_model(plain: importer.ImportReport):
    from pydrake.multibody.parsing import Parser
    from pydrake.multibody.plant import MultibodyPlant

    plant = MultibodyPlant(0.001)
    Parser(plant).AddModels(str(load_tool(str(plain.directory)).sdf))
    plant.Finalize()
    body = plant.GetBodyByName("tool")
    assert body.default_mass() == pytest.approx(plain.record["mass"], abs=1e-6)
    assert "package://" not in load_tool(str(plain.directory)).sdf.read_text()


@pytest.mark.parametrize("suffix", ["stl", "obj", "ply", "off", "glb", "gltf"])
def test_every_format_is_read(suffix: str, tmp_path: Path):
    vertices, faces = read_mesh(exported(mallet(), tmp_path / f"mallet.{suffix}"))
    np.testing.assert_allclose(np.ptp(vertices, axis=0), mallet().extents, rtol=1e-6)
    triangles = vertices[faces]
    assert trimesh.triangles.mass_properties(triangles)["volume"] == pytest.approx(mallet().volume)


@pytest.mark.parametrize(
    ("suffix", "units_per_mm", "turned"),
    [
        ("obj", 1 / 25.4, True),
        ("obj", 37.0, True),
        pytest.param("glb", 0.001, False, marks=pytest.mark.slow),
        pytest.param("stl", 1.0, False, marks=pytest.mark.slow),
        pytest.param("ply", 0.001, True, marks=pytest.mark.slow),
        pytest.param("stl", 0.1, True, marks=pytest.mark.slow),
    ],
)
def test_unit_pose_and_format_do_not_matter(
    plain: importer.ImportReport, tmp_path: Path, suffix: str, units_per_mm: float, turned: bool
):
    mesh = mallet()
    if turned:
        mesh.apply_transform(
            trimesh.transformations.random_rotation_matrix(np.array([0.3, 0.8, 0.1]))
        )
        mesh.apply_translation([900, -400, 100])
    mesh.apply_scale(units_per_mm)
    path = exported(mesh, tmp_path / f"mallet.{suffix}")
    # 37 units per mm is no known unit, so give the length. Inches are ambiguous, so give the unit.
    length = 175.0 if units_per_mm == 37.0 else None
    unit = "inches" if units_per_mm == 1 / 25.4 else None
    report = bring(path, tmp_path / "tools", length_mm=length, unit=unit)
    for key in ("length", "width", "height"):
        assert report.record[key] == pytest.approx(plain.record[key], abs=2e-4)
    assert report.record["mass"] == pytest.approx(plain.record["mass"], rel=0.005)
    mine, other = report.record["grasp"], plain.record["grasp"]
    for key in ("x", "width", "surface_height"):
        assert mine[key] == pytest.approx(other[key], abs=1.5e-3)
    # The tool may lie on its other side, which changes the sign of y.
    assert abs(mine["y"]) == pytest.approx(abs(other["y"]), abs=5e-4)


@pytest.mark.parametrize(
    ("length", "height", "mm"),
    [
        (203, 20, 203),
        (330, 30, 330),
        (37, 8, 37),
        (0.203, 0.02, 203),
        (0.0155, 0.006, 15.5),
        # In the other possible unit the tool would be too long, too thin or too high.
        (18, 1.2, 180),
        (25, 22, 25),
        (12, 0.35, 304.8),
        (7.1, 1.9, 71),
    ],
)
def test_a_mesh_has_its_true_length(length: float, height: float, mm: float):
    found, phrase = true_length(length, height, None, None)
    assert found == pytest.approx(mm, abs=0.5)
    assert f"{mm:.0f}" in phrase or f"{mm:.1f}" in phrase


@pytest.mark.parametrize(
    ("length", "height", "unit", "tokens"),
    [
        (7.1, 0.6, None, ("180 mm long (in inches)", "71 mm long (in cm)", "--unit")),
        (20.0, 4.2, None, ("20 mm long (in mm)", "200 mm long (in cm)")),
        (4000, 300, None, ("4000 mm long in mm", "--length_mm")),
        (1e-5, 1e-6, None, ("0.01 mm long in m", "--length_mm")),
        (420, 30, "mm", ("420 mm", "15 to 350")),
    ],
)
def test_an_ambiguous_length_lists_its_readings(
    length: float, height: float, unit: str | None, tokens: tuple[str, ...]
):
    with pytest.raises(UserError) as refusal:
        true_length(length, height, unit, None)
    assert all(token in str(refusal.value) for token in tokens)
    assert true_length(length, height, unit, 90.0)[0] == 90.0


@pytest.mark.slow
@pytest.mark.parametrize("smaller", [False, True])
def test_a_long_open_mesh_is_repaired_and_keeps_its_length(smaller: bool, tmp_path: Path):
    mesh = mallet()
    mesh.apply_scale(1.9)
    mesh.update_faces(np.arange(len(mesh.faces)) != 3)
    given = {"length_mm": 180.0} if smaller else {}
    report = bring(exported(mesh, tmp_path / "open.stl"), tmp_path / "tools", **given)
    assert any("repaired" in note for note in report.notes)
    length = 0.180 if smaller else 0.3325
    assert report.record["length"] == pytest.approx(length, abs=1e-5)
    assert report.record["width"] == pytest.approx(length * 50 / 175, abs=1e-4)


@pytest.mark.slow
def test_small_tools_keep_their_length(tmp_path: Path):
    bolt = Manifold.cube((25, 10, 8), True) + Manifold.cube((6, 16, 8), True).translate((9.5, 0, 0))
    mesh = trimesh.Trimesh(*vertices_and_faces(bolt), process=False)
    report = bring(exported(mesh, tmp_path / "bolt.stl"), tmp_path / "tools", material="steel")
    assert report.record["length"] == pytest.approx(0.025, abs=1e-5)
    assert report.record["mass"] == pytest.approx(7850e-9 * bolt.volume(), rel=1e-3)


@pytest.mark.slow
def test_a_drive_socket_keeps_its_length(tmp_path: Path):
    """The socket is round, with a hexagonal hole at one end and a square hole at the other."""
    socket = Manifold.cylinder(25, 11, circular_segments=48)
    socket -= Manifold.cylinder(14, 7.5, circular_segments=6).translate((0, 0, 12))
    socket -= Manifold.cube((9.6, 9.6, 10), True).translate((0, 0, 4))
    mesh = trimesh.Trimesh(*vertices_and_faces(socket), process=False)
    path = exported(mesh, tmp_path / "socket.stl")
    report = bring(path, tmp_path / "tools", category="socket", material="steel")
    assert report.record["length"] == pytest.approx(0.025, abs=1e-5)
    assert report.record["mass"] == pytest.approx(7850e-9 * socket.volume(), rel=1e-3)


@pytest.mark.slow
def test_a_wooden_tool_is_light(tmp_path: Path):
    path = exported(mallet(), tmp_path / "mallet.stl")
    wooden = bring(path, tmp_path / "tools", material="wood")
    assert wooden.record["mass"] == pytest.approx(700e-9 * mallet().volume, rel=1e-4)
    assert wooden.record["center_of_mass"][0] < 0.05
    assert not any("steel" in note or "guess" in note for note in wooden.notes)


def test_a_tool_weighs_what_the_scale_says(plain: importer.ImportReport, tmp_path: Path):
    path = exported(mallet(), tmp_path / "mallet.stl")
    weighed = bring(path, tmp_path / "tools", mass_g=123.0)
    assert weighed.record["mass"] == pytest.approx(0.123, abs=1e-6)
    assert weighed.record["center_of_mass"] == plain.record["center_of_mass"]
    assert any("guess" in note for note in plain.notes)
    for options, token in (
        ({"mass_g": 9000.0}, "cannot weigh 9000 g"),
        ({"material": "cheese"}, "steel, aluminium"),
        ({"material": "wood", "density": 700.0}, "leave out one"),
        ({"unit": "ells"}, "mm, cm, m, inches"),
    ):
        with pytest.raises(UserError, match=token):
            bring(path, tmp_path / "tools", name="other", **options)


def test_added_surface_is_reported():
    """A box without a lid is not closed. The import adds the missing surface and notes it."""
    box = trimesh.creation.box((0.18, 0.02, 0.012)).subdivide().subdivide()
    assert not any("% of its surface" in note for note in solid_of(box)[1])
    box.update_faces(box.triangles_center[:, 2] < 0.0055)
    assert any("% of its surface" in note for note in solid_of(box)[1])


def test_a_broad_tool_keeps_its_length(tmp_path: Path):
    # The head is broader than the slot of a hammer, so the kit is nested.
    handle = Manifold.cube((180, 20, 14), True)
    head = Manifold.cube((30, 130, 14), True).translate((80, 0, 0))
    vertices, faces = vertices_and_faces(handle + head)
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    report = bring(exported(mesh, tmp_path / "broad.stl"), tmp_path / "tools")
    assert report.record["length"] == pytest.approx(0.185, abs=1e-5)
    assert report.record["width"] == pytest.approx(0.130, abs=1e-5)
    tools = [load_tool(str(report.directory)), *map(load_tool, ("tin_snips", "s_wrench"))]
    assert len(layout_kit(tools, KitParameters()).poses) == 3


def two_bodies() -> trimesh.Trimesh:
    handle, head = trimesh.creation.box((170, 20, 12)), trimesh.creation.box((26, 50, 16))
    head.apply_translation((72, 0, 0))
    return trimesh.util.concatenate([handle, head])


def test_bodies_are_united():
    united, notes = solid_of(two_bodies())
    assert "united 2 bodies" in notes
    assert size(united) == pytest.approx(NOMINAL_MM / 170 * np.array([170, 50, 16]), rel=0.1)


@pytest.mark.slow
def test_triangle_soup_is_wrapped():
    both = two_bodies()
    united, _ = solid_of(both)
    rng = np.random.default_rng(0)
    triangles = both.subdivide_to_size(8.0).triangles
    triangles = triangles + rng.normal(0, 0.05, (len(triangles), 1, 3))
    soup = trimesh.Trimesh(**trimesh.triangles.to_kwargs(triangles), process=False)
    wrapped, notes = solid_of(soup)
    assert any("wrapped" in note for note in notes)
    assert size(wrapped) == pytest.approx(size(united), abs=1.2)


@pytest.mark.parametrize("inverted", [False, True])
def test_a_sealed_hollow_has_no_mass(inverted: bool):
    outer, hollow = trimesh.creation.box((180, 30, 20)), trimesh.creation.box((170, 26, 16))
    hollow.invert()
    # A loose rod inside the hollow.
    rod = trimesh.creation.box((20, 10, 8))
    mesh = trimesh.util.concatenate([outer, hollow, rod])
    if inverted:
        mesh.invert()
    solid, notes = solid_of(mesh)
    assert solid.volume() == pytest.approx(180 * 30 * 20 - 170 * 26 * 16 + 20 * 10 * 8, rel=1e-3)
    assert "kept 1 sealed hollow" in notes


@pytest.mark.slow
def test_a_mesh_of_many_triangles_is_decimated(tmp_path: Path):
    mesh = mallet().subdivide_to_size(1.7)
    assert len(mesh.faces) > 11_000
    # Bumps of a tenth of a millimetre, like scanner noise.
    waves = np.sin(mesh.vertices @ np.random.default_rng(0).normal(0, 1, (3, 3)))
    mesh.vertices = mesh.vertices + 0.05 * waves
    report = bring(exported(mesh, tmp_path / "scan.stl"), tmp_path / "tools", density=3000.0)
    tool = load_tool(str(report.directory))
    assert len(tool.triangles) < 0.8 * len(mesh.faces)
    shape = trimesh.load_mesh(tmp_path / "scan.stl")
    assert tool.mass == pytest.approx(1e-9 * shape.volume * 3000, rel=2e-3)
    assert (tool.length, tool.width) == pytest.approx(tuple(1e-3 * shape.extents[:2]), abs=1e-4)
    assert report.collision_hulls <= 5


def apart() -> trimesh.Trimesh:
    other = mallet()
    other.apply_translation((0, 90, 0))
    return trimesh.util.concatenate([mallet(), other])


def sheet() -> trimesh.Trimesh:
    corners = [[0, 0, 0], [180, 0, 0], [180, 20, 3], [0, 20, 0]]
    return trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]], process=False)


@pytest.mark.parametrize(
    ("make", "token"),
    [
        (lambda: trimesh.creation.box((180, 20, 2)), "2.0 mm thick"),
        (lambda: trimesh.creation.box((180, 80, 60)), "60 mm high"),
        (lambda: trimesh.creation.box((300, 76, 78)), "76 mm high"),
        (lambda: trimesh.creation.box((180, 150, 20)), "jaws"),
        (lambda: trimesh.creation.box((160, 150, 10)), "65 mm"),
        (sheet, "no volume"),
        (apart, "2 separate objects"),
    ],
)
def test_an_unusable_mesh_is_rejected(
    make: Callable[[], trimesh.Trimesh], token: str, tmp_path: Path
):
    path = exported(make(), tmp_path / "it.stl")
    with pytest.raises(UserError, match=token) as refusal:
        bring(path, tmp_path / "tools")
    assert str(path) in str(refusal.value) and "\n" not in str(refusal.value)
    assert not (tmp_path / "tools").exists()


def test_an_invalid_file_is_rejected(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    for name, content, token in (
        ("empty.stl", b"", "empty"),
        ("notes.txt", b"hello", "neither"),
        ("letter.stl", b"Dear Sir or Madam, " * 40, "(STL|no triangle)"),
        ("points.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\n", "(OBJ|no triangle)"),
        ("nan.obj", b"v nan nan nan\nv nan 0 0\nv 0 nan 0\nf 1 2 3\n", "finite"),
    ):
        (tmp_path / name).write_bytes(content)
        with pytest.raises(UserError, match=token):
            bring(tmp_path / name, tmp_path / "tools")
    with pytest.raises(UserError, match=r"missing\.stl"):
        bring(tmp_path / "missing.stl", tmp_path / "tools")
    with pytest.raises(UserError, match="folder"):
        bring(tmp_path, tmp_path / "tools")
    huge = tmp_path / "huge.stl"
    with huge.open("wb") as file:
        file.truncate(300_000_000)
    with pytest.raises(UserError, match="200 MB"):
        bring(huge, tmp_path / "tools")
    monkeypatch.setattr("kitting_drake.hkd.importing.reading.mesh_files.MOST_TRIANGLES", 20)
    with pytest.raises(UserError, match="20"):
        bring(exported(mallet(), tmp_path / "mallet.stl"), tmp_path / "tools")
    assert not (tmp_path / "tools").exists()


def quickly_made(plain: importer.ImportReport) -> Callable[..., Prepared]:
    """A fast stand-in for `prepare_tool`: the mallet with the requested name and length."""

    def prepare(request: ImportRequest, name: str, directory: Path) -> Prepared:
        for path in plain.directory.iterdir():
            copy = directory / (f"{name}.sdf" if path.suffix == ".sdf" else path.name)
            copy.write_bytes(path.read_bytes())
        length = 1e-3 * (request.length_mm or 175.0)
        digest = hashlib.sha256(request.mesh.read_bytes()).hexdigest()
        imported = {**plain.record["imported"], "file": request.mesh.name, "sha256": digest}
        record = {**plain.record, "name": name, "length": length, "imported": imported}
        (directory / "tool.yaml").write_text(yaml.safe_dump(record))
        return record, [], 1

    return prepare


def test_names(plain: importer.ImportReport, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(importer, "prepare_tool", quickly_made(plain))
    monkeypatch.setenv("KITTING_DRAKE_TOOLS", str(tmp_path / "own"))
    assert user_tool_names() == []
    path = exported(mallet(), tmp_path / "Claw Hammer.stl")
    request = ImportRequest(path, "hammer")
    with pytest.raises(UserError, match="'claw_hammer'"):
        import_tool(request, time_limit=None)
    with pytest.raises(UserError, match="--name"):
        bring(path, tmp_path / "own", name="../away")
    report = import_tool(ImportRequest(path, "hammer", name="mine"), time_limit=None)
    assert user_tool_names() == ["mine"]
    assert load_tool("mine").directory == report.directory == tmp_path / "own" / "mine"
    # The same file can be imported again under its name, which replaces the tool.
    again = bring(path, tmp_path / "own", name="mine", length_mm=160.0)
    assert load_tool("mine").length == pytest.approx(0.160) == again.record["length"]
    # Another file of the same name may be a newer version.
    newer = exported(mallet().apply_scale(1.05), path)
    notes = bring(newer, tmp_path / "own", name="mine").notes
    assert any(note.endswith("Claw Hammer.stl") for note in notes)
    with pytest.raises(UserError, match=r"Claw Hammer\.stl"):
        bring(exported(mallet(), tmp_path / "hammer.stl"), tmp_path / "own", name="mine")
    with pytest.raises(UserError, match="give --name"):
        bring(exported(mallet(), tmp_path / "\u6273\u624b.stl"), tmp_path / "own")
    # An import does not overwrite an annotated grasp.
    grasp = dataclasses.replace(load_tool("mine").grasp, x=0.011)
    save_grasp(load_tool("mine"), grasp)
    with pytest.raises(UserError, match="grasp"):
        bring(path, tmp_path / "own", name="mine")
    assert load_tool("mine").grasp == grasp
    (tmp_path / "own" / "other").mkdir()
    with pytest.raises(UserError, match="other"):
        bring(path, tmp_path / "own", name="other")
    assert left_in(tmp_path / "own") == ["mine", "other"]


def test_two_runs_into_one_folder(
    plain: importer.ImportReport, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """A tool that another run made meanwhile is overwritten only if it comes from the same file."""
    make = quickly_made(plain)
    first = exported(mallet(), tmp_path / "first.stl")
    second = exported(mallet(), tmp_path / "second.stl")

    def overtaken(request: ImportRequest, name: str, directory: Path) -> Prepared:
        monkeypatch.setattr(importer, "prepare_tool", make)
        bring(first, tmp_path / "tools", name="mine")
        return make(request, name, directory)

    monkeypatch.setattr(importer, "prepare_tool", overtaken)
    with pytest.raises(UserError, match=r"was made from first\.stl"):
        bring(second, tmp_path / "tools", name="mine")
    monkeypatch.setattr(importer, "prepare_tool", overtaken)
    bring(first, tmp_path / "tools", name="mine")
    assert left_in(tmp_path / "tools") == ["mine"]


@pytest.mark.parametrize(
    "options", [{"length_mm": float("nan")}, {"length_mm": -5.0}, {"density": 1e9}]
)
def test_numbers_out_of_range(options: dict, tmp_path: Path):
    with pytest.raises(UserError, match="out of range"):
        bring(exported(mallet(), tmp_path / "it.stl"), tmp_path / "tools", **options)


@pytest.mark.slow
def test_the_child_process_has_a_limit_of_time(tmp_path: Path):
    path = exported(mallet(), tmp_path / "mallet.stl")
    with pytest.raises(UserError, match="s of processor time and was stopped while"):
        # The limit becomes the minimum, 1 s. Starting the process alone takes longer.
        import_tool(ImportRequest(path, "hammer", output=tmp_path / "tools"), time_limit=-9.0)
    assert not (tmp_path / "tools").exists()


@pytest.mark.slow
def test_the_child_process_makes_the_tool(tmp_path: Path):
    path = exported(mallet(), tmp_path / "mallet.stl")
    report = import_tool(ImportRequest(path, "hammer", output=tmp_path / "tools"))
    assert load_tool(str(report.directory)).name == "mallet"
    assert left_in(tmp_path / "tools") == ["mallet"]


def test_the_child_process_refuses_a_bad_file(tmp_path: Path):
    (tmp_path / "bad.stl").write_bytes(b"solid\n" + bytes(range(256)) * 9)
    with pytest.raises(UserError, match="bad"):
        import_tool(ImportRequest(tmp_path / "bad.stl", "hammer", output=tmp_path / "tools"))
    assert not left_in(tmp_path / "tools")


# Broken files.

SUFFIXES = ("stl", "ascii.stl", "obj", "ply", "ascii.ply", "glb")


def sound_file(suffix: str) -> bytes:
    kinds = {"ascii.stl": "stl_ascii", "ascii.ply": "ply"}
    options = {"encoding": "ascii"} if suffix == "ascii.ply" else {}
    data = mallet().export(file_type=kinds.get(suffix, suffix), **options)
    return data.encode() if isinstance(data, str) else data


def corrupted(data: bytes, rng: np.random.Generator) -> bytes:
    """A file with a random defect of a kind that occurs in practice."""
    place = int(rng.integers(len(data)))
    size = int(rng.integers(1, 200))
    floats = [float("nan"), float("inf"), -1e38, 1e-45, 0.0, 1e6]
    match int(rng.integers(10)):
        case 0:
            return data[:place]
        case 1:
            return data[:place] + data[place + size :]
        case 2:
            noise = rng.integers(256, size=size, dtype=np.uint8).tobytes()
            return data[:place] + noise + data[place + size :]
        case 3:
            flipped = bytearray(data)
            for index in rng.integers(len(data), size=int(rng.integers(1, 30))):
                flipped[index] ^= 1 << int(rng.integers(8))
            return bytes(flipped)
        case 4:
            place -= place % 4
            packed = struct.pack("<f", floats[int(rng.integers(len(floats)))])
            return data[:place] + packed * 3 + data[place + 12 :]
        case 5:
            words = data.split(b" ")
            for index in rng.integers(len(words), size=3):
                words[index] = [b"nan", b"inf", b"-7", b"1e400", b"99999999", b"x"][
                    int(rng.integers(6))
                ]
            return b" ".join(words)
        case 6:
            lines = data.split(b"\n")
            rng.shuffle(lines)
            return b"\n".join(lines)
        case 7:
            return data + data[place:]
        case 8:
            return data[:place] + b"\n# what is this doing here?\n" + data[place:]
        case _:
            return rng.integers(256, size=size * 20, dtype=np.uint8).tobytes()


@pytest.mark.parametrize(
    "seed", [*range(6), *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(6, 40))]
)
def test_a_broken_file_makes_a_complete_tool_or_none(seed: int, tmp_path: Path):
    suffix = SUFFIXES[seed % len(SUFFIXES)]
    path = tmp_path / f"it.{suffix.split('.')[-1]}"
    path.write_bytes(corrupted(sound_file(suffix), np.random.default_rng(seed)))
    try:
        report = bring(path, tmp_path / "tools")
    except UserError as error:
        assert str(path) in str(error) and "\n" not in str(error)
        assert not (tmp_path / "tools").exists()
    else:
        assert left_in(tmp_path / "tools") == ["it"]
        tool = load_tool(str(report.directory))
        assert np.isfinite(tool.triangles).all() and tool.mass > 0


# Real meshes.


@pytest.mark.skipif(not REAL.is_dir(), reason=f"no real meshes in {REAL}")
@pytest.mark.parametrize(
    "name",
    [
        pytest.param("pliers/cc0_pliers", marks=pytest.mark.slow),
        pytest.param("hammer/cc0_claw_hammer", marks=pytest.mark.slow),
        pytest.param("wrench/zeyuli_wrench", marks=pytest.mark.slow),
    ],
)
def test_real_tools(name: str, tmp_path: Path):
    report = bring(REAL / f"{name}.obj", tmp_path / "tools", category=name.split("/")[0])
    tool = load_tool(str(report.directory))
    assert 0.0149 < tool.length < 0.3501
    assert report.collision_hulls <= 16
    assert report.record["imported"]["outline_deviation"] <= 0.0005
    com = yaml.safe_load((tool.directory / "tool.yaml").read_text())["center_of_mass"]
    assert abs(tool.grasp.x - com[0]) < 0.25 * tool.length


@pytest.mark.slow
def test_an_unbalanced_tool_is_laid_in_its_resting_pose(tmp_path: Path):
    """The thick handle just balances the long shaft above the table; a touch tips the tool over."""
    handle = Manifold.cube((40, 30, 30), True).translate((-20, 0, 0))
    shaft = Manifold.cube((97, 12, 12), True).translate((48.5, 0, 0))
    whole = (handle + shaft).translate((-28.5, 0, 15)).scale((1.2, 1.2, 1.2))
    mesh = trimesh.Trimesh(*vertices_and_faces(whole), process=False)
    report = bring(exported(mesh, tmp_path / "d.stl"), tmp_path / "tools", category="screwdriver")
    assert any("resting pose" in note for note in report.notes)
    tilt = resting_tilt(report.directory / "d.sdf")
    assert np.degrees(np.arccos(tilt[2, 2])) < 2
    tool = load_tool(str(report.directory))
    # The lowest point of the shaft's end is on the table.
    low = tool.triangles.reshape(-1, 3)
    assert low[low[:, 0] > 0.9 * low[:, 0].max()][:, 2].min() < 0.001
