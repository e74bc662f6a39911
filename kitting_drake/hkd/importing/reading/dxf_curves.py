"""Reads the curves of DXF files."""

import re
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from kitting_drake.common.errors import UserError
from kitting_drake.common.extras import import_extra
from kitting_drake.hkd.importing.reading.drawn_curves import FLAT_MM, UNITS_MM, Curve, DrawnCurves
from kitting_drake.hkd.tools.tool import LONGEST_MM, SHORTEST_MM

_NOTES = ("DIMENSION", "ARC_DIMENSION", "LARGE_RADIAL_DIMENSION", "LEADER", "MULTILEADER")
"""DXF entities that annotate a drawing, so their lines do not belong to an outline."""
_SMOOTHED, _CONTROL_POINT = 4, 16
"""The flags of a smoothed polyline, and of a vertex that is only a control point."""
_MORE_UNITS_MM = {8: 25.4e-6, 9: 0.0254, 21: 1200 / 3937 * 1e3, 22: 100 / 3937 * 1e3}
"""The length in mm of each unit ($INSUNITS) that ezdxf does not convert: microinches, mils, US
survey feet and US survey inches."""

_END_MARK, _TAIL = re.compile(rb"^\s*EOF\b", re.MULTILINE), 1000
"""The end mark of a DXF, and the number of bytes at the file's end in which it is sought.

Some programs write more bytes behind the end mark.
"""


def dxf_curves(path: Path, unit_mm: float | None = None) -> DrawnCurves:
    """Reads the plotted curves in a DXF's model space.

    Args:
        path: the drawing.
        unit_mm: the length in mm of a unit of the drawing. None: the unit in the file's $INSUNITS;
            if there is none, the only unit in which the drawing has the size of a tool.

    Raises:
        UserError: the file is broken, or its unit is ambiguous.
    """
    ezdxf = import_extra(
        "ezdxf", "disassemble", "path", "units", purpose="DXF", extra="fabrication"
    )
    try:
        document = _document(ezdxf, path)
        hidden = _hidden_layers(document)
        unseen = 0

        def is_drawn(entity: Any) -> bool:
            layer = entity.dxf.get("layer", "0").lower()
            seen = layer not in hidden and not entity.dxf.get("invisible", 0)
            nonlocal unseen
            unseen += not seen
            return seen and entity.dxftype() not in _NOTES

        whole = filter(is_drawn, document.modelspace())
        found = []
        for entity in filter(is_drawn, ezdxf.disassemble.recursive_decompose(whole)):
            _drop_control_points(entity)
            try:
                curve = ezdxf.path.make_path(entity)
            except TypeError:
                # The entity is not a curve; it is, for instance, text.
                continue
            found += curve.sub_paths()
        box = ezdxf.path.bbox(found, fast=True)
        extent = max(box.size.x, box.size.y) if box.has_data else 0.0
        mm, measured = _scale(ezdxf, document, path, unit_mm, extent)
        curves = [
            Curve(np.array([(mm * p.x, mm * p.y) for p in part.flattening(FLAT_MM / mm)]))
            for part in found
        ]
        elsewhere = [name for name in document.layout_names() if name != "Model"]
        elsewhere = [name for name in elsewhere if len(document.layout(name))]
    except (MemoryError, UserError):
        raise
    except Exception as error:
        raise UserError(f"{path} cannot be read as DXF: export it again") from error
    if not curves and elsewhere:
        raise UserError(
            f"{path} has its curves in paper space ('{elsewhere[0]}'): move them to model space"
        )
    notes = []
    if unseen:
        notes.append(f"left out {unseen} entities that are hidden or not plotted")
    return DrawnCurves(curves, measured, None, notes)


def _document(ezdxf: Any, path: Path) -> Any:
    """Reads a DXF. A file that lacks only the end mark counts as complete.

    Raises:
        UserError: the file is cut short.
    """
    data = path.read_bytes()
    if data.startswith(b"AutoCAD Binary DXF") or _END_MARK.search(data[-_TAIL:]):
        return ezdxf.readfile(path)
    if data.rsplit(None, 1)[-1:] != [b"ENDSEC"]:
        raise UserError(f"{path} is cut short or not a DXF: copy or export it again")
    with tempfile.TemporaryDirectory() as scratch:
        whole = Path(scratch) / "whole.dxf"
        whole.write_bytes(data.rstrip() + b"\n0\nEOF\n")
        return ezdxf.readfile(whole)


def _hidden_layers(document: Any) -> set[str]:
    """Returns the names, in lower case, of the layers that are not plotted."""
    return {
        layer.dxf.name.lower()
        for layer in document.layers
        if layer.is_off() or layer.is_frozen() or not layer.dxf.get("plot", 1)
    } | {"defpoints"}


def _drop_control_points(entity: Any) -> None:
    """Removes a smoothed polyline's control points, which are stored among its vertices."""
    if entity.dxftype() == "POLYLINE" and entity.dxf.flags & _SMOOTHED:
        entity.vertices[:] = [v for v in entity.vertices if not v.dxf.flags & _CONTROL_POINT]


def _scale(
    ezdxf: Any, document: Any, path: Path, unit_mm: float | None, extent: float
) -> tuple[float, str]:
    """Returns the length of a unit in mm, and a phrase that says how it is known.

    Raises:
        UserError: the drawing would have the size of a tool in several units.
    """
    if unit_mm is not None:
        return unit_mm, f"by units of {unit_mm:g} mm as requested"
    # ezdxf assumes metres for files without a header.
    given = b"$INSUNITS" in path.read_bytes()
    units = ezdxf.units.InsertUnits(int(document.header.get("$INSUNITS", 0)) if given else 0)
    if units == ezdxf.units.InsertUnits.Unitless:
        return _likely(path, document, extent)
    mm = _MORE_UNITS_MM.get(int(units)) or ezdxf.units.conversion_factor(
        units, ezdxf.units.InsertUnits.Millimeters
    )
    return mm, f"by its $INSUNITS, {units.name.lower()}"


def _likely(path: Path, document: Any, extent: float) -> tuple[float, str]:
    """Chooses the unit of a drawing that states none.

    The chosen unit is the only one that makes the drawing as long as a tool, or mm if none does.

    Returns:
        The length of the unit in mm, and a phrase for the user.

    Raises:
        UserError: several units make the drawing as long as a tool.
    """
    names = ["mm", "inches", "cm", "m"]
    if b"$MEASUREMENT" in path.read_bytes():
        metric = int(document.header.get("$MEASUREMENT", 1))
        names = ["mm", "cm", "m"] if metric else ["mm", "inches"]
    possible = [n for n in names if SHORTEST_MM <= extent * UNITS_MM[n] <= LONGEST_MM]
    if len(possible) > 1:
        readings = " or ".join(f"{extent * UNITS_MM[n]:.4g} mm (in {n})" for n in possible)
        raise UserError(f"{path} states no unit, and may be {readings} long: give --unit")
    name = possible[0] if possible else "mm"
    return UNITS_MM[name], f"in {name}, because the file states no unit"
