"""A grasp of an object from above."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Grasp:
    """A planar grasp in the body frame B of an object in its nominal resting pose."""

    x: float
    """x of the point midway between the pads, in B, in metres; `y` is its y coordinate."""
    y: float
    theta: float
    """Rotation of the hand about B's z, in radians; at zero the jaws close along B's y."""
    width: float
    """Distance between the gripped faces, in metres."""
    surface_height: float
    """Height of the object's top above B's origin at the grasp, in metres."""
