"""An area of a kit's block that is cut away from above."""

from dataclasses import dataclass

from manifold3d import CrossSection


@dataclass(frozen=True)
class Recess:
    """A recess with upright walls and a level floor, in the kit frame, in metres."""

    kind: str
    """`cavity`, `notch` or `label`."""
    tool: str
    """The name of the tool that it belongs to."""
    outline: CrossSection
    floor: float
    """Its height above the block's bottom."""
