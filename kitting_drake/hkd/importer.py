"""`hkd import`: from anyone's mesh to a tool that scenarios can name.

Read and mended (`repair`), laid down flat in a pose in which it stays, turned along x, scaled,
weighed, given collision pieces (`pieces`) and the best grasp (`grasps`). All of that happens in a
process of its own, which may fail or hang as it likes: the tool's folder appears whole or not at
all. Solids are handled in mm and written in metres.
"""

import hashlib
import multiprocessing
import os
import re
import shutil
import signal
import tempfile
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
import yaml
from manifold3d import Manifold

from kitting_drake.errors import UserError
from kitting_drake.hkd import meshes
from kitting_drake.hkd.grasps import WIDEST, propose_grasps
from kitting_drake.hkd.kit import SLOTS, KitParameters, kit_cavities
from kitting_drake.hkd.lie import lie_down, placed, size
from kitting_drake.hkd.pieces import convex_pieces
from kitting_drake.hkd.repair import NOMINAL_MM, make_solid, read_mesh
from kitting_drake.hkd.sdf import tool_sdf
from kitting_drake.hkd.tool import CATEGORIES, Tool, load_tool, tool_names, user_tools

DENSITIES = {"hammer": 3000.0, "pliers": 6000.0, "wrench": 7850.0, "screwdriver": 2000.0}
"""What a tool of a category weighs on average, handle and all, in kg/m^3."""

MATERIALS = {
    "hammer": "steel",
    "pliers": "steel",
    "wrench": "polished_steel",
    "screwdriver": "steel",
}

LENGTH_MM = 180.0
KEPT_LENGTHS_MM = (150.0, 200.0)
"""A tool of such a length keeps it: those of the dataset's tools."""
POSSIBLE_LENGTHS_MM = (50.0, 600.0)
"""How long hand tools are, by which a file's unit is guessed."""
THINNEST_MM, HIGHEST_MM = 4.0, 45.0
TIME_LIMIT = 55.0
"""Seconds after which the geometry is given up."""
_MOST_MEMORY = 12 * 2**30

_UNITS = {"mm": 1.0, "m": 1000.0, "cm": 10.0, "inches": 25.4}
_CREASE_ANGLE_DEG = 35.0


@dataclass(frozen=True)
class ImportRequest:
    """What to import, as what."""

    mesh: Path
    category: str
    name: str | None = None
    """Of the tool; from the file's if None."""
    length_mm: float | None = None
    """To scale it to; see `_length` for None."""
    density: float | None = None
    """In kg/m^3; see `DENSITIES` for None."""
    output: Path | None = None
    """The folder of tools to write into; `user_tools` if None."""


@dataclass(frozen=True)
class ImportReport:
    """What became of it."""

    directory: Path
    record: dict[str, Any]
    """The tool's record, as in `tool.yaml`."""
    notes: list[str]
    """What was assumed and mended, a phrase each."""
    pieces: int
    """Of its collision geometry."""


def import_tool(request: ImportRequest, time_limit: float | None = TIME_LIMIT) -> ImportReport:
    """Makes a tool's folder from a mesh.

    Args:
        request: what to import.
        time_limit: in seconds, for the process that does it; None does it in this process.

    Raises:
        UserError: it cannot be saved, and nothing was written.
    """
    if request.category not in CATEGORIES:
        raise UserError(f"category '{request.category}' is none of {', '.join(CATEGORIES)}")
    name = _checked_name(request)
    for flag, value, low, high in (
        ("--length_mm", request.length_mm, 20.0, 250.0),
        ("--density", request.density, 50.0, 25000.0),
    ):
        if value is not None and not low <= value <= high:
            raise UserError(f"{flag} {value:g} is out of range: give {low:g} to {high:g}")
    folder = request.output or user_tools()
    final = folder / name
    if final.exists() and not _is_import(final):
        raise UserError(f"{final} exists and is no imported tool: give another --name")
    new_folders = [p for p in (folder, *folder.parents) if not p.exists()]
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=folder, prefix=".making-") as scratch:
            made = Path(scratch) / name
            made.mkdir()
            report = (
                prepare_tool(request, name, made)
                if time_limit is None
                else _prepare_aside(request, name, made, time_limit)
            )
            if final.exists():
                os.rename(final, Path(scratch) / "replaced")
            os.rename(made, final)
            return ImportReport(final, *report)
    except OSError as error:
        raise UserError(f"cannot write {final}: {error.strerror}") from error
    finally:
        for path in new_folders:
            if path.is_dir() and not any(path.iterdir()):
                path.rmdir()


def _checked_name(request: ImportRequest) -> str:
    if request.name is None:
        name = re.sub(r"[^a-z0-9]+", "_", request.mesh.stem.lower()).strip("_")[:60] or "tool"
    else:
        name = request.name
    if not re.fullmatch(r"[a-z0-9][a-z0-9_]{0,63}", name):
        raise UserError(f"--name '{name}' has to be small letters, digits and underscores")
    if name in tool_names():
        raise UserError(f"'{name}' is the name of one of the project's own tools: give --name")
    return name


def _is_import(folder: Path) -> bool:
    try:
        return bool(yaml.safe_load((folder / "tool.yaml").read_text())["split"] == "user")
    except (OSError, yaml.YAMLError, KeyError, TypeError, UnicodeDecodeError):
        return False


Prepared = tuple[dict[str, Any], list[str], int]


def _prepare_aside(request: ImportRequest, name: str, made: Path, time_limit: float) -> Prepared:
    """`prepare_tool` in a process that is ended after `time_limit`."""
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe(duplex=False)
    process = context.Process(target=_child, args=(theirs, request, name, made), daemon=True)
    process.start()
    theirs.close()
    try:
        if not ours.poll(time_limit):
            raise UserError(
                f"{request.mesh} was not worked out in {time_limit:.0f} s: decimate the mesh first"
            )
        error, result = ours.recv()
    except EOFError as end:
        raise UserError(f"{request.mesh} is too broken a mesh to be worked out") from end
    finally:
        process.kill()
        process.join()
        ours.close()
    if error is not None:
        raise UserError(error)
    return result


def _child(pipe: Connection, request: ImportRequest, name: str, made: Path) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    # Libraries talk: what there is to say goes through the pipe.
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 1)
    os.dup2(nowhere, 2)
    try:
        import resource

        resource.setrlimit(resource.RLIMIT_AS, (_MOST_MEMORY, _MOST_MEMORY))
    except (ImportError, ValueError, OSError):
        pass
    try:
        pipe.send((None, prepare_tool(request, name, made)))
    except UserError as error:
        pipe.send((str(error), None))


def prepare_tool(request: ImportRequest, name: str, directory: Path) -> Prepared:
    """Writes a tool's files into an empty folder.

    Returns:
        Its record, what was assumed and mended, and the number of its collision pieces.

    Raises:
        UserError: it cannot be saved.
    """
    try:
        return _prepare(request, name, directory)
    except UserError as error:
        text = str(error)
        path = str(request.mesh)
        raise UserError(text if path in text else f"{path}: {text}") from error
    except MemoryError as error:
        raise UserError(f"{request.mesh} needs more memory than there is") from error
    except Exception as error:
        # Whatever geometry fails on: a broken mesh is the user's to mend, not a fault to trace.
        raise UserError(
            f"{request.mesh} is too broken a mesh to be worked out ({type(error).__name__})"
        ) from error


def _prepare(request: ImportRequest, name: str, directory: Path) -> Prepared:
    vertices, faces = read_mesh(request.mesh)
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    longest = float((high - low).max())
    if not longest > 1e-12:
        raise UserError("all of the mesh is one point")
    nominal = NOMINAL_MM / longest
    solid, notes = make_solid((vertices - (low + high) / 2) * nominal, faces)
    solid = lie_down(solid, request.category)
    lengths, assumed = _lengths(size(solid)[0] / nominal, request.length_mm)
    notes = [assumed, *notes]
    tool, solid = _fitted(request, name, solid, lengths, notes, directory)
    density = request.density or DENSITIES[request.category]
    vertices, faces = meshes.vertices_and_faces(solid)
    physics = trimesh.triangles.mass_properties(1e-3 * vertices[faces], density=density)
    pieces = convex_pieces(solid, tool.grasp)
    if not pieces:
        raise UserError("the mesh encloses too little volume to be touched")
    collisions = []
    for index, piece in enumerate(pieces):
        collisions.append(f"collision_{index}.obj")
        meshes.write_convex_obj(directory / collisions[-1], piece)
    material = MATERIALS[request.category]
    text = tool_sdf(
        name,
        physics["mass"],
        physics["center_mass"],
        physics["inertia"],
        [(tool.visual_meshes[0].name, material)],
        collisions,
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
        "mass": round(float(physics["mass"]), 6),
        "center_of_mass": [round(float(v), 6) + 0.0 for v in physics["center_mass"]],
        "grasp": {key: round(float(value), 6) for key, value in vars(tool.grasp).items()},
        "visual_meshes": [path.name for path in tool.visual_meshes],
        "imported": {
            "file": request.mesh.name,
            "sha256": hashlib.sha256(request.mesh.read_bytes()).hexdigest(),
            "density": float(density),
            "notes": notes,
        },
    }
    (directory / "tool.yaml").write_text(yaml.safe_dump(record, sort_keys=False))
    load_tool(str(directory))
    return record, notes, len(pieces)


def _safe(text: str) -> str:
    """Text that may stand in an XML comment."""
    return re.sub(r"[^\w. ]|-", "_", text, flags=re.ASCII)


def guess_unit(length: float) -> str | None:
    """In what a hand tool of this length may have been measured, or None if in nothing usual.

    Inches and centimetres overlap; a length below 12 is taken for inches, above for centimetres.
    """
    shortest, longest = POSSIBLE_LENGTHS_MM
    for unit, low, high in (
        ("mm", shortest, longest),
        ("m", shortest / 1000, longest / 1000),
        ("inches", shortest / 25.4, 12.0),
        ("cm", 12.0, longest / 10),
    ):
        if low <= length <= high:
            return unit
    return None


def _lengths(length: float, wanted_mm: float | None) -> tuple[list[float], str]:
    """The lengths (mm) to try, the first that will do; and why, for the user."""
    unit = guess_unit(length)
    if unit is None:
        assumed, real = f"unit unknown ({length:.4g} long)", 0.0
    else:
        real = length * _UNITS[unit]
        assumed = f"taken to be in {unit}: {real:.0f} mm long"
    if wanted_mm is not None:
        return [wanted_mm], f"{assumed}, scaled as asked"
    if KEPT_LENGTHS_MM[0] <= real <= KEPT_LENGTHS_MM[1]:
        return [real], f"{assumed}, kept"
    return [LENGTH_MM, 170.0, 160.0, 150.0], f"{assumed}, scaled"


def _fitted(
    request: ImportRequest,
    name: str,
    solid: Manifold,
    lengths: list[float],
    notes: list[str],
    directory: Path,
) -> tuple[Tool, Manifold]:
    """The tool, with its visual mesh written, at the first length at which it can be used.

    Raises:
        UserError: there is none; what was wrong with the first.
    """
    refusal: UserError | None = None
    for length in lengths:
        factor = length / size(solid)[0]
        scaled = placed(solid.scale((factor, factor, factor)).simplify(0.01))
        try:
            _check_size(scaled)
            tool = _tool(request.category, name, scaled, directory)
            _check_place(tool)
        except UserError as error:
            refusal = refusal or error
            continue
        if refusal is not None:
            notes.append(f"made {length:.0f} mm long, for {refusal}")
        return tool, scaled
    assert refusal is not None
    raise refusal


def _check_size(solid: Manifold) -> None:
    length, width, height = size(solid)
    if height < THINNEST_MM:
        raise UserError(
            f"at {length:.0f} mm length it is {height:.1f} mm thick, and the hand needs "
            f"{THINNEST_MM:.0f} mm to hold"
        )
    if height > HIGHEST_MM:
        raise UserError(
            f"at {length:.0f} mm length it lies {height:.0f} mm high, and a kit takes "
            f"{HIGHEST_MM:.0f} mm"
        )


def _tool(category: str, name: str, solid: Manifold, directory: Path) -> Tool:
    """A tool with its visual mesh written and its best grasp.

    Raises:
        UserError: it cannot be grasped.
    """
    length, width, height = (round(1e-3 * float(extent), 6) for extent in size(solid))
    visual = directory / f"{MATERIALS[category]}.obj"
    meshes.write_smooth_obj(visual, solid, _CREASE_ANGLE_DEG)
    vertices, faces = meshes.vertices_and_faces(solid)
    triangles = 1e-3 * vertices[faces]
    com = trimesh.triangles.mass_properties(triangles)["center_mass"]
    proposals = propose_grasps(triangles, com)
    if not proposals:
        raise UserError(
            f"at {1e3 * length:.0f} mm length the hand, whose jaws take {1e3 * WIDEST:.0f} mm, "
            "finds no place to hold it from above"
        )
    return Tool(
        directory=directory,
        name=name,
        category=category,
        split="user",
        length=length,
        width=width,
        height=height,
        mass=0.0,
        grasp=proposals[0].grasp,
        visual_meshes=(visual,),
    )


def _check_place(tool: Tool) -> None:
    """Raises UserError if no standard kit has room for a tool."""
    parameters = KitParameters()
    at = f"at {1e3 * tool.length:.0f} mm length it is {1e3 * tool.width:.0f} mm wide"
    try:
        kit_cavities([tool], parameters)
    except UserError as error:
        raise UserError(f"{at}, too big for its place in the kit") from error
    shipped = [load_tool(name) for name in tool_names()]
    for category in SLOTS:
        others = [other for other in shipped if other.category == category != tool.category]
        if others and not any(_share_a_kit(tool, other, parameters) for other in others):
            raise UserError(f"{at} and leaves no room in the kit for any {category}")


def _share_a_kit(tool: Tool, other: Tool, parameters: KitParameters) -> bool:
    try:
        kit_cavities([tool, other], parameters)
    except UserError:
        return False
    return True
