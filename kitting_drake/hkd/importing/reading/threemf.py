"""Reads 3MF files: the core specification 1.3, and parts in other files (production extension).

trimesh's own reader is not used, because it needs lxml and ignores the unit.
"""

import posixpath
import xml.etree.ElementTree as ElementTree
import zipfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from kitting_drake.common.errors import UserError

_UNITS_MM = {
    "micron": 0.001,
    "millimeter": 1.0,
    "centimeter": 10.0,
    "inch": 25.4,
    "foot": 304.8,
    "meter": 1000.0,
}
_RELATION = "http://schemas.microsoft.com/3dmanufacturing/2013/01/3dmodel"
_MOST_BYTES = 1_000_000_000
_DEEPEST = 16

Transform = NDArray[np.float64]
"""A transform (4, 3) that maps a point to (x, y, z, 1) @ transform."""


@dataclass
class _Object:
    """An object of a model: a mesh, other objects with transforms, or both."""

    vertices: NDArray[np.float64]
    faces: NDArray[np.int64]
    parts: list[tuple[str, str, Transform]]
    """The file, object identifier and transform of each part."""
    is_solid: bool


def read_3mf(path: Path) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Returns the vertices (n, 3) in mm and triangles (m, 3) of all objects in a 3MF's build list.

    Raises:
        UserError: the file is broken, or its build list is empty.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            if sum(item.file_size for item in archive.infolist()) > _MOST_BYTES:
                raise UserError(
                    f"{path} unpacks to more than {_MOST_BYTES / 1e6:.0f} MB: decimate the mesh "
                    "first"
                )
            main = _main_part(archive)
            root = ElementTree.fromstring(archive.read(main))
            objects: dict[tuple[str, str], _Object] = {}
            names = {name.lower(): name for name in archive.namelist()}
            models = [n for n in names.values() if n.lower().endswith(".model")]
            for name in models:
                model = root if name == main else ElementTree.fromstring(archive.read(name))
                objects |= {(name, key): thing for key, thing in _objects(model, name, names)}
    except UserError:
        raise
    except (zipfile.BadZipFile, KeyError, ElementTree.ParseError, ValueError) as error:
        raise UserError(f"{path} cannot be read as 3MF: export it again") from error
    mm = _UNITS_MM.get(root.get("unit", "millimeter"))
    if mm is None:
        raise UserError(
            f"{path} has the unknown unit '{root.get('unit')}': export it in one of "
            f"{', '.join(_UNITS_MM)}"
        )
    meshes = [
        mesh
        for item in _all(root, "item")
        if item.get("printable", "1") != "0"
        for mesh in _placed(objects, _reference(item, main, names), _transform(item), _DEEPEST)
    ]
    if not meshes:
        raise UserError(f"{path} has no solid object to print: export it again")
    starts = np.cumsum([0, *(len(vertices) for vertices, _ in meshes)])
    faces = [faces + start for (_, faces), start in zip(meshes, starts, strict=False)]
    return mm * np.vstack([vertices for vertices, _ in meshes]), np.vstack(faces)


def _main_part(archive: zipfile.ZipFile) -> str:
    """Returns the name of the model file at which the package starts."""
    names = {name.lower(): name for name in archive.namelist()}
    relations = ElementTree.fromstring(archive.read(names["_rels/.rels"]))
    targets = [e.get("Target", "") for e in relations if e.get("Type") == _RELATION]
    return names[(targets[0] if targets else "3D/3dmodel.model").strip("/").lower()]


def _all(element: ElementTree.Element, tag: str) -> Iterator[ElementTree.Element]:
    return (e for e in element.iter() if e.tag.rsplit("}", 1)[-1] == tag)


def _objects(
    model: ElementTree.Element, file: str, names: dict[str, str]
) -> Iterator[tuple[str, _Object]]:
    for thing in _all(model, "object"):
        vertices = [[v.get(axis) for axis in "xyz"] for v in _all(thing, "vertex")]
        faces = [[t.get(key) for key in ("v1", "v2", "v3")] for t in _all(thing, "triangle")]
        parts = [(*_reference(c, file, names), _transform(c)) for c in _all(thing, "component")]
        yield (
            thing.attrib["id"],
            _Object(
                np.array(vertices, dtype=float).reshape(-1, 3),
                np.array(faces, dtype=np.int64).reshape(-1, 3),
                parts,
                thing.get("type", "model") in ("model", "solidsupport"),
            ),
        )


def _reference(element: ElementTree.Element, file: str, names: dict[str, str]) -> tuple[str, str]:
    """Returns the file and the identifier of the object to which an item or component refers."""
    other = [value for key, value in element.attrib.items() if key.endswith("}path")]
    if other:
        file = names[posixpath.normpath(other[0]).strip("/").lower()]
    return file, element.attrib["objectid"]


def _transform(element: ElementTree.Element) -> Transform:
    text = element.get("transform")
    if text is None:
        return np.eye(4, 3)
    return np.array(text.split(), dtype=float).reshape(4, 3)


def _placed(
    objects: dict[tuple[str, str], _Object], key: tuple[str, str], by: Transform, deepest: int
) -> Iterator[tuple[NDArray[np.float64], NDArray[np.int64]]]:
    """Yields the meshes of an object and its parts, with their transforms applied."""
    thing = objects.get(key)
    if thing is None or not thing.is_solid or deepest == 0:
        return
    if len(thing.faces):
        mirrored = np.linalg.det(by[:3]) < 0
        yield thing.vertices @ by[:3] + by[3], thing.faces[:, ::-1] if mirrored else thing.faces
    for file, part, moved in thing.parts:
        combined = moved @ by[:3]
        combined[3] += by[3]
        yield from _placed(objects, (file, part), combined, deepest - 1)
