"""Writes a kit's block as STL and 3MF files in millimetres, for slicers."""

import io
import zipfile
from xml.sax.saxutils import escape, quoteattr

import numpy as np
import trimesh
from numpy.typing import NDArray

Triangles = tuple[NDArray[np.float64], NDArray[np.int64]]
"""Vertices (n, 3) in millimetres, and faces (m, 3)."""

_STAMP = (1980, 1, 1, 0, 0, 0)
"""A fixed time for the archive's entries, so that equal kits give equal files."""

_CONTENT_TYPES = """<?xml version="1.0" encoding="UTF-8"?>
<Types xmlns="http://schemas.openxmlformats.org/package/2006/content-types">
 <Default Extension="rels" \
ContentType="application/vnd.openxmlformats-package.relationships+xml"/>
 <Default Extension="model" ContentType="application/vnd.ms-package.3dmanufacturing-3dmodel+xml"/>
</Types>
"""
_RELATIONSHIPS = """<?xml version="1.0" encoding="UTF-8"?>
<Relationships xmlns="http://schemas.openxmlformats.org/package/2006/relationships">
 <Relationship Target="/3D/3dmodel.model" Id="rel0" \
Type="http://schemas.microsoft.com/3dmanufacturing/2013/01/3dmodel"/>
</Relationships>
"""
_MODEL = """<?xml version="1.0" encoding="UTF-8"?>
<model unit="millimeter" xml:lang="en-US" \
xmlns="http://schemas.microsoft.com/3dmanufacturing/core/2015/02">
 <metadata name="Title">{title}</metadata>
 <metadata name="Application">kitting_drake</metadata>
 <resources>
{resources}
 </resources>
 <build><item objectid="{built}"/></build>
</model>
"""
_OBJECT = """  <object id="{number}" type="model" name={name}{material}>
   <mesh>
    <vertices>
{vertices}
    </vertices>
    <triangles>
{triangles}
    </triangles>
   </mesh>
  </object>"""
_COLOURS = """  <basematerials id="4">
   <base name="block" displaycolor="#2B2E33"/>
   <base name="labels" displaycolor="#F29E1A"/>
  </basematerials>"""
_BOTH = """  <object id="3" type="model" name={name}>
   <components><component objectid="1"/><component objectid="2"/></components>
  </object>"""


def stl_bytes(surface: Triangles) -> bytes:
    """Encodes a triangle surface as a binary STL file."""
    data = trimesh.Trimesh(*surface, process=False).export(file_type="stl")
    assert isinstance(data, bytes)
    return data


def threemf_bytes(surface: Triangles, title: str, labels: Triangles | None = None) -> bytes:
    """Encodes a triangle surface as a 3MF archive with one object (3MF core specification 1.3).

    trimesh's own 3MF export is not used, because it needs lxml and writes no unit.

    Args:
        surface: the block.
        title: the title in the metadata, and the name of the object.
        labels: the letters of another colour that fill the engraved labels; None: there are none.
            With letters, the object has two parts, each with its own base material.
    """
    if labels is None:
        resources, built = [_object(1, title, surface, "")], 1
    else:
        resources = [
            _COLOURS,
            _object(1, title, surface, ' pid="4" pindex="0"'),
            _object(2, f"{title}, labels", labels, ' pid="4" pindex="1"'),
            _BOTH.format(name=quoteattr(title)),
        ]
        built = 3
    model = _MODEL.format(title=escape(title), resources="\n".join(resources), built=built)
    archive = io.BytesIO()
    with zipfile.ZipFile(archive, "w", zipfile.ZIP_DEFLATED) as file:
        for path, text in (
            ("[Content_Types].xml", _CONTENT_TYPES),
            ("_rels/.rels", _RELATIONSHIPS),
            ("3D/3dmodel.model", model),
        ):
            entry = zipfile.ZipInfo(path, _STAMP)
            entry.compress_type = zipfile.ZIP_DEFLATED
            file.writestr(entry, text)
    return archive.getvalue()


def _object(number: int, name: str, surface: Triangles, material: str) -> str:
    vertices, faces = surface
    return _OBJECT.format(
        number=number,
        name=quoteattr(name),
        material=material,
        vertices="\n".join(
            f'     <vertex x="{x:.4f}" y="{y:.4f}" z="{z:.4f}"/>' for x, y, z in vertices
        ),
        triangles="\n".join(f'     <triangle v1="{a}" v2="{b}" v3="{c}"/>' for a, b, c in faces),
    )
