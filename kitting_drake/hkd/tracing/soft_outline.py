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
    light = linear(photo.pixels)
    inside = cv2.distanceTransform(mask, cv2.DIST_L2, 5) / ppm
    outside = cv2.distanceTransform(1 - mask, cv2.DIST_L2, 5) / ppm
    tool = _spread_colour(cv2, light, (inside > _SKIP_MM) & (inside < 2.0), ppm)
    ground = _spread_colour(cv2, light, (outside > _SKIP_MM) & (outside < 1.6), ppm)
    along = tool[..., :3] - ground[..., :3]
    contrast = (along**2).sum(axis=2)
    share = ((light - ground[..., :3]) * along).sum(axis=2) / np.maximum(contrast, 1e-6)
    hard = mask.astype(np.float32)
    unsure = (np.sqrt(contrast) < _LEAST_CONTRAST) | (tool[..., 3] < 1e-3) | (ground[..., 3] < 1e-3)
    share[unsure] = cv2.GaussianBlur(hard, (0, 0), 0.2 * ppm)[unsure]
    share = np.clip(share, 0, 1)
    share[inside > _BAND_MM] = 1
    share[outside > _BAND_MM] = 0
    return cv2.GaussianBlur(share, (0, 0), 0.12 * ppm + 0.4)


def _spread_colour(cv2: Any, light: Array, where: Array, ppm: float) -> Array:
    """(rows, columns, 4) the mean colour of the nearby pixels `where`, and their weight."""
    weight = where.astype(np.float32)
    stacked = np.dstack([light * weight[..., None], weight])
    stacked = cv2.GaussianBlur(stacked, (0, 0), _NEAR_MM * ppm)
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
