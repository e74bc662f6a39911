"""Grasp proposals computed from a tool's surface (section IV-B.3 of the paper).

The jaws of a hand that comes from above close on whatever stands out furthest between them. So for
a turn theta of the hand and a place u along its pads, all that matters of the tool is how far it
reaches to either side, at each height: the tool's horizontal slices give that, and where the grasp
lies along the closing direction follows, because a grasp is amid the faces that it grips.
"""

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from kitting_drake.hkd.grasps.grip import find_grip, jaw_axes
from kitting_drake.hkd.tools.tool import Grasp
from systems.hand_geometry import FINGER_LENGTH, FINGERTIP_DEPTH, MAX_OPENING, PAD_LENGTH
from systems.pick_place_parameters import PickPlaceParameters

Array = NDArray[np.float64]

# Lengths in m, as everywhere here.
_PRIMITIVE = PickPlaceParameters()

GRASP_DEPTH = _PRIMITIVE.grasp_depth
"""How far the pads reach below the tool's top."""
FLOOR_CLEARANCE = _PRIMITIVE.floor_clearance
"""The pads are never lower than this above the table."""
WIDEST = MAX_OPENING - 0.015
"""What the jaws can take, with a margin on either side."""
NARROWEST = _PRIMITIVE.minimum_width
"""What the jaws can feel."""
RELEASE_REACH = _PRIMITIVE.release_clearance + FINGERTIP_DEPTH
"""How far the fingertips reach beyond the gripped faces as they let go."""

# Surface that stands back by less than this touches a pad.
_TOUCH = 0.0003
# The same while the hand is turned in coarse steps.
_COARSE_TOUCH = 0.0008
# The hand's upper fingers stand this much further out than its pads.
_FINGER_RECESS = 0.003
# Steeper than this, faces that narrow upward slip down out of the pads.
_STEEPEST = np.radians(28.0)
# The least share of the pads' length that touches on both sides at once.
_LEAST_CONTACT = 0.15
# From the middle of a tool in its kit to where a neighbour begins.
_LANE = 0.040

_BIN, _STEP = 0.0005, 0.001
_COARSE_DEG, _FINE_DEG = 5.0, 0.5
_MOST_PROPOSALS = 12
# Proposals nearer than this to a better one are left out.
_DISTINCT, _DISTINCT_ANGLE = 0.012, np.radians(20.0)


@dataclass(frozen=True)
class GraspProposal(Grasp):
    """A grasp in frame T with what speaks for and against it."""

    offset: float
    """Distance of the centre of mass from the grasp, seen from above, in metres."""
    contact: float
    """Share of the pads' length, 0 to 1, along which both of them touch."""
    depth: float
    """Share of the pads' reach below the tool's top, 0 to 1, over which both of them touch."""
    slope: float
    """How far the gripped faces lean where the pads' lower edges bear on them, in radians."""
    overhang: float
    """How far the tool stands out past the gripped faces beside the pads, in metres."""
    penalties: dict[str, float] = field(default_factory=dict)
    """What makes up the cost, by cause."""

    @property
    def cost(self) -> float:
        """By which proposals are ranked: none is perfect, above 3 is poor."""
        return sum(self.penalties.values())

    @property
    def grasp(self) -> Grasp:
        """The grasp alone."""
        return Grasp(self.x, self.y, self.theta, self.width, self.surface_height)


def propose_grasps(triangles: Array, center_of_mass: Array) -> list[GraspProposal]:
    """Grasps from above, the best first; empty if the hand can hold the tool nowhere.

    Args:
        triangles: (n, 3, 3) of the surface in frame T, in metres, the table at z = 0.
        center_of_mass: (2,) or (3,) in T, in metres.
    """
    height = float(triangles[:, :, 2].max())
    if not height > FLOOR_CLEARANCE:
        return []
    levels = _levels(height)
    points, level = _slices(triangles, levels)
    if not len(points):
        return []
    com = np.asarray(center_of_mass, dtype=float)[:2]

    # A turn by pi swaps the jaws, which are alike.
    found: list[GraspProposal] = []
    for theta in np.radians(np.arange(-90.0, 90.0, _COARSE_DEG)):
        found += _search(points, level, levels, com, float(theta), _COARSE_TOUCH)
    fine = np.radians(np.arange(-_COARSE_DEG / 2, _COARSE_DEG / 2 + 1e-9, _FINE_DEG))
    result = []
    for coarse in _distinct(found):
        place = np.array([coarse.x, coarse.y])
        near: list[GraspProposal] = []
        for theta in coarse.theta + fine:
            near += _search(points, level, levels, com, float(theta), _TOUCH, place)
        if near:
            result.append(min(near, key=lambda p: p.cost))
    # Heights from the slices are as coarse as their levels.
    result = [replace(p, surface_height=_top(triangles, p)) for p in result]
    return sorted(result, key=lambda p: p.cost)


def _top(triangles: Array, grasp: Grasp) -> float:
    grip = find_grip(triangles, grasp.x, grasp.y, grasp.theta, PAD_LENGTH)
    return grasp.surface_height if grip is None else grip.top


def _levels(height: float) -> Array:
    step = min(0.001, height / 12)
    return (np.arange(int(np.ceil(height / step - 1e-9))) + 0.5) * step


def _slices(triangles: Array, levels: Array) -> tuple[Array, NDArray[np.int64]]:
    """Points (n, 2) on the outlines of the horizontal slices, and the level of each."""
    all_points, all_levels = [np.empty((0, 2))], [np.empty(0, dtype=np.int64)]
    low, high = triangles[:, :, 2].min(axis=1), triangles[:, :, 2].max(axis=1)
    for index, z in enumerate(levels):
        cut = triangles[(low < z) & (high >= z)]
        a, b = cut, np.roll(cut, -1, axis=1)
        crosses = (a[..., 2] < z) != (b[..., 2] < z)
        rise = np.where(crosses, b[..., 2] - a[..., 2], 1.0)
        share = ((z - a[..., 2]) / rise)[..., None]
        ends = (a + share * (b - a))[crosses][:, :2].reshape(-1, 2, 2)
        counts = np.ceil(np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1) / (0.6 * _BIN))
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
    near: Array | None = None,
) -> list[GraspProposal]:
    """The acceptable grasps with one turn of the hand: along all of the tool, or about `near`.

    Surface that stands back by less than `touch` counts as touched.
    """
    along, across = jaw_axes(theta)
    u, v = points @ along, points @ across
    pad, finger = round(PAD_LENGTH / 2 / _BIN), round(FINGER_LENGTH / 2 / _BIN)
    u_min = u.min() - finger * _BIN
    columns = int((u.max() - u_min) / _BIN) + finger + 2
    bins = ((u - u_min) / _BIN).astype(int)
    left = np.full((columns, len(levels)), -np.inf)
    right = np.full((columns, len(levels)), np.inf)
    np.maximum.at(left, (bins, level), v)
    np.minimum.at(right, (bins, level), v)

    if near is None:
        centres = np.arange(finger, columns - finger, round(_STEP / _BIN))
    else:
        centres = round((float(near @ along) - u_min) / _BIN) + np.arange(-4, 5, 2)
        centres = centres[(centres >= finger) & (centres < columns - finger)]
    result = []
    for centre in centres:
        # Bins to either side of the bins' common edge.
        pads = slice(centre - pad, centre + pad)
        fingers = slice(centre - finger, centre + finger)
        span = left[fingers].max() - right[fingers].min()
        if not NARROWEST <= span <= WIDEST + 2 * _FINGER_RECESS:
            continue
        occupied = np.flatnonzero(np.isfinite(left[pads]).any(axis=0))
        if not len(occupied):
            continue
        where = u_min + centre * _BIN
        judged = _judge(
            left[pads], right[pads], left[fingers], right[fingers], levels, occupied[-1], touch
        )
        if judged is None:
            continue
        middle, width, contact, depth, slope, overhang, twist = judged
        x, y = where * along + middle * across
        lever = abs(where - float(com @ along))
        aside = abs(middle - float(com @ across))
        reach = (
            abs(y)
            + (width / 2 + RELEASE_REACH) * abs(np.cos(theta))
            + (FINGER_LENGTH / 2 * abs(np.sin(theta)))
        )
        penalties = {
            "centre of mass": lever / 0.025 + (lever / 0.040) ** 2 + aside / 0.100,
            "contact along the pads": 1.2 * (1 - contact),
            "contact down the pads": 0.6 * (1 - depth),
            "slope": (slope / np.radians(18.0)) ** 2,
            "overhang": max(overhang, 0.0) / 0.003,
            "twist": twist / 0.009,
            "narrow": max(0.0, 0.008 - width) / 0.005,
            "wide": max(0.0, width - 0.030) / 0.015,
            "neighbour in the kit": max(0.0, reach - _LANE) / 0.015,
        }
        result.append(
            GraspProposal(
                x=float(x),
                y=float(y),
                theta=float((theta + np.pi / 2) % np.pi - np.pi / 2),
                width=float(width),
                surface_height=float(levels[occupied[-1]]),
                offset=float(np.hypot(lever, aside)),
                contact=contact,
                depth=depth,
                slope=slope,
                overhang=overhang,
                penalties={cause: float(value) for cause, value in penalties.items()},
            )
        )
    return result


def _judge(
    left: Array,
    right: Array,
    finger_left: Array,
    finger_right: Array,
    levels: Array,
    top: int,
    touch: float,
) -> tuple[float, float, float, float, float, float, float] | None:
    """What two pads would grip, from how far the tool reaches to either side of them.

    Args:
        left, right: (columns along the pad, levels), -inf and inf where there is nothing.
        finger_left, finger_right: the same over the length of the fingers.
        levels: their heights.
        top: the highest level that is occupied.
        touch: surface that stands back by less than this counts as touched.

    Returns:
        None if they cannot hold it; else the middle and the width between the faces, the shares of
        contact along and down the pads, slope, overhang and twist.
    """
    step = levels[1] - levels[0]
    bottom = max(levels[top] + step / 2 - GRASP_DEPTH, FLOOR_CLEARANCE)
    held = (levels >= bottom) & (levels <= levels[top])
    if not held.any():
        return None
    left, right = left[:, held], right[:, held]
    furthest_left, furthest_right = left.max(), right.min()
    width = furthest_left - furthest_right
    if not NARROWEST <= width <= WIDEST:
        return None
    # Fingers pass outside the tool from its top down to the pads' ends.
    passed = levels >= bottom
    overhang = float(
        max(
            finger_left[:, passed].max() - furthest_left,
            furthest_right - finger_right[:, passed].min(),
        )
    )
    if overhang > _FINGER_RECESS:
        return None
    touch_left, touch_right = left >= furthest_left - touch, right <= furthest_right + touch
    both = touch_left.any(axis=1) & touch_right.any(axis=1)
    contact = float(both.mean())
    if contact < _LEAST_CONTACT:
        return None
    rows = (touch_left[both].mean(axis=0) + touch_right[both].mean(axis=0)) / 2
    depth = float(min(1.0, rows.sum() * step / GRASP_DEPTH))
    slope = max(_lean(left.max(axis=0), step), _lean(-right.min(axis=0), step))
    if slope > _STEEPEST:
        return None
    places = np.arange(len(left)) * _BIN
    twist = abs(
        np.average(places, weights=touch_left.sum(axis=1))
        - np.average(places, weights=touch_right.sum(axis=1))
    )
    middle = (furthest_left + furthest_right) / 2
    return float(middle), float(width), contact, depth, slope, overhang, float(twist)


def _lean(profile: Array, step: float) -> float:
    """How a face leans inward where a pad's lower edge bears on it, from its reach by level."""
    above = min(2, len(profile) - 1)
    if above == 0 or profile.argmax() > 0 or not np.isfinite(profile[above]):
        return 0.0
    return float(np.arctan2(profile[0] - profile[above], above * step))


def _distinct(proposals: list[GraspProposal]) -> list[GraspProposal]:
    kept: list[GraspProposal] = []
    for proposal in sorted(proposals, key=lambda p: p.cost):
        for other in kept:
            turn = (proposal.theta - other.theta + np.pi / 2) % np.pi - np.pi / 2
            distance = np.hypot(proposal.x - other.x, proposal.y - other.y)
            if distance < _DISTINCT and abs(turn) < _DISTINCT_ANGLE:
                break
        else:
            kept.append(proposal)
            if len(kept) == _MOST_PROPOSALS:
                break
    return kept
