"""Reads the triangles of mesh files."""

from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray

from kitting_drake.common.errors import UserError
from kitting_drake.hkd.importing.reading.stl import read_stl
from kitting_drake.hkd.importing.reading.threemf import read_3mf

FORMATS = (".stl", ".obj", ".ply", ".off", ".glb", ".gltf", ".3mf")
IN_MM = (".3mf",)
"""The formats that state their unit; their vertices are converted to mm."""
_SOLIDS = (".step", ".stp", ".iges", ".igs", ".sldprt", ".f3d", ".fcstd", ".scad", ".blend")
MOST_BYTES = 200_000_000
MOST_TRIANGLES = 2_000_000

Array = NDArray[np.float64]
Faces = NDArray[np.int64]


def read_mesh(path: Path) -> tuple[Array, Faces]:
    """Reads the vertices (n, 3) and triangles (m, 3) of all visible meshes of a file.

    Vertices are in the file's units, or in mm for the formats `IN_MM`.

    Raises:
        UserError: the file is missing, too large or not a mesh.
    """
    kinds = ", ".join(suffix[1:].upper() for suffix in FORMATS)
    try:
        size = path.stat().st_size
    except (OSError, ValueError) as error:
        raise UserError(f"there is no file {path}: give a mesh ({kinds})") from error
    if not path.is_file():
        raise UserError(f"{path} is a folder or special file: give a mesh ({kinds})")
    if path.suffix.lower() in _SOLIDS:
        raise UserError(
            f"{path} is a CAD model ({path.suffix[1:].upper().replace('STP', 'STEP')}): export it "
            "as STL or 3MF from your CAD program, or from FreeCAD, with a deviation of 0.05 mm"
        )
    if path.suffix.lower() not in FORMATS:
        raise UserError(f"{path} is neither a supported mesh ({kinds}) nor an outline (SVG, DXF)")
    if size == 0:
        raise UserError(f"{path} is empty: copy or export it again")
    if size > MOST_BYTES:
        raise UserError(
            f"{path} has {size / 1e6:.0f} MB, more than the limit of {MOST_BYTES / 1e6:.0f} MB: "
            "decimate the mesh first"
        )
    read = {".stl": _stl, ".3mf": read_3mf}.get(path.suffix.lower(), _scene)
    vertices, faces = read(path)
    if len(faces) == 0 or vertices.ndim != 2 or faces.ndim != 2 or faces.shape[1] != 3:
        raise UserError(f"{path} has no triangles: check that the file is complete")
    if len(faces) > MOST_TRIANGLES:
        raise UserError(
            f"{path} has {len(faces)} triangles, more than the limit of {MOST_TRIANGLES}: decimate "
            "the mesh first"
        )
    whole = ((faces >= 0) & (faces < len(vertices))).all(axis=1)
    faces = faces[whole]
    with np.errstate(over="ignore", invalid="ignore"):
        good = np.isfinite(vertices).all(axis=1) & (np.abs(vertices) < 1e30).all(axis=1)
    faces = faces[good[faces].all(axis=1)]
    if len(faces) == 0:
        raise UserError(f"{path} has no triangle with finite corners: export it again")
    used, faces = np.unique(faces, return_inverse=True)
    return vertices[used], faces.reshape(-1, 3)


def _stl(path: Path) -> tuple[Array, Faces]:
    triangles = read_stl(path)
    return triangles.reshape(-1, 3), np.arange(3 * len(triangles)).reshape(-1, 3)


def _scene(path: Path) -> tuple[Array, Faces]:
    options = {"skip_materials": True} if path.suffix.lower() == ".obj" else {}
    try:
        mesh = trimesh.load_scene(path, process=False, **options).to_mesh()
        return np.array(mesh.vertices, dtype=float), np.array(mesh.faces, dtype=np.int64)
    except MemoryError:
        raise
    except Exception as error:
        # The readers raise many types of errors on broken files.
        kind = path.suffix[1:].upper()
        raise UserError(f"{path} cannot be read as {kind}: export it again") from error
