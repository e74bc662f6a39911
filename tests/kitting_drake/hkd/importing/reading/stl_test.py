import struct
from pathlib import Path

import numpy as np
import pytest
import trimesh

from kitting_drake.common.errors import UserError
from kitting_drake.hkd.importing.reading.mesh_files import read_mesh
from kitting_drake.hkd.importing.reading.stl import read_stl

BOX = trimesh.creation.box((160, 20, 10))
BINARY: bytes = BOX.export(file_type="stl")
TEXT: str = BOX.export(file_type="stl_ascii")
FACETS = TEXT[TEXT.index("facet") : TEXT.index("endsolid")]


@pytest.mark.parametrize(
    "data",
    [
        BINARY,
        BINARY + b"a colour table, 43 bytes long, of some modeller",
        BINARY + BINARY,
        b"solid facet normal vertex".ljust(80) + BINARY[80:],
        b"solid facet normal vertex\n".ljust(80, b"\0") + BINARY[80:],
        BINARY[:80] + bytes(4) + BINARY[84:],
        BINARY[:80] + b"\xff" * 4 + BINARY[84:],
        TEXT.encode(),
        f"solid facet normal of a vertex\n{FACETS}endsolid facet vertex\n".encode(),
        f"solid\n{FACETS}".encode(),
        f"solid a\n{FACETS}endsolid a\nsolid b\nendsolid b\n\n".encode(),
        TEXT.replace("\n", "\r\n").encode(),
        TEXT.replace("\n", "\r").encode(),
        TEXT.upper().encode(),
        TEXT.replace(".", ",").encode(),
        b"\xef\xbb\xbf" + TEXT.encode(),
        f"solid Schl\u00fcssel\n{FACETS}endsolid\n".encode("latin-1"),
    ],
)
def test_the_dialects_of_stl(data: bytes, tmp_path: Path):
    (tmp_path / "box.stl").write_bytes(data)
    triangles = read_stl(tmp_path / "box.stl")
    np.testing.assert_allclose(triangles, BOX.triangles, atol=1e-5)
    vertices, faces = read_mesh(tmp_path / "box.stl")
    np.testing.assert_array_equal(vertices[faces], triangles)


@pytest.mark.parametrize(
    ("data", "token"),
    [
        (BINARY[:-60], "12 triangles, and 2 of them are missing"),
        (BINARY[:84], "12 of them are missing"),
        (BINARY[:40], "too short"),
        (TEXT[: TEXT.rindex("vertex")].encode(), "36 corners, and 1 are missing"),
        (TEXT.replace("0.5", "half").replace("80", "eighty").encode(), "STL"),
        (BINARY[:80] + struct.pack("<I", 0), "no triangles"),
    ],
)
def test_a_short_stl_says_what_is_missing(data: bytes, token: str, tmp_path: Path):
    (tmp_path / "box.stl").write_bytes(data)
    with pytest.raises(UserError, match=token):
        read_mesh(tmp_path / "box.stl")
