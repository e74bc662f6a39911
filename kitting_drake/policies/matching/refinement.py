"""Refines the place and the grasp that networks predict, by the geometry of o_t.

The place is refined by fitting the object's outline to the recess. The fit corrects errors of
millimetres and degrees. It also decides between two rotations that differ by half a turn, even for
an object whose two ends differ little. If the outlines do not agree, for instance because the
recess is hidden or there is none, the prediction stays as it is. A grasp at which the jaws
would hit something is replaced. This is not in the paper.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from kitting_drake.policies.data.images import rotation_matrix
from kitting_drake.policies.matching.assignment import Pair
from kitting_drake.policies.matching.half_turn import advantage
from kitting_drake.policies.matching.jaw_clearance import JawGrasp, jaw_grasps, untried
from kitting_drake.policies.matching.regions.segmentation import Region, Segmentation
from kitting_drake.policies.matching.registration import (
    Outline,
    Registration,
    coarse_cost,
    is_covered,
    mismatch,
    outline_of,
    register,
)
from systems.pick_place_parameters import PickPlaceParameters
from systems.signals import wrap_to_pi

Array = NDArray[np.float64]

_WORST_COST = 0.0016
"""A fit is accepted if the mean difference of the outlines is at most this, in metres."""
_HALF_TURN_GAIN = 0.0005
"""Another fit replaces the fit at the predicted rotation only if its `advantage` is more than
this."""
_RIVAL_GAIN = 0.85
"""Another recess is chosen if its mismatch is less than this share of the predicted recess's
mismatch."""
_PROMISING = 1.2
"""The object's outline is registered to another recess only if its `coarse_cost` there is at most
this multiple of its `coarse_cost` in the predicted recess."""
_LARGEST_SHIFT = 0.010
"""The largest correction of the object's centre, in metres."""
_LARGEST_ROTATION = math.radians(10)
"""The largest correction of the object's rotation, apart from a half turn, in radians."""
_LEVER = 0.03
"""When grasps are compared, a rotation of the jaws by one radian counts as much as a shift by this
many metres."""
_FARTHEST_GRASP = 0.04
"""A refined grasp is at most this far from the predicted one, in metres."""
_POOR = 0.03
"""When grasps are compared, a rank of one counts as much as a shift by this many metres."""
_MUCH_WORSE = 0.5
"""A predicted grasp is replaced only if its `JawGrasp.rank` exceeds that of the best grasp nearby
by at least this."""
_SAME_PLACE = 0.008
"""Two grasps with similar angles count as the same if they are closer than this, in metres."""
_SAME_ANGLE = math.radians(8)
"""Two grasps at similar places count as the same if their angles differ by less than this, in
radians."""
_NEAR = 6.0
"""A position belongs to a region if their distance is less than this, in pixels."""


@dataclass(frozen=True)
class RefinedPlace:
    """A refined rotation of the object, and the place to which the gripped point goes."""

    rotation: float
    """The object's rotation from pick to place, in radians."""
    place: Array
    """(row, col) to which the gripped point goes."""
    cost: float
    """The mean difference of the outlines, in metres."""


def refine_place(
    segmentation: Segmentation,
    pick: Array,
    rotation: float,
    place: Array,
    resolution: float,
    unfilled: tuple[Region, ...],
    pairs: Sequence[Pair] = (),
) -> RefinedPlace | None:
    """Refines a predicted place. Returns None if the outlines do not determine it.

    Args:
        segmentation: the segmentation of o_t.
        pick: (row, col) at which the object is gripped.
        rotation: predicted rotation of the object, in radians.
        place: (row, col) predicted for the object's point under the pick.
        resolution: the side of a pixel, in metres.
        unfilled: the recesses of the segmentation into which objects may go.
        pairs: the result of `match`. If a pair has this object and the predicted recess, the better
            of two fits is used: that of the pair, or the one that starts at the prediction.
    """
    taken = nearest_region(segmentation.objects, pick)
    if taken is None:
        return None
    outline = outline_of(taken, resolution, close=True)
    goal = place + rotation_matrix(rotation) @ (outline.middle - pick)
    recess = nearest_region(unfilled, goal)
    if recess is None:
        return None
    target = outline_of(recess, resolution)

    def fit(angle: float, middle: Array) -> Registration | None:
        """Returns the fit that starts at rotation `angle` with the object's centre at `middle`;
        None if it ends too far from this start."""
        start = (angle, middle - rotation_matrix(angle) @ outline.middle)
        found = register(outline, target, starts=(start,))
        away = np.linalg.norm(found.moved(outline.middle) - middle) * resolution
        turned = abs(wrap_to_pi(found.rotation - angle))
        return found if away <= _LARGEST_SHIFT and turned <= _LARGEST_ROTATION else None

    best, rivals = fit(rotation, goal), [fit(rotation + math.pi, target.middle)]
    for pair in pairs:
        if segmentation.objects[pair.item] is taken and (
            segmentation.recesses[pair.recess] is recess
        ):
            rivals.append(pair.fit)
    known = segmentation.depth, taken, recess, (outline, target)
    for rival in rivals:
        if rival is not None and (best is None or advantage(*known, rival, best) > _HALF_TURN_GAIN):
            best = rival
    if best is None or best.cost > _WORST_COST:
        return None
    others = [other for other in unfilled if other is not recess]
    elsewhere = _better_elsewhere(taken, outline, recess, target, best, others, resolution)
    if elsewhere is not None:
        best = elsewhere
    elif not is_covered(outline, target, best):
        return None
    refined = RefinedPlace(wrap_to_pi(best.rotation), best.moved(pick), best.cost)
    rows, cols = segmentation.fixture.shape
    inside = (refined.place >= 0).all() and (refined.place <= (rows - 1, cols - 1)).all()
    return refined if inside else None


def _better_elsewhere(
    taken: Region,
    outline: Outline,
    recess: Region,
    target: Outline,
    fit: Registration,
    others: list[Region],
    resolution: float,
) -> Registration | None:
    """Returns the fit to another recess, if it is clearly better than the fit to the predicted
    recess; else None.

    Args:
        taken: the object.
        outline: the object's outline.
        recess: the predicted recess.
        target: the outline of the predicted recess.
        fit: the registration of `outline` to `target`.
        others: the recesses other than the predicted one.
        resolution: the side of a pixel, in metres.
    """
    best, least = None, _RIVAL_GAIN * mismatch(fit, taken, recess)
    enough = _PROMISING * coarse_cost(outline, target)
    for other in others:
        rival = outline_of(other, resolution)
        if coarse_cost(outline, rival) > enough:
            continue
        found = register(outline, rival)
        fits = found.cost < _WORST_COST and is_covered(outline, rival, found)
        if fits and mismatch(found, taken, other) < least:
            best, least = found, mismatch(found, taken, other)
    return best


def nearest_region(regions: tuple[Region, ...], pixel: Array) -> Region | None:
    """Returns the region nearest to a position (row, col); None if all are farther than `_NEAR`. A
    region's holes belong to it: jaws that grip a ring from outside are centred on its hole."""
    best, least = None, _NEAR
    for region in regions:
        distance = float(np.linalg.norm(region.pixels - pixel, axis=1).min())
        if distance >= 1 and _encloses(region, pixel):
            distance = 0.0
        if distance < least:
            best, least = region, distance
    return best


def belonging_to(
    regions: Sequence[Region], others: Sequence[Region], shape: tuple[int, int]
) -> NDArray[np.bool_]:
    """Returns a mask (rows, cols) of the pixels for which `nearest_region` finds one of these
    regions, of which there is at least one. The pixels of `others` are left out."""
    inside = np.zeros(shape, bool)
    for region in regions:
        inside |= ndimage.binary_fill_holes(region.mask)
    mask = ndimage.distance_transform_edt(~inside) < _NEAR
    for region in others:
        mask &= ~region.mask
    return np.asarray(mask)


def _encloses(region: Region, pixel: Array) -> bool:
    """Whether a position (row, col) lies in a hole of a region."""
    row, col = np.rint(pixel).astype(int)
    rows, cols = region.pixels.T
    if not (rows.min() < row < rows.max() and cols.min() < col < cols.max()):
        return False
    part = region.mask[rows.min() : rows.max() + 1, cols.min() : cols.max() + 1]
    return bool(ndimage.binary_fill_holes(part)[row - rows.min(), col - cols.min()])


@dataclass(frozen=True)
class RefinedGrasp:
    """A grasp that leaves the jaws enough room."""

    pick: Array
    """(row, col) midway between the pads."""
    theta: float
    """The gripper's angle, in radians."""
    cost: float
    """The cost of the grasp, see `JawGrasp.cost`."""


def refine_grasp(
    segmentation: Segmentation,
    pick: Array,
    theta: float,
    resolution: float,
    planner: PickPlaceParameters,
    failed: Array | None = None,
    balance: Array | None = None,
) -> RefinedGrasp | None:
    """Refines a predicted grasp.

    Returns the predicted grasp if it is feasible and its cost is not much higher than that of other
    grasps. Otherwise returns another feasible grasp of the same object within 4 cm of the predicted
    grasp, or None if there is none.

    Args:
        segmentation: the segmentation of o_t.
        pick: (row, col) predicted.
        theta: predicted angle of the gripper, in radians.
        resolution: the side of a pixel, in metres.
        planner: parameters of the motion with which the hand will pick.
        failed: (n, 2) row and column of each failed grasp; they are avoided.
        balance: (row, col) of the object's centre of mass, if the hand has measured it. Then the
            grasp with the least cost is chosen, however far it is from the predicted one.
    """
    taken = nearest_region(segmentation.objects, pick)
    if taken is None:
        return None

    def away(grasp: JawGrasp) -> tuple[float, float]:
        """Returns the distance of a grasp from the predicted one, in metres, and the angle between
        the two grasps, in radians."""
        distance = float(np.linalg.norm(grasp.pixel - pick)) * resolution
        return distance, abs(math.remainder(grasp.theta - theta, math.pi))

    def is_same(distance: float, turned: float) -> bool:
        return distance < _SAME_PLACE and turned < _SAME_ANGLE

    def departure(grasp: JawGrasp) -> float:
        distance, turned = away(grasp)
        return distance + _LEVER * turned + _POOR * grasp.rank

    grasps = jaw_grasps(segmentation, taken, resolution, planner, balance=balance)
    if balance is not None:
        grasps = grasps if failed is None else untried(grasps, failed, resolution)
        return RefinedGrasp(grasps[0].pixel, grasps[0].theta, grasps[0].cost) if grasps else None
    near = [grasp for grasp in grasps if away(grasp)[0] <= _FARTHEST_GRASP]
    if failed is not None:
        near = untried(near, failed, resolution)
    least = min((grasp.rank for grasp in near), default=math.inf)
    # The network takes more into account than the cost does, so keep the network's grasp unless
    # another grasp costs much less.
    # The grasps are sorted by rank.
    same = next((grasp for grasp in grasps if is_same(*away(grasp))), None)
    if same is not None and same.rank < least + _MUCH_WORSE:
        return RefinedGrasp(pick, theta, same.cost)
    best = min(near, key=departure, default=None)
    return None if best is None else RefinedGrasp(best.pixel, best.theta, best.cost)
