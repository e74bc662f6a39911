"""Reads outlines of tools from SVG or DXF, in mm, and extrudes them to solids."""

import dataclasses
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from manifold3d import CrossSection, Manifold
from numpy.typing import NDArray

from kitting_drake.common.errors import UserError
from kitting_drake.hkd.importing.reading.closed_curves import enclosed
from kitting_drake.hkd.importing.reading.dxf_curves import dxf_curves
from kitting_drake.hkd.importing.reading.svg_curves import svg_curves
from kitting_drake.hkd.importing.repair import NOMINAL_MM
from kitting_drake.hkd.importing.tool_frame import long_direction_deg
from kitting_drake.hkd.tools.tool import LONGEST_MM, SHORTEST_MM

OUTLINE_FORMATS = (".svg", ".dxf")
_MOST_BYTES = 20_000_000


@dataclass(frozen=True)
class Drawing:
    """The outline of a tool, as drawn."""

    outline: CrossSection
    """The outline in mm."""
    measured: str
    """A phrase for the user that says what gives the scale, such as `by its width and height`."""
    notes: list[str]
    """Phrases for the user on curves that were left out or closed."""


def is_outline(path: Path) -> bool:
    """Whether a file's suffix is that of a drawing."""
    return path.suffix.lower() in OUTLINE_FORMATS


def read_drawing(path: Path, unit_mm: float | None = None, frame: str | None = None) -> Drawing:
    """Reads the outline in a drawing: the region inside its largest closed curve, less the holes.

    A page or frame around the outline is left out, and curves that are drawn twice count once.
    Lines, arcs and open polylines are joined where their ends meet.

    Args:
        path: the path of the drawing.
        unit_mm: the length in mm of a unit of the drawing; None takes the unit from the file (see
            `svg_curves` and `dxf_curves`).
        frame: whether a rectangle around all other curves is the `page` or the `tool`. None: it is
            inferred from the drawing.

    Raises:
        FrameError: it cannot be inferred whether a rectangle is the page or the tool.
        UserError: the file is missing or not a drawing, its size is unknown, a curve is open, or
            the drawing is not the outline of one tool.
    """
    try:
        size = path.stat().st_size
    except (OSError, ValueError) as error:
        raise UserError(f"there is no file {path}: give a drawing (SVG, DXF)") from error
    if size > _MOST_BYTES:
        raise UserError(
            f"{path} has {size / 1e6:.0f} MB, more than the limit of {_MOST_BYTES / 1e6:.0f} MB: "
            "simplify the drawing first"
        )
    read = svg_curves if path.suffix.lower() == ".svg" else dxf_curves
    drawn = read(path, unit_mm)
    good = [c for c in drawn.curves if len(c.points) > 1 and np.isfinite(c.points).all()]
    if not good:
        raise UserError(f"{path} has no curves: convert text and pictures to paths first")
    outline, notes = enclosed(dataclasses.replace(drawn, curves=good), path, frame)
    return Drawing(outline, drawn.measured, [*drawn.notes, *notes])


def laid_along_x(
    outline: CrossSection, length_mm: float | None = None, name: str = "the outline"
) -> CrossSection:
    """Rotates an outline so that its length is along x, and scales it on request.

    Args:
        outline: the outline, in mm.
        length_mm: the length to scale to; None keeps the scale.
        name: the outline's name in messages.

    Raises:
        UserError: `length_mm` is None and the outline is too short or too long for a tool.
    """
    x_min, y_min, x_max, y_max = outline.bounds()
    nominal = NOMINAL_MM / max(x_max - x_min, y_max - y_min)
    outline = outline.rotate(-long_direction_deg(outline.scale((nominal, nominal))))
    x_min, _, x_max, _ = outline.bounds()
    length = x_max - x_min
    if length_mm is not None:
        return outline.scale((length_mm / length, length_mm / length))
    if not SHORTEST_MM <= length <= LONGEST_MM:
        raise UserError(
            f"{name} is {length:.4g} mm long by its own units; the range is {SHORTEST_MM:g} to "
            f"{LONGEST_MM:g} mm: give --unit or --length_mm, or set the drawing's units"
        )
    return outline


def extruded(outline: CrossSection, height_mm: float) -> tuple[NDArray, NDArray]:
    """Returns the vertices (n, 3) in mm and triangles (m, 3) of the upright prism over an
    outline."""
    mesh = Manifold.extrude(outline, height_mm).to_mesh64()
    vertices = np.asarray(mesh.vert_properties, dtype=float)[:, :3]
    return vertices, np.asarray(mesh.tri_verts, dtype=np.int64)
