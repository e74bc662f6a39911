"""Kits: blocks with a conformal cavity for each tool (section IV-B.2 of the paper).

The paper takes a depth image of the tool from above. It fills the image downward, closes it
morphologically, grows it by 2 mm and subtracts it from the block; then it cuts the cavity open to
the top. The result is a prism over the tool's outline. This module builds the same prism from the
exact outline, which it closes and grows by polygon offsetting. This needs no voxels and no
smoothing.
"""

import dataclasses
import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from kitting_drake.common.cached_folder import cached_folder
from kitting_drake.common.errors import UserError
from kitting_drake.common.paths import cache_directory
from kitting_drake.hkd.kits.block import build_block, contact_surfaces
from kitting_drake.hkd.kits.layout import CavityPose, KitLayout, kit_cavities, layout_kit
from kitting_drake.hkd.kits.parameters import KitParameters
from kitting_drake.hkd.tools.meshes import flat_obj
from kitting_drake.hkd.tools.tool import Tool

_DIGITS = 7
"""The number of decimals of coordinates in files."""
_FORMAT_VERSION = "9"
"""The version of the files in the cache. Increase it when the same tools, parameters and poses give
a different kit."""


@dataclass(frozen=True)
class Kit:
    """A kit block on disk.

    The kit frame K has z up, x along the block's length, and its origin in the centre of the
    block's bottom.
    """

    sdf: Path
    """The SDFormat file of the block: one link `kit`, whose frame is K."""
    tools: tuple[Tool, ...]
    layout: KitLayout

    @property
    def parameters(self) -> KitParameters:
        """The kit's parameters; their length and width are those of its block."""
        return self.layout.parameters

    @property
    def size(self) -> tuple[float, float, float]:
        """The block's extents along x, y and z of K, in metres."""
        return self.parameters.length, self.parameters.width, self.parameters.height

    def goal(self, index: int) -> CavityPose:
        """The goal pose of the tool frame T in K, for the tool with this index."""
        return self.layout.poses[index]


def make_kit(
    tools: Sequence[Tool], parameters: KitParameters, poses: Sequence[CavityPose] = ()
) -> Kit:
    """Makes a kit for tools, or loads it from the cache.

    The cache key is the content of the tools, parameters and poses. A kit appears in the cache
    atomically, so several processes may build the same kit at once.

    Args:
        tools: the tools.
        parameters: the parameters of the kit. `layout_kit` may choose another length and width.
        poses: the seated tools' poses, in the tools' order. If empty, `layout_kit` chooses them.

    Raises:
        UserError: the tools do not fit (see `layout_kit`), or the cache cannot be written.
    """

    def layout() -> KitLayout:
        if poses:
            return KitLayout(parameters, tuple(poses))
        return layout_kit(tools, parameters)

    folder = cached_folder(
        cache_directory() / "kits" / _content_key(tools, parameters, poses),
        _FILES,
        lambda scratch: _write(tools, layout(), scratch),
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
        raise UserError(
            f"{folder / _LAYOUT} is damaged: delete the folder {folder}, and it is made again"
        ) from error


def _content_key(
    tools: Sequence[Tool], parameters: KitParameters, poses: Sequence[CavityPose]
) -> str:
    placed = f" {tuple(poses)}" if poses else ""
    digest = hashlib.sha256(f"{_FORMAT_VERSION} {parameters}{placed}".encode())
    for tool in tools:
        digest.update(f"{tool.category} {tool.height!r} {tool.scale!r} {tool.grasp}".encode())
        for path in tool.visual_meshes:
            digest.update(path.read_bytes())
    return digest.hexdigest()[:24]


_LAYOUT = "layout.json"
_CONTACT = ("sides", "floors", "top", "outside")
_FILES = (
    "kit.obj",
    *(f"contact_{name}.obj" for name in _CONTACT),
    "block.obj",
    "cavities.obj",
    "kit.sdf",
    _LAYOUT,
)

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
{collisions}    </link>
  </model>
</sdf>
"""

_COLLISION = """      <collision name="{name}">
        <geometry><mesh><uri>contact_{name}.obj</uri></mesh></geometry>
        <drake:proximity_properties>
          <drake:rigid_hydroelastic/>
          <drake:hunt_crossley_dissipation>5.0</drake:hunt_crossley_dissipation>
          <drake:mu_static>0.3</drake:mu_static>
          <drake:mu_dynamic>0.3</drake:mu_dynamic>
        </drake:proximity_properties>
      </collision>
"""


def _write(tools: Sequence[Tool], layout: KitLayout, directory: Path) -> None:
    parameters = layout.parameters
    cavities = kit_cavities(tools, parameters, layout.poses)
    block = build_block(cavities, parameters)
    mesh = block.to_mesh()
    # Merge vertices that rounding makes equal. Separate vertices would leave cracks in the surface.
    rounded = np.round(np.asarray(mesh.vert_properties, dtype=float)[:, :3], _DIGITS) + 0.0
    vertices, index = np.unique(rounded, axis=0, return_inverse=True)
    faces = index[np.asarray(mesh.tri_verts, dtype=int)]
    a, b, c = faces.T
    faces = faces[(a != b) & (b != c) & (c != a)]
    (directory / "kit.obj").write_text(flat_obj(vertices, faces, digits=_DIGITS))
    for name, surface in contact_surfaces(cavities, parameters).items():
        (directory / f"contact_{name}.obj").write_text(flat_obj(*surface, digits=_DIGITS))
    # Use two colours: faces that are not on the block's bounding box belong to cavities.
    bounds = np.array(block.bounding_box()).reshape(2, 3)
    centres = vertices[faces].mean(axis=1)
    on_hull = np.isclose(centres[:, None], bounds[None], atol=1e-6).any(axis=(1, 2))
    for name, part in (("block", faces[on_hull]), ("cavities", faces[~on_hull])):
        text = flat_obj(vertices, part, digits=_DIGITS, normal_digits=4)
        (directory / f"{name}.obj").write_text(text)
    collisions = "".join(_COLLISION.format(name=name) for name in _CONTACT)
    (directory / "kit.sdf").write_text(_SDF.format(collisions=collisions))
    described = {"length": parameters.length, "width": parameters.width}
    poses = [dataclasses.asdict(pose) for pose in layout.poses]
    (directory / _LAYOUT).write_text(json.dumps({**described, "poses": poses}, indent=2) + "\n")
