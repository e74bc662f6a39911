"""`hkd import`: makes a tool from a mesh or an outline.

The mesh is read and repaired (`repair`) or extruded from an outline (`outline`). It is brought into
the tool frame in a stable pose (`tool_frame`), scaled, and given a grasp (`fit`), a mass
(`materials`) and collision hulls (`convex_decomposition`). Finally a simulation checks how it comes
to rest (`resting_pose`). All this happens in a child process, which may crash or hang, and the
tool's folder appears atomically. Solids are handled in mm and written in metres.
"""

import contextlib
import hashlib
import math
import multiprocessing
import os
import re
import shutil
import signal
import tempfile
import time
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from manifold3d import Manifold

from kitting_drake.common.errors import UserError
from kitting_drake.common.files import replace_folder
from kitting_drake.hkd.importing.convex_decomposition import decompose
from kitting_drake.hkd.importing.fit import (
    HIGHEST_MM,
    LONGEST_MM,
    SHORTEST_MM,
    THINNEST_MM,
    UNITS_MM,
    fit,
    grasp_record,
    material_of,
    true_length,
)
from kitting_drake.hkd.importing.materials import (
    DENSITY_RANGE,
    MATERIALS,
    bodies_of,
    weighed,
)
from kitting_drake.hkd.importing.outline import (
    extruded,
    is_outline,
    laid_along_x,
    read_outline,
)
from kitting_drake.hkd.importing.reading.mesh_files import read_mesh
from kitting_drake.hkd.importing.repair import NOMINAL_MM, make_solid
from kitting_drake.hkd.importing.resting_pose import resting_tilt
from kitting_drake.hkd.importing.tool_frame import (
    facing_forward,
    size,
    tipping_deg,
    to_tool_frame,
)
from kitting_drake.hkd.tools import meshes
from kitting_drake.hkd.tools.mass import mass_properties
from kitting_drake.hkd.tools.sdf import tool_sdf
from kitting_drake.hkd.tools.symmetry import symmetry_order
from kitting_drake.hkd.tools.tool import check_category, load_tool, tool_names, user_tools

TIME_LIMIT = 55.0
"""Seconds of processor time after which the import is aborted."""
_MOST_WAITING = 10.0
"""The limit in wall-clock time, as a multiple of the time limit, because the machine may be busy.
"""
_MAKING = ".making-"
"""The prefix of the folders of unfinished tools."""
_MOST_MEMORY = 12 * 2**30
# A tool that comes to rest tilted by more than `_SAME_POSE_DEG` is moved to that pose and dropped
# again, at most `_LAYINGS` times.
_SAME_POSE_DEG, _LAYINGS = 2.0, 3
# A tool that tips over when the table tilts by this, in degrees, is not stable.
_TIPS_DEG = 10.0
# The hydroelastic modulus, in Pa. The catalogue's would let the pads sink so far into a thin blade
# that they seem to hold nothing, and up a round handle's slope.
_MODULUS = 8e6
# A larger deviation of the collision hulls from the outline is reported.
_TRUE_OUTLINE_MM = 0.35
_FRONTS = {"hammer": "its head", "screwdriver": "its blade"}


@dataclass(frozen=True)
class ImportRequest:
    """A file to import, and the properties of its tool."""

    mesh: Path
    category: str
    name: str | None = None
    """The tool's name; by default the file's."""
    length_mm: float | None = None
    """The length to scale to; None keeps the true length."""
    unit: str | None = None
    """The unit of the file, a key of `fit.UNITS_MM`; None finds it."""
    mass_g: float | None = None
    """The mass as weighed; None follows from the densities."""
    material: str | None = None
    """The material of the whole tool, a key of `materials.MATERIALS`."""
    density: float | None = None
    """The mean density in kg/m^3; see `materials` for None."""
    output: Path | None = None
    """The folder of tools to write to; by default `user_tools`."""
    height_mm: float | None = None
    """The height of an extruded outline; only for outlines."""

    @property
    def given_density(self) -> float | None:
        """The density of the whole tool in kg/m^3, by itself or by the material."""
        return self.density if self.material is None else MATERIALS[self.material]


@dataclass(frozen=True)
class ImportReport:
    """The tool that was made."""

    directory: Path
    record: dict[str, Any]
    """The tool's record, as in `tool.yaml`."""
    notes: list[str]
    """The assumptions and repairs, one phrase each."""
    collision_hulls: int
    """The number of collision hulls."""


def import_tool(request: ImportRequest, time_limit: float | None = TIME_LIMIT) -> ImportReport:
    """Makes a tool's folder from a mesh or an outline.

    Args:
        request: the file to import.
        time_limit: seconds of processor time of the child process; None runs in this process.

    Raises:
        UserError: the tool cannot be made; nothing was written then.
    """
    check_category(request.category)
    name = _checked_name(request)
    _check_options(request)
    _check_height(request)
    folder = request.output or user_tools()
    final = folder / name
    replaced = _check_replaceable(final, request) if final.exists() else None
    new_folders = [p for p in (folder, *folder.parents) if not p.exists()]
    try:
        folder.mkdir(parents=True, exist_ok=True)
        _remove_abandoned(folder)
        with tempfile.TemporaryDirectory(dir=folder, prefix=_MAKING) as scratch:
            made = Path(scratch) / name
            made.mkdir()
            report = (
                prepare_tool(request, name, made)
                if time_limit is None
                else _prepare_aside(request, name, made, time_limit)
            )
            replace_folder(final, made, Path(scratch) / "replaced")
            record, notes, hulls = report
            if replaced is not None:
                notes = [*notes, replaced]
            return ImportReport(final, record, notes, hulls)
    except OSError as error:
        raise UserError(f"cannot write {final}: {error.strerror}") from error
    finally:
        for path in new_folders:
            if path.is_dir() and not any(path.iterdir()):
                path.rmdir()


def _remove_abandoned(folder: Path) -> None:
    """Removes unfinished folders of killed imports."""
    for path in folder.glob(f"{_MAKING}*"):
        # Another import may remove the folder at the same time.
        with contextlib.suppress(FileNotFoundError):
            if time.time() - path.stat().st_mtime > 2 * _MOST_WAITING * TIME_LIMIT:
                shutil.rmtree(path, ignore_errors=True)


def _check_options(request: ImportRequest) -> None:
    for flag, value, low, high in (
        ("--length_mm", request.length_mm, SHORTEST_MM, LONGEST_MM),
        ("--density", request.density, *DENSITY_RANGE),
        ("--mass_g", request.mass_g, 0.1, 10_000.0),
        ("--height_mm", request.height_mm, THINNEST_MM, HIGHEST_MM),
    ):
        if value is not None and not low <= value <= high:
            raise UserError(f"{flag} {value:g} is out of range: give {low:g} to {high:g}")
    for flag, name, names in (
        ("--unit", request.unit, UNITS_MM),
        ("--material", request.material, MATERIALS),
    ):
        if name is not None and name not in names:
            raise UserError(f"{flag} '{name}' is not known: give {', '.join(names)}")
    if request.material is not None and request.density is not None:
        raise UserError("--material and --density both give the density: leave out one")


def _check_height(request: ImportRequest) -> None:
    if is_outline(request.mesh) and request.height_mm is None:
        raise UserError(f"{request.mesh} is an outline: give its height with --height_mm")
    if not is_outline(request.mesh) and request.height_mm is not None:
        raise UserError(f"--height_mm is for outlines (SVG, DXF), and {request.mesh} is a mesh")


def _checked_name(request: ImportRequest) -> str:
    if request.name is None:
        name = re.sub(r"[^a-z0-9]+", "_", request.mesh.stem.lower()).strip("_")[:60]
        if not name:
            raise UserError(f"{request.mesh} has no letter or digit in its name: give --name")
    else:
        name = request.name
    if not re.fullmatch(r"[a-z0-9][a-z0-9_]{0,63}", name):
        raise UserError(f"--name '{name}' must be small letters, digits and underscores")
    if name in tool_names():
        raise UserError(f"'{name}' is the name of one of the project's own tools: give --name")
    return name


def _check_replaceable(folder: Path, request: ImportRequest) -> str | None:
    """Checks that a folder may be replaced; returns a note if the file's content has changed.

    Raises:
        UserError: the folder is not an imported tool, comes from a file of another name, or has an
            annotated grasp.
    """
    try:
        record = yaml.safe_load((folder / "tool.yaml").read_text())
        file, digest = record["imported"]["file"], record["imported"]["sha256"]
        annotated = record.get("annotated")
    except (OSError, yaml.YAMLError, KeyError, TypeError, UnicodeDecodeError) as error:
        raise UserError(
            f"{folder} exists and is not an imported tool: give another --name"
        ) from error
    if annotated:
        raise UserError(f"{folder} has a grasp that you saved: give another --name, or delete it")
    if file != request.mesh.name:
        raise UserError(f"{folder} is the tool of {file}: give another --name, or delete it")
    if request.mesh.is_file() and digest != _digest(request.mesh):
        return f"replaces the tool of an older {file}"
    return None


def _digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


Prepared = tuple[dict[str, Any], list[str], int]


def _prepare_aside(request: ImportRequest, name: str, made: Path, time_limit: float) -> Prepared:
    """Runs `prepare_tool` in a process that is killed after `time_limit` of processor time."""
    too_long = UserError(
        f"{request.mesh} took more than {time_limit:.0f} s to process: decimate the mesh first"
    )
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe(duplex=False)
    arguments = (theirs, request, name, made, time_limit)
    process = context.Process(target=_child, args=arguments, daemon=True)
    process.start()
    theirs.close()
    try:
        if not ours.poll(_MOST_WAITING * time_limit):
            raise too_long
        error, result = ours.recv()
    except EOFError as end:
        process.join()
        if process.exitcode == -signal.SIGXCPU:
            raise too_long from end
        raise UserError(f"{request.mesh} cannot be processed: repair the mesh first") from end
    finally:
        process.kill()
        process.join()
        ours.close()
    if error is not None:
        raise UserError(error)
    return result


def _child(
    pipe: Connection, request: ImportRequest, name: str, made: Path, time_limit: float
) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    # Discard what libraries print; results go through the pipe.
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 1)
    os.dup2(nowhere, 2)
    try:
        import resource

        resource.setrlimit(resource.RLIMIT_AS, (_MOST_MEMORY, _MOST_MEMORY))
        most = math.ceil(time.process_time() + time_limit)
        resource.setrlimit(resource.RLIMIT_CPU, (most, resource.getrlimit(resource.RLIMIT_CPU)[1]))
    except (ImportError, ValueError, OSError):
        pass
    try:
        pipe.send((None, prepare_tool(request, name, made)))
    except UserError as error:
        pipe.send((str(error), None))


def prepare_tool(request: ImportRequest, name: str, directory: Path) -> Prepared:
    """Writes a tool's files into an empty folder.

    Returns:
        Its record, the assumptions and repairs, and the number of collision hulls.

    Raises:
        UserError: the tool cannot be made.
    """
    try:
        return _prepare(request, name, directory)
    except UserError as error:
        text = str(error)
        path = str(request.mesh)
        raise UserError(text if path in text else f"{path}: {text}") from error
    except MemoryError as error:
        raise UserError(f"{request.mesh} needs more memory than is available") from error
    except OSError as error:
        raise UserError(f"cannot write {name}: {error.strerror}") from error
    except Exception as error:
        # Geometry libraries fail in many ways on broken meshes, which are the user's to repair.
        raise UserError(
            f"{request.mesh} cannot be processed ({type(error).__name__}): repair the mesh first"
        ) from error


def _prepare(request: ImportRequest, name: str, directory: Path) -> Prepared:
    vertices, faces = _surface(request)
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    longest = float((high - low).max())
    if not longest > 1e-12:
        raise UserError("the mesh has no extent")
    nominal = NOMINAL_MM / longest
    solid, notes = make_solid((vertices - (low + high) / 2) * nominal, faces)
    drawn = is_outline(request.mesh)
    # An outline shows the tool at rest, from above.
    solid = (facing_forward if drawn else to_tool_frame)(solid, request.category)
    length = size(solid)[0] / nominal
    if drawn:
        if tipping_deg(solid) < _TIPS_DEG:
            raise UserError(
                f"the tool is {request.height_mm:g} mm high and would tip over: draw it from "
                "above, as it lies at rest"
            )
        assumed = f"an outline, {length:.0f} mm long and extruded to {request.height_mm:g} mm"
    else:
        length, assumed = true_length(
            length, size(solid)[2] / nominal, request.unit, request.length_mm
        )
    notes = [assumed, *notes]
    first, wanted = solid, length
    laid: list[str] = []
    for _ in range(_LAYINGS):
        _empty(directory)
        prepared, fitted = _write(request, name, directory, solid, length, [*notes, *laid])
        tilt = resting_tilt(directory / f"{name}.sdf")
        angle = math.degrees(math.acos(np.clip(tilt[2, 2], -1.0, 1.0)))
        if angle <= _SAME_POSE_DEG:
            return prepared
        solid = fitted.transform(np.column_stack([tilt, np.zeros(3)]))
        length = request.length_mm or size(solid)[0]
        laid = [f"laid in its resting pose, which is tilted by {angle:.0f} degrees"]
    # No pose is at rest: use the one with the lowest centre of mass.
    _empty(directory)
    notes.append("it rolls on a table")
    return _write(request, name, directory, first, wanted, notes)[0]


def _surface(request: ImportRequest) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (n, 3) and triangles (m, 3): of a mesh in its units, or of an outline in mm."""
    if not is_outline(request.mesh):
        return read_mesh(request.mesh)
    assert request.height_mm is not None
    outline = laid_along_x(read_outline(request.mesh), request.length_mm, str(request.mesh))
    return extruded(outline, request.height_mm)


def _empty(directory: Path) -> None:
    for file in directory.iterdir():
        file.unlink()


def _write(
    request: ImportRequest,
    name: str,
    directory: Path,
    solid: Manifold,
    length: float,
    notes: list[str],
) -> tuple[Prepared, Manifold]:
    """Writes the files of a solid (mm) in the tool frame; also returns the solid as scaled."""
    notes = list(notes)
    category, density = request.category, request.given_density
    tool, solid = fit(category, name, solid, length, directory, density)
    bodies = bodies_of(solid, category, density)
    if request.mass_g is not None:
        bodies = weighed(bodies, 1e-3 * request.mass_g)
    mass, center, inertia = mass_properties(bodies)
    if len(bodies) > 1:
        notes.append(f"{_FRONTS[category]} taken to be steel, its handle light")
    if request.mass_g is None and density is None:
        notes.append("its mass is a guess: give --mass_g, or --material if it is of one")
    vertices, faces = meshes.vertices_and_faces(solid)
    collision = decompose(solid, tool.grasp)
    if not collision.hulls:
        raise UserError("the mesh encloses too little volume for collision hulls")
    if collision.outline_deviation_mm > _TRUE_OUTLINE_MM:
        notes.append(
            f"its {len(collision.hulls)} collision hulls are up to "
            f"{collision.outline_deviation_mm:.2f} mm off its outline"
        )
    collisions = []
    for index, hull in enumerate(collision.hulls):
        collisions.append(f"collision_{index}.obj")
        meshes.write_convex_obj(directory / collisions[-1], hull)
    material = material_of(request.category)
    text = tool_sdf(
        name,
        mass,
        center,
        inertia,
        [(tool.visual_meshes[0].name, material)],
        collisions,
        modulus=_MODULUS,
    )
    (directory / f"{name}.sdf").write_text(
        re.sub(r"<!--.*?-->", f"<!-- Made by `hkd import` of {_safe(request.mesh.name)}. -->", text)
    )
    record = {
        "name": name,
        "category": request.category,
        "split": "user",
        "length": tool.length,
        "width": tool.width,
        "height": tool.height,
        "mass": round(float(mass), 6),
        "center_of_mass": [round(float(v), 6) + 0.0 for v in center],
        "symmetry": symmetry_order(1e-3 * vertices[faces]),
        "grasp": grasp_record(tool.grasp),
        "other_grasps": [grasp_record(grasp) for grasp in tool.other_grasps],
        "visual_meshes": [path.name for path in tool.visual_meshes],
        "imported": {
            "file": request.mesh.name,
            "sha256": _digest(request.mesh),
            "density": round(float(mass / (1e-9 * solid.volume())), 1),
            "outline_deviation": round(1e-3 * collision.outline_deviation_mm, 6),
            "notes": notes,
        },
    }
    (directory / "tool.yaml").write_text(yaml.safe_dump(record, sort_keys=False))
    load_tool(str(directory))
    return (record, notes, len(collision.hulls)), solid


def _safe(text: str) -> str:
    """Text that is safe in an XML comment."""
    return re.sub(r"[^\w. ]|-", "_", text, flags=re.ASCII)
