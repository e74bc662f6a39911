"""The grip: the faces between which the jaws hold a tool from above.

Only the surface between the two planes through the pads' ends matters. The closing pads touch it
where it stands out farthest. So the extent of this surface along the closing direction is the grip.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Grip:
    """The extent of the surface between the jaws, in the unit of the triangles (see
    `find_grip`)."""

    low: float
    """The surface's least coordinate along the closing direction, measured from the point (x, y)
    of `find_grip`."""
    high: float
    """The surface's greatest coordinate along the closing direction."""
    top: float
    """The greatest height of the surface between the jaws."""

    @property
    def width(self) -> float:
        """The distance between the gripped faces."""
        return self.high - self.low

    @property
    def middle(self) -> float:
        """The coordinate halfway between the gripped faces."""
        return (self.low + self.high) / 2


def find_grip(triangles: Array, x: float, y: float, theta: float, length: float) -> Grip | None:
    """Measures the part of a tool's surface that is between pads of a given length.

    Args:
        triangles: (n, 3, 3) the surface of a tool in its frame T.
        x: the x of the middle of the pads in T.
        y: the y of the middle of the pads in T.
        theta: the rotation of the hand about T's z, in radians; at zero the jaws close along y.
        length: the length of the pads, perpendicular to the closing direction.

    Returns:
        The grip, or None if nothing is between the pads.
    """
    along, across = jaw_axes(theta)
    points = _points_between(triangles - (x, y, 0.0), np.append(along, 0.0), length / 2)
    if not len(points):
        return None
    reach = points[:, :2] @ across
    return Grip(float(reach.min()), float(reach.max()), float(points[:, 2].max()))


def jaw_axes(theta: float) -> tuple[Array, Array]:
    """Returns the unit vectors (2,) in T along the pads and along the closing direction."""
    along = np.array([np.cos(theta), np.sin(theta)])
    return along, np.array([-along[1], along[0]])


def _points_between(triangles: Array, normal: Array, distance: float) -> Array:
    """Clips triangles (n, 3, 3) to |normal . p| <= distance.

    Returns:
        The corners (m, 3) of what remains.
    """
    starts, ends = triangles.reshape(-1, 3), np.roll(triangles, -1, axis=1).reshape(-1, 3)
    start_heights, end_heights = starts @ normal, ends @ normal
    found = [starts[np.abs(start_heights) <= distance]]
    for plane in (-distance, distance):
        crossing = (start_heights < plane) != (end_heights < plane)
        share = (plane - start_heights[crossing]) / (
            end_heights[crossing] - start_heights[crossing]
        )
        found.append(starts[crossing] + share[:, None] * (ends[crossing] - starts[crossing]))
    return np.concatenate(found)
