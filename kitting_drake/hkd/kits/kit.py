"""Kits: a block with a conformal cavity for each tool (section IV-B.2 of the paper).

The paper takes a depth image of the tool from above, fills what is beneath it, closes the result
morphologically, grows it by 2 mm and subtracts it from the block; its authors then cut upward, so
that the tool can get in. A depth image filled downward and cut upward is a prism over the tool's
outline. So the outline is taken exactly, as polygons, and closed and grown exactly, by offsetting:
the same cavity without the voxels, their steps, and the smoothing that has to hide them.

A toolset, one tool of each of the paper's categories at most, takes the slots of a template. Any
other tools, and tools that are too big for their slots, are nested on a block of their own size.
"""

import dataclasses
import hashlib
import itertools
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from manifold3d import CrossSection, JoinType, Manifold, Mesh, triangulate
from numpy.typing import NDArray

from kitting_drake.common.errors import UserError
from kitting_drake.common.paths import cache_directory
from kitting_drake.hkd.cache import cached_folder
from kitting_drake.hkd.grasps.proposals import RELEASE_REACH
from kitting_drake.hkd.kits.nesting import LONGEST_SIDES, NestedShape, nest
from kitting_drake.hkd.tools.tool import Tool
from systems.bounds import bounded
from systems.hand_geometry import FINGER_LENGTH

SLOTS = {
    "hammer": (0.02, 0.03),
    "pliers": (0.0, -0.03),
    "wrench": (0.0, -0.09),
    "screwdriver": (0.0, 0.09),
}
"""(x, y) of the frame T of the tool of each category in the kit frame, in metres."""

MOST_TOOLS = 12
"""The largest number of tools in a kit."""

_ARC_SEGMENTS = 64
_DIGITS = 7
"""The number of decimals of coordinates in files."""
_TOP_CELL = 0.02
"""Side of the squares into which the top is cut for the contact solver, in metres."""
_SIZE_STEP = 0.001
"""Nested blocks have a length and a width that are multiples of this, in metres."""
_FORMAT_VERSION = "8"
"""Part of the cache key: changed whenever the same input makes another kit."""


@dataclass
class KitParameters:
    """The template of the kit block. Lengths in m."""

    # The block's extents along x, y and z. The length and the width are those of a block with the
    # slots of a toolset; where tools are nested instead, the block gets a size of its own.
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


@dataclass(frozen=True)
class CavityPose:
    """The pose of a seated tool's frame T in the kit frame K; lengths in metres."""

    x: float
    y: float
    z: float
    yaw: float = 0.0
    """The rotation about K's z, in radians."""


@dataclass(frozen=True)
class KitLayout:
    """How large a kit block is, and where its cavities are."""

    parameters: KitParameters
    """The template, with the length and the width that the block has."""
    poses: tuple[CavityPose, ...]
    """The poses of the seated tools, in their order."""


@dataclass(frozen=True)
class Kit:
    """A kit block on disk.

    The kit frame K: z up, the origin in the centre of the block's bottom, x along its length.
    """

    sdf: Path
    """A model with one link `kit` whose body frame is K."""
    tools: tuple[Tool, ...]
    layout: KitLayout

    @property
    def parameters(self) -> KitParameters:
        """The template, with the length and the width that the block has."""
        return self.layout.parameters

    @property
    def size(self) -> tuple[float, float, float]:
        """The block's extents along x, y and z of K, in metres."""
        return self.parameters.length, self.parameters.width, self.parameters.height

    def goal(self, index: int) -> CavityPose:
        """Where the frame T of tool `index` belongs in K."""
        return self.layout.poses[index]


def slot_pose(tool: Tool, parameters: KitParameters) -> CavityPose:
    """The pose of a tool in the slot of its category: its top is flush with the block's.

    Raises:
        KeyError: there is no slot for the tool's category.
    """
    x, y = SLOTS[tool.category]
    return CavityPose(x, y, parameters.height - tool.height)


def cavity_outline(outline: CrossSection, parameters: KitParameters) -> CrossSection:
    """The outline of a tool, closed and grown by the clearance.

    A hole through the tool leaves no pillar standing in its cavity, thin and of no use.
    """
    closing, clearance = parameters.closing_radius, parameters.clearance
    # Simplified first and last only: each time costs up to the tolerance.
    grown = outline.simplify(parameters.tolerance / 4).offset(
        closing + clearance, JoinType.Round, circular_segments=_ARC_SEGMENTS
    )
    closed = grown.offset(-closing, JoinType.Round, circular_segments=_ARC_SEGMENTS)
    # Loops around holes run clockwise, and have negative areas.
    loops = [loop for loop in closed.to_polygons() if _signed_area(loop) > 0]
    return CrossSection(loops).simplify(parameters.tolerance)


def _signed_area(loop: NDArray[np.float64]) -> float:
    x, y = loop.T
    return float(np.dot(x, np.roll(y, -1)) - np.dot(y, np.roll(x, -1))) / 2


class _Surface:
    """Triangles that grow ring by ring. Lengths in metres, normals out of the cavity's solid."""

    def __init__(self) -> None:
        self._vertices: list[NDArray[np.float64]] = []
        self._faces: list[NDArray[np.int64]] = []
        self._count = 0

    def add_vertices(self, vertices: NDArray[np.float64]) -> int:
        """Adds (n, 3) vertices; returns the index of the first."""
        self._vertices.append(vertices)
        self._count += len(vertices)
        return self._count - len(vertices)

    def add_faces(self, faces: NDArray[np.int64]) -> None:
        """Adds (n, 3) faces."""
        self._faces.append(faces)

    def add_ring(self, loops: list[NDArray[np.float64]], z: float) -> int:
        """Adds the vertices of closed loops at a height; returns the index of the first."""
        flat = np.concatenate(loops)
        return self.add_vertices(np.column_stack([flat, np.full(len(flat), z)]))

    def add_walls(self, loops: list[NDArray[np.float64]], lower: int, upper: int) -> None:
        """Joins two rings of the same loops by upright walls."""
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
        """Joins a ring to a narrower and lower one: the flat band between the loops, let down."""
        band = np.asarray(triangulate(outer_loops + [loop[::-1] for loop in inner_loops]))
        starts = np.cumsum([0, *map(len, inner_loops[:-1])])
        inner_index = [
            inner + start + np.arange(len(loop))[::-1]
            for start, loop in zip(starts, inner_loops, strict=True)
        ]
        outer_index = outer + np.arange(sum(map(len, outer_loops)))
        self.add_faces(np.concatenate([outer_index, *inner_index])[band][:, ::-1])

    def arrays(self) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """Vertices (n, 3) and faces (m, 3)."""
        return np.concatenate(self._vertices), np.concatenate(self._faces)


@dataclass(frozen=True)
class Cavity:
    """A bevelled pit in the kit frame, in metres."""

    outline: CrossSection
    """The outline of the wall."""
    floor: float
    """Heights in the kit frame."""
    top: float
    lead_in: float
    """Width and depth of the bevel around the rim; none at zero."""

    @property
    def rim(self) -> CrossSection:
        """The outline at the very top."""
        if self.lead_in <= 0:
            return self.outline
        return self.outline.offset(self.lead_in, JoinType.Round, circular_segments=_ARC_SEGMENTS)

    def add_sides(self, surface: _Surface) -> tuple[int, int]:
        """Adds wall and bevel; returns the first vertices of the floor's ring and of the rim's."""
        wall_loops, rim_loops = self.outline.to_polygons(), self.rim.to_polygons()
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
        """The solid to subtract from the block."""
        surface = _Surface()
        floor, rim = self.add_sides(surface)
        rim_loops = self.rim.to_polygons()
        above = surface.add_ring(rim_loops, self.top + 0.01)
        surface.add_walls(rim_loops, rim, above)
        surface.add_faces(np.asarray(triangulate(self.outline.to_polygons()))[:, ::-1] + floor)
        surface.add_faces(np.asarray(triangulate(rim_loops)) + above)
        vertices, faces = surface.arrays()
        return Manifold(Mesh(vertices.astype(np.float32), faces.astype(np.uint32)))


def layout_kit(tools: Sequence[Tool], parameters: KitParameters) -> KitLayout:
    """Chooses the block's size and the poses of the tools: in their slots, or else nested.

    Raises:
        UserError: there are no tools or too many, one is too high for the block, or no block is
            large enough for them all.
    """
    if not 1 <= len(tools) <= MOST_TOOLS:
        raise UserError(f"a kit holds 1 to {MOST_TOOLS} tools, not {len(tools)}")
    for tool in tools:
        if parameters.height - tool.height < parameters.minimum_wall:
            raise UserError(
                f"'{tool.name}' is {1e3 * tool.height:.1f} mm high and leaves less than "
                f"kit.minimum_wall, {1e3 * parameters.minimum_wall:.1f} mm, below it in a block of "
                f"{1e3 * parameters.height:.1f} mm"
            )
    categories = [tool.category for tool in tools]
    if len(set(categories)) == len(categories) and set(categories) <= set(SLOTS):
        slots = tuple(slot_pose(tool, parameters) for tool in tools)
        if _has_walls(kit_cavities(tools, parameters, slots), parameters):
            return KitLayout(parameters, slots)
    return _nested_layout(tools, parameters)


def _nested_layout(tools: Sequence[Tool], parameters: KitParameters) -> KitLayout:
    def shape(tool: Tool) -> NestedShape:
        outline = cavity_outline(tool.footprint, parameters)
        rim = Cavity(outline, 0.0, parameters.height, parameters.lead_in).rim
        return NestedShape(rim, released_fingers(tool))

    wall = max(parameters.minimum_wall, parameters.nested_wall)
    nesting = nest([shape(tool) for tool in tools], wall)
    if nesting is None:
        names = ", ".join(f"'{tool.name}'" for tool in tools)
        sides = " by ".join(f"{1e3 * side:.0f}" for side in LONGEST_SIDES)
        raise UserError(f"{names} do not fit into one kit: its block may be {sides} mm at most")
    length, width = (
        _SIZE_STEP * math.ceil(side / _SIZE_STEP) for side in (nesting.length, nesting.width)
    )
    return KitLayout(
        dataclasses.replace(parameters, length=length, width=width),
        tuple(
            CavityPose(pose.x, pose.y, parameters.height - tool.height, math.radians(pose.yaw_deg))
            for tool, pose in zip(tools, nesting.poses, strict=True)
        ),
    )


def released_fingers(tool: Tool) -> CrossSection:
    """The area under the fingers as they let go of a tool at its annotated grasp, in T, in metres.

    One rectangle for each finger, from the gripped face outward.
    """
    fingers = CrossSection()
    for side in (-1, 1):
        middle = side * (tool.grasp.width + RELEASE_REACH) / 2
        fingers += CrossSection.square((FINGER_LENGTH, RELEASE_REACH), True).translate((0, middle))
    return fingers.rotate(math.degrees(tool.grasp.theta)).translate((tool.grasp.x, tool.grasp.y))


def kit_cavities(
    tools: Sequence[Tool], parameters: KitParameters, poses: Sequence[CavityPose] | None = None
) -> list[Cavity]:
    """The cavity of each tool.

    Args:
        tools: of the kit.
        parameters: of the kit.
        poses: of the seated tools; those of `layout_kit` if None.

    Raises:
        UserError: the tools make no kit; see `layout_kit`.
    """
    poses = layout_kit(tools, parameters).poses if poses is None else poses
    return [
        Cavity(
            moved_outline(cavity_outline(tool.footprint, parameters), pose),
            pose.z,
            parameters.height,
            parameters.lead_in,
        )
        for tool, pose in zip(tools, poses, strict=True)
    ]


def moved_outline(outline: CrossSection, pose: CavityPose) -> CrossSection:
    """An outline in a tool's frame T as it is in the kit frame K when the tool is seated."""
    if pose.yaw:
        outline = outline.rotate(math.degrees(pose.yaw))
    return outline.translate((pose.x, pose.y))


def build_block(cavities: Sequence[Cavity], parameters: KitParameters) -> Manifold:
    """The kit block in the frame K, in metres: watertight, one body.

    Args:
        cavities: to cut out.
        parameters: whose length and width are the block's; see `KitLayout.parameters`.
    """
    size = (parameters.length, parameters.width, parameters.height)
    block = Manifold.cube(size, True).translate((0, 0, parameters.height / 2))
    for cavity in cavities:
        block -= cavity.cutter()
    return block


def _add_floor(surface: _Surface, cavity: Cavity, cavities: Sequence[Cavity]) -> None:
    """Adds the bounding rectangle of a cavity's floor, without what is in others as deep or deeper.

    There it would be a shelf, or a second floor in the place of the first.
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


def contact_surface(
    cavities: Sequence[Cavity], parameters: KitParameters
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """The block's outside as the contact solver likes it: vertices (n, 3) and faces (m, 3).

    The same walls, bevels and planes as the block's, cut otherwise. A triangulation of floors and
    top by their outlines has long slivers, whose bounding boxes all overlap, and breaks every
    contact patch into as many polygons. So a floor is one rectangle that reaches into the solid,
    where nothing can touch it, but not into another cavity, and the top is cut into squares first.
    The underside is left out.
    """
    surface = _Surface()
    room = CrossSection.square((parameters.length, parameters.width), True)
    top = room
    for cavity in cavities:
        cavity.add_sides(surface)
        _add_floor(surface, cavity, cavities)
        top -= cavity.rim
    # What bounds the cavities from outside bounds the block from inside.
    vertices, faces = surface.arrays()
    block = _Surface()
    block.add_faces(block.add_vertices(vertices) + faces[:, ::-1])
    loops = room.to_polygons()
    block.add_walls(loops, block.add_ring(loops, 0.0), block.add_ring(loops, parameters.height))
    for x in np.arange(-parameters.length / 2, parameters.length / 2, _TOP_CELL):
        for y in np.arange(-parameters.width / 2, parameters.width / 2, _TOP_CELL):
            cell = top ^ CrossSection.square((_TOP_CELL, _TOP_CELL)).translate((x, y))
            if cell.area() > 1e-10:
                loops = cell.to_polygons()
                start = block.add_ring(loops, parameters.height)
                block.add_faces(start + np.asarray(triangulate(loops)))
    return block.arrays()


def _has_walls(cavities: Sequence[Cavity], parameters: KitParameters) -> bool:
    """Whether there is a wall between any two cavities, and around them in the block."""
    half_wall = parameters.minimum_wall / 2
    grown = [
        cavity.rim.offset(half_wall, JoinType.Round, circular_segments=_ARC_SEGMENTS)
        for cavity in cavities
    ]
    room = CrossSection.square((parameters.length, parameters.width), True)
    return all((outline - room).area() <= 1e-9 for outline in grown) and all(
        (one ^ other).area() <= 1e-9 for one, other in itertools.combinations(grown, 2)
    )


def make_kit(tools: Sequence[Tool], parameters: KitParameters) -> Kit:
    """The kit for these tools, from the cache, or built and put there.

    The cache goes by content, so a changed tool or parameter makes another kit. A kit appears there
    atomically, and two processes that build the same one do not disturb each other.

    Raises:
        UserError: the tools make no kit (see `layout_kit`), or the cache cannot be written.
    """
    folder = cached_folder(
        cache_directory() / "kits" / _content_key(tools, parameters),
        _FILES,
        lambda scratch: _write(tools, layout_kit(tools, parameters), scratch),
    )
    return Kit(folder / "kit.sdf", tuple(tools), _read_layout(folder, parameters))


def _read_layout(folder: Path, parameters: KitParameters) -> KitLayout:
    try:
        layout = json.loads((folder / _LAYOUT).read_text())
        return KitLayout(
            dataclasses.replace(parameters, length=layout["length"], width=layout["width"]),
            tuple(CavityPose(**pose) for pose in layout["poses"]),
        )
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise UserError(f"{folder / _LAYOUT} is damaged: delete {folder}") from error


def _content_key(tools: Sequence[Tool], parameters: KitParameters) -> str:
    digest = hashlib.sha256(f"{_FORMAT_VERSION} {parameters}".encode())
    for tool in tools:
        digest.update(f"{tool.category} {tool.height!r} {tool.scale!r} {tool.grasp}".encode())
        for path in tool.visual_meshes:
            digest.update(path.read_bytes())
    return digest.hexdigest()[:24]


_LAYOUT = "layout.json"
_FILES = ("kit.obj", "contact.obj", "block.obj", "cavities.obj", "kit.sdf", _LAYOUT)

_SDF = """<?xml version="1.0"?>
<sdf version="1.9" xmlns:drake="http://drake.mit.edu">
  <model name="kit">
    <link name="kit">
      <visual name="block">
        <geometry><mesh><uri>block.obj</uri></mesh></geometry>
        <material><diffuse>0.17 0.18 0.20 1</diffuse></material>
      </visual>
      <visual name="cavities">
        <geometry><mesh><uri>cavities.obj</uri></mesh></geometry>
        <material><diffuse>0.95 0.62 0.10 1</diffuse></material>
      </visual>
      <collision name="kit">
        <geometry><mesh><uri>contact.obj</uri></mesh></geometry>
        <drake:proximity_properties>
          <drake:rigid_hydroelastic/>
          <drake:hunt_crossley_dissipation>5.0</drake:hunt_crossley_dissipation>
          <drake:mu_static>0.3</drake:mu_static>
          <drake:mu_dynamic>0.3</drake:mu_dynamic>
        </drake:proximity_properties>
      </collision>
    </link>
  </model>
</sdf>
"""


def _write(tools: Sequence[Tool], layout: KitLayout, directory: Path) -> None:
    parameters = layout.parameters
    cavities = kit_cavities(tools, parameters, layout.poses)
    block = build_block(cavities, parameters)
    mesh = block.to_mesh()
    # Vertices that the file's digits cannot tell apart are one, or the surface would have seams.
    rounded = np.round(np.asarray(mesh.vert_properties, dtype=float)[:, :3], _DIGITS) + 0.0
    vertices, index = np.unique(rounded, axis=0, return_inverse=True)
    faces = index[np.asarray(mesh.tri_verts, dtype=int)]
    a, b, c = faces.T
    faces = faces[(a != b) & (b != c) & (c != a)]
    _write_obj(directory / "kit.obj", vertices, faces, normals=False)
    _write_obj(directory / "contact.obj", *contact_surface(cavities, parameters), normals=False)
    # Two colours, as tool foam has: what is inside the block's faces is a cavity.
    bounds = np.array(block.bounding_box()).reshape(2, 3)
    centres = vertices[faces].mean(axis=1)
    on_hull = np.isclose(centres[:, None], bounds[None], atol=1e-6).any(axis=(1, 2))
    _write_obj(directory / "block.obj", vertices, faces[on_hull], normals=True)
    _write_obj(directory / "cavities.obj", vertices, faces[~on_hull], normals=True)
    (directory / "kit.sdf").write_text(_SDF)
    described = {"length": parameters.length, "width": parameters.width}
    poses = [dataclasses.asdict(pose) for pose in layout.poses]
    (directory / _LAYOUT).write_text(json.dumps({**described, "poses": poses}, indent=2) + "\n")


def _write_obj(
    path: Path, vertices: NDArray[np.float64], faces: NDArray[np.int64], *, normals: bool
) -> None:
    lines = [f"v {x:.{_DIGITS}f} {y:.{_DIGITS}f} {z:.{_DIGITS}f}" for x, y, z in vertices]
    if normals:
        a, b, c = np.moveaxis(vertices[faces], 1, 0)
        normal = np.cross(b - a, c - a)
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-30)
        lines += [f"vn {x:.4f} {y:.4f} {z:.4f}" for x, y, z in normal]
        lines += [f"f {i}//{n} {j}//{n} {k}//{n}" for n, (i, j, k) in enumerate(faces + 1, start=1)]
    else:
        lines += [f"f {i} {j} {k}" for i, j, k in faces + 1]
    path.write_text("\n".join(lines) + "\n")
