"""Checks the files of kits as slicers and cutters do."""

import xml.etree.ElementTree as ElementTree
import zipfile
from pathlib import Path

import ezdxf
import numpy as np
import pytest
import trimesh
from manifold3d import CrossSection, Manifold, Mesh64

from kitting_drake.hkd.fabrication.export import export_kit
from kitting_drake.hkd.fabrication.kit_request import KitRequest, SheetRequest
from kitting_drake.hkd.fabrication.splitting.opening import LEAST_WALL, corner_area, thin_parts
from kitting_drake.hkd.tools.tool import tool_names
from tests.kitting_drake.hkd.fabrication.rebuilding import assembled, assert_rebuilds

CORE = "{http://schemas.microsoft.com/3dmanufacturing/core/2015/02}"


def solid_of(path: Path) -> Manifold:
    mesh = trimesh.load_mesh(path)
    assert mesh.is_watertight and mesh.is_winding_consistent
    assert len(mesh.split()) == 1
    return Manifold(Mesh64(np.array(mesh.vertices), mesh.faces.astype(np.uint64)))


def thin(shape: CrossSection) -> list[CrossSection]:
    parts = thin_parts(shape, LEAST_WALL).decompose()
    return [part for part in parts if part.area() > corner_area(LEAST_WALL)]


FEET_MM = 5.0
"""The height of Gridfinity feet. A neck beside a dovetail may be thin there (docs/printing.md)."""


def check_solid(path: Path, lowest_wall: float = 0.0) -> None:
    """Checks that walls above `lowest_wall` are at least 1.2 mm thick, and that nothing is printed
    on air."""
    solid = solid_of(path)
    below = solid.slice(0.05)
    top = solid.bounding_box()[5]
    for z in np.arange(0.45, top - 0.1, 1.7):
        layer = solid.slice(z)
        # Walls between engraved letters may be thin; letters are less than 0.8 mm deep.
        if lowest_wall < z < top - 0.8:
            assert not thin(layer), f"{path.name} at {z:g} mm"
        assert all((part ^ below).area() > 1e-3 for part in layer.decompose())
        below = layer


def check_threemf(path: Path) -> None:
    lib3mf = pytest.importorskip("lib3mf")
    model = lib3mf.Wrapper().CreateModel()
    reader = model.QueryReader("3mf")
    reader.SetStrictModeActive(True)
    reader.ReadFromFile(str(path))
    assert reader.GetWarningCount() == 0
    objects = model.GetMeshObjects()
    while objects.MoveNext():
        assert objects.GetCurrentMeshObject().IsManifoldAndOriented()


def check_kit(folder: Path, lowest_wall: float = 0.0) -> None:
    solids = sorted(folder.glob("*.3mf"))
    for path in solids:
        check_threemf(path)
        check_solid(path.with_suffix(".stl"), lowest_wall)
    for path in folder.glob("*.dxf"):
        assert not ezdxf.readfile(path).audit().errors


@pytest.mark.parametrize("gridfinity", [pytest.param(False, marks=pytest.mark.slow), True])
def test_slicers_and_cutters_find_nothing(gridfinity: bool, tmp_path: Path):
    made = export_kit(
        KitRequest(
            ("plate_120x40x8", "disc_35x10"),
            tmp_path / "kit",
            notches=True,
            labels=True,
            two_colours=True,
            chamfer_mm=0.6,
            gridfinity=gridfinity,
            bed_mm=(100.0, 100.0),
            sheet=SheetRequest((400.0, 300.0)),
        )
    )
    assert made.split is not None
    check_kit(tmp_path / "kit")
    check_letters(tmp_path / "kit")


def check_letters(folder: Path) -> None:
    """Checks that the printed letters fill the engraved ones, in the block and in its pieces."""
    letters, whole = (trimesh.load_mesh(folder / name) for name in ("labels.stl", "kit.stl"))
    assert letters.is_watertight
    block, filled = (
        Manifold(Mesh64(np.array(mesh.vertices), mesh.faces.astype(np.uint64)))
        for mesh in (whole, letters)
    )
    assert (block ^ filled).volume() < 1e-3 * filled.volume()
    assert (block + filled).genus() == block.genus()
    assert second_colour(folder / "kit.3mf") == pytest.approx(letters.volume, rel=1e-3)
    pieces = sum(second_colour(path) for path in folder.glob("piece_*.3mf"))
    assert pieces == pytest.approx(letters.volume, rel=1e-2)


def second_colour(path: Path) -> float:
    """The volume of the parts of a 3MF file that have the second base material."""
    with zipfile.ZipFile(path) as file:
        root = ElementTree.fromstring(file.read("3D/3dmodel.model"))
    volume = 0.0
    for item in root.iter(f"{CORE}object"):
        if item.get("pindex") == "1":
            corners = [[float(v.get(k)) for k in "xyz"] for v in item.iter(f"{CORE}vertex")]
            faces = [
                [int(t.get(k)) for k in ("v1", "v2", "v3")] for t in item.iter(f"{CORE}triangle")
            ]
            volume += trimesh.Trimesh(corners, faces).volume
    return volume


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(20))
def test_slicers_and_cutters_find_nothing_in_random_kits(seed: int, tmp_path: Path):
    rng = np.random.default_rng(seed)
    made = export_kit(
        KitRequest(
            tuple(str(name) for name in rng.choice(tool_names(), rng.integers(2, 9))),
            tmp_path / "kit",
            clearance_mm=float(rng.choice([0.35, 0.75, 2.0])),
            wall_mm=float(rng.choice([4.0, 6.0])),
            notches=bool(rng.random() < 0.5),
            labels=bool(rng.random() < 0.5),
            gridfinity=seed % 5 == 4,
            bed_mm=(180.0, 180.0),
        )
    )
    check_kit(tmp_path / "kit", FEET_MM if seed % 5 == 4 else 0.0)
    if made.split is not None:
        assert_rebuilds(made.block, assembled(tmp_path / "kit"), made.split)
