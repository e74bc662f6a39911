import zipfile
from pathlib import Path

import numpy as np
import pytest
import trimesh

from kitting_drake.common.errors import UserError
from kitting_drake.hkd.fabrication.block_files import threemf_bytes
from kitting_drake.hkd.importing.importer import ImportRequest, import_tool
from kitting_drake.hkd.importing.reading.mesh_files import read_mesh

CORE = 'xmlns="http://schemas.microsoft.com/3dmanufacturing/core/2015/02"'
OTHER = 'xmlns:p="http://schemas.microsoft.com/3dmanufacturing/production/2015/06"'
RELATIONS = (
    '<Relationships xmlns="http://schemas.openxmlformats.org/package/2006/relationships">'
    '<Relationship Target="/{}" Id="r" '
    'Type="http://schemas.microsoft.com/3dmanufacturing/2013/01/3dmodel"/></Relationships>'
)


def mesh_object(number: int, scale: float = 1.0, kind: str = "model") -> str:
    box = trimesh.creation.box((160, 20, 10))
    vertices = "".join('<vertex x="{}" y="{}" z="{}"/>'.format(*(scale * v)) for v in box.vertices)
    faces = "".join('<triangle v1="{}" v2="{}" v3="{}"/>'.format(*f) for f in box.faces)
    return (
        f'<object id="{number}" type="{kind}"><mesh><vertices>{vertices}</vertices>'
        f"<triangles>{faces}</triangles></mesh></object>"
    )


def model(resources: str, items: str, attributes: str = "") -> str:
    return (
        f"<model {CORE} {OTHER} {attributes}><resources>{resources}</resources>"
        f"<build>{items}</build></model>"
    )


def package(path: Path, parts: dict[str, str], main: str = "3D/3dmodel.model") -> Path:
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("_rels/.rels", RELATIONS.format(main))
        for name, text in parts.items():
            archive.writestr(name, text)
    return path


ITEM = '<item objectid="1"/>'
TWO = (
    mesh_object(1)
    + '<object id="2"><components><component objectid="1"/>'
    + '<component objectid="1" transform="0 1 0 -1 0 0 0 0 1 0 0 10"/></components></object>'
)


@pytest.mark.parametrize(
    ("text", "extents", "bodies"),
    [
        (model(mesh_object(1), ITEM), (160, 20, 10), 1),
        (model(mesh_object(1, 1 / 25.4), ITEM, 'unit="inch"'), (160, 20, 10), 1),
        (model(mesh_object(1, 0.001), ITEM, 'unit="meter"'), (160, 20, 10), 1),
        (model(mesh_object(1, 1000), ITEM, 'unit="micron"'), (160, 20, 10), 1),
        (model(mesh_object(1) + mesh_object(2), ITEM), (160, 20, 10), 1),
        (model(mesh_object(1) + mesh_object(2, 2, "support"), ITEM), (160, 20, 10), 1),
        (model(TWO, '<item objectid="2"/>'), (160, 160, 20), 2),
        (
            model(TWO, '<item objectid="2" transform="-2 0 0 0 1 0 0 0 1 5 5 5"/>'),
            (320, 160, 20),
            2,
        ),
        (model(TWO, ITEM + '<item objectid="2" printable="0"/>'), (160, 20, 10), 1),
    ],
)
def test_units_objects_and_transforms(
    text: str, extents: tuple[float, ...], bodies: int, tmp_path: Path
):
    path = package(tmp_path / "it.3mf", {"3D/3dmodel.model": text})
    vertices, faces = read_mesh(path)
    np.testing.assert_allclose(np.ptp(vertices, axis=0), extents, rtol=1e-9)
    whole = trimesh.Trimesh(vertices, faces)
    assert whole.body_count == bodies and whole.volume > 0


def test_an_object_in_another_file(tmp_path: Path):
    part = '<object id="9"><components><component objectid="1" p:path="/3D/Objects/a.model"/>'
    parts = {
        "3D/main.model": model(part + "</components></object>", '<item objectid="9"/>'),
        "3D/Objects/a.model": model(mesh_object(1), ""),
    }
    vertices, _ = read_mesh(package(tmp_path / "it.3mf", parts, "3D/main.model"))
    np.testing.assert_allclose(np.ptp(vertices, axis=0), (160, 20, 10))


def test_a_written_block_is_read_and_has_a_unit(tmp_path: Path):
    # Without a unit, 20 could be mm or cm, but a 3MF file states its unit.
    box = trimesh.creation.box((20, 6, 4.5))
    path = tmp_path / "bit.3mf"
    path.write_bytes(threemf_bytes((box.vertices, box.faces), "bit"))
    report = import_tool(ImportRequest(path, "bit", output=tmp_path / "tools"), time_limit=None)
    assert report.record["length"] == pytest.approx(0.020, abs=1e-6)
    assert (report.directory / "outline.png").stat().st_size > 500


@pytest.mark.parametrize(
    ("name", "content", "token"),
    [
        ("it.3mf", b"PK\x03\x04 cut short", "cannot be read as 3MF"),
        ("it.step", b"ISO-10303-21;", "STL or 3MF"),
        ("it.stp", b"ISO-10303-21;", "STEP"),
        ("it.dwg", b"", "neither"),
    ],
)
def test_what_cannot_be_read_is_said(name: str, content: bytes, token: str, tmp_path: Path):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(UserError, match=token):
        read_mesh(tmp_path / name)
    empty = package(tmp_path / "empty.3mf", {"3D/3dmodel.model": model(mesh_object(1), "")})
    with pytest.raises(UserError, match="no solid object"):
        read_mesh(empty)
