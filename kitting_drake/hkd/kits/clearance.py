"""Measures the clearance of a seated tool in its cavity, on the built block."""

from dataclasses import dataclass

import numpy as np
from manifold3d import CrossSection, Manifold
from numpy.typing import NDArray

from kitting_drake.hkd.kits.layout import CavityPose, moved_outline, slot_pose
from kitting_drake.hkd.kits.parameters import KitParameters
from kitting_drake.hkd.tools.tool import Tool

_STEP = 0.00025
"""The spacing of the measured points along a tool's outline, in metres."""


@dataclass(frozen=True)
class Clearance:
    """The distance between a seated tool's outline and its cavity's wall, in metres."""

    median: float
    minimum: float


def measure_clearance(
    block: Manifold, tool: Tool, parameters: KitParameters, pose: CavityPose | None = None
) -> Clearance:
    """Measures the clearance along the whole outline of a seated tool.

    The outline is that of the tool's visual mesh. The wall is a horizontal slice of the block,
    halfway between floor and bevel. The clearance of a point of the outline is its distance from
    the nearest wall. Points inside narrow notches of the tool are measured too, although the wall
    bridges these notches.

    Args:
        block: the kit's block, in the kit frame K.
        tool: the tool to seat.
        parameters: the parameters of the kit.
        pose: the pose of the seated tool in K; by default the slot of its category.

    Raises:
        ValueError: the seated tool is not inside a cavity.
    """
    pose = slot_pose(tool, parameters) if pose is None else pose
    level = (pose.z + parameters.height - parameters.lead_in) / 2
    solid = block.slice(level)
    outline = moved_outline(tool.footprint, pose)
    if (outline ^ solid).area() > 1e-9:
        raise ValueError(f"'{tool.name}' does not fit into its cavity")
    points = np.concatenate([_points_along(loop) for loop in outline.to_polygons()])
    distances = _distances(points, solid)
    return Clearance(float(np.median(distances)), float(distances.min()))


def _points_along(loop: NDArray[np.float64]) -> NDArray[np.float64]:
    closed = np.concatenate([loop, loop[:1]])
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(closed, axis=0), axis=1))])
    at = np.arange(0.0, along[-1], _STEP)
    return np.column_stack([np.interp(at, along, closed[:, axis]) for axis in (0, 1)])


def _distances(points: NDArray[np.float64], shape: CrossSection) -> NDArray[np.float64]:
    """Returns the distance (n) of points (n, 2) from the nearest edge of a shape."""
    nearest = np.full(len(points), np.inf)
    for loop in shape.to_polygons():
        for start, end in zip(loop, np.roll(loop, -1, axis=0), strict=True):
            edge = end - start
            share = np.clip((points - start) @ edge / (edge @ edge), 0.0, 1.0)
            offset = points - start - share[:, None] * edge
            np.minimum(nearest, np.linalg.norm(offset, axis=1), out=nearest)
    return nearest
