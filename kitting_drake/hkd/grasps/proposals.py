"""Grasp proposals computed from a tool's surface (section IV-B.3 of the paper).

The hand comes from above, and its jaws close on the part of the surface between them that stands
out farthest. For a rotation theta of the hand and a position u along its pads, only the tool's
extents to the left and right at each height matter. Horizontal slices of the tool give these
extents. The position along the closing direction follows from them, because a grasp is centred
between the gripped faces.
"""

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from kitting_drake.hkd.grasps.grip import find_grip, jaw_axes
from kitting_drake.hkd.grasps.holds import (
    BIN,
    FINGER_COLUMNS,
    Hold,
    find_holds,
    reach_of,
)
from systems.grasp import Grasp
from systems.hand_geometry import FINGER_LENGTH, FINGERTIP_DEPTH, PAD_LENGTH
from systems.pick_place_parameters import PickPlaceParameters

Array = NDArray[np.float64]

# Lengths are in metres.
PLANNER = PickPlaceParameters()
"""The default parameters of the planner, for which tools are annotated and kits are laid out."""
GRASP_DEPTH = PLANNER.grasp_depth
"""The depth of the pads' lower edges below the tool's top."""
FLOOR_CLEARANCE = PLANNER.floor_clearance
"""The least height of the pads above the table."""
RELEASE_REACH = PLANNER.release_clearance + FINGERTIP_DEPTH
"""The distance beyond the gripped faces that the fingertips need when they release."""

# A pad touches the parts of a face that are at most this far behind the face's foremost point. The
# first value is for the fine search, the second one for the coarse search.
_TOUCH = 0.0003
_COARSE_TOUCH = 0.0008
# In a kit, the neighbouring tools are assumed to be this far from the middle of a tool.
_LANE = 0.040

_STEP = 0.001
_COARSE_DEG, _FINE_DEG = 5.0, 0.5
_MOST_PROPOSALS = 12
# A proposal is dropped if it differs from a better one by less than these limits, in position (m)
# and in rotation (rad).
_DISTINCT, _DISTINCT_ANGLE = 0.012, np.radians(20.0)


@dataclass(frozen=True)
class GraspProposal(Grasp):
    """A grasp in frame T, with the measures by which proposals are ranked."""

    offset: float
    """The horizontal distance between the centre of mass and the grasp, in metres."""
    contact: float
    """The share of the pads' length, 0 to 1, along which both pads touch the tool."""
    depth: float
    """The mean height over which a pad touches the tool, as a share of the grasp depth, 0 to 1."""
    slope: float
    """The inward lean of the gripped faces at the pads' lower edges, in radians."""
    overhang: float
    """How far any part of the tool between the fingers stands out beyond the gripped faces, in
    metres."""
    penalties: dict[str, float] = field(default_factory=dict)
    """The terms of the cost, by their causes."""

    @property
    def cost(self) -> float:
        """The sum of the penalties, by which proposals are ranked. A cost above 3 is poor."""
        return sum(self.penalties.values())

    @property
    def grasp(self) -> Grasp:
        """The grasp without its measures."""
        return Grasp(self.x, self.y, self.theta, self.width, self.surface_height)


def propose_grasps(
    triangles: Array,
    center_of_mass: Array,
    planner: PickPlaceParameters = PLANNER,
    *,
    corners: bool = False,
) -> list[GraspProposal]:
    """Proposes grasps from above, best first. The list is empty if the hand cannot hold the tool.

    A triangle, a pentagon or a star has no two parallel faces for the pads, and is held at a
    corner. The soft pad yields to the corner, and the face or the two points under the other pad
    keep the tool from turning.

    Args:
        triangles: (n, 3, 3) the surface in frame T, in metres, with the table at z = 0.
        center_of_mass: (2,) or (3,) in T, in metres.
        planner: the planner's parameters; the pads' depth, their clearance to the table and the
            release clearance are used.
        corners: whether grasps at a corner compete with those between faces. If not, they are
            proposed only for a tool that has no other grasp.
    """
    found = _propose(triangles, center_of_mass, planner, corners=corners)
    return found or _propose(triangles, center_of_mass, planner, corners=True)


def _propose(
    triangles: Array, center_of_mass: Array, planner: PickPlaceParameters, *, corners: bool
) -> list[GraspProposal]:
    """Does the work of `propose_grasps`, either with grasps at a corner or without."""
    height = float(triangles[:, :, 2].max())
    if not height > planner.floor_clearance:
        return []
    levels = _levels(height)
    points, level = _slices(triangles, levels)
    if not len(points):
        return []
    com = np.asarray(center_of_mass, dtype=float)[:2]

    # Search half a turn only: a rotation by pi swaps the two jaws, which are alike.
    found: list[GraspProposal] = []
    for theta in np.radians(np.arange(-90.0, 90.0, _COARSE_DEG)):
        found += _search(points, level, levels, com, float(theta), _COARSE_TOUCH, planner, corners)
    fine = np.radians(np.arange(-_COARSE_DEG / 2, _COARSE_DEG / 2 + 1e-9, _FINE_DEG))
    result = []
    for coarse in _distinct(found):
        place = np.array([coarse.x, coarse.y])
        near: list[GraspProposal] = []
        for theta in coarse.theta + fine:
            near += _search(
                points, level, levels, com, float(theta), _TOUCH, planner, corners, place
            )
        if near:
            result.append(min(near, key=lambda p: p.cost))
    # Measure heights on the triangles, because the slices are too far apart for exact heights.
    result = [replace(p, surface_height=_top(triangles, p)) for p in result]
    return sorted(result, key=lambda p: p.cost)


def _top(triangles: Array, grasp: Grasp) -> float:
    grip = find_grip(triangles, grasp.x, grasp.y, grasp.theta, PAD_LENGTH)
    return grasp.surface_height if grip is None else grip.top


def _levels(height: float) -> Array:
    step = min(0.001, height / 12)
    return (np.arange(np.ceil(height / step - 1e-9), dtype=float) + 0.5) * step


def _slices(triangles: Array, levels: Array) -> tuple[Array, NDArray[np.int64]]:
    """Returns points (n, 2) on the outlines of the horizontal slices, and the index (n) of each
    point's slice."""
    all_points, all_levels = [np.empty((0, 2))], [np.empty(0, dtype=np.int64)]
    low, high = triangles[:, :, 2].min(axis=1), triangles[:, :, 2].max(axis=1)
    for index, z in enumerate(levels):
        cut = triangles[(low < z) & (high >= z)]
        a, b = cut, np.roll(cut, -1, axis=1)
        crosses = (a[..., 2] < z) != (b[..., 2] < z)
        rise = np.where(crosses, b[..., 2] - a[..., 2], 1.0)
        share = ((z - a[..., 2]) / rise)[..., None]
        ends = (a + share * (b - a))[crosses][:, :2].reshape(-1, 2, 2)
        counts = np.ceil(np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1) / (0.6 * BIN))
        counts = counts.astype(int) + 2
        which = np.repeat(np.arange(len(ends)), counts)
        order = np.arange(len(which)) - np.repeat(np.cumsum(counts) - counts, counts)
        t = (order / (counts[which] - 1))[:, None]
        all_points.append((1 - t) * ends[which, 0] + t * ends[which, 1])
        all_levels.append(np.full(len(which), index))
    return np.concatenate(all_points), np.concatenate(all_levels)


def _search(
    points: Array,
    level: NDArray[np.int64],
    levels: Array,
    com: Array,
    theta: float,
    touch: float,
    planner: PickPlaceParameters,
    corners: bool,
    near: Array | None = None,
) -> list[GraspProposal]:
    """Returns the acceptable grasps at one rotation of the hand.

    Args:
        points: (n, 2) points of the slices.
        level: (n) the index of each point's slice.
        levels: the heights of the slices, in metres.
        com: (2,) the centre of mass in T, in metres.
        theta: the rotation of the hand, in radians.
        touch: a pad touches the parts of a face that are at most this far behind the face's
            foremost point, in metres.
        planner: the planner's parameters.
        corners: whether a corner may be held.
        near: (2,) the point in T near which to search; None searches along the whole tool.
    """
    reach = reach_of(points, level, levels, theta)
    first, last = FINGER_COLUMNS, len(reach.left) - FINGER_COLUMNS
    if near is None:
        centres = np.arange(first, last, round(_STEP / BIN))
    else:
        along, _ = jaw_axes(theta)
        centres = round((float(near @ along) - reach.u_min) / BIN) + np.arange(-4, 5, 2)
        centres = centres[(centres >= first) & (centres < last)]
    return [
        _proposal(hold, reach.u_min + centre * BIN, theta, com, planner)
        for centre, hold in find_holds(reach, centres, touch, planner, corners=corners)
    ]


def _proposal(
    hold: Hold, u: float, theta: float, com: Array, planner: PickPlaceParameters
) -> GraspProposal:
    """Makes a proposal from a hold, and computes its penalties. The pads' middle is at `u`."""
    along, across = jaw_axes(theta)
    x, y = u * along + hold.middle * across
    lever = abs(u - float(com @ along))
    aside = abs(hold.middle - float(com @ across))
    release_reach = planner.release_clearance + FINGERTIP_DEPTH
    fingers = (
        abs(y)
        + (hold.width / 2 + release_reach) * abs(np.cos(theta))
        + (FINGER_LENGTH / 2 * abs(np.sin(theta)))
    )
    penalties = {
        "centre of mass": lever / 0.025 + (lever / 0.040) ** 2 + aside / 0.100,
        "contact along the pads": 1.2 * (1 - hold.contact),
        "contact down the pads": 0.6 * (1 - hold.depth),
        "slope": (hold.slope / np.radians(18.0)) ** 2,
        "overhang": max(hold.overhang, 0.0) / 0.003,
        "twist": hold.twist / 0.009,
        "narrow": max(0.0, 0.008 - hold.width) / 0.005,
        "wide": max(0.0, hold.width - 0.030) / 0.015,
        "neighbour in the kit": max(0.0, fingers - _LANE) / 0.015,
    }
    if hold.corner:
        penalties["corner"] = hold.corner
    return GraspProposal(
        x=float(x),
        y=float(y),
        theta=float((theta + np.pi / 2) % np.pi - np.pi / 2),
        width=hold.width,
        surface_height=hold.top,
        offset=float(np.hypot(lever, aside)),
        contact=hold.contact,
        depth=hold.depth,
        slope=hold.slope,
        overhang=hold.overhang,
        penalties={cause: float(value) for cause, value in penalties.items()},
    )


def _distinct(proposals: list[GraspProposal]) -> list[GraspProposal]:
    kept: list[GraspProposal] = []
    for proposal in sorted(proposals, key=lambda p: p.cost):
        for other in kept:
            rotation = (proposal.theta - other.theta + np.pi / 2) % np.pi - np.pi / 2
            distance = np.hypot(proposal.x - other.x, proposal.y - other.y)
            if distance < _DISTINCT and abs(rotation) < _DISTINCT_ANGLE:
                break
        else:
            kept.append(proposal)
            if len(kept) == _MOST_PROPOSALS:
                break
    return kept
