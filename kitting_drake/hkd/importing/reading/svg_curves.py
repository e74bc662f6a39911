"""Reads the curves of SVG files."""

import io
import math
import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from kitting_drake.common.errors import UserError
from kitting_drake.common.extras import import_extra
from kitting_drake.hkd.importing.reading.closed_curves import PAPERS_MM
from kitting_drake.hkd.importing.reading.drawn_curves import Curve, DrawnCurves

_RESOLUTIONS = (72, 90, 96, 150, 300)
_STEP_MM = 0.25
_MOST_STEPS = 400
_NUMBER_UNIT = re.compile(r"([0-9.eE+-]+)\s*([a-z]*)")
_UNITS = ("", "mm", "cm", "in", "pt", "pc", "px")
_NOT_DRAWN = ("symbol", "mask", "marker", "clipPath", "pattern")


def svg_curves(path: Path, unit_mm: float | None = None) -> DrawnCurves:
    """Reads the visible curves of an SVG.

    The scale follows from width, height and viewBox. If they have no units, a pixel is

    - 1/72 inch in files of Adobe Illustrator;
    - 1/90 inch in files of Inkscape before 0.92, and 1/96 inch in later ones;
    - else the unit that makes the page a standard sheet of paper, if there is one;
    - else 1/96 inch.

    Args:
        path: the drawing.
        unit_mm: the length in mm of a unit of the drawing; None takes the unit from the file.

    Raises:
        UserError: the file is broken, or its scale is ambiguous.
    """
    svgelements = import_extra("svgelements", purpose="SVG", extra="fabrication")
    try:
        text = path.read_bytes()
        root = ElementTree.fromstring(text)
        if root.tag.rsplit("}", 1)[-1] != "svg":
            raise ValueError("the root is not an svg element")
        _read_style(root)
        mm, measured = _scale(root, text, unit_mm)
        width, height = _settle_size(root)
        _keep_from_drawing(root)
        stream = io.StringIO(ElementTree.tostring(root, encoding="unicode"))
        drawing = svgelements.SVG.parse(stream, width=width, height=height)
        shapes = [e for e in drawing.elements() if isinstance(e, svgelements.Shape)]
        shapes = [e for e in shapes if e.values.get("visibility") not in ("hidden", "collapse")]
        # Leave out invisible shapes. If all are invisible, keep them: some programs write neither
        # fill nor line.
        seen = [e for e in shapes if _is_painted(e.fill) or _is_painted(e.stroke)]
        seen = [e for e in seen if str(e.values.get("opacity", 1)).strip() not in ("0", "0%")]
        curves = [
            Curve(mm * np.array(points) * (1, -1), *_filling(shape, number))
            for number, shape in enumerate(seen or shapes)
            # Convert to a path, because svgelements drops rotations of rectangles and ellipses.
            for part in abs(svgelements.Path(shape)).as_subpaths()
            if (points := _sampled(svgelements.Path(part), mm))
        ]
        page = (mm * float(drawing.width), mm * float(drawing.height))
    except (MemoryError, UserError):
        raise
    except Exception as error:
        # The reader raises many types of errors on broken files.
        raise UserError(f"{path} cannot be read as SVG: export it again") from error
    notes = []
    if any(e.get(name) for e in root.iter() for name in ("clip-path", "mask")):
        notes.append("clipping and masks are ignored: curves count as a whole")
    return DrawnCurves(curves, measured, page, notes)


def _filling(shape: Any, number: int) -> tuple[bool, int | None]:
    """Returns (True, `number`) if a shape is filled, and (False, None) if it is not."""
    filled = _is_painted(shape.fill)
    return filled, number if filled else None


def _is_painted(colour: Any) -> bool:
    return colour is not None and colour.value is not None and colour.opacity != 0


def _read_style(root: ElementTree.Element) -> None:
    """Copies the width and height in the root element's style to its attributes, if missing."""
    for name in ("width", "height"):
        found = re.search(rf"(?:^|;)\s*{name}\s*:\s*([^;]+)", root.get("style", ""))
        if found and name not in root.attrib:
            root.set(name, found[1])


def _scale(root: ElementTree.Element, text: bytes, unit_mm: float | None) -> tuple[float, str]:
    """Returns the length in mm of a pixel, and a phrase that says how it is known.

    Raises:
        UserError: the scale is unknown or ambiguous.
    """
    if unit_mm is not None:
        # Remove the width and height, so that a pixel is one unit of the drawing.
        for name in ("width", "height"):
            root.attrib.pop(name, None)
        return unit_mm, f"by units of {unit_mm:g} mm as requested"
    given = [root.get(name, "").strip() for name in ("width", "height")]
    given = [value for value in given if value not in ("", "auto") and not value.endswith("%")]
    units = {_length(value, "width")[1] for value in given} - {"", "px"}
    writer, dpi = _writer(root, text)
    if units and (dpi != 90 or "viewBox" in root.attrib):
        return 25.4 / 96, "by its width and height"
    box = root.get("viewBox", "").replace(",", " ").split()
    sides = sorted(map(float, box[2:])) if len(box) == 4 else [0.0, 0.0]
    if len(given) == 2 and not units:
        sides = sorted(float(_length(value, "width")[0]) for value in given)
    paper, paper_mm = _paper(sides)
    if writer is not None:
        if paper and abs(25.4 / dpi / paper_mm - 1) > 1e-6:
            raise UserError(
                f"the page's longer side may be {25.4 / dpi * sides[1]:.0f} mm, in the pixels of "
                f"{writer} (1/{dpi} inch), or {paper_mm * sides[1]:.0f} mm, if the page is "
                f"{paper}: give --length_mm, or set width and height in mm"
            )
        return 25.4 / dpi, f"by pixels of 1/{dpi} inch, as {writer} writes them"
    if paper:
        return paper_mm, f"by its page, which is {paper}"
    if given:
        return 25.4 / 96, "by pixels of 1/96 inch, because it states no unit"
    readings = ", ".join(
        f"{mm * sides[1]:.0f} mm if a unit is {name}"
        for name, mm in (("1 mm", 1.0), ("1/72 inch", 25.4 / 72), ("1/96 inch", 25.4 / 96))
    )
    size = f" (its page is {sides[1]:g} units long: {readings})" if sides[1] else ""
    raise UserError(
        f"the drawing does not state its width and height{size}: set them, or give --unit or "
        "--length_mm"
    )


def _paper(sides: list[float]) -> tuple[str, float]:
    """Finds the unit in which a page has the size of a standard sheet of paper.

    Args:
        sides: the page's sides in units, the shorter first.

    Returns:
        A phrase that names the sheet and the unit, and the unit's length in mm. If no sheet fits,
        "" and 1.
    """
    for paper, short, long in PAPERS_MM:
        for unit, mm in (("mm", 1.0), *((f"1/{n} inch", 25.4 / n) for n in _RESOLUTIONS)):
            if abs(mm * sides[0] - short) < 0.6 and abs(mm * sides[1] - long) < 0.6:
                return f"{paper} in units of {unit}", mm
    return "", 1.0


def _writer(root: ElementTree.Element, text: bytes) -> tuple[str | None, int]:
    """Returns the program that wrote an SVG, or None if unknown, and the SVG's pixels per inch."""
    head = text[:4000]
    layers = [e.get("id", "") for e in root.iter() if e.get("data-name") or e is root]
    illustrator = b"Adobe Illustrator" in head or b"ns.adobe.com/AdobeIllustrator" in head
    if illustrator or any(re.fullmatch(r"(Layer|Ebene|Calque|Capa)_1", name) for name in layers):
        return "Adobe Illustrator", 72
    for name, value in root.attrib.items():
        if name.endswith("/namespaces/inkscape}version"):
            version = re.match(r"(\d+)\.(\d+)", value)
            if version:
                old = (int(version[1]), int(version[2])) < (0, 92)
                return f"Inkscape {version[0]}", 90 if old else 96
    return None, 96


def _settle_size(root: ElementTree.Element) -> tuple[float, float]:
    """Completes the width and height of the root element.

    If only one of the two is given, the other follows from the viewBox's aspect ratio. If neither
    is given, nothing is added.

    Returns:
        The width and height of the viewBox in pixels.
    """
    box = root.get("viewBox", "0 0 1000 1000").replace(",", " ").split()
    sides = {"width": float(box[2]), "height": float(box[3])}
    for name in sides:
        value = root.get(name, "").strip()
        if value == "auto" or value.endswith("%"):
            del root.attrib[name]
    given = [name for name in sides if name in root.attrib]
    for name in given:
        # Normalize lengths, because svgelements reads `200 mm` as 200 pixels.
        root.set(name, "".join(_length(root.attrib[name], name)))
    if len(given) == 2 and "viewBox" in root.attrib:
        _match_rounded_box(root, [float(number) for number in box])
    if len(given) == 1 and "viewBox" in root.attrib:
        (known,) = given
        (other,) = sides.keys() - {known}
        number, unit = _length(root.attrib[known], known)
        root.set(other, f"{float(number) * sides[other] / sides[known]!r}{unit}")
    return sides["width"], sides["height"]


def _match_rounded_box(root: ElementTree.Element, box: list[float]) -> None:
    """Restores the shorter side of a viewBox that was rounded to whole numbers.

    Otherwise the rounding would change the drawing's scale.
    """
    lengths = [_length(root.attrib[name], name) for name in ("width", "height")]
    sides = [float(number) for number, _ in lengths]
    if lengths[0][1] != lengths[1][1] or any(n != round(n) for n in box) or min(sides) <= 0:
        return
    long = int(box[3] > box[2])
    exact = box[2 + long] * sides[1 - long] / sides[long]
    if abs(exact - box[3 - long]) <= 1:
        box[3 - long] = exact
        root.set("viewBox", " ".join(map(repr, box)))


def _length(text: str, name: str) -> tuple[str, str]:
    """Splits a length into its number and its unit, which may be "".

    Raises:
        UserError: the text is not a length in a known unit.
    """
    match = _NUMBER_UNIT.fullmatch(text.strip().lower())
    if match is None or match[2] not in _UNITS:
        units = ", ".join(unit for unit in _UNITS if unit)
        raise UserError(f"its {name} is '{text}': give a number, and one of the units {units}")
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
    """Returns points of a svgelements subpath, in its units; one unit is `mm` mm."""
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
