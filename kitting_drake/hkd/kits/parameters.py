"""The template of a kit."""

from dataclasses import dataclass

from systems.bounds import bounded


@dataclass
class KitParameters:
    """The template of the kit block. Lengths in m."""

    # The block's extents along x, y and z. The length and the width are those of a block with the
    # slots of a toolset; where tools are nested instead, the block gets a size of its own, unless
    # `fixed_size`.
    length: float = bounded(0.280, 0.05, 1.0)
    width: float = bounded(0.260, 0.05, 1.0)
    height: float = bounded(0.050, 0.01, 0.2)

    # Free space between a seated tool's outline and the wall.
    clearance: float = bounded(0.002, 0.0, 0.01)

    # Radius of the morphological closing: notches narrower than twice this are bridged.
    closing_radius: float = bounded(0.008, 0.0, 0.03)

    # Width and depth of the bevel around the rim, which leads a tool in.
    lead_in: float = bounded(0.001, 0.0, 0.005)

    # Walls are drawn with straight edges that stray at most this far.
    tolerance: float = bounded(0.0001, 1e-6, 0.001)

    # The least thickness of block between two cavities, and below one.
    minimum_wall: float = bounded(0.002, 0.0, 0.05)

    # The same between two nested cavities, and around them.
    nested_wall: float = bounded(0.006, 0.001, 0.05)

    # Whether tools are nested even where they could take the slots of a toolset.
    always_nested: bool = False

    # Whether a nested block has the length and the width above; else it is as small as can be.
    fixed_size: bool = False
