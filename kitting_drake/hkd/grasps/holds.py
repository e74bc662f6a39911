"""Finds how two pads can hold a tool, from the tool's extents to the left and right at each height.

The coordinate u is along the pads, and v is across them. Lengths are in metres.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kitting_drake.hkd.grasps.corners import LEAST_WIDTH, corner_cost
from kitting_drake.hkd.grasps.grip import jaw_axes
from systems.hand_geometry import FINGER_LENGTH, MAX_OPENING, PAD_LENGTH
from systems.pick_place_parameters import PickPlaceParameters

Array = NDArray[np.float64]

WIDEST = MAX_OPENING - 0.015
"""The largest width to grasp; it leaves a margin on either side of the tool."""
_NARROWEST = 0.003
"""The smallest width to grasp."""
BIN = 0.0005
"""The length of a column along u."""

# The distance by which the upper fingers are set back from the pads.
_FINGER_RECESS = 0.003
# A face that leans inward by more than this, in radians, slips out of the pads.
_STEEPEST = np.radians(28.0)
# The least share of the pads' length along which both pads must touch the tool, except at a corner.
_LEAST_CONTACT = 0.15

# The numbers of columns in half the length of the pads, and in half the length of the fingers.
_PAD_COLUMNS = round(PAD_LENGTH / 2 / BIN)
FINGER_COLUMNS = round(FINGER_LENGTH / 2 / BIN)


@dataclass(frozen=True)
class Reach:
    """The extents of a tool to the left (+v) and right (-v) at each height, for one rotation of the
    hand."""

    u_min: float
    """The u of the first column; each column is `BIN` long."""
    left: Array
    """The greatest v (columns, levels) of the tool; -inf where the tool is absent."""
    right: Array
    """The least v (columns, levels) of the tool; inf where the tool is absent."""
    levels: Array
    """The heights (levels) of the slices, equally spaced."""


@dataclass(frozen=True)
class Hold:
    """How two pads hold a tool; see `GraspProposal` for the measures."""

    middle: float
    """The v halfway between the gripped faces."""
    width: float
    top: float
    contact: float
    depth: float
    slope: float
    overhang: float
    twist: float
    """The distance along the pads between the two pads' mean points of contact."""
    corner: float = 0.0
    """The cost of holding a corner; 0 for a hold between two faces."""


def reach_of(points: Array, level: NDArray[np.int64], levels: Array, theta: float) -> Reach:
    """Returns the extents of a tool at one rotation of the hand.

    Args:
        points: points (n, 2) on the outlines of the tool's horizontal slices.
        level: (n) the index of each point's slice.
        levels: (levels) the heights of the slices, equally spaced.
        theta: the rotation of the hand, in radians.
    """
    along, across = jaw_axes(theta)
    u, v = points @ along, points @ across
    u_min = u.min() - FINGER_COLUMNS * BIN
    columns = int((u.max() - u_min) / BIN) + FINGER_COLUMNS + 2
    bins = ((u - u_min) / BIN).astype(int)
    # Use one index for each cell: `np.maximum.at` is faster with one index than with two.
    cells = bins * len(levels) + level
    left = np.full(columns * len(levels), -np.inf)
    right = np.full(columns * len(levels), np.inf)
    np.maximum.at(left, cells, v)
    np.minimum.at(right, cells, v)
    shape = columns, len(levels)
    return Reach(u_min, left.reshape(shape), right.reshape(shape), levels)


def find_holds(
    reach: Reach,
    centres: NDArray[np.int64],
    touch: float,
    planner: PickPlaceParameters,
    *,
    corners: bool,
) -> Iterator[tuple[int, Hold]]:
    """Yields the columns on which the pads can be centred, and how they hold the tool there.

    `find_grip` measures only the distance between the pads. This function also measures their
    contact.

    Args:
        reach: the extents of the tool.
        centres: (n) the columns to try; the pads' middle is at the lower edge of a column.
        touch: a pad touches the parts of a face that are at most this far behind the face's
            foremost point, in metres.
        planner: the planner's parameters; the pads' depth and their clearance to the table are
            used.
        corners: whether a corner may be held.
    """
    centres, finger_left, finger_right = _between_fingers(reach, centres)
    pads = centres[:, None] + np.arange(-_PAD_COLUMNS, _PAD_COLUMNS)
    left, right = reach.left[pads], reach.right[pads]
    occupied = np.isfinite(left).any(axis=1)
    levels = reach.levels
    top, step = levels[len(levels) - 1 - occupied[:, ::-1].argmax(axis=1)], levels[1] - levels[0]
    bottom = np.maximum(top + step / 2 - planner.grasp_depth, planner.floor_clearance)
    # The fingers pass all levels from the tool's top down to the pads' lower edges.
    passed = levels >= bottom[:, None]
    held = passed & (levels <= top[:, None]) & occupied.any(axis=1)[:, None]
    left = np.where(held[:, None], left, -np.inf)
    right = np.where(held[:, None], right, np.inf)
    furthest_left, furthest_right = left.max(axis=(1, 2)), right.min(axis=(1, 2))
    width = furthest_left - furthest_right
    fit = (width >= _NARROWEST) & (width <= WIDEST)
    overhang = np.full(len(centres), np.inf)
    overhang[fit] = np.maximum(
        np.where(passed, finger_left, -np.inf).max(axis=1)[fit] - furthest_left[fit],
        furthest_right[fit] - np.where(passed, finger_right, np.inf).min(axis=1)[fit],
    )
    touch_left = left >= (furthest_left - touch)[:, None, None]
    touch_right = right <= (furthest_right + touch)[:, None, None]
    contact = (touch_left.any(axis=2) & touch_right.any(axis=2)).mean(axis=1)
    fit &= overhang <= _FINGER_RECESS
    fit &= (contact >= _LEAST_CONTACT) | (corners & (width >= LEAST_WIDTH))
    for i in np.flatnonzero(fit):
        here = held[i]
        one, other = left[i][:, here], right[i][:, here]
        slope = max(_lean(one.max(axis=0), step), _lean(-other.min(axis=0), step))
        at_corner = contact[i] < _LEAST_CONTACT
        corner = corner_cost(one, other, BIN, touch) if at_corner else 0.0
        if corner is None or slope > _STEEPEST:
            continue
        depth, twist = _contact(touch_left[i][:, here], touch_right[i][:, here], at_corner)
        yield (
            int(centres[i]),
            Hold(
                middle=float((furthest_left[i] + furthest_right[i]) / 2),
                width=float(width[i]),
                top=float(top[i]),
                contact=float(contact[i]),
                depth=float(min(1.0, depth * step / planner.grasp_depth)),
                slope=slope,
                overhang=float(overhang[i]),
                twist=float(abs(twist)),
                corner=corner,
            ),
        )


def _between_fingers(
    reach: Reach, centres: NDArray[np.int64]
) -> tuple[NDArray[np.int64], Array, Array]:
    """Keeps the columns where the open fingers have room on both sides of the tool.

    Returns:
        The columns (n) that are kept; and the greatest v and the least v (n, levels) of the tool
        between the fingers.
    """
    fingers = centres[:, None] + np.arange(-FINGER_COLUMNS, FINGER_COLUMNS)
    left, right = reach.left[fingers].max(axis=1), reach.right[fingers].min(axis=1)
    extent = left.max(axis=1) - right.min(axis=1)
    fit = (extent >= _NARROWEST) & (extent <= WIDEST + 2 * _FINGER_RECESS)
    return centres[fit], left[fit], right[fit]


def _contact(
    touch_left: NDArray[np.bool_], touch_right: NDArray[np.bool_], at_corner: bool
) -> tuple[float, float]:
    """Returns the number of levels at which a pad touches, averaged over the touching columns and
    both pads, and the twist.

    The twist is the distance along the pads from the right pad's mean point of contact to the left
    pad's, in metres.

    Args:
        touch_left: (columns, levels) where the left pad touches.
        touch_right: (columns, levels) where the right pad touches.
        at_corner: whether the tool is held at a corner; the pads may touch in different columns.
    """
    columns_left, columns_right = touch_left.any(axis=1), touch_right.any(axis=1)
    if not at_corner:
        columns_left = columns_right = columns_left & columns_right
    rows = (touch_left[columns_left].mean(axis=0) + touch_right[columns_right].mean(axis=0)) / 2
    places = np.arange(len(touch_left)) * BIN
    twist = np.average(places, weights=touch_left.sum(axis=1)) - np.average(
        places, weights=touch_right.sum(axis=1)
    )
    return rows.sum(), twist


def _lean(profile: Array, step: float) -> float:
    """Returns the inward lean of a face at a pad's lower edge, in radians.

    Args:
        profile: how far the face stands out at each level, from the lowest level up, in metres.
        step: the distance between levels, in metres.
    """
    above = min(2, len(profile) - 1)
    if above == 0 or profile.argmax() > 0 or not np.isfinite(profile[above]):
        return 0.0
    return float(np.arctan2(profile[0] - profile[above], above * step))
