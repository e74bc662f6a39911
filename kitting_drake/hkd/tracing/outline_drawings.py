"""Writes outlines as SVG and DXF in true millimetres."""

import io

import numpy as np
from manifold3d import CrossSection
from numpy.typing import NDArray

from kitting_drake.common.extras import import_extra

_MARGIN_MM = 5.0


def _loops(outline: CrossSection) -> list[NDArray[np.float64]]:
    return [np.asarray(loop, float) for loop in outline.to_polygons()]


def outlines_svg(outlines: dict[str, CrossSection]) -> str:
    """An SVG with 1 mm user units and one path for each outline, holes included."""
    bounds = np.array([outline.bounds() for outline in outlines.values()])
    low, high = bounds[:, :2].min(axis=0) - _MARGIN_MM, bounds[:, 2:].max(axis=0) + _MARGIN_MM
    width, height = high - low
    lines = [
        '<?xml version="1.0" encoding="UTF-8"?>',
        f'<svg xmlns="http://www.w3.org/2000/svg" version="1.1" width="{width:.4f}mm" '
        f'height="{height:.4f}mm" viewBox="0 0 {width:.4f} {height:.4f}">',
        "  <desc>1 unit is 1 mm.</desc>",
    ]
    for name, outline in outlines.items():
        path = " ".join(
            "M " + " L ".join(f"{x - low[0]:.4f} {high[1] - y:.4f}" for x, y in loop) + " Z"
            for loop in _loops(outline)
        )
        lines.append(
            f'  <path id="{name}" fill="#0b5fa5" fill-opacity="0.12" fill-rule="evenodd" '
            f'stroke="#0b5fa5" stroke-width="0.1" d="{path}"/>'
        )
    return "\n".join([*lines, "</svg>", ""])


def outlines_dxf(outlines: dict[str, CrossSection]) -> str:
    """A DXF of release 2010 in mm, with closed polylines on one layer for each outline.

    Raises:
        MachineError: ezdxf is not installed.
    """
    ezdxf = import_extra("ezdxf", "units", purpose="DXF", extra="fabrication")
    document = ezdxf.new("R2010", units=ezdxf.units.MM)
    document.header["$INSUNITS"] = int(ezdxf.units.MM)
    document.header["$MEASUREMENT"] = 1
    space = document.modelspace()
    for name, outline in outlines.items():
        layer = name.upper()
        document.layers.add(layer, color=5)
        for loop in _loops(outline):
            space.add_lwpolyline(loop.tolist(), close=True, dxfattribs={"layer": layer})
    text = io.StringIO()
    document.write(text)
    return text.getvalue()
