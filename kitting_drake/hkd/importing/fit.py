"""Scales an imported tool to a length at which the hand can hold it and a kit can take it."""

from pathlib import Path

from manifold3d import Manifold

from kitting_drake.common.errors import UserError
from kitting_drake.hkd.grasps.proposals import WIDEST, GraspProposal, propose_grasps
from kitting_drake.hkd.importing.materials import bodies_of
from kitting_drake.hkd.importing.tool_frame import centred, size
from kitting_drake.hkd.kits.layout import layout_kit
from kitting_drake.hkd.kits.parameters import KitParameters
from kitting_drake.hkd.tools import meshes
from kitting_drake.hkd.tools.mass import mass_properties
from kitting_drake.hkd.tools.tool import Tool
from systems.grasp import Grasp

SCALED_LENGTHS_MM = (180.0, 170.0, 160.0, 150.0)
"""Lengths to try; the tool gets the first at which it can be held and kitted."""
KEPT_LENGTHS_MM = (150.0, 200.0)
"""Tools in this range of lengths, that of the dataset, are not scaled."""
POSSIBLE_LENGTHS_MM = (50.0, 600.0)
"""The range of lengths of hand tools, for guessing a file's unit."""
THINNEST_MM, HIGHEST_MM = 4.0, 45.0

# The number of other grasps to keep, and how much more they may cost than the best.
_OTHERS, _MUCH_WORSE = 3, 2.0

_UNITS = {"mm": 1.0, "m": 1000.0, "cm": 10.0, "inches": 25.4}
_CREASE_ANGLE_DEG = 35.0
# Decimation tolerances to try until a mesh has few enough triangles.
_DECIMATION_TOLERANCES_MM, _ENOUGH_TRIANGLES = (0.01, 0.02, 0.04), 10_000


def guess_unit(length: float) -> str | None:
    """The unit in which this length is that of a hand tool: mm, m, cm or inches; None if none fits.

    Inches and centimetres overlap: a length of at most 12 is taken as inches, above as centimetres.
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


def material_of(category: str) -> str:
    """The material to draw an imported tool with: a key of `hkd.tools.solids.MATERIALS`."""
    return "polished_steel" if category == "wrench" else "steel"


def lengths_to_try(length: float, wanted_mm: float | None) -> tuple[list[float], str]:
    """The lengths (mm) to try in order, and a phrase for the user that explains them."""
    unit = guess_unit(length)
    if unit is None:
        assumed, real = f"unit unknown ({length:.4g} long)", 0.0
    else:
        real = length * _UNITS[unit]
        assumed = f"taken to be in {unit}: {real:.0f} mm long"
    if wanted_mm is not None:
        return [wanted_mm], f"{assumed}, scaled as requested"
    if KEPT_LENGTHS_MM[0] <= real <= KEPT_LENGTHS_MM[1]:
        return [real], f"{assumed}, kept"
    return list(SCALED_LENGTHS_MM), f"{assumed}, scaled"


def fit(
    category: str,
    name: str,
    solid: Manifold,
    lengths: list[float],
    notes: list[str],
    directory: Path,
    density: float | None = None,
) -> tuple[Tool, Manifold]:
    """Makes a tool at the first of `lengths` (mm) that works, and writes its visual mesh.

    Raises:
        UserError: no length works; the message is that of the first one.
    """
    refusal: UserError | None = None
    for length in lengths:
        factor = length / size(solid)[0]
        scaled = centred(_decimated(solid.scale((factor, factor, factor))))
        try:
            _check_size(scaled)
            tool = _tool(category, name, scaled, directory, density)
            layout_kit([tool], KitParameters())
        except UserError as error:
            refusal = refusal or error
            continue
        if refusal is not None:
            notes.append(f"made {1e3 * tool.length:.0f} mm long, because {refusal}")
        return tool, scaled
    assert refusal is not None
    raise refusal


def _decimated(solid: Manifold) -> Manifold:
    """Removes triangles that hardly show, and coarsens a very fine mesh."""
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
            f"at a length of {length:.0f} mm it is {height:.1f} mm thick (the hand needs "
            f"at least {THINNEST_MM:.0f} mm)"
        )
    if height > HIGHEST_MM:
        raise UserError(
            f"at a length of {length:.0f} mm it is {height:.0f} mm high at rest (a kit has room "
            f"for {HIGHEST_MM:.0f} mm)"
        )


def _tool(
    category: str, name: str, solid: Manifold, directory: Path, density: float | None
) -> Tool:
    """Writes the visual mesh of a solid and finds its best grasp.

    Raises:
        UserError: the hand cannot hold it.
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
            f"at a length of {1e3 * length:.0f} mm the hand cannot hold it from above (the jaws "
            f"hold at most {1e3 * WIDEST:.0f} mm)"
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
    """The grasps to try after the first of `propose_grasps`, best first.

    The nearest to the centre of mass is always among them, for a tool that turns between the pads.
    """
    usable = [item for item in proposals[1:] if item.cost < proposals[0].cost + _MUCH_WORSE]
    chosen = usable[:_OTHERS]
    nearest = min(usable, key=lambda item: item.offset, default=None)
    if nearest is not None and nearest not in chosen:
        chosen[-1] = nearest
    return tuple(item.grasp for item in chosen)


def grasp_record(grasp: Grasp) -> dict[str, float]:
    """A grasp as in `tool.yaml`."""
    return {key: round(float(value), 6) for key, value in vars(grasp).items()}
