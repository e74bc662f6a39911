"""Corrects a silhouette for the tool's height above the plane on which it lies."""

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
    """Computes a tool's outline from its silhouette, both in mm in the plane's frame.

    Let H be the camera's height above the plane, and t the tool's height. In the photo, a point at
    height h is H / (H - h) times too far from the point below the camera. Where an upright side
    faces away from the camera, the silhouette ends at the side's top edge; where it faces the
    camera, at the side's bottom edge. So the outline is the part of the plane that the silhouette
    covers at every scale from 1 to (H - t) / H; the point below the camera stays fixed. The widest
    points of a round tool are at height t / 2 on all sides, so its silhouette is scaled only once.

    Args:
        silhouette: the part of the plane that the tool hides.
        camera: (3,) the camera's position.
        height: the tool's height t in mm, less than H.
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
