"""Corrects a silhouette for the tool's height above the plane that it lies on."""

import math

import numpy as np
from manifold3d import CrossSection
from numpy.typing import NDArray

EDGES = ("upright", "round")
"""Shapes of a tool's sides: see `outline_of_silhouette`."""

_STEP_MM = 0.4


def outline_of_silhouette(
    silhouette: CrossSection, camera: NDArray[np.float64], height: float, edges: str
) -> CrossSection:
    """The outline of a tool whose silhouette a camera casts on the plane, in mm.

    A point at height h is seen H / (H - h) times as far from the point below the camera. Upright
    sides are seen from top to bottom: at their top where they face away from that point, and at
    their foot where they face it. So the outline is what the silhouette holds at every factor
    from 1 to H / (H - t). The edge of a round tool is at half its height t on all sides.

    Args:
        silhouette: in the plane's frame.
        camera: (3,) the camera's position.
        height: t, below the camera's height H.
        edges: one of `EDGES`.
    """
    below = (float(camera[0]), float(camera[1]))
    factor = camera[2] / (camera[2] - height / (2 if edges == "round" else 1))
    centred = silhouette.translate((-below[0], -below[1]))
    if edges == "round":
        return centred.scale((1 / factor, 1 / factor)).translate(below)
    low_x, low_y, high_x, high_y = centred.bounds()
    reach = math.hypot(max(abs(low_x), abs(high_x)), max(abs(low_y), abs(high_y)))
    steps = max(1, math.ceil(reach * (1 - 1 / factor) / _STEP_MM))
    outline = centred
    for share in np.arange(1, steps + 1) / steps:
        scale = 1 / (1 + share * (factor - 1))
        outline = outline ^ centred.scale((scale, scale))
    return outline.translate(below)
