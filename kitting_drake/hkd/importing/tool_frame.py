"""Moves a solid into the tool frame: in a stable pose, along x, with its working end toward +x."""

import numpy as np
import trimesh
from manifold3d import CrossSection, Manifold
from numpy.typing import NDArray
from scipy.spatial import QhullError

from kitting_drake.common.errors import UserError
from kitting_drake.hkd.tools import meshes
from kitting_drake.hkd.tools.stable_pose import StablePose, stable_poses

Array = NDArray[np.float64]

# These numbers are for a solid about 180 mm long. Stable poses count as equally low if their
# centres of mass are within `_EQUAL_HEIGHT_MM` of the lowest one. Of these, the pose with the
# broadest support is chosen. Supports are compared after rounding to multiples of
# `_MARGIN_STEP_MM`.
_EQUAL_HEIGHT_MM, _MARGIN_STEP_MM = 0.3, 0.5
# A tool's direction is found by votes of its edges: each edge votes for the directions near its
# own, with a Gaussian weight. `_SIDEWAYS_DEG` is the largest angle between the result and the axis
# of least inertia, and `_LIKE_DEG` the standard deviation of the Gaussian.
_SIDEWAYS_DEG, _LIKE_DEG = 25.0, 6.0
_END = 0.3
"""The length of each of a tool's two ends, as a share of the tool's length."""


def to_tool_frame(solid: Manifold, category: str) -> Manifold:
    """Moves a solid (in mm) into the frame T of a tool of the given category; see `Tool`.

    The pose is the stable pose with the lowest centre of mass. For a hammer, the working end is the
    wider end; for a wrench, the end nearer to the centre of mass; and for any other tool, the
    narrower end.

    Raises:
        UserError: the solid is flat or has no stable pose.
    """
    vertices, faces = meshes.vertices_and_faces(solid)
    com = trimesh.triangles.mass_properties(vertices[faces])["center_mass"]
    pose = _lowest_pose(vertices, com)
    R_TB = pose.rotation(forward=np.eye(3)[np.abs(pose.normal).argmin()])
    solid = solid.transform(np.column_stack([R_TB, np.zeros(3)]))
    return facing_forward(solid.rotate((0.0, 0.0, -long_direction_deg(solid.project()))), category)


def facing_forward(solid: Manifold, category: str) -> Manifold:
    """Moves a solid (in mm) that rests along x into the tool frame T, with its working end toward
    +x.

    `to_tool_frame` says which end is the working end.
    """
    if not _works_at_plus_x(solid, category):
        solid = solid.rotate((0.0, 0.0, 180.0))
    return centred(solid)


def tipping_deg(solid: Manifold) -> float:
    """Returns the tilt of the table, in degrees, at which a solid (in mm) at rest tips over.

    It is 0 if the solid is not in a stable pose.
    """
    vertices, faces = meshes.vertices_and_faces(solid)
    com = trimesh.triangles.mass_properties(vertices[faces])["center_mass"]
    kept = [pose for pose in stable_poses(vertices, com) if pose.normal[2] < -0.999]
    return max((np.degrees(np.arctan2(p.margin, p.height)) for p in kept), default=0.0)


def centred(solid: Manifold) -> Manifold:
    """Moves a solid so that its bounding box is centred at x = y = 0 and its bottom is at z = 0."""
    low, high = np.array(solid.bounding_box()).reshape(2, 3)
    middle = (low + high) / 2
    return solid.translate((-middle[0], -middle[1], -low[2]))


def size(solid: Manifold) -> Array:
    """Returns the extents (3,) of a solid's bounding box."""
    low, high = np.array(solid.bounding_box()).reshape(2, 3)
    return high - low


def _lowest_pose(vertices: Array, com: Array) -> StablePose:
    """Returns the stable pose with the lowest centre of mass.

    Of equally low poses, it is the one with the broadest support.

    Raises:
        UserError: there is no stable pose.
    """
    try:
        poses = stable_poses(vertices, com)
    except (QhullError, ValueError) as error:
        raise UserError("the mesh encloses no volume: repair it first") from error
    if not poses:
        raise UserError("the mesh has no stable pose: repair it first")
    lowest = min(pose.height for pose in poses)
    good = [pose for pose in poses if pose.height < lowest + _EQUAL_HEIGHT_MM]
    # If poses are still equal, choose the one nearest to the pose in the file.
    return max(
        good,
        key=lambda pose: (round(pose.margin / _MARGIN_STEP_MM), -round(float(pose.normal[2]), 3)),
    )


def long_direction_deg(outline: CrossSection) -> float:
    """Returns the direction of an outline's length.

    Of the directions near the principal axis, this is the one in which most of the outline's edges
    run. The long edges of a handle therefore count more than a head or a jaw that sticks out to one
    side.

    Args:
        outline: an outline about 180 mm long.

    Returns:
        The angle from x, counter-clockwise, in degrees.
    """
    loops = outline.simplify(0.2).to_polygons()
    points = np.vstack([0.5 * (loop + np.roll(loop, -1, axis=0)) for loop in loops])
    edges = np.vstack([np.roll(loop, -1, axis=0) - loop for loop in loops])
    lengths = np.linalg.norm(edges, axis=1)
    angles = np.degrees(np.arctan2(edges[:, 1], edges[:, 0]))
    offsets = points - np.average(points, axis=0, weights=lengths)
    _, axes = np.linalg.eigh((offsets * lengths[:, None]).T @ offsets)
    axis = np.degrees(np.arctan2(axes[1, 1], axes[0, 1]))
    directions = axis + np.arange(-_SIDEWAYS_DEG, _SIDEWAYS_DEG, 0.25)
    apart = (directions[:, None] - angles + 90.0) % 180.0 - 90.0
    votes = np.exp(-0.5 * (apart / _LIKE_DEG) ** 2) @ lengths
    # Refine the best direction: average the directions of the edges near it.
    near = apart[int(np.argmax(votes))]
    weights = lengths * np.exp(-0.5 * (near / _LIKE_DEG) ** 2)
    return float(directions[int(np.argmax(votes))] - np.average(near, weights=weights))


def _works_at_plus_x(solid: Manifold, category: str) -> bool:
    low, high = np.array(solid.bounding_box()).reshape(2, 3)[:, 0]
    if category == "wrench":
        vertices, faces = meshes.vertices_and_faces(solid)
        com = trimesh.triangles.mass_properties(vertices[faces])["center_mass"]
        return bool(com[0] >= (low + high) / 2)
    outline, span = solid.project(), _END * (high - low)
    at_plus = _width(outline, high - span, high)
    at_minus = _width(outline, low, low + span)
    return at_plus >= at_minus if category == "hammer" else at_plus <= at_minus


def _width(outline: CrossSection, start: float, end: float) -> float:
    """Returns the mean width of the hull of an outline between two positions along x."""
    y_min, y_max = outline.bounds()[1], outline.bounds()[3]
    band = CrossSection.square((end - start, y_max - y_min)).translate((start, y_min))
    return float((outline ^ band).hull().area() / (end - start))
