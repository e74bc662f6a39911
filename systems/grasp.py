"""How an object may be held from above."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Grasp:
    """A planar grasp in the frame B of an object that lies as it should."""

    x: float
    """Coordinates of the point midway between the pads, in B, in metres."""
    y: float
    theta: float
    """Rotation of the hand about B's z, in radians; at zero the jaws close along B's y."""
    width: float
    """Distance of the faces that are gripped, in metres."""
    surface_height: float
    """Height of the object's top at the grasp above B's origin, in metres."""
