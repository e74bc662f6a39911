"""Makes tools from flat shapes: the project's own shapes, and the meshes in a folder.

A shape lies as it was drawn, with z up. All shapes are of plastic, in one of six colours. The
collision hulls follow the outline; those of a prism also keep its holes. The tools are stored in
the cache.
"""

import hashlib
import re
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import yaml
from manifold3d import CrossSection, JoinType, Manifold

from kitting_drake.common.cached_folder import cached_folder
from kitting_drake.common.errors import UserError
from kitting_drake.common.paths import cache_directory
from kitting_drake.hkd.grasps.holds import WIDEST
from kitting_drake.hkd.grasps.proposals import GraspProposal, propose_grasps
from kitting_drake.hkd.importing.convex_cover import convex_cover
from kitting_drake.hkd.importing.convex_decomposition import decompose
from kitting_drake.hkd.importing.fit import HIGHEST_MM, THINNEST_MM
from kitting_drake.hkd.importing.reading.mesh_files import FORMATS, read_mesh
from kitting_drake.hkd.importing.repair import NOMINAL_MM, make_solid
from kitting_drake.hkd.importing.tool_frame import centred, size, tipping_deg
from kitting_drake.hkd.shapes.shape_outlines import HEIGHT_MM, SHAPES, OutlinedShape
from kitting_drake.hkd.tools import meshes
from kitting_drake.hkd.tools.collision import thinned
from kitting_drake.hkd.tools.mass import mass_properties
from kitting_drake.hkd.tools.sdf import tool_sdf
from kitting_drake.hkd.tools.solids import without_holes
from kitting_drake.hkd.tools.symmetry import symmetry_order
from kitting_drake.hkd.tools.tool import Tool, load_tool
from systems.grasp import Grasp

CATEGORY = "shape"
"""The category of all shapes."""
RAVENS_SCALE = (0.003, 0.003, 0.001)
"""The scale of the meshes of Ravens' assembling-kits, in metres per unit along x, y and z."""

_FORMAT_VERSION = "1"
"""The version of the files in the cache. Increase it if a change of the code changes the files."""
_DENSITY = 1150.0
"""The density of the shapes, in kg/m^3."""
_COLOURS = ("red_grip", "blue_grip", "yellow_grip", "green_grip", "orange_grip", "hickory")
_LARGEST_MM = 250.0
_TIPS_DEG = 10.0
"""A shape counts as flat if it does not tip over on a table with this tilt, in degrees."""
_CREASE_DEG = 35.0
# A solid counts as a prism if its volume differs from that of its extruded outline by less than
# this share.
_PRISM = 0.01
_OUTLINES_MM = (0.12, 0.2, 0.3)
"""The tolerances of the collision hulls' outline, tried in turn until there are at most
`_MOST_HULLS` hulls."""
_HOLE_MM = 0.8
"""The tolerance of the outlines of holes in the collision hulls."""
_VERTEX_MM = 0.08
"""The tolerance for thinning the vertices of the hulls."""
_MOST_HULLS = 12
_BESIDE = 0.025
"""The distance of a grasp from the centre of mass, in metres, that adds 1 to its cost."""


def shapes_of(split: str) -> list[OutlinedShape]:
    """Returns the project's shapes of a split, `train` or `test`."""
    return [shape for shape in SHAPES if shape.split == split]


def shape_tool(shape: OutlinedShape) -> Tool:
    """Returns the tool of one of the project's shapes. The tool is made at the first call.

    Raises:
        UserError: the cache cannot be written.
    """
    outline = shape.draw()
    key = hashlib.sha256(f"{shape.name} {shape.split} {shape.symmetry} {HEIGHT_MM}".encode())
    for loop in outline.to_polygons():
        key.update(np.round(loop, 6).tobytes())
    colour = _COLOURS[SHAPES.index(shape) % len(_COLOURS)]

    def write(folder: Path) -> None:
        solid = outline.extrude(HEIGHT_MM)
        _write(folder, shape.name, shape.split, solid, colour, shape.symmetry)

    return _cached(key.hexdigest(), shape.name, colour, write)


def shape_files(folder: Path) -> list[Path]:
    """Returns the meshes in a folder, sorted by name.

    Raises:
        UserError: there is no such folder, or no mesh in it.
    """
    kinds = ", ".join(suffix[1:].upper() for suffix in FORMATS)
    if not folder.is_dir():
        raise UserError(f"there is no folder {folder}: give a folder with meshes ({kinds})")
    found = sorted(path for path in folder.iterdir() if path.suffix.lower() in FORMATS)
    if not found:
        raise UserError(f"{folder} has no meshes: give a folder with meshes ({kinds})")
    return found


def imported_shape(path: Path, scale: Sequence[float] = RAVENS_SCALE) -> Tool:
    """Returns the tool of a mesh that is a flat shape with z up.

    The tool is made at the first call.

    Args:
        path: the mesh.
        scale: metres per unit of the file, along x, y and z.

    Raises:
        UserError: the mesh is unreadable, or is not a flat shape that the hand can hold; or the
            cache cannot be written.
    """
    try:
        digest = hashlib.sha256(path.read_bytes())
    except OSError as error:
        raise UserError(f"cannot read {path}: {error.strerror}") from error
    name = re.sub(r"[^a-z0-9]+", "_", path.stem.lower()).strip("_")[:50]
    name = name if name[:1].isalpha() else f"shape_{name}"
    digest.update(f"{name} {tuple(map(float, scale))}".encode())
    colour = _COLOURS[int(digest.hexdigest()[:8], 16) % len(_COLOURS)]

    def write(folder: Path) -> None:
        _write(folder, name, "user", _solid(path, scale), colour, None)

    try:
        return _cached(digest.hexdigest(), name, colour, write)
    except UserError as error:
        text = str(error)
        raise type(error)(text if str(path) in text else f"{path}: {text}") from error


def _solid(path: Path, scale: Sequence[float]) -> Manifold:
    """Returns the solid of a mesh, in mm."""
    vertices, faces = read_mesh(path)
    # Scale the mesh for repair, whose tolerances are for a solid of `NOMINAL_MM`.
    vertices = 1e3 * np.asarray(scale) * vertices
    extent = float(np.ptp(vertices, axis=0).max())
    if not 1e-9 < extent < np.inf:
        raise UserError("the mesh has no extent: all of its points are the same")
    factor = NOMINAL_MM / extent
    solid, _ = make_solid(factor * vertices, faces)
    return solid.scale([1 / factor] * 3)


def _cached(key: str, name: str, colour: str, write: Callable[[Path], None]) -> Tool:
    key = hashlib.sha256(f"{_FORMAT_VERSION} {key}".encode()).hexdigest()[:24]
    files = (f"{name}.sdf", "tool.yaml", f"{colour}.obj")
    folder = cached_folder(cache_directory() / "shapes" / key, files, write)
    return load_tool(str(folder))


def _write(
    folder: Path, name: str, split: str, solid: Manifold, colour: str, symmetry: int | None
) -> None:
    """Writes a tool's files into an empty folder.

    Args:
        folder: the folder.
        name: the tool's name.
        split: the tool's split.
        solid: the shape at rest, in mm.
        colour: the shape's material, a key of `MATERIALS`.
        symmetry: the order of the rotational symmetry; None to measure it.

    Raises:
        UserError: the solid is not a flat shape that the hand can hold.
    """
    solid = centred(solid)
    _check(solid)
    vertices, faces = meshes.vertices_and_faces(solid)
    triangles = 1e-3 * vertices[faces]
    mass, center, inertia = mass_properties([(solid, _DENSITY)])
    proposals = propose_grasps(triangles, center, corners=True)
    if not proposals:
        raise UserError(
            "the hand cannot hold the shape from above (the jaws open to at most "
            f"{1e3 * WIDEST:.0f} mm): give another scale"
        )
    grasp = min(proposals, key=_rank).grasp
    meshes.write_smooth_obj(folder / f"{colour}.obj", solid, _CREASE_DEG)
    collisions = []
    for index, hull in enumerate(_hulls(solid, grasp)):
        collisions.append(f"collision_{index}.obj")
        meshes.write_convex_obj(folder / collisions[-1], hull)
    text = tool_sdf(name, mass, center, inertia, [(f"{colour}.obj", colour)], collisions)
    (folder / f"{name}.sdf").write_text(re.sub(r"<!--.*?-->\n", "", text))
    length, width, height = (round(1e-3 * float(extent), 6) for extent in size(solid))
    record = {
        "name": name,
        "category": CATEGORY,
        "split": split,
        "length": length,
        "width": width,
        "height": height,
        "mass": round(float(mass), 6),
        "center_of_mass": [round(float(value), 6) + 0.0 for value in center],
        "symmetry": symmetry_order(triangles) if symmetry is None else symmetry,
        "grasp": {key: round(float(value), 6) for key, value in vars(grasp).items()},
        "visual_meshes": [f"{colour}.obj"],
    }
    (folder / "tool.yaml").write_text(yaml.safe_dump(record, sort_keys=False))


def _rank(proposal: GraspProposal) -> float:
    """Returns the cost of a grasp of a shape.

    Shapes are far apart in their kit, so the cost of being close to a neighbour is left out. The
    distance from the centre of mass costs more than for a hand tool: a shape has no handle, and
    near its end it touches only a small part of the pads.
    """
    beside = proposal.offset / _BESIDE
    return proposal.cost - proposal.penalties["neighbour in the kit"] + beside


def _check(solid: Manifold) -> None:
    length, width, height = size(solid)
    if max(length, width) > _LARGEST_MM:
        raise UserError(
            f"the shape is {max(length, width):.0f} mm long, but may be at most "
            f"{_LARGEST_MM:.0f} mm long: give another scale"
        )
    if not THINNEST_MM <= height <= HIGHEST_MM:
        raise UserError(
            f"the shape is {height:.1f} mm high, but the hand and a kit need {THINNEST_MM:.0f} to "
            f"{HIGHEST_MM:.0f} mm: give another scale"
        )
    if tipping_deg(solid) < _TIPS_DEG:
        raise UserError(
            "the shape does not lie flat: turn the mesh so that its flat side is in the xy plane"
        )


def _hulls(solid: Manifold, grasp: Grasp) -> list[np.ndarray]:
    """Makes convex hulls (n, 3) that fill a shape, in mm. The holes of a prism stay open."""
    height = float(size(solid)[2])
    outline = solid.project().simplify(0.01)
    prism = abs(outline.area() * height - solid.volume()) < _PRISM * solid.volume()
    if not prism:
        return decompose(solid, grasp).hulls
    filled = without_holes(outline)
    holes = filled - outline
    polygons: list[CrossSection] = []
    for tolerance in _OUTLINES_MM:
        inner = _grown(filled, -tolerance) - _grown(holes, _HOLE_MM)
        outer = _grown(filled, tolerance) - _grown(holes, -_HOLE_MM)
        polygons = convex_cover(inner, outer, outline)
        if len(polygons) <= _MOST_HULLS:
            break
    return [_prism(polygon, height) for polygon in polygons]


def _grown(outline: CrossSection, distance: float) -> CrossSection:
    return outline.offset(distance, JoinType.Round, circular_segments=96)


def _prism(polygon: CrossSection, height: float) -> np.ndarray:
    corners = np.vstack(polygon.to_polygons())
    points = np.vstack(
        [np.column_stack([corners, np.full(len(corners), z)]) for z in (0.0, height)]
    )
    return thinned(points, _VERTEX_MM, _VERTEX_MM)
