"""Kits: a block with a conformal cavity for each tool (section IV-B.2 of the paper).

The paper takes a depth image of the tool from above, fills what lies beneath it, closes the result
morphologically, grows it by 2 mm and subtracts it from the block; its authors then cut upward, so
that the tool can get in. A depth image filled downward and cut upward is a prism over the tool's
outline. So the outline is taken exactly, as polygons, and closed and grown exactly, by offsetting:
the same cavity without the voxels, their steps, and the smoothing that has to hide them.
"""

import hashlib
import os
import shutil
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from manifold3d import CrossSection, JoinType, Manifold, Mesh, triangulate
from numpy.typing import NDArray

from kitting_drake.errors import UserError
from kitting_drake.hkd.tool import Tool
from kitting_drake.paths import cache_directory
from systems.bounds import bounded

SLOTS = {
    "hammer": (0.02, 0.03),
    "pliers": (0.0, -0.03),
    "wrench": (0.0, -0.09),
    "screwdriver": (0.0, 0.09),
}
"""Where the tool of each category goes: (x, y) of its frame T in the kit frame, in metres."""

_ARC_SEGMENTS = 64
_FORMAT_VERSION = "2"


@dataclass
class KitParameters:
    """The template of the kit block. Lengths in m."""

    # The block's extents along x, y and z.
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


@dataclass(frozen=True)
class Kit:
    """A kit block on disk.

    The kit frame K: z up, the origin amid the block's bottom, x along its length.
    """

    sdf: Path
    """A model with one link `kit` whose body frame is K."""
    parameters: KitParameters
    tools: tuple[Tool, ...]

    def goal(self, index: int) -> tuple[float, float, float]:
        """Where the frame T of tool `index` belongs, (x, y, z) in K, unturned, in metres."""
        return cavity_place(self.tools[index], self.parameters)


def cavity_place(tool: Tool, parameters: KitParameters) -> tuple[float, float, float]:
    """(x, y, z) of a seated tool's frame in the kit frame: its top is flush with the block's."""
    x, y = SLOTS[tool.category]
    return x, y, parameters.height - tool.height


def cavity_outline(outline: CrossSection, parameters: KitParameters) -> CrossSection:
    """The outline of a tool, closed and grown by the clearance."""
    closing, clearance = parameters.closing_radius, parameters.clearance
    # Simplified first and last only: each time costs up to the tolerance.
    grown = outline.simplify(parameters.tolerance / 4).offset(
        closing + clearance, JoinType.Round, circular_segments=_ARC_SEGMENTS
    )
    closed = grown.offset(-closing, JoinType.Round, circular_segments=_ARC_SEGMENTS)
    return closed.simplify(parameters.tolerance)


def cavity_cutter(outline: CrossSection, depth: float, lead_in: float) -> Manifold:
    """The solid to subtract: a prism down to z = -depth whose rim, at z = 0, is bevelled.

    Args:
        outline: of the wall, in metres.
        depth: of the floor, in metres.
        lead_in: width and depth of the bevel; none at zero.
    """
    above = 0.01
    if lead_in <= 0:
        return Manifold.extrude(outline, depth + above).translate((0, 0, -depth))
    rim = outline.offset(lead_in, JoinType.Round, circular_segments=_ARC_SEGMENTS)
    wall_loops, rim_loops = outline.to_polygons(), rim.to_polygons()
    vertices: list[NDArray[np.float64]] = []
    faces: list[NDArray[np.int64]] = []

    def ring(loops: list[NDArray[np.float64]], z: float) -> int:
        start = sum(map(len, vertices))
        flat = np.concatenate(loops)
        vertices.append(np.column_stack([flat, np.full(len(flat), z)]))
        return start

    def walls(loops: list[NDArray[np.float64]], lower: int, upper: int) -> None:
        start = 0
        for loop in loops:
            here = start + np.arange(len(loop))
            there = start + (np.arange(len(loop)) + 1) % len(loop)
            faces.append(np.column_stack([lower + here, lower + there, upper + there]))
            faces.append(np.column_stack([lower + here, upper + there, upper + here]))
            start += len(loop)

    floor = ring(wall_loops, -depth)
    shoulder = ring(wall_loops, -lead_in)
    edge = ring(rim_loops, 0.0)
    top = ring(rim_loops, above)
    walls(wall_loops, floor, shoulder)
    walls(rim_loops, edge, top)
    faces.append(np.asarray(triangulate(wall_loops))[:, ::-1] + floor)
    faces.append(np.asarray(triangulate(rim_loops)) + top)
    # The bevel is the flat band between rim and wall, its inner vertices let down to the shoulder.
    band = np.asarray(triangulate(rim_loops + [loop[::-1] for loop in wall_loops]))
    rim_count = sum(map(len, rim_loops))
    # Reversed loops come out of the triangulation in reversed order.
    reversed_index = np.concatenate(
        [
            start + np.arange(len(loop))[::-1]
            for start, loop in zip(
                np.cumsum([0, *map(len, wall_loops[:-1])]), wall_loops, strict=True
            )
        ]
    )
    lookup = np.concatenate([edge + np.arange(rim_count), shoulder + reversed_index])
    faces.append(lookup[band][:, ::-1])
    mesh = Mesh(
        vert_properties=np.concatenate(vertices).astype(np.float32),
        tri_verts=np.concatenate(faces).astype(np.uint32),
    )
    return Manifold(mesh)


def build_block(tools: Sequence[Tool], parameters: KitParameters) -> Manifold:
    """The kit block in the frame K, in metres: watertight, one body.

    Raises:
        UserError: two tools of one category, a tool too big for its place, cavities that meet.
    """
    outlines: dict[str, CrossSection] = {}
    for tool in tools:
        if tool.category in {other.category for other in tools if other is not tool}:
            raise UserError(f"a kit holds one {tool.category}, not two")
        x, y, z = cavity_place(tool, parameters)
        if z < parameters.minimum_wall:
            raise UserError(
                f"'{tool.name}' is {1e3 * tool.height:.1f} mm high and leaves no floor in a kit "
                f"block of {1e3 * parameters.height:.1f} mm"
            )
        outlines[tool.name] = cavity_outline(tool.silhouette, parameters).translate((x, y))
    _check_walls(outlines, parameters)
    block = Manifold.cube((parameters.length, parameters.width, parameters.height), True)
    cutters = [
        cavity_cutter(outlines[tool.name], tool.height, parameters.lead_in) for tool in tools
    ]
    top = parameters.height / 2
    for cutter in cutters:
        block -= cutter.translate((0, 0, top))
    return block.translate((0, 0, top))


def _check_walls(outlines: dict[str, CrossSection], parameters: KitParameters) -> None:
    half_wall = parameters.minimum_wall / 2 + parameters.lead_in
    grown = {
        name: outline.offset(half_wall, JoinType.Round, circular_segments=_ARC_SEGMENTS)
        for name, outline in outlines.items()
    }
    room = CrossSection.square((parameters.length, parameters.width), True)
    names = list(grown)
    for index, name in enumerate(names):
        if (grown[name] - room).area() > 1e-9:
            raise UserError(f"the cavity of '{name}' does not fit into the kit block")
        for other in names[index + 1 :]:
            if (grown[name] ^ grown[other]).area() > 1e-9:
                raise UserError(f"the cavities of '{name}' and '{other}' meet in the kit block")


def make_kit(tools: Sequence[Tool], parameters: KitParameters) -> Kit:
    """The kit for these tools, from the cache, or built and put there.

    The cache goes by content, so a changed tool or parameter makes another kit. A kit appears there
    whole or not at all, and two processes that build the same one do not disturb each other.

    Raises:
        UserError: the tools make no kit; see `build_block`.
    """
    final = cache_directory() / "kits" / _content_key(tools, parameters)
    kit = Kit(sdf=final / "kit.sdf", parameters=parameters, tools=tuple(tools))
    if final.is_dir():
        return kit
    block = build_block(tools, parameters)
    final.parent.mkdir(parents=True, exist_ok=True)
    scratch = Path(tempfile.mkdtemp(dir=final.parent, prefix=".making-"))
    try:
        _write(block, scratch)
        os.rename(scratch, final)
    except OSError:
        if not final.is_dir():
            raise
        # Another process was quicker; its kit is the same.
    finally:
        shutil.rmtree(scratch, ignore_errors=True)
    return kit


def _content_key(tools: Sequence[Tool], parameters: KitParameters) -> str:
    digest = hashlib.sha256(f"{_FORMAT_VERSION} {parameters}".encode())
    for tool in tools:
        digest.update(f"{tool.category} {tool.height!r}".encode())
        for path in tool.visual_meshes:
            digest.update(path.read_bytes())
    return digest.hexdigest()[:24]


_SDF = """<?xml version="1.0"?>
<sdf version="1.9" xmlns:drake="http://drake.mit.edu">
  <model name="kit">
    <link name="kit">
      <visual name="block">
        <geometry><mesh><uri>block.obj</uri></mesh></geometry>
        <material><diffuse>0.13 0.14 0.16 1</diffuse></material>
      </visual>
      <visual name="cavities">
        <geometry><mesh><uri>cavities.obj</uri></mesh></geometry>
        <material><diffuse>0.95 0.62 0.10 1</diffuse></material>
      </visual>
      <collision name="kit">
        <geometry><mesh><uri>kit.obj</uri></mesh></geometry>
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


def _write(block: Manifold, directory: Path) -> None:
    mesh = block.to_mesh()
    vertices = np.asarray(mesh.vert_properties, dtype=float)[:, :3]
    faces = np.asarray(mesh.tri_verts, dtype=int)
    _write_obj(directory / "kit.obj", vertices, faces, normals=False)
    # Two colours, as tool foam has: what is inside the block's faces is a cavity.
    bounds = np.array(block.bounding_box()).reshape(2, 3)
    centres = vertices[faces].mean(axis=1)
    on_hull = np.isclose(centres[:, None], bounds[None], atol=1e-6).any(axis=(1, 2))
    _write_obj(directory / "block.obj", vertices, faces[on_hull], normals=True)
    _write_obj(directory / "cavities.obj", vertices, faces[~on_hull], normals=True)
    (directory / "kit.sdf").write_text(_SDF)


def _write_obj(
    path: Path, vertices: NDArray[np.float64], faces: NDArray[np.int64], *, normals: bool
) -> None:
    lines = [f"v {x:.7f} {y:.7f} {z:.7f}" for x, y, z in vertices]
    if normals:
        a, b, c = np.moveaxis(vertices[faces], 1, 0)
        normal = np.cross(b - a, c - a)
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-30)
        lines += [f"vn {x:.4f} {y:.4f} {z:.4f}" for x, y, z in normal]
        lines += [f"f {i}//{n} {j}//{n} {k}//{n}" for n, (i, j, k) in enumerate(faces + 1, start=1)]
    else:
        lines += [f"f {i} {j} {k}" for i, j, k in faces + 1]
    path.write_text("\n".join(lines) + "\n")
