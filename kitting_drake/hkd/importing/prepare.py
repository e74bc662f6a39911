"""Makes the files of a tool: runs the steps of `hkd import` in order."""

import hashlib
import math
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from manifold3d import Manifold
from numpy.typing import NDArray

from kitting_drake.common.errors import UserError
from kitting_drake.hkd.importing.convex_decomposition import decompose
from kitting_drake.hkd.importing.fit import fit, grasp_record, material_of, true_length
from kitting_drake.hkd.importing.import_request import ImportRequest
from kitting_drake.hkd.importing.materials import bodies_of, weighed
from kitting_drake.hkd.importing.outline import extruded, is_outline, laid_along_x, read_drawing
from kitting_drake.hkd.importing.reading import drawn_curves
from kitting_drake.hkd.importing.reading.closed_curves import FrameError
from kitting_drake.hkd.importing.reading.mesh_files import IN_MM, read_mesh
from kitting_drake.hkd.importing.reading.outline_picture import holes_text, write_outline_picture
from kitting_drake.hkd.importing.repair import NOMINAL_MM, make_solid
from kitting_drake.hkd.importing.resting_pose import resting_tilt
from kitting_drake.hkd.importing.tool_frame import facing_forward, size, tipping_deg, to_tool_frame
from kitting_drake.hkd.tools import meshes
from kitting_drake.hkd.tools.mass import mass_properties
from kitting_drake.hkd.tools.sdf import tool_sdf
from kitting_drake.hkd.tools.symmetry import symmetry_order
from kitting_drake.hkd.tools.tool import Tool, load_tool

# If a dropped tool comes to rest tilted by more than `_SAME_POSE_DEG`, its model is rotated by this
# tilt and dropped again. A tool is dropped at most `_LAYINGS` times in all.
_SAME_POSE_DEG, _LAYINGS = 2.0, 3
# A tool made from an outline must not tip over on a table with this tilt, in degrees.
_TIPS_DEG = 10.0
# The hydroelastic modulus, in Pa. With the lower `sdf.HYDROELASTIC_MODULUS`, the pads would sink
# too far into thin blades and slide up round handles.
_MODULUS = 8e6
# If the collision hulls deviate by more than this from the outline, in mm, a note reports it.
_TRUE_OUTLINE_MM = 0.35
Prepared = tuple[dict[str, Any], list[str], int]
Say = Callable[[str], None]

_FRONTS = {"hammer": "its head", "screwdriver": "its blade"}


def _silent(step: str) -> None:
    pass


def digest_of(path: Path) -> str:
    """Returns the SHA-256 of a file's content."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


def prepare_tool(
    request: ImportRequest, name: str, directory: Path, say: Say = _silent
) -> Prepared:
    """Writes a tool's files into an empty folder.

    Args:
        request: the file to import, and the properties of the tool.
        name: the tool's name.
        directory: the folder.
        say: a function that is called with the name of each step.

    Returns:
        The tool's record, notes on assumptions and repairs, and the number of collision hulls.

    Raises:
        UserError: the tool cannot be made.
    """
    try:
        return _prepare(request, name, directory, say)
    except UserError as error:
        text = str(error)
        path = str(request.mesh)
        raise UserError(text if path in text else f"{path}: {text}") from error
    except MemoryError as error:
        raise UserError(
            f"{request.mesh} needs more memory than is available: simplify it first"
        ) from error
    except OSError as error:
        raise UserError(f"cannot write {name}: {error.strerror}") from error
    except Exception as error:
        # Geometry libraries raise many types of errors on broken meshes, which the user has to
        # repair.
        raise UserError(
            f"{request.mesh} cannot be processed ({type(error).__name__}): repair the mesh first"
        ) from error


def _prepare(request: ImportRequest, name: str, directory: Path, say: Say) -> Prepared:
    say("reading it")
    vertices, faces, found = _surface(request)
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    longest = float((high - low).max())
    if not longest > 1e-12:
        raise UserError("the mesh has no extent: all of its points are the same")
    nominal = NOMINAL_MM / longest
    say(f"repairing its {len(faces)} triangles")
    solid, notes = make_solid((vertices - (low + high) / 2) * nominal, faces)
    drawn = is_outline(request.mesh)
    say("laying it down")
    # An outline already shows the tool at rest, from above.
    solid = (facing_forward if drawn else to_tool_frame)(solid, request.category)
    length = size(solid)[0] / nominal
    if drawn:
        if tipping_deg(solid) < _TIPS_DEG:
            raise UserError(
                f"the tool is {request.height_mm:g} mm high and would tip over: draw it as it "
                "lies at rest, seen from above, or check --height_mm"
            )
        assumed = (
            f"an outline of {' x '.join(f'{side / nominal:.1f}' for side in size(solid)[:2])} mm "
            f"with {holes_text(solid.project())}, {found[0]}; {request.height_mm:g} mm high"
        )
        notes = [*found[1:], *notes]
    else:
        unit = "mm" if request.mesh.suffix.lower() in IN_MM else request.unit
        length, assumed = true_length(length, size(solid)[2] / nominal, unit, request.length_mm)
    notes = [assumed, *notes]
    first, wanted = solid, length
    laid: list[str] = []
    for _ in range(_LAYINGS):
        _empty(directory)
        prepared, fitted = _write(request, name, directory, solid, length, [*notes, *laid], say)
        say("letting it come to rest")
        tilt = resting_tilt(directory / f"{name}.sdf", length)
        angle = math.degrees(math.acos(np.clip(tilt[2, 2], -1.0, 1.0)))
        if angle <= _SAME_POSE_DEG:
            return prepared
        solid = fitted.transform(np.column_stack([tilt, np.zeros(3)]))
        length = request.length_mm or size(solid)[0]
        laid = [f"laid in its resting pose, which is tilted by {angle:.0f} degrees"]
    # The tool did not come to rest in any pose that was tried, so use the first one.
    _empty(directory)
    notes.append("it rolls on a table")
    return _write(request, name, directory, first, wanted, notes, say)[0]


def _surface(request: ImportRequest) -> tuple[np.ndarray, np.ndarray, list[str]]:
    """Reads the mesh of a request, or extrudes its outline.

    Returns:
        Vertices (n, 3), triangles (m, 3) and notes. The vertices of a mesh are in its own units,
        those of an outline in mm. For an outline, the first note says how its scale is known.
    """
    if not is_outline(request.mesh):
        return *read_mesh(request.mesh), []
    assert request.height_mm is not None
    unit_mm = None if request.unit is None else drawn_curves.UNITS_MM[request.unit]
    try:
        drawing = read_drawing(request.mesh, unit_mm, request.frame)
    except FrameError:
        raise
    except UserError:
        # The unit does not matter for a drawing that is scaled to a given length.
        if request.length_mm is None or unit_mm is not None:
            raise
        drawing = read_drawing(request.mesh, 1.0, request.frame)
    outline = laid_along_x(drawing.outline, request.length_mm, str(request.mesh))
    measured = f"measured {drawing.measured}"
    if request.length_mm is not None:
        measured = "scaled as requested"
    return *extruded(outline, request.height_mm), [measured, *drawing.notes]


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
    say: Say,
) -> tuple[Prepared, Manifold]:
    """Scales a solid in the tool frame to a length in mm, and writes the files of its tool.

    Returns:
        The results of `prepare_tool`, and the solid scaled to `length` mm.
    """
    notes = list(notes)
    category, density = request.category, request.given_density
    say("finding a grasp")
    tool, solid = fit(category, name, solid, length, directory, density)
    bodies = bodies_of(solid, category, density)
    if request.mass_g is not None:
        bodies = weighed(bodies, 1e-3 * request.mass_g)
    mass, center, inertia = mass_properties(bodies)
    if len(bodies) > 1:
        notes.append(
            f"{_FRONTS[category]} is assumed to be of steel, its handle of a light material"
        )
    if request.mass_g is None and density is None:
        notes.append(
            "its mass is a guess: give --mass_g, or --material if the tool is of one material"
        )
    vertices, faces = meshes.vertices_and_faces(solid)
    say("making its collision hulls")
    collision = decompose(solid, tool.grasp)
    if not collision.hulls:
        raise UserError("the mesh encloses too little volume for collision hulls: repair it first")
    if collision.outline_deviation_mm > _TRUE_OUTLINE_MM:
        notes.append(
            f"its {len(collision.hulls)} collision hulls are up to "
            f"{collision.outline_deviation_mm:.2f} mm off its outline"
        )
    collisions = []
    for index, hull in enumerate(collision.hulls):
        collisions.append(f"collision_{index}.obj")
        meshes.write_convex_obj(directory / collisions[-1], hull)
    write_outline_picture(solid.project(), directory / "outline.png")
    text = tool_sdf(
        name,
        mass,
        center,
        inertia,
        [(tool.visual_meshes[0].name, material_of(category))],
        collisions,
        modulus=_MODULUS,
    )
    (directory / f"{name}.sdf").write_text(
        re.sub(r"<!--.*?-->", f"<!-- Made by `hkd import` of {_safe(request.mesh.name)}. -->", text)
    )
    say("measuring its symmetry")
    record = {
        **_properties(tool, mass, center, symmetry_order(1e-3 * vertices[faces])),
        **({"outline_error": 1e-3 * error} if (error := request.outline_error_mm) else {}),
        "imported": {
            "file": request.mesh.name,
            "sha256": digest_of(request.mesh),
            "density": round(float(mass / (1e-9 * solid.volume())), 1),
            "outline_deviation": round(1e-3 * collision.outline_deviation_mm, 6),
            "notes": notes,
        },
    }
    (directory / "tool.yaml").write_text(yaml.safe_dump(record, sort_keys=False))
    load_tool(str(directory))
    return (record, notes, len(collision.hulls)), solid


def _properties(
    tool: Tool, mass: float, center: NDArray[np.float64], symmetry: int
) -> dict[str, Any]:
    """Returns a tool's record without the entry `imported`."""
    return {
        "name": tool.name,
        "category": tool.category,
        "split": "user",
        "length": tool.length,
        "width": tool.width,
        "height": tool.height,
        "mass": round(float(mass), 6),
        "center_of_mass": [round(float(v), 6) + 0.0 for v in center],
        "symmetry": symmetry,
        "grasp": grasp_record(tool.grasp),
        "other_grasps": [grasp_record(grasp) for grasp in tool.other_grasps],
        "visual_meshes": [path.name for path in tool.visual_meshes],
    }


def _safe(text: str) -> str:
    """Replaces special characters by underscores, so that a text cannot end an XML comment."""
    return re.sub(r"[^\w. ]|-", "_", text, flags=re.ASCII)
