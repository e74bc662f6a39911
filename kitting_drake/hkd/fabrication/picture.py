"""Draws a kit from above in two views: empty, with depths and dimensions; and with its tools."""

import io
from typing import Any

import numpy as np
from manifold3d import CrossSection, JoinType
from numpy.typing import NDArray

from kitting_drake.hkd.fabrication.design import Design, loops_mm
from kitting_drake.hkd.fabrication.foam_sheet import FoamSheet, moved, sheet_layers
from kitting_drake.hkd.fabrication.splitting.opening import roomiest_point
from kitting_drake.hkd.tools.solids import MATERIALS
from kitting_drake.hkd.tools.tool import Tool

_PAPER, _INK, _FAINT = "#f6f5f1", "#26282c", "#8a8d91"
_TOP, _BEVEL, _ENGRAVED = "#2f3338", "#59606a", "#b9bec6"
# Colours of shallow and deep floors, and of the shadows on them.
_SHALLOW, _DEEP = np.array([0.98, 0.72, 0.26]), np.array([0.83, 0.43, 0.05])
_SHADOW = (0.20, 0.08, 0.0)
_LIGHT = np.array([-0.45, 0.55, 0.70]) / np.linalg.norm([-0.45, 0.55, 0.70])
"""The unit vector towards the light, in the kit frame."""
_ROOMIEST = 0.032
"""The search for the point farthest from a cavity's wall starts at this distance, in metres, from
the wall."""
_INCHES = 7.5
"""The width of each of the two views, in inches."""


def picture_png(design: Design) -> bytes:
    """Draws a picture of a kit's design, as a PNG."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    length, width, height = design.size_mm
    tall = _INCHES * min(1.6, max(0.5, width / length))
    figure, (empty, full) = plt.subplots(
        1, 2, figsize=(2 * _INCHES + 0.4, tall + 1.0), facecolor=_PAPER, layout="constrained"
    )
    for axes in (empty, full):
        _draw_block(axes, design)
        axes.set_aspect("equal")
        axes.set_axis_off()
        axes.set_xlim(-0.075 * length, 1.03 * length)
        axes.set_ylim(-0.09 * length, width + 0.03 * length)
    _draw_depths(empty, design)
    _draw_measures(empty, design)
    for index in range(len(design.kit.tools)):
        _draw_tool(full, design, index)
    count = len(design.kit.tools)
    tools = "1 tool" if count == 1 else f"{count} tools"
    figure.suptitle(
        f"{tools} on {length:g} by {width:g} by {height:g} mm", color=_INK, fontsize=15, x=0.5
    )
    picture = io.BytesIO()
    figure.savefig(picture, format="png", dpi=110, facecolor=_PAPER)
    plt.close(figure)
    return picture.getvalue()


def sheet_png(sheet: FoamSheet) -> bytes:
    """Draws a sheet with its kits as a PNG."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt
    from matplotlib.patches import PathPatch
    from matplotlib.path import Path

    length, width = sheet.size
    scale = 11.0 / max(length, width)
    figure, axes = plt.subplots(
        figsize=(scale * length + 0.6, scale * width + 0.9), facecolor=_PAPER, layout="constrained"
    )
    axes.set_aspect("equal")
    axes.set_facecolor(_PAPER)
    axes.tick_params(colors=_FAINT)
    for spine in axes.spines.values():
        spine.set_visible(False)
    axes.set_xlim(-0.01 * length, 1.01 * length)
    axes.set_ylim(-0.01 * width, 1.01 * width)
    for name, loops in sheet_layers(sheet).items():
        fill = {"SHEET": "#e9e6dd", "BLOCK": _TOP}.get(name, tuple(_DEEP))
        path = Path.make_compound_path(*(Path(np.vstack([a, a[:1]]), closed=True) for a in loops))
        axes.add_artist(PathPatch(path, facecolor=fill, edgecolor=_INK, linewidth=0.4))
    for number, place in enumerate(sheet.places):
        corner = moved(np.array([[0.0, 0.0], sheet.kits[place.kit].size]), place, sheet)
        x, y = corner.min(axis=0)
        name = sheet.kits[place.kit].name
        axes.text(x + 2, y + 2, f"{number + 1} {name}", color="#ffffff", fontsize=7, va="bottom")
    count = len(sheet.places)
    kits = "1 kit" if count == 1 else f"{count} kits"
    axes.set_title(f"{kits} on {length:g} by {width:g} mm", color=_INK, fontsize=13)
    picture = io.BytesIO()
    figure.savefig(picture, format="png", dpi=110, facecolor=_PAPER)
    plt.close(figure)
    return picture.getvalue()


def _draw_block(axes: Any, design: Design) -> None:
    length, width, _ = design.size_mm
    parameters = design.kit.parameters
    room = CrossSection.square((parameters.length, parameters.width), True)
    for step in (4, 3, 2, 1):
        soft = room.offset(0.0012 * step, JoinType.Round).translate((0.0012, -0.0016))
        _fill(axes, design, soft, "#000000", alpha=0.05)
    _fill(axes, design, room, _TOP)
    axes.plot([0, 0, length], [0, width, width], color="#4a5058", linewidth=1.2)
    for cavity in design.cavities:
        _fill(axes, design, cavity.rim, _BEVEL)
    deepest = max(design.depth_mm(recess) for recess in design.recesses)
    order = sorted(
        (recess for recess in design.recesses if recess.kind != "label"), key=lambda r: -r.floor
    )
    for recess in order:
        share = design.depth_mm(recess) / deepest
        floor = (1 - share) * _SHALLOW + share * _DEEP
        _fill(axes, design, recess.outline, tuple(floor))
        depth = 1e-3 * design.depth_mm(recess)
        # Draw the shadow of a cavity and its notches as one, because there is no wall between them.
        opening = CrossSection()
        for other in order:
            if other.tool == recess.tool:
                opening += other.outline
        # Draw three hard shadows, which together look like a soft one.
        for part in (0.25, 0.45, 0.65):
            offset = part * depth * _LIGHT[:2] / _LIGHT[2]
            lit = opening.translate((-float(offset[0]), -float(offset[1])))
            _fill(axes, design, recess.outline - lit, _SHADOW, alpha=0.17)
    for recess in design.recesses:
        if recess.kind == "label":
            on_top = design.depth_mm(recess) < 1.0
            _fill(axes, design, recess.outline, _ENGRAVED if on_top else "#7a3d02")


def _fill(axes: Any, design: Design, outline: CrossSection, colour: Any, alpha: float = 1) -> None:
    from matplotlib.patches import PathPatch
    from matplotlib.path import Path

    loops = loops_mm(outline, design.kit.parameters)
    if loops:
        path = Path.make_compound_path(*(Path(np.vstack([a, a[:1]]), closed=True) for a in loops))
        # `add_patch` would also compute the patch's extent, which takes longer than drawing.
        axes.add_artist(PathPatch(path, facecolor=colour, edgecolor="none", alpha=alpha))


def _draw_depths(axes: Any, design: Design) -> None:
    """Writes each cavity's depth at the point farthest from the cavity's wall."""
    for cavity, recess in zip(design.cavities, design.recesses, strict=False):
        point = roomiest_point(cavity.outline, _ROOMIEST)
        x, y = 1e3 * (point + np.array(design.kit.size[:2]) / 2)
        axes.text(
            x,
            y,
            f"{design.depth_mm(recess):.1f}",
            color=_INK,
            fontsize=9,
            ha="center",
            va="center",
            fontweight="bold",
            bbox={"boxstyle": "round,pad=0.25", "facecolor": (1, 1, 1, 0.72), "edgecolor": "none"},
        )


def _draw_measures(axes: Any, design: Design) -> None:
    length, width, _ = design.size_mm
    off = 0.04 * length
    line = {"arrowstyle": "<->", "color": _FAINT, "linewidth": 0.9, "shrinkA": 0, "shrinkB": 0}
    axes.annotate("", (0, -off), (length, -off), arrowprops=line)
    axes.annotate("", (-off, 0), (-off, width), arrowprops=line)
    text = {"color": _INK, "fontsize": 10, "ha": "center", "va": "center"}
    box = {"boxstyle": "round,pad=0.3", "facecolor": _PAPER, "edgecolor": "none"}
    axes.text(length / 2, -off, f"{length:g} mm", bbox=box, **text)
    axes.text(-off, width / 2, f"{width:g} mm", bbox=box, rotation=90, **text)


def _draw_tool(axes: Any, design: Design, index: int) -> None:
    """Draws the upward-facing triangles of a seated tool, the highest last."""
    from matplotlib.collections import PolyCollection

    tool, pose = design.kit.tools[index], design.kit.layout.poses[index]
    triangles, colours = _shaded(tool, pose.yaw)
    c, s = np.cos(pose.yaw), np.sin(pose.yaw)
    flat = triangles[:, :, :2] @ np.array([[c, s], [-s, c]]) + np.array([pose.x, pose.y])
    corners = 1e3 * (flat + np.array(design.kit.size[:2]) / 2)
    order = np.argsort(triangles[:, :, 2].mean(axis=1), kind="stable")
    axes.add_collection(
        PolyCollection(
            corners[order], facecolors=colours[order], edgecolors=colours[order], linewidths=0.25
        )
    )


def _shaded(tool: Tool, yaw: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Returns the triangles (n, 3, 3) of a tool that face upward, and their colours (n, 3).

    The triangles are in the tool's frame T.
    """
    triangles = tool.triangles
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
    base = np.concatenate(
        [
            np.tile(MATERIALS.get(material, MATERIALS["steel"]).rgba[:3], (len(part), 1))
            for material, part in tool.parts
        ]
    )
    c, s = np.cos(yaw), np.sin(yaw)
    turned = normals @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
    diffuse = np.clip(turned @ _LIGHT, 0.0, 1.0)
    halfway = (_LIGHT + [0, 0, 1]) / np.linalg.norm(_LIGHT + [0, 0, 1])
    gloss = np.clip(turned @ halfway, 0.0, 1.0) ** 30
    colours = np.clip(base * (0.38 + 0.72 * diffuse[:, None]) + 0.22 * gloss[:, None], 0, 1)
    up = normals[:, 2] > 1e-6
    return triangles[up], colours[up]
