"""Draws a figure of the heights at which each camera sees the table."""

from __future__ import annotations

import io
from collections.abc import Mapping

import matplotlib
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy import ndimage

from systems.signals import PixelGrid


def draw_heights(heights: Mapping[str, NDArray[np.float32]], grid: PixelGrid) -> bytes:
    """Draws maps of the heights above the table, for each camera and for all cameras together.

    Args:
        heights: (rows, cols) heights in metres, by the camera's name; the empty name stands for all
            cameras together. Unseen pixels are NaN.
        grid: the pixel grid of the heights.

    Returns:
        The picture as PNG.
    """
    values = np.concatenate([item[np.isfinite(item)] for item in heights.values()])
    # Leave out objects, so that the colour scale shows small errors of the table's height.
    flat = np.abs(values[np.abs(values) < 0.02])
    reach = max(1.0, 1e3 * float(np.percentile(flat, 98))) if flat.size else 1.0
    down = (len(heights) + 1) // 2
    figure = Figure(figsize=(12, 0.6 + 3.1 * down), layout="constrained", dpi=110)
    axes = np.atleast_1d(figure.subplots(down, min(2, len(heights)), squeeze=False)).ravel()
    colours = matplotlib.colormaps["RdBu_r"].with_extremes(bad="0.8")
    picture = None
    for axis, (name, height) in zip(axes, heights.items(), strict=False):
        picture = axis.imshow(
            1e3 * _without_gaps(height),
            cmap=colours,
            vmin=-reach,
            vmax=reach,
            extent=(grid.y_min, grid.y_max, grid.x_max, grid.x_min),
        )
        axis.set_title(name or "together, the highest of each pixel", loc="left", fontsize=10)
        axis.set(xlabel="y, m", ylabel="x, m")
        axis.spines[:].set_visible(False)
    for axis in axes[len(heights) :]:
        axis.set_axis_off()
    figure.colorbar(picture, ax=axes, label="above the table, mm", shrink=0.8)
    buffer = io.BytesIO()
    with matplotlib.rc_context({"font.size": 9}):
        figure.savefig(buffer, format="png")
    return buffer.getvalue()


def _without_gaps(height: NDArray[np.float32]) -> NDArray[np.float32]:
    """Fills the pixels between a camera's samples, which would look like holes otherwise."""
    seen = np.isfinite(height)
    share = ndimage.uniform_filter(seen.astype(np.float32), 3)
    mean = ndimage.uniform_filter(np.where(seen, height, 0).astype(np.float32), 3)
    filled = np.where(share > 0.4, mean / np.maximum(share, 1e-6), np.nan)
    return np.where(seen, height, filled)
