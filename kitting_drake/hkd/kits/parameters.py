"""The template of a kit."""

from dataclasses import dataclass, replace

from systems.bounds import bounded

TIGHT = 0.001
"""Cavities with less clearance than this, in metres, need finer contact geometry."""
_FINEST = 5e-6
"""The least tolerance of a tight cavity, in metres."""


@dataclass
class KitParameters:
    """The template of the kit block. Lengths in m."""

    # The block's extents along x, y and z. Length and width apply to a block with the slots of a
    # toolset, and to a nested block if `fixed_size` is set.
    length: float = bounded(0.280, 0.05, 1.0)
    width: float = bounded(0.260, 0.05, 1.0)
    height: float = bounded(0.050, 0.01, 0.2)

    # Free space between a seated tool's outline and the wall. Below 1 mm, the tools get collision
    # hulls whose outlines are within 0.05 mm of the true ones, and the tolerance is at most a
    # twentieth of the clearance.
    clearance: float = bounded(0.002, 0.0, 0.01)

    # Radius of the morphological closing: notches narrower than twice this are bridged.
    closing_radius: float = bounded(0.008, 0.0, 0.03)

    # Width and depth of the bevel around the rim, which leads a tool in.
    lead_in: float = bounded(0.001, 0.0, 0.005)

    # The largest deviation of the straight edges from the exact walls.
    tolerance: float = bounded(0.0001, 1e-6, 0.001)

    # The least wall thickness between two cavities, and below a cavity.
    minimum_wall: float = bounded(0.002, 0.0, 0.05)

    # The wall thickness between and around nested cavities.
    nested_wall: float = bounded(0.006, 0.001, 0.05)

    # Nest the tools even where they fit the slots of a toolset.
    always_nested: bool = False

    # Give a nested block the length and width above, instead of the smallest size found.
    fixed_size: bool = False

    @property
    def is_tight(self) -> bool:
        """Whether the clearance needs finer contact geometry."""
        return self.clearance < TIGHT

    def with_fine_walls(self) -> "KitParameters":
        """The parameters with a tolerance that suits a tight clearance."""
        finest = max(self.clearance / 20, _FINEST)
        return replace(self, tolerance=min(self.tolerance, finest)) if self.is_tight else self
