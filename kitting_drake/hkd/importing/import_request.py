"""The request of `hkd import`, and its checks."""

import re
from dataclasses import dataclass
from pathlib import Path

from kitting_drake.common.errors import UserError
from kitting_drake.hkd.importing.fit import HIGHEST_MM, THINNEST_MM, UNITS_MM
from kitting_drake.hkd.importing.materials import DENSITY_RANGE, MATERIALS
from kitting_drake.hkd.importing.outline import is_outline
from kitting_drake.hkd.importing.reading import drawn_curves
from kitting_drake.hkd.importing.reading.closed_curves import FRAMES
from kitting_drake.hkd.importing.reading.mesh_files import IN_MM
from kitting_drake.hkd.tools.tool import (
    LONGEST_MM,
    SHORTEST_MM,
    check_category,
    tool_names,
)


@dataclass(frozen=True)
class ImportRequest:
    """A file to import, and the properties of its tool."""

    mesh: Path
    category: str
    name: str | None = None
    """The tool's name. None: the file's name."""
    length_mm: float | None = None
    """The length in mm to which the tool is scaled. None: the length in the file."""
    unit: str | None = None
    """The unit of the file, a key of `fit.UNITS_MM` or, for outlines, of `drawn_curves.UNITS_MM`.
    None: the unit is taken from the file or found by `fit.true_length`."""
    mass_g: float | None = None
    """The weighed mass in grams. None: the mass is computed from the densities."""
    material: str | None = None
    """The material of the whole tool, a key of `materials.MATERIALS`."""
    density: float | None = None
    """The mean density in kg/m^3. None: the density of the category (see `materials`)."""
    output: Path | None = None
    """The folder of tools to write to. None: `user_tools`."""
    height_mm: float | None = None
    """The height in mm to which an outline is extruded; None for a mesh."""
    frame: str | None = None
    """Whether a rectangle around all other curves of a drawing is the page or the tool: one of
    `closed_curves.FRAMES`. None: it is inferred from the drawing."""
    outline_error_mm: float = 0.0
    """See `Tool.outline_error`."""

    @property
    def given_density(self) -> float | None:
        """The density of the whole tool in kg/m^3, given by `density` or `material`; None if
        neither is."""
        return self.density if self.material is None else MATERIALS[self.material]


def check_request(request: ImportRequest) -> None:
    """Checks all options but the name.

    Raises:
        UserError: an option is out of range or unknown, or contradicts another option or the file.
    """
    check_category(request.category)
    for flag, value, low, high in (
        ("--length_mm", request.length_mm, SHORTEST_MM, LONGEST_MM),
        ("--density", request.density, *DENSITY_RANGE),
        ("--mass_g", request.mass_g, 0.1, 10_000.0),
        ("--height_mm", request.height_mm, THINNEST_MM, HIGHEST_MM),
    ):
        if value is not None and not low <= value <= high:
            raise UserError(f"{flag} {value:g} is out of range: give {low:g} to {high:g}")
    units = drawn_curves.UNITS_MM if is_outline(request.mesh) else UNITS_MM
    for flag, name, names in (
        ("--unit", request.unit, units),
        ("--material", request.material, MATERIALS),
        ("--frame", request.frame, FRAMES),
    ):
        if name is not None and name not in names:
            raise UserError(f"{flag} '{name}' is not known: give one of {', '.join(names)}")
    if request.unit is not None and request.mesh.suffix.lower() in IN_MM:
        raise UserError(
            f"{request.mesh} states its own unit: leave out --unit, or give --length_mm"
        )
    if request.material is not None and request.density is not None:
        raise UserError("--material and --density both give the density: leave out one")
    if is_outline(request.mesh) and request.height_mm is None:
        raise UserError(f"{request.mesh} is an outline: give the tool's height with --height_mm")
    if not is_outline(request.mesh) and request.height_mm is not None:
        raise UserError(
            f"{request.mesh} is a mesh, and --height_mm is only for outlines (SVG, DXF): leave out "
            "this flag"
        )
    if not is_outline(request.mesh) and request.frame is not None:
        raise UserError(
            f"{request.mesh} is a mesh, and --frame is only for outlines (SVG, DXF): leave out "
            "this flag"
        )


def checked_name(request: ImportRequest) -> str:
    """Returns the tool's name: the requested one, or the file's.

    Raises:
        UserError: the name is too long, has other characters than lower-case letters, digits and
            underscores, or belongs to one of the project's own tools.
    """
    if request.name is None:
        name = re.sub(r"[^a-z0-9]+", "_", request.mesh.stem.lower()).strip("_")[:60]
        if not name:
            raise UserError(f"{request.mesh} has no letter or digit in its name: give --name")
    else:
        name = request.name
    if not re.fullmatch(r"[a-z0-9][a-z0-9_]{0,63}", name):
        raise UserError(
            f"--name '{name}' is not valid: give at most 64 lower-case letters, digits and "
            "underscores, beginning with a letter or digit"
        )
    if name in tool_names():
        raise UserError(
            f"'{name}' is the name of one of the project's own tools: give another --name"
        )
    return name
