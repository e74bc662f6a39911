"""Generates the model of a tool from its catalogue entry: meshes, SDFormat and `tool.yaml`.

`Tool` defines the tool frame T. Solids are handled in mm and written in metres.
"""

import dataclasses
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from manifold3d import CrossSection, JoinType, Manifold, OpType

from kitting_drake.common.errors import MachineError
from kitting_drake.common.files import replace_folder
from kitting_drake.hkd.families import hammer, pliers, screwdriver, wrench
from kitting_drake.hkd.generation.catalogue import CatalogueError, GraspEntry, ToolEntry
from kitting_drake.hkd.grasps.grip import Grip, find_grip, jaw_axes
from kitting_drake.hkd.tools import meshes
from kitting_drake.hkd.tools.collision import (
    closed,
    cover,
    furthest,
    projection,
    thinned,
)
from kitting_drake.hkd.tools.mass import Body, mass_properties
from kitting_drake.hkd.tools.sdf import tool_sdf
from kitting_drake.hkd.tools.solids import MATERIALS, Part
from kitting_drake.hkd.tools.stable_pose import stable_poses
from kitting_drake.hkd.tools.symmetry import symmetry_order
from systems.hand_geometry import FINGER_LENGTH, PAD_LENGTH

# The clearance of a kit's cavities. Collision hulls may bridge notches narrower than twice this,
# because cavities bridge them too.
CAVITY_CLEARANCE_MM = 2.0
# Tolerances of the outline: for merging collision hulls, and for thinning their vertices.
MERGE_TOLERANCE_MM = 0.25
VERTEX_TOLERANCE_MM = 0.2
# The tolerance for merging hulls at the gripped faces.
GRIP_TOLERANCE_MM = 0.06
# The largest distance of an annotated grasp from the middle between the gripped faces.
GRIP_CENTRING_MM = 0.2
# An edge is shaded as sharp if the angle between its faces is larger than this.
CREASE_ANGLE_DEG = 35.0
# The lengths of pads and fingers along the tool, with a margin for an inexact grasp.
PAD_LENGTH_MM = round(1e3 * PAD_LENGTH + 0.4, 3)
FINGER_LENGTH_MM = round(1e3 * FINGER_LENGTH + 1.2, 3)

DESIGNS: dict[str, tuple[type, Callable[[Any], list[Part]]]] = {
    "hammer": (hammer.HammerParameters, hammer.build_hammer),
    "pliers": (pliers.PliersParameters, pliers.build_pliers),
    "wrench": (wrench.WrenchParameters, wrench.build_wrench),
    "screwdriver": (screwdriver.ScrewdriverParameters, screwdriver.build_screwdriver),
}


@dataclass
class Report:
    """Measurements of a generated tool; lengths in mm."""

    description: dict[str, Any]
    triangles: int
    collision_hulls: int
    # The largest distances by which the collision outline exceeds the visual outline, and by which
    # it falls short.
    outside_mm: float
    inside_mm: float
    # The lowest point, the highest point and the gripped width of the collision geometry, minus
    # those of the visual geometry.
    bottom_error_mm: float
    top_error_mm: float
    grip_error_mm: float
    # How much the position of a gripped face varies along the pads.
    grip_flatness_mm: float
    # How far any part of the tool between the fingers stands out beyond the gripped faces.
    finger_overhang_mm: float
    # The tilt of the stable pose relative to the design's pose.
    tilt_deg: float


def build_parts(entry: ToolEntry) -> list[Part]:
    """Returns a tool's parts in the design frame in mm, scaled to its length and without
    overlaps."""
    parameters_type, build = DESIGNS[entry.category]
    known = {f.name for f in dataclasses.fields(parameters_type)}
    if unknown := sorted(set(entry.parameters) - known):
        raise CatalogueError(
            f"tool {entry.name}: a tool of the category {entry.category} has no parameter "
            f"{unknown[0]!r}"
        )
    try:
        parts = build(parameters_type(**entry.parameters))
    except (TypeError, ValueError, KeyError) as error:
        raise CatalogueError(f"tool {entry.name}: {error}") from error
    box = Manifold.batch_boolean([part.solid for part in parts], OpType.Add).bounding_box()
    scale = entry.length_mm / max(box[3] - box[0], box[4] - box[1])
    taken, result = Manifold(), []
    for part in parts:
        solid = part.solid.scale((scale, scale, scale))
        result.append(
            Part(part.name, part.material, solid - taken, [scale * h for h in part.hulls])
        )
        taken += solid
    return result


def homogeneous(parts: list[Part]) -> list[Body]:
    """Returns the solids of a tool's parts with their densities, for `mass_properties`."""
    return [(part.solid, MATERIALS[part.material].density) for part in parts]


def rest_rotation(points: np.ndarray, center_of_mass: np.ndarray) -> np.ndarray:
    """Returns R_TD (3, 3), the rotation to the stable pose nearest to the design's pose.

    Args:
        points: points (n, 3) in the design frame D that have the same convex hull as the body.
        center_of_mass: (3,) in D, in the unit of the points.
    """
    poses = stable_poses(points, center_of_mass)
    nearest = max(poses, key=lambda pose: -pose.normal[2])
    return nearest.rotation(forward=np.array([1.0, 0.0, 0.0]))


def generate_tool(entry: ToolEntry, directory: Path) -> Report:
    """Writes a tool's model to `directory` atomically; replaces an older model.

    Raises:
        CatalogueError: the entry does not make a usable tool.
        MachineError: the model cannot be written. After either error the older model is unchanged.
    """
    try:
        directory.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=directory.parent, prefix=".making-") as scratch:
            made = Path(scratch) / entry.name
            made.mkdir()
            report = _write_tool(entry, made)
            replace_folder(directory, made, Path(scratch) / "replaced")
            return report
    except OSError as error:
        raise MachineError(f"cannot write {directory}: {error.strerror}") from error


def _write_tool(entry: ToolEntry, directory: Path) -> Report:
    """Writes the model of one tool into an empty folder; see `generate_tool`."""
    parts = build_parts(entry)
    mass, center, inertia = mass_properties(homogeneous(parts))
    # Merge the hulls in the stable pose, because the outline and the heights in this pose matter.
    R_TD, p_T, whole = _tool_frame(entry, parts, center)
    outline = closed(whole.project(), CAVITY_CLEARANCE_MM)
    hulls = _collision_hulls(parts, R_TD, p_T, outline, entry.grasp)
    box = np.array(whole.bounding_box()).reshape(2, 3)
    grip = _measure_grasp(entry, whole)

    center = R_TD @ center + 1e-3 * p_T
    inertia = R_TD @ inertia @ R_TD.T
    visuals, triangles = _write_visuals(parts, R_TD, p_T, directory)
    collisions = []
    for i, hull in enumerate(hulls):
        collisions.append(f"collision_{i}.obj")
        meshes.write_convex_obj(directory / collisions[-1], hull)
    (directory / f"{entry.name}.sdf").write_text(
        tool_sdf(entry.name, mass, center, inertia, visuals, collisions)
    )

    vertices, faces = meshes.vertices_and_faces(whole)
    symmetry = symmetry_order(1e-3 * vertices[faces])
    description = _description(entry, box, mass, center, symmetry, grip, visuals)
    (directory / "tool.yaml").write_text(yaml.safe_dump(description, sort_keys=False))
    points = np.vstack(hulls)
    solid_hulls = Manifold.batch_boolean([Manifold.hull_points(h) for h in hulls], OpType.Add)
    return Report(
        description,
        triangles,
        len(hulls),
        outside_mm=furthest(projection(hulls), outline),
        inside_mm=furthest(outline, closed(projection(hulls), CAVITY_CLEARANCE_MM)),
        bottom_error_mm=points[:, 2].min() - box[0, 2],
        top_error_mm=points[:, 2].max() - box[1, 2],
        grip_error_mm=_measure_grasp(entry, solid_hulls).width - grip.width,
        grip_flatness_mm=grip.flatness,
        finger_overhang_mm=grip.overhang,
        tilt_deg=float(np.degrees(np.arccos(min(1.0, R_TD[2, 2])))),
    )


def _tool_frame(
    entry: ToolEntry, parts: list[Part], center: np.ndarray
) -> tuple[np.ndarray, np.ndarray, Manifold]:
    """Places a tool in its frame T.

    Args:
        entry: the tool's entry in the catalogue.
        parts: the tool's parts in the design frame D.
        center: (3,) the centre of mass in D, in metres.

    Returns:
        R_TD (3, 3), p_T (3,) in mm, and the union of the parts in T, in mm. A point q of D is at
        R_TD q + p_T.

    Raises:
        CatalogueError: the parts do not touch.
    """
    hulls = [h for part in parts for h in part.hulls]
    R_TD = rest_rotation(np.vstack(hulls), 1e3 * center)
    whole = _moved(Manifold.batch_boolean([p.solid for p in parts], OpType.Add), R_TD, np.zeros(3))
    if sum(body.volume() > 1e-3 for body in whole.decompose()) != 1:
        raise CatalogueError(f"tool {entry.name}: its parts do not touch: change its parameters")
    box = np.array(whole.bounding_box()).reshape(2, 3)
    bottom = min((h @ R_TD.T)[:, 2].min() for h in hulls)
    p_T = -np.array([*box[:, :2].mean(axis=0), bottom])
    return R_TD, p_T, whole.translate(p_T)


def _collision_hulls(
    parts: list[Part], R_TD: np.ndarray, p_T: np.ndarray, outline: CrossSection, grasp: GraspEntry
) -> list[np.ndarray]:
    """Returns the vertices (n, 3) of each collision hull, in T in mm, in a deterministic order."""
    hulls = [h @ R_TD.T + p_T for part in parts for h in part.hulls]
    covering = cover(hulls, outline, _allowed(outline, grasp), MERGE_TOLERANCE_MM)
    return sorted(
        (thinned(h, VERTEX_TOLERANCE_MM) for h in covering),
        key=lambda h: tuple(np.round(h.mean(axis=0), 3)),
    )


def _allowed(outline: CrossSection, grasp: GraspEntry) -> CrossSection:
    """Returns the region that collision hulls may cover: the outline and a margin around it.

    The margin is smaller where the jaws grip.
    """

    def grown(distance: float) -> CrossSection:
        return outline.offset(distance, JoinType.Round, circular_segments=96)

    jaws = CrossSection.square((FINGER_LENGTH_MM + 2.0, 80.0), True)
    jaws = jaws.rotate(grasp.theta_deg).translate((grasp.x_mm, grasp.y_mm))
    return grown(MERGE_TOLERANCE_MM) - (jaws - grown(GRIP_TOLERANCE_MM))


def _moved(solid: Manifold, R: np.ndarray, p: np.ndarray) -> Manifold:
    return solid.transform(np.column_stack([R, p]))


def _write_visuals(
    parts: list[Part], R_TD: np.ndarray, p_T: np.ndarray, directory: Path
) -> tuple[list[tuple[str, str]], int]:
    """Writes one OBJ per material; returns (file, material) pairs and the number of triangles."""
    visuals, triangles = [], 0
    for material in sorted({part.material for part in parts}):
        solids = [part.solid for part in parts if part.material == material]
        solid = _moved(Manifold.batch_boolean(solids, OpType.Add), R_TD, p_T).simplify(0.01)
        visuals.append((f"{material}.obj", material))
        triangles += meshes.write_smooth_obj(directory / visuals[-1][0], solid, CREASE_ANGLE_DEG)
    return visuals, triangles


@dataclass
class _GripReport:
    """Measurements of a grasp; lengths in mm."""

    width: float
    # How much the position of a gripped face varies along the pads.
    flatness: float
    # How far any part of the tool between the fingers stands out beyond the gripped faces.
    overhang: float
    # The height of the tool's top at the grasp.
    top: float


def _measure_grasp(entry: ToolEntry, solid: Manifold) -> _GripReport:
    """Measures the annotated grasp of a tool. The solid is in the tool's frame T, in mm.

    Raises:
        CatalogueError: the jaws cannot hold the tool by this grasp.
    """
    grasp = entry.grasp
    named = f"tool {entry.name}: the grasp at ({grasp.x_mm}, {grasp.y_mm}) mm"
    vertices, faces = meshes.vertices_and_faces(solid)
    triangles = vertices[faces]
    theta = np.radians(grasp.theta_deg)
    along, _ = jaw_axes(theta)

    def grip(offset: float, length: float) -> Grip:
        x, y = (grasp.x_mm, grasp.y_mm) + offset * along
        found = find_grip(triangles, x, y, theta, length)
        if found is None:
            raise CatalogueError(f"{named} has nothing between the pads at ({x:.2f}, {y:.2f}) mm")
        return found

    pad, finger = grip(0.0, PAD_LENGTH_MM), grip(0.0, FINGER_LENGTH_MM)
    slices = [grip(offset, 0.5) for offset in np.linspace(-0.5, 0.5, 7) * (PAD_LENGTH_MM - 0.5)]
    if not 8.0 <= pad.width <= 35.0:
        raise CatalogueError(f"{named} is {pad.width:.1f} mm wide; it must be 8 to 35 mm")
    if abs(pad.middle) > GRIP_CENTRING_MM:
        # A tool that is held off centre is shifted by the closing jaws, and is then placed with
        # this offset.
        raise CatalogueError(
            f"{named} is not centred between the gripped faces: move it by "
            f"{pad.middle:+.2f} mm along the direction in which the jaws close"
        )
    return _GripReport(
        width=pad.width,
        flatness=float(max(np.ptp([s.low for s in slices]), np.ptp([s.high for s in slices]))),
        overhang=max(finger.high - pad.high, pad.low - finger.low),
        top=pad.top,
    )


def _description(
    entry: ToolEntry,
    box: np.ndarray,
    mass: float,
    center: np.ndarray,
    symmetry: int,
    grip: _GripReport,
    visuals: list[tuple[str, str]],
) -> dict[str, Any]:
    """Returns the content of `tool.yaml`, in SI units, in frame T."""

    def metres(value_mm: float) -> float:
        return round(1e-3 * float(value_mm), 6)

    return {
        "name": entry.name,
        "category": entry.category,
        "split": entry.split,
        "length": metres(box[1, 0] - box[0, 0]),
        "width": metres(box[1, 1] - box[0, 1]),
        "height": metres(box[1, 2]),
        "mass": round(float(mass), 6),
        "center_of_mass": [round(float(v), 6) + 0.0 for v in center],
        "symmetry": symmetry,
        "grasp": {
            "x": metres(entry.grasp.x_mm),
            "y": metres(entry.grasp.y_mm),
            "theta": round(float(np.radians(entry.grasp.theta_deg)), 6),
            "width": metres(grip.width),
            "surface_height": metres(grip.top),
        },
        "visual_meshes": [name for name, _ in visuals],
    }
