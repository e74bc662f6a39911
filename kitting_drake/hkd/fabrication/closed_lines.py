"""Helpers that write closed polylines to DXF and SVG, in millimetres."""

import io
from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kitting_drake.common.extras import import_extra


def new_dxf() -> Any:
    """Returns an empty ezdxf document of DXF release 2010, in mm.

    Raises:
        MachineError: ezdxf is not installed.
    """
    ezdxf = import_extra("ezdxf", "units", purpose="DXF", extra="fabrication")
    document = ezdxf.new("R2010", units=ezdxf.units.MM)
    document.header["$INSUNITS"] = int(ezdxf.units.MM)
    document.header["$MEASUREMENT"] = 1
    return document


def add_layer(document: Any, name: str, colour: int, loops: Iterable[NDArray[np.float64]]) -> None:
    """Adds a layer of closed polylines, each (n, 2) in mm; `colour` is an AutoCAD colour index."""
    document.layers.add(name, color=colour)
    for loop in loops:
        document.modelspace().add_lwpolyline(loop.tolist(), close=True, dxfattribs={"layer": name})


def text_of(document: Any) -> str:
    """Returns the content of an ezdxf document as the text of a DXF file."""
    text = io.StringIO()
    document.write(text)
    return text.getvalue()


def svg_path(loop: NDArray[np.float64]) -> str:
    """Returns the `d` attribute of a closed SVG path through points (n, 2) in mm.

    As in SVG, the y axis points down.
    """
    return "M " + " L ".join(f"{x:.4f} {y:.4f}" for x, y in loop) + " Z"
