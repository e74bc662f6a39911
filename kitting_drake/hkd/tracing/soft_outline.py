"""Outlines to a fraction of a pixel: where half of the light is the tool's."""

from typing import Any

import numpy as np
from manifold3d import CrossSection, FillRule
from numpy.typing import NDArray

from kitting_drake.hkd.tracing.photo_file import linear
from kitting_drake.hkd.tracing.plane_view import RectifiedPhoto

Array = NDArray[Any]

_BAND_MM = 0.7
"""The outline is within this distance of the mask's edge."""
_SKIP_MM = 0.35
_NEAR_MM = 0.8
_LEAST_CONTRAST = 0.03


def soft_mask(cv2: Any, photo: RectifiedPhoto, mask: Array) -> Array:
    """(rows, columns) the share of a tool's light in each pixel near the edge of a mask.

    The tool's and the ground's colours are those a little inside and outside of the edge, so a
    shadow beside a tool counts as ground.
    """
    ppm = photo.px_per_mm
    u, v, width, height = cv2.boundingRect(mask)
    margin = int(4 * ppm)
    box = (
        slice(max(0, v - margin), v + height + margin),
        slice(max(0, u - margin), u + width + margin),
    )
    whole = np.zeros(mask.shape, np.float32)
    whole[box] = _soft(cv2, linear(photo.pixels[box]), mask[box], ppm)
    return whole


def _soft(cv2: Any, light: Array, mask: Array, ppm: float) -> Array:
    # Blur is at least a pixel or two wide.
    skip = max(_SKIP_MM, 1.5 / ppm)
    inside = cv2.distanceTransform(mask, cv2.DIST_L2, 5) / ppm
    outside = cv2.distanceTransform(1 - mask, cv2.DIST_L2, 5) / ppm
    tool = _spread_colour(cv2, light, (inside > skip) & (inside < 2.0), ppm)
    ground = _spread_colour(cv2, light, (outside > skip) & (outside < 1.6), ppm)
    contrast = np.zeros_like(inside)
    share = np.zeros_like(inside)
    for k in range(3):
        along = tool[..., k] - ground[..., k]
        contrast += along * along
        share += (light[..., k] - ground[..., k]) * along
    share /= np.maximum(contrast, 1e-6)
    unsure = (contrast < _LEAST_CONTRAST**2) | (tool[..., 3] < 1e-3) | (ground[..., 3] < 1e-3)
    share[unsure] = cv2.GaussianBlur(mask.astype(np.float32), (0, 0), 0.2 * ppm)[unsure]
    share = np.clip(share, 0, 1)
    share[inside > _BAND_MM] = 1
    share[outside > _BAND_MM] = 0
    return cv2.GaussianBlur(share, (0, 0), 0.12 * ppm + 0.4)


def _spread_colour(cv2: Any, light: Array, where: Array, ppm: float) -> Array:
    """(rows, columns, 4) the mean colour of the nearby pixels `where`, and their weight."""
    stacked = np.empty((*where.shape, 4), np.float32)
    stacked[..., :3] = light
    stacked[..., 3] = 1
    stacked[~where] = 0
    # Three box filters are close to a Gaussian, and faster.
    side = 2 * round(0.85 * _NEAR_MM * ppm) + 1
    for _ in range(3):
        stacked = cv2.blur(stacked, (side, side))
    stacked[..., :3] /= np.maximum(stacked[..., 3:], 1e-6)
    return stacked


def contours(photo: RectifiedPhoto, soft: Array) -> CrossSection:
    """The area, in mm, where a soft mask is over one half."""
    # Import lazily: it comes with matplotlib.
    import contourpy

    padded = np.pad(soft, 1)
    lines = contourpy.contour_generator(z=padded).lines(0.5)
    loops = [photo.to_mm(np.asarray(line)[:-1] - 1) for line in lines if len(line) > 8]
    return CrossSection(loops, FillRule.EvenOdd)
