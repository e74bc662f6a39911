"""The design of a kit's block for printing or milling: the simulated kit with notches and
labels."""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from manifold3d import CrossSection, JoinType, Manifold
from numpy.typing import NDArray

from kitting_drake.hkd.fabrication.labels import DEPTH, engrave_labels
from kitting_drake.hkd.fabrication.notches import cut_notches
from kitting_drake.hkd.fabrication.outside import Outside, shaped
from kitting_drake.hkd.fabrication.recess import Recess
from kitting_drake.hkd.fabrication.splitting.opening import Opening
from kitting_drake.hkd.kits.block import ARC_SEGMENTS, Cavity, build_block
from kitting_drake.hkd.kits.kit import Kit
from kitting_drake.hkd.kits.layout import kit_cavities
from kitting_drake.hkd.kits.parameters import KitParameters

TEST_HOLE_MM = 20.0
"""The side of the square hole in `test_piece`, in mm."""
_ABOVE = 0.01
"""How far the solids that cut notches and labels stick out above the block, in metres.

Without this, rounding could leave a thin skin at the block's top.
"""
_FINEST = 2e-6
"""The size of the smallest detail that the solid keeps, in metres."""
_DIGITS = 4
"""The number of decimals to which coordinates are rounded in files, whose unit is 1 mm."""


@dataclass(frozen=True)
class Design:
    """A kit's block, with all recesses that are cut from it."""

    kit: Kit
    cavities: tuple[Cavity, ...]
    recesses: tuple[Recess, ...]
    """All recesses: first the cavities in the tools' order, then the notches and labels."""
    notes: tuple[str, ...]
    """A sentence for each tool whose notches or label found no room."""
    compensation: float = 0.0
    """How much wider the cavities are than those of `kit`, on each side, in metres."""
    outside: Outside = field(default_factory=Outside)
    """The shape of the block's outside. It changes the solid, but not the drawings."""

    @property
    def size_mm(self) -> tuple[float, float, float]:
        """The length, width and height of the block, in millimetres."""
        length, width, height = (round(1e3 * extent, _DIGITS) for extent in self.kit.size)
        return length, width, height

    def depth_mm(self, recess: Recess) -> float:
        """The depth of a recess below the block's top, rounded to 0.01 mm."""
        return round(1e3 * (self.kit.parameters.height - recess.floor), 2)


def design_kit(
    kit: Kit,
    *,
    notches: bool = False,
    labels: bool = False,
    compensation: float = 0.0,
    outside: Outside | None = None,
) -> Design:
    """Designs the block of a kit.

    Args:
        kit: the simulated kit.
        notches: whether to add finger notches where they fit.
        labels: whether to engrave the tools' names where they fit.
        compensation: see `Design.compensation`.
        outside: see `Design.outside`.
    """
    cavities = tuple(
        dataclasses.replace(
            cavity,
            outline=cavity.outline.offset(
                compensation, JoinType.Round, circular_segments=ARC_SEGMENTS
            )
            if compensation
            else cavity.outline,
        )
        for cavity in kit_cavities(kit.tools, kit.parameters, kit.layout.poses)
    )
    recesses = [
        Recess("cavity", tool.name, cavity.outline, cavity.floor)
        for tool, cavity in zip(kit.tools, cavities, strict=True)
    ]
    notes: list[str] = []
    for wanted, cut in ((notches, cut_notches), (labels, engrave_labels)):
        if wanted:
            added, refused = cut(kit, cavities, tuple(recesses))
            recesses += added
            notes += refused
    return Design(kit, cavities, tuple(recesses), tuple(notes), compensation, outside or Outside())


def solid(design: Design) -> Manifold:
    """Returns the block in the files' frame: in mm, with its lower left corner at the origin."""
    parameters = design.kit.parameters
    block = build_block(design.cavities, parameters)
    for recess in design.recesses:
        if recess.kind != "cavity":
            depth = parameters.height - recess.floor + _ABOVE
            block -= Manifold.extrude(recess.outline, depth).translate((0, 0, recess.floor))
    # Remove details that would collapse when coordinates are rounded to `_DIGITS` decimals.
    block = block.simplify(_FINEST)
    corner = (parameters.length / 2, parameters.width / 2, 0.0)
    return shaped(block.translate(corner).scale((1e3, 1e3, 1e3)), design.outside)


def letters(design: Design) -> Manifold:
    """Returns the letters that fill the engraved labels, in the frame of `solid`, in mm."""
    parameters = design.kit.parameters
    filled = Manifold()
    for recess in design.recesses:
        if recess.kind == "label":
            body = Manifold.extrude(recess.outline, DEPTH)
            filled += body.translate((0, 0, recess.floor))
    corner = (parameters.length / 2, parameters.width / 2, 0.0)
    filled = filled.simplify(_FINEST).translate(corner).scale((1e3, 1e3, 1e3))
    return filled.translate((0, 0, design.outside.raised_mm))


def surface(solid: Manifold) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Returns the surface of a solid, with coordinates rounded to `_DIGITS` decimals.

    Returns:
        Vertices (n, 3) in millimetres and triangles (m, 3). The surface is watertight, and its
        triangles are wound so that the normals point outward.
    """
    mesh = solid.to_mesh64()
    corners = np.asarray(mesh.vert_properties, dtype=float)[:, :3]
    vertices, index = np.unique(np.round(corners, _DIGITS) + 0.0, axis=0, return_inverse=True)
    faces = index.reshape(-1)[np.asarray(mesh.tri_verts, dtype=np.int64)]
    a, b, c = faces.T
    return vertices, faces[(a != b) & (b != c) & (c != a)]


def openings(design: Design) -> list[Opening]:
    """Returns the cavities, notches and labels of a block, in the frame of `solid`, in mm."""
    parameters, raised = design.kit.parameters, design.outside.raised_mm

    def loops(outline: CrossSection) -> CrossSection:
        return CrossSection(loops_mm(outline, parameters))

    found = [
        Opening(loops(c.rim), 1e3 * c.floor + raised, below_bevel=loops(c.outline))
        for c in design.cavities
    ]
    found += [
        Opening(loops(recess.outline), 1e3 * recess.floor + raised, recess.kind == "label")
        for recess in design.recesses
        if recess.kind != "cavity"
    ]
    return found


def test_piece() -> Manifold:
    """Returns a small plate with a square hole, in mm. It shows how much a printer shrinks holes.

    The side of the designed hole is `TEST_HOLE_MM`. The compensation to use is half the difference
    between `TEST_HOLE_MM` and the side of the printed hole.
    """
    hole = TEST_HOLE_MM
    plate = Manifold.cube((hole + 12.0, hole + 12.0, 8.0))
    return plate - Manifold.cube((hole, hole, 10.0)).translate((6.0, 6.0, -1.0))


def in_block(points: NDArray[np.float64], parameters: KitParameters) -> NDArray[np.float64]:
    """Converts points (n, 2) from the kit frame in metres to the frame of the files in mm.

    The files' origin is the lower left corner of the block's bottom, because many slicers and
    mills reject negative coordinates.
    """
    return np.round(1e3 * (points + np.array([parameters.length, parameters.width]) / 2), _DIGITS)


def loops_mm(outline: CrossSection, parameters: KitParameters) -> list[NDArray[np.float64]]:
    """Converts an outline in the kit frame to closed loops (n, 2) in mm, in the files' frame."""
    return [in_block(np.asarray(loop), parameters) for loop in outline.to_polygons()]


def layers(design: Design) -> dict[tuple[str, float], list[Recess]]:
    """Groups the recesses by (kind, depth in mm): cavities first, then notches, then labels."""
    groups: dict[tuple[str, float], list[Recess]] = {}
    for recess in design.recesses:
        groups.setdefault((recess.kind, design.depth_mm(recess)), []).append(recess)
    kinds: Sequence[str] = ("cavity", "notch", "label")
    return dict(sorted(groups.items(), key=lambda item: (kinds.index(item[0][0]), item[0][1])))
