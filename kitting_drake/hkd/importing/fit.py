"""Finds the true length of an imported tool, and how the hand holds it."""

from pathlib import Path

from manifold3d import Manifold

from kitting_drake.common.errors import UserError
from kitting_drake.hkd.grasps.holds import WIDEST
from kitting_drake.hkd.grasps.proposals import GraspProposal, propose_grasps
from kitting_drake.hkd.importing.materials import bodies_of
from kitting_drake.hkd.importing.tool_frame import centred, size
from kitting_drake.hkd.kits.layout import layout_kit
from kitting_drake.hkd.kits.parameters import KitParameters
from kitting_drake.hkd.tools import meshes
from kitting_drake.hkd.tools.mass import mass_properties
from kitting_drake.hkd.tools.tool import LONGEST_MM, SHORTEST_MM, Tool
from systems.grasp import Grasp

THINNEST_MM, HIGHEST_MM = 4.0, 45.0
"""The least and the largest height of a tool at rest, in mm."""

# The number of other grasps to keep. Grasps that cost at least `_MUCH_WORSE` more than the best
# grasp are left out.
_OTHERS, _MUCH_WORSE = 3, 2.0

UNITS_MM = {"mm": 1.0, "cm": 10.0, "m": 1000.0, "inches": 25.4}
"""The length in mm of each unit that a mesh may use."""
_CREASE_ANGLE_DEG = 35.0
# Decimation tolerances, tried in turn until the mesh has at most `_ENOUGH_TRIANGLES`.
_DECIMATION_TOLERANCES_MM, _ENOUGH_TRIANGLES = (0.01, 0.02, 0.04), 10_000


def material_of(category: str) -> str:
    """Returns the material with which an imported tool is drawn, a key of
    `hkd.tools.solids.MATERIALS`."""
    return "polished_steel" if category == "wrench" else "steel"


def true_length(
    length: float, height: float, unit: str | None, wanted_mm: float | None
) -> tuple[float, str]:
    """Returns the length of a tool in mm, and a phrase for the user that explains it.

    Many meshes do not state a unit. It is then inferred: it must be the only unit in which the
    tool's length and height are permitted.

    Args:
        length: the length of the tool at rest, in the unit of its file.
        height: the height of the tool at rest, in the unit of its file.
        unit: a key of `UNITS_MM` that the user or the file gives; None if unknown.
        wanted_mm: the length in mm to scale to; None keeps the length in the file.

    Raises:
        UserError: several units are possible, or none, or the tool is too short or too long.
    """
    if wanted_mm is not None:
        return wanted_mm, f"scaled to {wanted_mm:g} mm as requested ({length:.4g} in the file)"
    if unit is not None:
        real = length * UNITS_MM[unit]
        if not SHORTEST_MM <= real <= LONGEST_MM:
            raise UserError(
                f"the tool is {real:.4g} mm long ({length:.4g} {unit}), but tools must be "
                f"{SHORTEST_MM:g} to {LONGEST_MM:g} mm long: give another --unit, or --length_mm "
                "to scale it"
            )
        return real, f"in {unit}: {real:.1f} mm long"
    lengths = {name: length * mm for name, mm in UNITS_MM.items()}
    units = [name for name, real in lengths.items() if SHORTEST_MM <= real <= LONGEST_MM]
    # Drop the units in which the tool is too thin or too high, unless this would drop all units.
    units = [u for u in units if THINNEST_MM <= height * UNITS_MM[u] <= HIGHEST_MM] or units
    if len(units) == 1:
        return lengths[units[0]], f"taken to be in {units[0]}: {lengths[units[0]]:.1f} mm long"
    if not units:
        readings = ", ".join(f"{real:.4g} mm long in {name}" for name, real in lengths.items())
        raise UserError(
            f"the tool would be {readings}, but must be {SHORTEST_MM:g} to {LONGEST_MM:g} mm long: "
            "give --length_mm"
        )
    readings = " or ".join(f"{lengths[name]:.0f} mm long (in {name})" for name in units)
    raise UserError(f"the tool may be {readings}: give --unit, or --length_mm")


def fit(
    category: str,
    name: str,
    solid: Manifold,
    length: float,
    directory: Path,
    density: float | None = None,
) -> tuple[Tool, Manifold]:
    """Scales a solid to the length of its tool, finds the grasps, and writes the visual mesh.

    Args:
        category: the tool's category.
        name: the tool's name.
        solid: the solid at rest with its length along x, in any unit.
        length: the tool's length in mm.
        directory: the folder for the visual mesh.
        density: the density of the whole tool in kg/m^3; by default that of the category.

    Returns:
        The tool, whose mass is still 0, and its solid in mm in the tool frame T.

    Raises:
        UserError: the hand cannot hold the tool, or a kit has no room for it.
    """
    factor = length / size(solid)[0]
    scaled = centred(_decimated(solid.scale((factor, factor, factor))))
    _check_size(scaled)
    tool = _tool(category, name, scaled, directory, density)
    layout_kit([tool], KitParameters())
    return tool, scaled


def _decimated(solid: Manifold) -> Manifold:
    """Removes triangles that make little visible difference, and coarsens a very fine mesh."""
    simple = solid
    for tolerance in _DECIMATION_TOLERANCES_MM:
        simple = solid.simplify(tolerance)
        if simple.num_tri() <= _ENOUGH_TRIANGLES:
            break
    return simple


def _check_size(solid: Manifold) -> None:
    length, _, height = size(solid)
    if height < THINNEST_MM:
        raise UserError(
            f"at a length of {length:.0f} mm the tool is {height:.1f} mm thick, but the hand needs "
            f"at least {THINNEST_MM:.0f} mm: check --unit and --length_mm"
        )
    if height > HIGHEST_MM:
        raise UserError(
            f"at a length of {length:.0f} mm the tool is {height:.0f} mm high at rest, but a kit "
            f"has room for at most {HIGHEST_MM:.0f} mm: check --unit and --length_mm"
        )


def _tool(
    category: str, name: str, solid: Manifold, directory: Path, density: float | None
) -> Tool:
    """Makes a tool, with grasps, from a solid. Writes its visual mesh.

    Raises:
        UserError: the hand cannot hold the tool.
    """
    length, width, height = (round(1e-3 * float(extent), 6) for extent in size(solid))
    visual = directory / f"{material_of(category)}.obj"
    meshes.write_smooth_obj(visual, solid, _CREASE_ANGLE_DEG)
    vertices, faces = meshes.vertices_and_faces(solid)
    triangles = 1e-3 * vertices[faces]
    _, com, _ = mass_properties(bodies_of(solid, category, density))
    proposals = propose_grasps(triangles, com)
    if not proposals:
        raise UserError(
            f"at a length of {1e3 * length:.0f} mm the hand cannot hold the tool from above (the "
            f"jaws open to at most {1e3 * WIDEST:.0f} mm): check --unit and --length_mm"
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
        other_grasps=other_grasps(proposals),
    )


def other_grasps(proposals: list[GraspProposal]) -> tuple[Grasp, ...]:
    """Selects the grasps to try after the first of `propose_grasps`, best first.

    Grasps that cost much more than the first are left out. Of the others, the one nearest to the
    centre of mass is always selected: a tool held there does not turn between the pads.
    """
    usable = [item for item in proposals[1:] if item.cost < proposals[0].cost + _MUCH_WORSE]
    chosen = usable[:_OTHERS]
    nearest = min(usable, key=lambda item: item.offset, default=None)
    if nearest is not None and nearest not in chosen:
        chosen[-1] = nearest
    return tuple(item.grasp for item in chosen)


def grasp_record(grasp: Grasp) -> dict[str, float]:
    """Returns a grasp as it is written to `tool.yaml`."""
    return {key: round(float(value), 6) for key, value in vars(grasp).items()}
