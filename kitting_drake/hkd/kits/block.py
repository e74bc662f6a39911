"""The kit block as a solid, and its surface as meshes for the contact solver."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from manifold3d import CrossSection, JoinType, Manifold, Mesh, triangulate
from numpy.typing import NDArray

from kitting_drake.hkd.kits.parameters import KitParameters

ARC_SEGMENTS = 64
"""The number of edges of a full circle in a rounded outline."""
_CELL = 0.02
"""The largest size of the pieces into which walls and top are cut for the contact solver, in
metres."""

Triangles = tuple[NDArray[np.float64], NDArray[np.int64]]
"""Vertices (n, 3), in metres, and faces (m, 3)."""


class _Surface:
    """Collects the triangles of a surface, ring by ring.

    Lengths are in metres. The normals of a cavity's triangles point away from the cavity.
    """

    def __init__(self) -> None:
        self._vertices: list[NDArray[np.float64]] = []
        self._faces: list[NDArray[np.int64]] = []
        self._count = 0

    def add_vertices(self, vertices: NDArray[np.float64]) -> int:
        """Adds vertices (n, 3); returns the index of the first vertex."""
        self._vertices.append(vertices)
        self._count += len(vertices)
        return self._count - len(vertices)

    def add_faces(self, faces: NDArray[np.int64]) -> None:
        """Adds triangles (n, 3), each three indices of vertices."""
        self._faces.append(faces)

    def add_ring(self, loops: list[NDArray[np.float64]], z: float) -> int:
        """Adds the vertices of closed loops, each (n, 2), at height z; returns the index of the
        first vertex."""
        flat = np.concatenate(loops)
        return self.add_vertices(np.column_stack([flat, np.full(len(flat), z)]))

    def add_walls(self, loops: list[NDArray[np.float64]], lower: int, upper: int) -> None:
        """Adds vertical walls between two rings that `add_ring` made of the same loops.

        Args:
            loops: the loops.
            lower: the index of the lower ring's first vertex.
            upper: the index of the upper ring's first vertex.
        """
        start = 0
        for loop in loops:
            here = start + np.arange(len(loop))
            there = start + (np.arange(len(loop)) + 1) % len(loop)
            self.add_faces(np.column_stack([lower + here, lower + there, upper + there]))
            self.add_faces(np.column_stack([lower + here, upper + there, upper + here]))
            start += len(loop)

    def add_bevel(
        self,
        outer_loops: list[NDArray[np.float64]],
        outer: int,
        inner_loops: list[NDArray[np.float64]],
        inner: int,
    ) -> None:
        """Adds a bevel between a ring and a narrower, lower one: triangulates the band between
        their loops.

        Args:
            outer_loops: the loops of the wider, upper ring.
            outer: the index of the upper ring's first vertex.
            inner_loops: the loops of the narrower, lower ring.
            inner: the index of the lower ring's first vertex.
        """
        band = np.asarray(triangulate(outer_loops + [loop[::-1] for loop in inner_loops]))
        starts = np.cumsum([0, *map(len, inner_loops[:-1])])
        inner_index = [
            inner + start + np.arange(len(loop))[::-1]
            for start, loop in zip(starts, inner_loops, strict=True)
        ]
        outer_index = outer + np.arange(sum(map(len, outer_loops)))
        self.add_faces(np.concatenate([outer_index, *inner_index])[band][:, ::-1])

    def arrays(self) -> Triangles:
        """Returns the vertices and faces added so far."""
        return np.concatenate(self._vertices), np.concatenate(self._faces)


@dataclass(frozen=True)
class Cavity:
    """A bevelled cavity in the kit frame, in metres."""

    outline: CrossSection
    """The outline of the walls."""
    floor: float
    """The height of the floor in the kit frame."""
    top: float
    """The height of the rim in the kit frame."""
    lead_in: float
    """The width and depth of the bevel around the rim; zero for none."""

    @property
    def rim(self) -> CrossSection:
        """The outline at the block's top, where the bevel begins."""
        if self.lead_in <= 0:
            return self.outline
        return self.outline.offset(self.lead_in, JoinType.Round, circular_segments=ARC_SEGMENTS)

    def add_sides(self, surface: _Surface, longest: float = np.inf) -> tuple[int, int]:
        """Adds the cavity's walls and its bevel to a surface.

        Args:
            surface: the surface to add to.
            longest: edges of the outlines that are longer than this, in metres, are subdivided.

        Returns:
            The indices of the first vertex of the floor's ring and of the rim's ring.
        """
        wall_loops = _subdivided(self.outline.to_polygons(), longest)
        rim_loops = _subdivided(self.rim.to_polygons(), longest)
        floor = surface.add_ring(wall_loops, self.floor)
        if self.lead_in <= 0:
            rim = surface.add_ring(rim_loops, self.top)
            surface.add_walls(wall_loops, floor, rim)
            return floor, rim
        shoulder = surface.add_ring(wall_loops, self.top - self.lead_in)
        surface.add_walls(wall_loops, floor, shoulder)
        rim = surface.add_ring(rim_loops, self.top)
        surface.add_bevel(rim_loops, rim, wall_loops, shoulder)
        return floor, rim

    def cutter(self) -> Manifold:
        """Returns the solid to subtract from the block."""
        surface = _Surface()
        floor, rim = self.add_sides(surface)
        rim_loops = self.rim.to_polygons()
        above = surface.add_ring(rim_loops, self.top + 0.01)
        surface.add_walls(rim_loops, rim, above)
        surface.add_faces(np.asarray(triangulate(self.outline.to_polygons()))[:, ::-1] + floor)
        surface.add_faces(np.asarray(triangulate(rim_loops)) + above)
        vertices, faces = surface.arrays()
        return Manifold(Mesh(vertices.astype(np.float32), faces.astype(np.uint32)))


def _subdivided(loops: list[NDArray[np.float64]], longest: float) -> list[NDArray[np.float64]]:
    """Adds vertices to closed loops, each (n, 2), so that no edge is longer than `longest`
    metres."""
    result = []
    for loop in loops:
        edges = np.roll(loop, -1, axis=0) - loop
        counts = np.maximum(1, np.ceil(np.linalg.norm(edges, axis=1) / longest)).astype(int)
        steps = np.concatenate([np.arange(count) / count for count in counts])
        result.append(
            np.repeat(loop, counts, axis=0) + steps[:, None] * np.repeat(edges, counts, axis=0)
        )
    return result


def build_block(cavities: Sequence[Cavity], parameters: KitParameters) -> Manifold:
    """Builds the kit block in the kit frame K, in metres: watertight and connected.

    Args:
        cavities: the cavities to cut.
        parameters: the parameters of the kit; their length and width are the block's.
    """
    size = (parameters.length, parameters.width, parameters.height)
    block = Manifold.cube(size, True).translate((0, 0, parameters.height / 2))
    for cavity in cavities:
        block -= cavity.cutter()
    return block


def _add_floor(surface: _Surface, cavity: Cavity, cavities: Sequence[Cavity]) -> None:
    """Adds a cavity's floor: the bounding rectangle of the cavity's outline.

    Other cavities that are at least as deep are cut out of the rectangle. Otherwise the rectangle
    would be a shelf or a second floor inside them.
    """
    x_min, y_min, x_max, y_max = cavity.outline.bounds()
    corners = np.array([(x_min, y_min), (x_max, y_min), (x_max, y_max), (x_min, y_max)])
    rectangle = CrossSection([corners])
    floor = rectangle
    for other in cavities:
        if other is not cavity and other.floor <= cavity.floor:
            floor -= other.rim
    if rectangle.area() - floor.area() < 1e-9:
        start = surface.add_ring([corners], cavity.floor)
        surface.add_faces(start + np.array([[0, 2, 1], [0, 3, 2]]))
        return
    loops = floor.to_polygons()
    start = surface.add_ring(loops, cavity.floor)
    surface.add_faces(start + np.asarray(triangulate(loops))[:, ::-1])


def contact_surfaces(cavities: Sequence[Cavity], parameters: KitParameters) -> dict[str, Triangles]:
    """Meshes the block's surface for the contact solver: sides, floors, top and outside.

    The geometry is that of the block without its underside. The solver puts small groups of
    neighbouring triangles into bounding boxes; its cost grows with the number of boxes that an
    object overlaps. A plain triangulation has long slivers, whose boxes overlap and which split
    contact patches into many polygons. Therefore:

    - each floor is one rectangle that extends into the solid, where nothing can touch it;
    - top and walls are cut into small pieces;
    - large and small triangles are in separate meshes; in one mesh they would share large boxes.

    Args:
        cavities: the block's cavities.
        parameters: the parameters of the kit.

    Returns:
        The meshes by name, in the kit frame K.
    """
    sides, floors, top, outside = _Surface(), _Surface(), _Surface(), _Surface()
    room = CrossSection.square((parameters.length, parameters.width), True)
    plane = room
    for cavity in cavities:
        cavity.add_sides(sides, _CELL)
        _add_floor(floors, cavity, cavities)
        plane -= cavity.rim
    for x in np.arange(-parameters.length / 2, parameters.length / 2, _CELL):
        for y in np.arange(-parameters.width / 2, parameters.width / 2, _CELL):
            cell = plane ^ CrossSection.square((_CELL, _CELL)).translate((x, y))
            if cell.area() > 1e-10:
                loops = cell.to_polygons()
                start = top.add_ring(loops, parameters.height)
                top.add_faces(start + np.asarray(triangulate(loops)))
    loops = _subdivided(room.to_polygons(), _CELL)
    outside.add_walls(
        loops, outside.add_ring(loops, 0.0), outside.add_ring(loops, parameters.height)
    )
    # The normals of sides and floors point away from the cavities; flip them to point out of the
    # block.
    return {
        "sides": _reversed(sides),
        "floors": _reversed(floors),
        "top": top.arrays(),
        "outside": outside.arrays(),
    }


def _reversed(surface: _Surface) -> Triangles:
    vertices, faces = surface.arrays()
    return vertices, faces[:, ::-1]
