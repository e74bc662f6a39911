"""All grasps of a tool: the annotated one, and proposals computed from its surface."""

import hashlib
import json
import xml.etree.ElementTree as ElementTree
from dataclasses import astuple

import numpy as np
from numpy.typing import NDArray

from kitting_drake.common.cached_folder import cached_folder
from kitting_drake.common.errors import UserError
from kitting_drake.common.paths import cache_directory
from kitting_drake.hkd.grasps.holds import WIDEST
from kitting_drake.hkd.grasps.proposals import propose_grasps
from kitting_drake.hkd.tools.tool import Tool
from systems.grasp import Grasp
from systems.grip_force import GRAVITY

_FORMAT_VERSION = "1"
"""The version of the files in the cache. Increase it when the same tool gives different grasps."""
_FILE = "grasps.json"
_EASY_MOMENT = 0.18
"""The grip easily withstands this moment about the axis through both pads, in N m."""
_WORST = 12.5
"""The cost (`GraspProposal.cost`) above which proposals are left out."""


def all_grasps(tool: Tool) -> tuple[Grasp, ...]:
    """Returns the annotated grasp and then the proposals, best first.

    Computing proposals takes a second or two, so they are stored in the cache. The proposals of a
    scaled tool are those of the unscaled tool, scaled.

    Raises:
        UserError: a mesh or the model cannot be read, or the cache cannot be written.
    """
    com = _center_of_mass(tool) / tool.scale
    digest = hashlib.sha256(f"{_FORMAT_VERSION} {com.round(9).tolist()}".encode())
    for path in tool.visual_meshes:
        digest.update(path.read_bytes())
    folder = cached_folder(
        cache_directory() / "grasps" / digest.hexdigest()[:24],
        [_FILE],
        lambda scratch: (scratch / _FILE).write_text(json.dumps(_proposals(tool, com))),
    )
    try:
        rows = json.loads((folder / _FILE).read_text())
        unscaled = [Grasp(*map(float, row)) for row in rows]
    except (OSError, ValueError, TypeError) as error:
        raise UserError(
            f"{folder / _FILE} is damaged: delete the folder {folder}, and it is made again"
        ) from error
    s = tool.scale
    proposed = [
        Grasp(s * g.x, s * g.y, g.theta, s * g.width, s * g.surface_height) for g in unscaled
    ]
    return (tool.grasp, *(grasp for grasp in proposed if grasp.width <= WIDEST))


def carrying_grasps(tool: Tool) -> tuple[Grasp, ...]:
    """Returns the grasps by which to carry a tool, best first.

    A heavy tool that is gripped far from its centre of mass turns between the pads. If the weight's
    moment about the pads is at most `_EASY_MOMENT` at the annotated grasp, `tool.grasps` are
    returned. Otherwise, the grasps of `all_grasps` are returned, sorted by how much the moment at
    each of them exceeds `_EASY_MOMENT`, least first.

    Raises:
        UserError: as for `all_grasps`.
    """
    com = _center_of_mass(tool)

    def excess(grasp: Grasp) -> float:
        along = np.array([np.cos(grasp.theta), np.sin(grasp.theta)])
        lever = abs(float((com[:2] - (grasp.x, grasp.y)) @ along))
        return max(GRAVITY * tool.mass * lever - _EASY_MOMENT, 0.0)

    if not excess(tool.grasp):
        return tool.grasps
    return tuple(sorted(all_grasps(tool), key=excess))


def _proposals(tool: Tool, com: NDArray[np.float64]) -> list[list[float]]:
    proposals = propose_grasps(tool.triangles / tool.scale, com)
    return [list(astuple(item.grasp)) for item in proposals if item.cost <= _WORST]


def _center_of_mass(tool: Tool) -> NDArray[np.float64]:
    """Returns the centre of mass (3,) in T, in metres."""
    try:
        pose = ElementTree.parse(tool.sdf).getroot().findtext(".//inertial/pose", "0 0 0")
        return np.array([float(word) for word in pose.split()[:3]])
    except (OSError, ElementTree.ParseError, ValueError) as error:
        raise UserError(f"{tool.sdf} cannot be read: {error}") from error
