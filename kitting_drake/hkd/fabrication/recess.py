"""A recess cut into a kit's block from above."""

from dataclasses import dataclass

from manifold3d import CrossSection


@dataclass(frozen=True)
class Recess:
    """A recess with upright walls and a level floor, in the kit frame, in metres."""

    kind: str
    """`cavity`, `notch` or `label`."""
    tool: str
    """The tool's name."""
    outline: CrossSection
    floor: float
    """The height of the recess's floor above the block's bottom, in metres."""
