"""Reads outlines of tools from SVG or DXF in true millimetres, and extrudes them to solids."""

import io
import math
import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from manifold3d import CrossSection, FillRule, Manifold
from numpy.typing import NDArray

from kitting_drake.common.errors import UserError
from kitting_drake.common.extras import import_extra
from kitting_drake.hkd.importing.repair import NOMINAL_MM
from kitting_drake.hkd.importing.tool_frame import long_direction_deg

OUTLINE_FORMATS = (".svg", ".dxf")
LENGTHS_MM = (20.0, 250.0)
"""The range of lengths of an imported outline."""

_MM_PER_PIXEL = 25.4 / 96
"""CSS, and an SVG without units, has 96 pixels per inch."""
_JOIN_MM = 0.1
"""The largest gap between ends of curves that are joined."""
_FLAT_MM = 0.01
"""The approximate tolerance of the polylines that replace curves."""
_STEP_MM = 0.25
_MOST_STEPS = 400
_MOST_BYTES = 20_000_000
_LEAST_AREA_MM2 = 1.0
_NUMBER_UNIT = re.compile(r"([0-9.eE+-]+)\s*([a-z]*)")
_UNITS = ("", "mm", "cm", "in", "pt", "pc", "px")
_NOT_DRAWN = ("symbol", "mask", "marker", "clipPath", "pattern")
_NOTES = ("DIMENSION", "ARC_DIMENSION", "LARGE_RADIAL_DIMENSION", "LEADER", "MULTILEADER")
"""DXF entities that annotate a drawing, so their lines do not belong to an outline."""

Curve = NDArray[np.float64]
"""The points (n, 2) of a curve, in mm, y up."""


def is_outline(path: Path) -> bool:
    """Whether a file's suffix is that of a drawing."""
    return path.suffix.lower() in OUTLINE_FORMATS


def read_outline(path: Path) -> CrossSection:
    """The area inside a drawing's largest closed curve and outside its other curves, in mm.

    The scale of an SVG follows from its width, height and viewBox, or else is 96 pixels per inch.
    That of a DXF follows from $INSUNITS, or else is in mm. Lines, arcs and open polylines are
    joined where their ends meet.

    Args:
        path: the path of the drawing.

    Raises:
        UserError: the file is missing or not a drawing, a curve is open, or the drawing is not the
            outline of one tool.
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
    read = _svg_curves if path.suffix.lower() == ".svg" else _dxf_curves
    curves = [curve for curve in read(path) if len(curve) > 1 and np.isfinite(curve).all()]
    if not curves:
        raise UserError(f"{path} has no curves: convert text and pictures to paths first")
    return _enclosed(_joined(curves, path), path)


def laid_along_x(
    outline: CrossSection, length_mm: float | None = None, name: str = "the outline"
) -> CrossSection:
    """Rotates an outline so that its length is along x, and scales it on request.

    Args:
        outline: in mm.
        length_mm: the length to scale to; None keeps the scale.
        name: the outline's name in messages.

    Raises:
        UserError: `length_mm` is None and the outline's length is not in `LENGTHS_MM`.
    """
    x_min, y_min, x_max, y_max = outline.bounds()
    nominal = NOMINAL_MM / max(x_max - x_min, y_max - y_min)
    outline = outline.rotate(-long_direction_deg(outline.scale((nominal, nominal))))
    x_min, _, x_max, _ = outline.bounds()
    length = x_max - x_min
    if length_mm is not None:
        return outline.scale((length_mm / length, length_mm / length))
    low, high = LENGTHS_MM
    if not low <= length <= high:
        raise UserError(
            f"{name} is {length:.4g} mm long by its own units; the range is {low:g} to {high:g} "
            "mm: give --length_mm, or set the drawing's units"
        )
    return outline


def extruded(outline: CrossSection, height_mm: float) -> tuple[NDArray, NDArray]:
    """Vertices (n, 3), in mm, and triangles (m, 3) of the upright prism over an outline."""
    mesh = Manifold.extrude(outline, height_mm).to_mesh64()
    vertices = np.asarray(mesh.vert_properties, dtype=float)[:, :3]
    return vertices, np.asarray(mesh.tri_verts, dtype=np.int64)


def _svg_curves(path: Path) -> list[Curve]:
    svgelements = import_extra("svgelements", purpose="SVG", extra="fabrication")
    try:
        root = ElementTree.parse(path).getroot()
        if root.tag.rsplit("}", 1)[-1] != "svg":
            raise ValueError("the root is not an svg element")
        width, height = _settle_size(root)
        _keep_from_drawing(root)
        text = io.StringIO(ElementTree.tostring(root, encoding="unicode"))
        drawing = svgelements.SVG.parse(text, width=width, height=height)
        shapes = [e for e in drawing.elements() if isinstance(e, svgelements.Shape)]
        shapes = [e for e in shapes if e.values.get("visibility") not in ("hidden", "collapse")]
        curves = [
            _MM_PER_PIXEL * np.array(points) * (1, -1)
            for shape in shapes
            # Convert to a path, because svgelements drops rotations of rectangles and ellipses.
            for part in abs(svgelements.Path(shape)).as_subpaths()
            if (points := _sampled(svgelements.Path(part), _MM_PER_PIXEL))
        ]
    except (MemoryError, UserError):
        raise
    except Exception as error:
        # The reader fails in many ways on broken files.
        raise UserError(f"{path} cannot be read as SVG") from error
    return curves


def _settle_size(root: ElementTree.Element) -> tuple[float, float]:
    """Completes the width and height of the root element; returns the viewBox's size in pixels.

    A root that has only one of the two gets the other from the viewBox's aspect ratio. A root that
    has neither has the returned size.
    """
    box = root.get("viewBox", "0 0 1000 1000").replace(",", " ").split()
    sides = {"width": float(box[2]), "height": float(box[3])}
    for name in sides:
        value = root.get(name, "").strip()
        if value == "auto" or value.endswith("%"):
            del root.attrib[name]
    given = [name for name in sides if name in root.attrib]
    for name in given:
        # Normalize lengths, because svgelements reads `200 mm` as pixels.
        root.set(name, "".join(_length(root.attrib[name], name)))
    if len(given) == 1 and "viewBox" in root.attrib:
        (known,) = given
        (other,) = sides.keys() - {known}
        number, unit = _length(root.attrib[known], known)
        root.set(other, f"{float(number) * sides[other] / sides[known]!r}{unit}")
    return sides["width"], sides["height"]


def _length(text: str, name: str) -> tuple[str, str]:
    """The number and the unit (or "") of a length.

    Raises:
        UserError: the text is not a length in a known unit.
    """
    match = _NUMBER_UNIT.fullmatch(text.strip().lower())
    if match is None or match[2] not in _UNITS:
        units = ", ".join(unit for unit in _UNITS if unit)
        raise UserError(f"its {name} is '{text}': give a number and one of {units}")
    return match[1], match[2]


def _keep_from_drawing(root: ElementTree.Element) -> None:
    """Moves elements that are drawn only by reference into the definitions."""
    space = root.tag.rpartition("svg")[0]
    definitions = ElementTree.Element(f"{space}defs")
    for parent in list(root.iter()):
        if parent.tag == f"{space}defs":
            continue
        for child in list(parent):
            if child.tag in [f"{space}{name}" for name in _NOT_DRAWN]:
                parent.remove(child)
                definitions.append(child)
    root.insert(0, definitions)


def _sampled(path: Iterable, mm: float) -> list[tuple[float, float]]:
    """Points of a subpath of svgelements, in its units; one unit is `mm` mm."""
    points: list[tuple[float, float]] = []
    for segment in path:
        if segment.end is None:
            continue
        straight = type(segment).__name__ in ("Move", "Line", "Close")
        steps = 1
        if not straight:
            length = mm * segment.length(error=1e-3)
            steps = min(_MOST_STEPS, max(8, math.ceil(length / _STEP_MM)))
        for share in np.arange(1, steps + 1) / steps:
            point = segment.end if straight else segment.point(float(share))
            points.append((float(point.x), float(point.y)))
    return points


def _dxf_curves(path: Path) -> list[Curve]:
    ezdxf = import_extra(
        "ezdxf", "disassemble", "path", "units", purpose="DXF", extra="fabrication"
    )
    try:
        document = ezdxf.readfile(path)
        units = ezdxf.units.InsertUnits(int(document.header.get("$INSUNITS", 0)))
        mm = 1.0
        if units != ezdxf.units.InsertUnits.Unitless:
            mm = ezdxf.units.conversion_factor(units, ezdxf.units.InsertUnits.Millimeters)
        hidden = {
            layer.dxf.name.lower()
            for layer in document.layers
            if layer.is_off() or layer.is_frozen()
        }

        def is_drawn(entity: Any) -> bool:
            layer = entity.dxf.get("layer", "0").lower()
            seen = layer not in hidden and not entity.dxf.get("invisible", 0)
            return seen and entity.dxftype() not in _NOTES

        whole = filter(is_drawn, document.modelspace())
        curves = []
        for entity in filter(is_drawn, ezdxf.disassemble.recursive_decompose(whole)):
            try:
                curve = ezdxf.path.make_path(entity)
            except TypeError:
                # Not a curve, for instance text.
                continue
            for part in curve.sub_paths():
                points = [(mm * p.x, mm * p.y) for p in part.flattening(_FLAT_MM / mm)]
                curves.append(np.array(points).reshape(-1, 2))
    except MemoryError:
        raise
    except Exception as error:
        raise UserError(f"{path} cannot be read as DXF") from error
    return curves


def _joined(curves: list[Curve], path: Path) -> list[Curve]:
    """Joins curves whose ends meet into closed curves.

    Raises:
        UserError: a curve stays open.
    """
    # Drop the single points that some programs leave behind.
    curves = [curve for curve in curves if np.ptp(curve, axis=0).max() > _JOIN_MM]
    loops = [curve for curve in curves if _is_closed(curve)]
    chains = [curve for curve in curves if not _is_closed(curve)]
    while chains:
        chain = chains.pop()
        while not _is_closed(chain) and chains:
            ends = np.array([(other[0], other[-1]) for other in chains])
            gaps = np.linalg.norm(ends - chain[-1], axis=2)
            index, end = np.unravel_index(int(np.argmin(gaps)), gaps.shape)
            if gaps[index, end] > _JOIN_MM:
                break
            other = chains.pop(int(index))
            chain = np.concatenate([chain, other if end == 0 else other[::-1]])
        if not _is_closed(chain):
            gap = float(np.linalg.norm(chain[-1] - chain[0]))
            raise UserError(
                f"{path} has an open curve with a gap of {gap:.2f} mm: close it, or delete what "
                "does not belong to the outline"
            )
        loops.append(chain)
    return loops


def _is_closed(curve: Curve) -> bool:
    return len(curve) > 2 and bool(np.linalg.norm(curve[-1] - curve[0]) <= _JOIN_MM)


def _enclosed(loops: list[Curve], path: Path) -> CrossSection:
    """The area inside the largest closed curve and outside the others.

    Raises:
        UserError: the largest curve encloses no area or crosses itself, or another is not inside
            it.
    """
    areas = [CrossSection([loop], FillRule.EvenOdd) for loop in loops]
    areas.sort(key=lambda area: -area.area())
    if not areas or areas[0].area() < _LEAST_AREA_MM2:
        raise UserError(f"{path} has no closed curve that encloses an area")
    outer, *holes = areas
    if len(outer.decompose()) > 1:
        raise UserError(f"{path}: its outline crosses itself")
    for hole in holes:
        if (hole - outer).area() > 0.01 * hole.area():
            raise UserError(
                f"{path} has a curve outside the largest one: draw the outline of one tool only"
            )
    # The same curve drawn twice, as fill and stroke, is not a hole.
    for hole in holes:
        if hole.area() < 0.999 * areas[0].area():
            outer -= hole
    return outer.simplify(_FLAT_MM)
