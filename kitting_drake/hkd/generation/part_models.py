"""Makes the models of simple parts by name (`hkd.families.parts`), and loads tools of all kinds."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from manifold3d import Manifold, OpType

from kitting_drake.common.cached_folder import cached_folder
from kitting_drake.common.errors import UserError
from kitting_drake.common.paths import cache_directory
from kitting_drake.hkd.families.parts import PartDesign, PartError
from kitting_drake.hkd.generation.part_kinds import PART_KINDS, design_part
from kitting_drake.hkd.tools import meshes
from kitting_drake.hkd.tools.mass import mass_properties
from kitting_drake.hkd.tools.sdf import tool_sdf
from kitting_drake.hkd.tools.solids import MATERIALS
from kitting_drake.hkd.tools.tool import Tool, load_tool, tool_names, user_tool_names

_MODULUS = 2e7
"""The hydroelastic modulus in Pa. The pads press with 30 N on a few square millimetres of a small
part, and would sink into a softer part by millimetres."""
_FORMAT_VERSION = "3"
"""The version of the files in the cache. Increase it when the same name gives a different model."""
_CREASE_ANGLE_DEG = 35.0
_NAME = re.compile(r"([a-z]+)(?:_(\d+(?:\.\d+)?(?:x\d+(?:\.\d+)?)*))?")


def load_named(name: str, base: Path | None = None) -> Tool:
    """Loads a tool by its name or folder (`load_tool`), or makes a part by its name.

    A part's name is its kind (`PART_KINDS`), or its kind and dimensions in mm, such as
    `ring_40x20x10`. If a tool of the project or the user has the same name, the tool is loaded.

    Raises:
        UserError: there is neither a tool nor a part of this name, the tool's files are broken, or
            the dimensions are impossible.
    """
    kind = _parsed(name)
    if kind is None or name in tool_names() or name in user_tool_names():
        return load_tool(name, base)
    return make_part(*kind)


def is_part_kind(name: str) -> bool:
    """Whether a name is that of a kind of part, without dimensions, and not that of a tool."""
    return name in PART_KINDS and name not in tool_names() and name not in user_tool_names()


def sized_part(kind: str, length: float, shares: tuple[float, float]) -> Tool:
    """Makes a part of a given length, which is rounded to 0.1 mm.

    Args:
        kind: a key of `PART_KINDS`.
        length: the length in metres. If the kind does not exist in this length, the nearest
            possible length is used.
        shares: two numbers from 0 to 1 that vary the part's proportions.

    Raises:
        UserError: the dimensions do not make a part that the hand can hold.
    """
    known = PART_KINDS[kind]
    length_mm = min(max(1e3 * length, known.shortest), known.longest)
    return make_part(kind, tuple(round(v, 1) for v in known.scaled(length_mm, *shares)))


def make_part(kind: str, dimensions: tuple[float, ...]) -> Tool:
    """Returns the tool of a part from the cache; makes it if it is missing.

    Args:
        kind: a key of `PART_KINDS`.
        dimensions: the dimensions in mm; see `PartKind.dimensions`.

    Raises:
        UserError: the dimensions do not make a part that the hand can hold.
    """
    name = f"{kind}_{'x'.join(f'{value:g}' for value in dimensions)}"
    try:
        design = design_part(kind, dimensions)
    except PartError as error:
        raise UserError(f"there is no part '{name}': {error}") from error
    visuals = [f"{material}.obj" for material in _materials(design)]
    folder = cached_folder(
        cache_directory() / "parts" / f"{name}-{_FORMAT_VERSION}",
        [*visuals, f"{name}.sdf", "tool.yaml"],
        lambda scratch: _write(name, kind, design, scratch),
    )
    return load_tool(str(folder))


def _parsed(name: str) -> tuple[str, tuple[float, ...]] | None:
    """Splits a part's name into kind and dimensions in mm; returns None if it is not a part's
    name."""
    match = _NAME.fullmatch(name)
    if match is None or match[1] not in PART_KINDS:
        return None
    if match[2] is None:
        return match[1], PART_KINDS[match[1]].default
    return match[1], tuple(float(value) for value in match[2].split("x"))


def _materials(design: PartDesign) -> list[str]:
    return sorted({part.material for part in design.parts})


def _write(name: str, kind: str, design: PartDesign, directory: Path) -> None:
    """Writes the model of a part into an empty folder."""
    solids, taken = [], Manifold()
    for part in design.parts:
        solids.append((part, part.solid - taken))
        taken += part.solid
    box = np.array(taken.bounding_box()).reshape(2, 3)
    origin = -np.array([*box[:, :2].mean(axis=0), box[0, 2]])
    mass, center, inertia = mass_properties(
        [(solid, MATERIALS[part.material].density) for part, solid in solids]
    )
    visuals = []
    for material in _materials(design):
        own = [solid for part, solid in solids if part.material == material]
        whole = Manifold.batch_boolean(own, OpType.Add).translate(origin)
        visuals.append((f"{material}.obj", material))
        meshes.write_smooth_obj(directory / visuals[-1][0], whole, _CREASE_ANGLE_DEG)
    collisions = []
    for index, hull in enumerate(hull for part in design.parts for hull in part.hulls):
        collisions.append(f"collision_{index}.obj")
        meshes.write_convex_obj(directory / collisions[-1], hull + origin)
    center = center + 1e-3 * origin
    (directory / f"{name}.sdf").write_text(
        tool_sdf(name, mass, center, inertia, visuals, collisions, _MODULUS)
    )
    record = _record(name, kind, design, box, origin, mass)
    (directory / "tool.yaml").write_text(yaml.safe_dump(record, sort_keys=False))


def _record(
    name: str,
    kind: str,
    design: PartDesign,
    box: np.ndarray,
    origin: np.ndarray,
    mass: float,
) -> dict[str, Any]:
    """Returns the content of `tool.yaml`, in SI units, in frame T."""

    def metres(value_mm: float) -> float:
        return round(1e-3 * float(value_mm), 6)

    grasp, size = design.grasp, box[1] - box[0]
    return {
        "name": name,
        "category": kind,
        "split": "user",
        "length": metres(size[0]),
        "width": metres(size[1]),
        "height": metres(size[2]),
        "mass": round(float(mass), 6),
        "symmetry": design.symmetry,
        "grasp": {
            "x": metres(grasp.x_mm + origin[0]),
            "y": metres(grasp.y_mm + origin[1]),
            "theta": round(float(np.radians(grasp.theta_deg)), 6),
            "width": metres(grasp.width_mm),
            "surface_height": metres(grasp.top_mm),
        },
        "visual_meshes": [f"{material}.obj" for material in _materials(design)],
    }
