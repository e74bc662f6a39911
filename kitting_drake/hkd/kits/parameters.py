"""The parameters of a kit's block. Their default values are the template of the dataset's kits."""

from dataclasses import dataclass, field, replace

from systems.bounds import bounded

TIGHT = 0.001
"""The clearance in metres below which a cavity is tight and needs finer contact geometry."""
_FINEST = 5e-6
"""The smallest tolerance of a tight cavity's outline, in metres."""


@dataclass
class KitParameters:
    """The parameters of a kit's block. Lengths in m."""

    # The block's extents along x, y and z. If the tools are nested (packed closely), the length and
    # width are used only with `fixed_size`; without it, the block is as small as possible.
    length: float = bounded(0.280, 0.04, 1.0)
    width: float = bounded(0.260, 0.04, 1.0)
    height: float = bounded(0.050, 0.01, 0.2)

    # The clearance between a seated tool's outline and the wall. Below 1 mm, the tools get
    # collision hulls whose outlines are within 0.05 mm of the true outlines, and `tolerance` is at
    # most a twentieth of the clearance.
    clearance: float = bounded(0.002, 0.0, 0.01)

    # Clearances of single tools by name, instead of `clearance`.
    clearance_of: dict[str, float] = field(default_factory=dict, metadata={"range": (0.0, 0.01)})

    # The height of the tops of seated tools above the block's top; 0: flush.
    stand_out: float = bounded(0.0, 0.0, 0.1)

    # The radius of the morphological closing, which bridges notches narrower than twice this.
    closing_radius: float = bounded(0.008, 0.0, 0.03)

    # The width and depth of the bevel around the rim, which leads a tool in.
    lead_in: float = bounded(0.001, 0.0, 0.005)

    # The largest deviation of the simplified outline from the exact wall.
    tolerance: float = bounded(0.0001, 1e-6, 0.001)

    # The least wall thickness between two cavities, and below a cavity.
    minimum_wall: float = bounded(0.002, 0.0, 0.05)

    # The least wall thickness between and around nested cavities.
    nested_wall: float = bounded(0.006, 0.001, 0.05)

    # Whether to nest the tools even if they fit the fixed slots for the paper's four categories.
    always_nested: bool = False

    # Whether the block of nested tools has the length and width above instead of the smallest size
    # found.
    fixed_size: bool = False

    @property
    def least_clearance(self) -> float:
        """The least clearance of any tool, in metres."""
        return min([self.clearance, *self.clearance_of.values()])

    @property
    def is_tight(self) -> bool:
        """Whether a clearance is so small that finer contact geometry is needed."""
        return self.least_clearance < TIGHT

    def of_tool(self, name: str) -> "KitParameters":
        """Returns the parameters of one tool's cavity, with this tool's clearance."""
        if name not in self.clearance_of:
            return self
        return replace(self, clearance=self.clearance_of[name], clearance_of={})

    def with_fine_walls(self) -> "KitParameters":
        """Returns the parameters, with a finer tolerance if the clearance is tight."""
        finest = max(self.least_clearance / 20, _FINEST)
        return replace(self, tolerance=min(self.tolerance, finest)) if self.is_tight else self
