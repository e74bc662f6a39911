"""Draws the outlines of a block's recesses as DXF and SVG, in millimetres.

Each layer (DXF) or group (SVG) holds the recesses of one kind and one depth. Cavities are drawn
along their walls; only the STL and 3MF files have the bevel around the rims.
"""

from html import escape

import numpy as np
from numpy.typing import NDArray

from kitting_drake.hkd.fabrication.closed_lines import add_layer, new_dxf, svg_path, text_of
from kitting_drake.hkd.fabrication.design import Design, layers, loops_mm

_NAMES = {"cavity": "CAVITIES", "notch": "NOTCHES", "label": "LABELS"}
# AutoCAD's colour indices. Cavities cycle through cool colours; notches and labels are warm.
_BLOCK_COLOUR, _CAVITY_COLOURS, _NOTCH_COLOUR, _LABEL_COLOUR = 7, (4, 3, 6, 2, 150, 80), 30, 1
_STROKES = {"cavity": "#0b5fa5", "notch": "#d9480f", "label": "#2b8a3e"}


def layer_name(kind: str, depth: float) -> str:
    """Returns the name of a layer, for instance `CAVITIES_17.62_MM_DEEP`."""
    return f"{_NAMES[kind]}_{depth:.2f}_MM_DEEP"


def dxf_text(design: Design) -> str:
    """Draws the recesses as a DXF of release 2010.

    There is one layer of closed polylines for each kind and depth; the layer BLOCK has the block's
    outline.

    Raises:
        MachineError: ezdxf is not installed.
    """
    document = new_dxf()
    add_layer(document, "BLOCK", _BLOCK_COLOUR, [_block(design)])
    cavities = 0
    for (kind, depth), recesses in layers(design).items():
        colour = {"notch": _NOTCH_COLOUR, "label": _LABEL_COLOUR}.get(kind)
        if colour is None:
            colour = _CAVITY_COLOURS[cavities % len(_CAVITY_COLOURS)]
            cavities += 1
        loops = [
            loop for recess in recesses for loop in loops_mm(recess.outline, design.kit.parameters)
        ]
        add_layer(document, layer_name(kind, depth), colour, loops)
    length, width, _ = design.size_mm
    document.header["$EXTMIN"], document.header["$EXTMAX"] = (0, 0, 0), (length, width, 0)
    document.set_modelspace_vport(height=1.1 * max(length, width), center=(length / 2, width / 2))
    return text_of(document)


def svg_text(design: Design) -> str:
    """Draws the recesses as an SVG in units of 1 mm.

    There is one group for each kind and depth, and in it one path for each recess.
    """
    length, width, height = design.size_mm
    lines = [
        '<?xml version="1.0" encoding="UTF-8"?>',
        f'<svg xmlns="http://www.w3.org/2000/svg" version="1.1" width="{length:g}mm" '
        f'height="{width:g}mm" viewBox="0 0 {length:g} {width:g}">',
        f"  <title>Kit of {escape(', '.join(tool.name for tool in design.kit.tools))}</title>",
        f"  <desc>Block of {length:g} by {width:g} by {height:g} mm; 1 unit is 1 mm.</desc>",
        '  <g id="BLOCK" fill="none" stroke="#000000" stroke-width="0.1">',
        f'    <path d="{_path(_block(design), width)}"/>',
        "  </g>",
    ]
    for (kind, depth), recesses in layers(design).items():
        stroke = _STROKES[kind]
        lines.append(
            f'  <g id="{layer_name(kind, depth)}" fill="{stroke}" fill-opacity="0.12" '
            f'fill-rule="evenodd" stroke="{stroke}" stroke-width="0.1">'
        )
        for recess in recesses:
            loops = loops_mm(recess.outline, design.kit.parameters)
            path = " ".join(_path(loop, width) for loop in loops)
            lines.append(f'    <path d="{path}"><title>{escape(recess.tool)}</title></path>')
        lines.append("  </g>")
    return "\n".join([*lines, "</svg>", ""])


def _block(design: Design) -> NDArray[np.float64]:
    length, width, _ = design.size_mm
    return np.array([(0, 0), (length, 0), (length, width), (0, width)])


def _path(loop: NDArray[np.float64], width: float) -> str:
    """Returns the SVG path of a closed loop (n, 2) on a block of the given width, both in mm."""
    # The y axis points down in SVG.
    return svg_path(np.column_stack([loop[:, 0], width - loop[:, 1]]))
