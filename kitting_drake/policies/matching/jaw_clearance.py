"""Finds grasps of an object at which the jaws hit no obstacle in o_t.

For each position and angle the heights along the jaws' path are sampled from o_t. Anything above
the fingertips is either the gripped object or an obstacle. The grasp is centred between the
object's faces, as closing jaws would centre it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from kitting_drake.policies.matching.regions.segmentation import Region, Segmentation
from systems.hand_geometry import FINGERTIP_DEPTH, PAD_LENGTH, PALM_HEIGHT
from systems.jaw_room import heights_below_palm
from systems.pick_place_parameters import PickPlaceParameters
from systems.signals import PixelGrid, PlanarPose

Array = NDArray[np.float64]

RETRY_DISTANCE = 0.010
"""No grasp is tried within this distance of a failed one, in metres."""
_ANGLES = 36
_MOST_PLACES = 80
_REACH = 0.055
"""The radius, in metres, around the object's centre within which grasps are sought."""
_STEP = 0.0015
"""The distance between samples across the jaws, in metres."""
_LINES = 5
"""The number of sampled lines along the pads' length."""
_ROOM = 0.010
"""The gripped part must be narrower than the open jaws by at least this, in metres, so that the
fingers can come down on either side."""
_NARROWEST = 0.003
"""The least width of a grasp, in metres."""
_LOWEST = 0.003
"""The least clearance, in metres, of the fingertips above the object's support, and of the palm
above everything under it."""
_FINGER_MARGIN = 0.003
"""An obstacle outside the open fingers blocks a grasp if it is closer to them than this, in
metres."""
_STRAIGHT = 0.003
"""A part of the object's face that is recessed by less than this, in metres, touches the pad."""
_SLIDES = 0.003
"""A grasp is unsure if the closing jaws may push the object by more than this, in metres."""
_UNSURE = 3.0
"""What `JawGrasp.rank` adds to the cost of an unsure grasp."""


@dataclass(frozen=True)
class JawGrasp:
    """A feasible grasp, in pixels of o_t."""

    pixel: Array
    """(row, col) midway between the gripped faces."""
    theta: float
    """The gripper's angle in radians; adding pi gives the same grasp."""
    cost: float
    """A dimensionless penalty for the distance from the object's centre and for faces that are not
    parallel to the pads; 0 is best."""
    is_unsure: bool = False
    """Whether the closing jaws may push the object."""

    @property
    def rank(self) -> float:
        """The cost, plus a penalty if the grasp is unsure. Grasps are chosen by it."""
        return self.cost + _UNSURE * self.is_unsure


def failed_pixels(grid: PixelGrid, failed_picks: Sequence[PlanarPose]) -> Array:
    """Returns the (row, col) of each of n failed picks, (n, 2)."""
    places = np.array([(pick.x, pick.y) for pick in failed_picks]).reshape(-1, 2)
    return grid.to_pixel(places)


def untried(grasps: Sequence[JawGrasp], failed: Array, resolution: float) -> list[JawGrasp]:
    """Returns the grasps that are farther than `RETRY_DISTANCE` from every failed grasp.

    Args:
        grasps: the grasps from which to choose.
        failed: (n, 2) row and column of each failed grasp.
        resolution: the side of a pixel, in metres.
    """
    return [
        grasp
        for grasp in grasps
        if np.linalg.norm(failed - grasp.pixel, axis=1).min(initial=np.inf) * resolution
        > RETRY_DISTANCE
    ]


def jaw_grasps(
    segmentation: Segmentation,
    region: Region,
    resolution: float,
    planner: PickPlaceParameters,
    *,
    support: float = 0.0,
    balance: Array | None = None,
) -> list[JawGrasp]:
    """Returns the feasible grasps of an object, best first.

    Args:
        segmentation: the segmentation of the observation.
        region: the object.
        resolution: the side of a pixel, in metres.
        planner: parameters that say how deep the fingertips go and how wide the jaws open.
        support: height of the object's support above the table, in metres.
        balance: (row, col) of the object's centre of mass, if known. Otherwise the centre of the
            volume below the object's surface is used.
    """
    relief = segmentation.relief
    pixels = region.pixels
    weights = np.maximum(relief[region.mask] - support, 1e-3)
    middle = np.average(pixels, axis=0, weights=weights) if balance is None else balance
    distance = np.linalg.norm(pixels - middle, axis=1) * resolution
    near = pixels[distance < max(_REACH, distance.min() + resolution)]
    places = near[:: max(1, math.ceil(len(near) / _MOST_PLACES))].astype(float)

    def grip(places: Array, thetas: Array) -> list[JawGrasp]:
        found = _grip(relief, places, thetas, middle, resolution, planner, support)
        return sorted(_seen(found, segmentation, planner), key=lambda item: item.rank)

    thetas = np.arange(_ANGLES) * math.pi / _ANGLES
    place, theta = (item.ravel() for item in np.meshgrid(np.arange(len(places)), thetas))
    found = grip(places[place.astype(int)], theta.astype(float))
    if not found:
        return []
    # Refine the best angle, to align the faces with the pads.
    best = found[0]
    nearby = best.theta + np.radians(np.linspace(-4, 4, 9))
    refined = grip(np.repeat(best.pixel[None], len(nearby), axis=0), nearby)
    return sorted([*refined, *found], key=lambda item: item.rank)


def _seen(
    grasps: list[JawGrasp], segmentation: Segmentation, planner: PickPlaceParameters
) -> list[JawGrasp]:
    """Returns the grasps whose surroundings are seen (`Visibility.picks_are_seen`)."""
    if not grasps:
        return grasps
    pixels = np.array([grasp.pixel for grasp in grasps])
    thetas = np.array([grasp.theta for grasp in grasps])
    seen = segmentation.visibility.picks_are_seen(pixels, thetas, planner.open_width)
    return [grasp for grasp, good in zip(grasps, seen, strict=True) if good]


def tip_height(top: Array, support: float, planner: PickPlaceParameters) -> Array:
    """Returns the height of the fingertips above the table at a grasp, in metres.

    It is the grasp height of `motion_heights` where the palm has room, raised if needed to clear
    the object's support.

    Args:
        top: the height of the object's top, in metres above the table.
        support: the height of the object's support, in metres above the table.
        planner: parameters that give the depth of the fingertips below the object's top and their
            clearance above the table.
    """
    share = planner.grasp_depth_share * (top - support)
    depth = np.maximum(planner.grasp_depth, np.minimum(share, planner.max_grasp_depth))
    return np.maximum(top - depth, max(support + _LOWEST, planner.floor_clearance))


def _grip(
    relief: NDArray[np.float32],
    places: Array,
    thetas: Array,
    middle: Array,
    resolution: float,
    planner: PickPlaceParameters,
    support: float,
) -> list[JawGrasp]:
    """Returns the feasible ones of n grasps, at positions (n, 2) and angles (n,)."""
    raised = ndimage.maximum_filter(relief, 3)
    top = raised[tuple(np.rint(places).astype(int).T)].astype(float)
    tip = tip_height(top, support, planner)

    along = np.column_stack([np.cos(thetas), np.sin(thetas)])
    across = np.column_stack([-np.sin(thetas), np.cos(thetas)])
    open_half = planner.open_width / 2
    half = open_half + FINGERTIP_DEPTH + _FINGER_MARGIN + 0.02
    s = np.arange(-half, half + _STEP / 2, _STEP)
    u = np.linspace(-PAD_LENGTH / 2, PAD_LENGTH / 2, _LINES)
    positions = (
        places[:, None, None, :]
        + along[:, None, None, :] * (u / resolution)[None, :, None, None]
        + across[:, None, None, :] * (s / resolution)[None, None, :, None]
    )
    heights = ndimage.map_coordinates(
        relief, np.moveaxis(positions, -1, 0), order=1, mode="constant", cval=0.0
    )
    occupied = heights > (tip - 0.0005)[:, None, None]  # (n, lines, samples)
    anywhere = occupied.any(axis=1)
    centre = len(s) // 2
    first = centre - _run(anywhere[:, centre::-1])
    last = centre + _run(anywhere[:, centre:])
    held = anywhere[:, centre] & (first > 0) & (last < len(s) - 1)
    left, right = s[np.maximum(first, 0)], s[np.minimum(last, len(s) - 1)]
    width, shift = right - left + _STEP, (left + right) / 2

    index = np.arange(len(s))[None]
    beside = (s[None] > (shift + open_half + FINGERTIP_DEPTH + _FINGER_MARGIN)[:, None]) | (
        s[None] < (shift - open_half - FINGERTIP_DEPTH - _FINGER_MARGIN)[:, None]
    )
    own = (index >= first[:, None]) & (index <= last[:, None])
    blocked = (anywhere & ~own & ~beside).any(axis=1)
    fits = held & ~blocked & (width <= planner.open_width - _ROOM) & (width >= _NARROWEST)
    if not fits.any():
        return []

    inside = occupied & own[:, None, :]
    contact, lean, twist = _straightness(inside, s, u, left, right)
    centres = places + across * (shift / resolution)[:, None]
    arm = (centres - middle) * resolution
    lever = np.abs((arm * along).sum(axis=1))
    aside = np.abs((arm * across).sum(axis=1))
    cost = _costs(lever, aside, width, contact, lean, twist)
    fits &= contact > 0
    chosen = np.flatnonzero(fits)
    below = heights_below_palm(raised, centres[chosen], thetas[chosen], resolution, step=3.0)
    fits[chosen] = below.max(axis=1, initial=0.0) < tip[chosen] + PALM_HEIGHT - _LOWEST
    unsure = _is_unsure(inside, s, left, right)
    return [
        JawGrasp(centres[i], float(thetas[i]), float(cost[i]), bool(unsure[i]))
        for i in np.flatnonzero(fits)
    ]


def _costs(
    lever: Array, aside: Array, width: Array, contact: Array, lean: Array, twist: Array
) -> Array:
    """(n,) `JawGrasp.cost` of n grasps.

    Args:
        lever: (n,) distance from the object's centre along the pads, in metres.
        aside: (n,) distance from the object's centre across the pads, in metres.
        width: (n,) distance between the gripped faces, in metres.
        contact: (n,) the first value that `_straightness` returns; `lean` and `twist` are the
            second and the third.
    """
    return np.asarray(
        lever / 0.025
        + (lever / 0.040) ** 2
        + aside / 0.050
        + 2.4 * (1 - contact)
        + 2.0 * lean
        + 4.0 * twist
        + np.maximum(0.0, width - 0.035) / 0.015
    )


def _straightness(
    inside: NDArray[np.bool_], s: Array, u: Array, left: Array, right: Array
) -> tuple[Array, Array, Array]:
    """Measures how straight the gripped faces are along the pads.

    Args:
        inside: (n, lines, samples) whether each sample is within the object.
        s: (samples,), positions across the jaws, in metres.
        u: (lines,), positions along the pads, in metres.
        left: (n,), the lowest s within the object.
        right: (n,), the highest s within the object.

    Returns:
        (n,): the share of the lines that touch both pads.
        (n,): how far the faces are from parallel to the pads: |left slope| + |right slope|.
        (n,): how far both slope in the same direction: |left slope + right slope|. It is 0 for a
            wedge that lies symmetrically between the pads.
    """
    low, high = _faces(inside, s)
    touch = (low < left[:, None] + _STRAIGHT) & (high > right[:, None] - _STRAIGHT)
    with np.errstate(invalid="ignore"):
        lean = np.nan_to_num(np.abs(_slope(u, low)) + np.abs(_slope(u, high)), nan=1.0)
        twist = np.nan_to_num(np.abs(_slope(u, low) + _slope(u, high)), nan=1.0)
    return touch.mean(axis=1), lean, twist


def _is_unsure(inside: NDArray[np.bool_], s: Array, left: Array, right: Array) -> NDArray[np.bool_]:
    """Returns whether the jaws of each of n grasps may push the object as they close.

    A part of the object that only the end of a pad would touch may be missed. The pad then enters
    a notch beside this part, and the jaws push the object until the faces that they do touch are
    centred between them. So the faces on all lines are compared with those on the inner lines.

    Args:
        inside: (n, lines, samples) whether each sample is within the object.
        s: (samples,), positions across the jaws, in metres.
        left: (n,), the lowest s within the object.
        right: (n,), the highest s within the object.
    """
    low, high = _faces(inside[:, 1:-1], s)
    beyond = np.nan_to_num(low, nan=np.inf).min(axis=1) - left
    before = np.nan_to_num(high, nan=-np.inf).max(axis=1) - right
    touched = np.isfinite(beyond)
    pushed = np.where(touched, beyond, 0.0) + np.where(touched, before, 0.0)
    return ~touched | (np.abs(pushed) / 2 > _SLIDES)


def _faces(inside: NDArray[np.bool_], s: Array) -> tuple[Array, Array]:
    """Returns the lowest and the highest s within the object on each line, both (n, lines) and in
    metres; NaN where a line misses the object.

    Args:
        inside: (n, lines, samples) whether each sample is within the object.
        s: (samples,), positions across the jaws, in metres.
    """
    hit = inside.any(axis=2)
    low = np.where(hit, s[inside.argmax(axis=2)], np.nan)
    high = np.where(hit, s[len(s) - 1 - inside[:, :, ::-1].argmax(axis=2)], np.nan)
    return low, high


def _run(occupied: NDArray[np.bool_]) -> NDArray[np.intp]:
    """Returns, for each of n rows, the index of the last True before the first False."""
    free = ~occupied
    ends = free.argmax(axis=1)
    return np.where(free.any(axis=1), ends - 1, occupied.shape[1] - 1)


def _slope(u: Array, values: Array) -> Array:
    """Returns the least-squares slopes (n,) of `values` (n, lines) over `u` (lines,).

    A slope is NaN if one of its values is NaN.
    """
    centred = u - u.mean()
    return (values * centred).sum(axis=1) / (centred**2).sum()
