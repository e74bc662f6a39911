"""Draws the workspace and region that `find_table` proposes, seen from above."""

from __future__ import annotations

import io
from collections.abc import Sequence

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, PathPatch, Polygon, Rectangle
from matplotlib.path import Path
from numpy.typing import NDArray
from scipy import ndimage

from systems.signals import Observation, PixelGrid

Corners = Sequence[tuple[float, float]]

_REGION, _WORKSPACE, _IGNORED = "#f2a33a", "#2f6fde", "#d6336c"
_HIGHEST = 0.08
"""Height at the upper end of the colour scale, in metres."""
_UNSEEN = 0.82
"""Grey value of unseen pixels."""


def draw_found(
    observation: Observation, workspace: PixelGrid, region: Corners, ignore: Sequence[Corners]
) -> bytes:
    """Draws colour and height from above, with the outlines of workspace and region.

    Args:
        observation: the heightmap of the whole visible table.
        workspace: the proposed pixel grid of o_t.
        region: corners (x, y) of the region of interest in the robot's base frame, in metres.
        ignore: polygons, in the same frame, whose content is ignored.

    Returns:
        The picture as PNG.
    """
    grid = observation.grid
    width = 12.0
    height = 0.45 * width * grid.rows / grid.cols + 1.1
    figure = Figure(figsize=(width, height), layout="constrained", dpi=110)
    colour, heights = figure.subplots(1, 2, sharey=True)
    extent = (grid.y_min, grid.y_max, grid.x_max, grid.x_min)
    rgb, seen = _without_gaps(observation.rgb, observation.valid)
    shown = np.where(seen[..., None], rgb.transpose(1, 2, 0), _UNSEEN)
    colour.imshow(np.clip(shown, 0, 1), extent=extent)
    above, _ = _without_gaps(observation.height[None], observation.valid)
    picture = heights.imshow(
        np.where(seen, 1e3 * above[0], np.nan),
        cmap=matplotlib.colormaps["viridis"].with_extremes(bad=str(_UNSEEN)),
        vmin=0,
        vmax=1e3 * _HIGHEST,
        extent=extent,
    )
    for axes, title in ((colour, "colour"), (heights, "height above the table")):
        axes.set_title(title, loc="left", fontsize=10)
        axes.set_xlabel("y, m")
        axes.spines[:].set_visible(False)
        _outline(axes, grid, workspace, region, ignore)
    colour.set_ylabel("x, m")
    figure.colorbar(picture, ax=heights, label="mm", shrink=0.8, extend="max")
    figure.legend(handles=_legend(bool(ignore)), loc="outside lower left", ncols=5, frameon=False)
    buffer = io.BytesIO()
    with matplotlib.rc_context({"font.size": 9}):
        figure.savefig(buffer, format="png")
    return buffer.getvalue()


def _outline(
    axes: Axes, grid: PixelGrid, workspace: PixelGrid, region: Corners, ignore: Sequence[Corners]
) -> None:
    """Darkens pixels outside the region, and draws all outlines and the robot's base."""
    border = [
        (grid.y_min, grid.x_min),
        (grid.y_max, grid.x_min),
        (grid.y_max, grid.x_max),
        (grid.y_min, grid.x_max),
    ]
    inner = [(y, x) for x, y in region]
    if _area(inner) * _area(border) > 0:
        inner.reverse()
    outside = Path.make_compound_path(Path(border, closed=False), Path(inner, closed=False))
    axes.add_patch(PathPatch(outside, facecolor="black", edgecolor="none", alpha=0.35))
    axes.add_patch(Polygon(inner, fill=False, edgecolor=_REGION, lw=2))
    for polygon in ignore:
        corners = [(y, x) for x, y in polygon]
        axes.add_patch(Polygon(corners, facecolor="none", edgecolor=_IGNORED, hatch="////", lw=1.5))
    axes.add_patch(
        Rectangle(
            (workspace.y_min, workspace.x_min),
            workspace.y_max - workspace.y_min,
            workspace.x_max - workspace.x_min,
            fill=False,
            edgecolor=_WORKSPACE,
            lw=2,
            ls="--",
        )
    )
    if grid.contains((0.0, 0.0)):
        axes.plot(0, 0, "P", ms=9, mfc="white", mec="black")


def _area(corners: Corners) -> float:
    """Twice the signed area of a polygon, in m^2."""
    x, y = np.array(corners).T
    return float((x * np.roll(y, -1) - y * np.roll(x, -1)).sum())


def _legend(ignored: bool) -> list[Line2D | Patch]:
    handles: list[Line2D | Patch] = [
        Line2D([], [], color=_REGION, lw=2, label="region: only inside is table"),
        Line2D([], [], color=_WORKSPACE, lw=2, ls="--", label="workspace"),
    ]
    if ignored:
        handles.append(
            Patch(facecolor="none", edgecolor=_IGNORED, hatch="////", label="ignored, too tall")
        )
    handles += [
        Patch(facecolor=str(_UNSEEN), label="not seen"),
        Line2D([], [], ls="", marker="P", ms=9, mfc="white", mec="black", label="robot's base"),
    ]
    return handles


def _without_gaps(
    image: NDArray[np.float32], seen: NDArray[np.bool_]
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Fills the pixels between a camera's samples with the means of their neighbours.

    Returns:
        The filled image (channels, rows, cols), and the mask (rows, cols) of its known pixels.
    """
    share = ndimage.uniform_filter(seen.astype(np.float32), 3)
    means = np.stack([ndimage.uniform_filter(np.where(seen, one, 0), 3) for one in image])
    filled = np.where(seen, image, means / np.maximum(share, 1e-6))
    return filled.astype(np.float32), seen | (share > 0.3)
