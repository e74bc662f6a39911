"""Defines goals, measures the errors of placements, and decides about success, for
`PlacementMonitor` and `OraclePolicy`."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence, Set
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Protocol

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.tree import BodyIndex

from systems.signals import wrap_to_pi

if TYPE_CHECKING:
    from scipy.spatial import cKDTree

STRICT_HEIGHT = 0.002
"""Largest height error of a strict success, in metres."""
STRICT_ANGLE = math.radians(20.0)
"""Largest heading error of a strict success, modulo the object's symmetry, in radians."""
ALL = 1 - 1e-9
"""A share or a reward above this counts as 1, to allow for rounding."""

GONE = 10.0
"""An object at least this far from the world's origin, in metres, has left the cell or has not
appeared yet."""

_FAR = 0.5
"""When objects are assigned to goals, displacements are limited to this, in metres."""
_NEAR = 0.05
"""In the assignment, only objects within this distance of a goal, in metres, can count as filling
it."""
_FREE_ANGLES = 24
"""Number of headings that are compared for a goal that accepts any heading."""


@dataclass(frozen=True)
class PlacedObject:
    """An object whose placement is scored."""

    name: str
    body: BodyIndex
    """The object's body B; points and goal poses refer to its frame."""
    p_BPoints: NDArray[np.float64]
    """(m, 3) points sampled uniformly by area from the object's surface, in metres."""
    symmetry: int = 1
    """Order of the object's rotational symmetry about body z; 1 for none."""
    axis: tuple[float, float] | None = None
    """(x, y) of the axis of symmetry in B, in metres; None stands for the middle of the points'
    bounding box. This middle is not on the axis if the order of the symmetry is odd, as for a
    triangle."""
    p_BCom: NDArray[np.float64] | None = None
    """(3,) the centre of mass in B, in metres; None if it is unknown."""

    @property
    def p_BCenter(self) -> NDArray[np.float64]:
        """(3,) the centre of mass in B or, if it is unknown, the mean of `p_BPoints`."""
        return self.p_BPoints.mean(axis=0) if self.p_BCom is None else self.p_BCom

    @cached_property
    def p_BMiddle(self) -> NDArray[np.float64]:
        """(3,) the point in B that is used to compare positions. It is the middle of the points'
        bounding box, or the point of the same height on the `axis`. Unlike the origin of B, it
        lies on the axis of a round object and does not move as the object rolls in place."""
        middle = (self.p_BPoints.min(axis=0) + self.p_BPoints.max(axis=0)) / 2
        return middle if self.axis is None else np.array([*self.axis, middle[2]])

    @cached_property
    def p_BCorners(self) -> NDArray[np.float64]:
        """(8, 3) corners of the points' bounding box."""
        low, high = self.p_BPoints.min(axis=0), self.p_BPoints.max(axis=0)
        signs = np.array(np.meshgrid(*[(0, 1)] * 3)).reshape(3, -1).T
        return low + signs * (high - low)

    @cached_property
    def tree(self) -> cKDTree:
        """A k-d tree of the points."""
        # Import SciPy lazily.
        from scipy.spatial import cKDTree

        return cKDTree(self.p_BPoints)

    @cached_property
    def _last_add_s(self) -> dict[bytes, tuple[bytes, float]]:
        """By goal pose: the last pose that `add_s` was computed for, and the result."""
        return {}

    def add_s(self, X_WGoal: RigidTransform, X_WB: RigidTransform) -> float:
        """The ADD-S of a pose of the object, in metres; see `add_s`. The last result for each goal
        pose is kept, because most objects have not moved since."""
        goal, actual = (pose.GetAsMatrix34().tobytes() for pose in (X_WGoal, X_WB))
        known = self._last_add_s.get(goal)
        if known is None or known[0] != actual:
            known = actual, _add_s(self.tree, self.p_BPoints, X_WGoal, X_WB)
            self._last_add_s[goal] = known
        return known[1]


@dataclass(frozen=True)
class Goal:
    """A goal that one of several objects can fill, in one of several poses."""

    name: str
    objects: tuple[int, ...]
    """Indices, in the scene's list, of the objects that may fill the goal."""
    poses: tuple[RigidTransform, ...]
    """X_WGoal: poses of the object's frame, any of which fills the goal."""
    reward: float
    """Share of the episode's score; the goals' shares add up to 1."""
    after: tuple[int, ...] = ()
    """Indices, in the scene's list, of the goals that must be filled before this one counts."""
    any_heading: bool = False
    """Whether the object's rotation about world z is ignored."""
    rim_height: float | None = None
    """World z of the rim of the cavity that the object goes into, in metres; None if there is no
    cavity. For a tilted cavity it is the height of the rim's middle."""
    highest: float | None = None
    """World z of the highest point of the fixture with a tilted cavity, in metres; None if the
    cavity is level."""
    fixture: int = 0
    """Index, in the scene's list, of the fixture with the cavity."""


@dataclass(frozen=True)
class Placement:
    """The errors of one object with respect to the goal assigned to it."""

    goal: int | None = None
    """Index of the goal; None if no goal is left for the object."""
    pose: int = 0
    """Index, in `Goal.poses`, of the pose that is nearest to the object."""
    add_s: float = math.inf
    """ADD-S, equation 9 of the paper, in metres."""
    position_error: float = math.inf
    """Distance between the object's middle (`PlacedObject.p_BMiddle`) and its goal, parallel to the
    goal's (x, y) plane, in metres. All errors are measured in the goal's frame, which is tilted
    with a tilted cavity."""
    angle_error: float = math.inf
    """Heading error about the goal's z axis, modulo the object's symmetry, in radians; zero if the
    goal accepts any heading."""
    height_error: float = math.inf
    """Height of the object's middle above its goal, in metres."""
    share: float = 0.0
    """Earned share of the goal's reward, 0 to 1; 0 until the goal's prerequisites are filled."""

    @property
    def success(self) -> bool:
        """Whether the object fills its goal by the task's success predicate."""
        return self.share > ALL

    @property
    def strict_success(self) -> bool:
        """Whether the object fills its goal and also has the right height and heading."""
        return (
            self.success
            and abs(self.height_error) <= STRICT_HEIGHT
            and abs(self.angle_error) <= STRICT_ANGLE
        )


class SuccessPredicate(Protocol):
    """Decides when an object fills its goal."""

    @property
    def description(self) -> str:
        """The criterion and its threshold, in words."""
        ...

    def share(self, placement: Placement, X_WB: RigidTransform) -> float:
        """The share of the goal's reward, 0 to 1, that a pose earns.

        Args:
            placement: the errors; its `share` is not set yet.
            X_WB: the object's pose.
        """
        ...


def heading(X_WB: RigidTransform) -> float:
    """The direction of body x seen from above, about world +z, in radians."""
    x_axis = X_WB.rotation().col(0)
    return float(np.arctan2(x_axis[1], x_axis[0]))


def is_tilted(X_WB: RigidTransform) -> bool:
    """Whether body z deviates from the vertical by more than rounding errors."""
    return bool(X_WB.rotation().matrix()[2, 2] < 1 - 1e-9)


def add_s(points: NDArray[np.float64], X_WGoal: RigidTransform, X_WActual: RigidTransform) -> float:
    """The average distance for symmetric objects, equation 9 of the paper, in metres.

    It is the mean, over the model's points at the goal pose, of the distance to the *nearest* model
    point at the actual pose. A rotation that maps the points onto themselves adds no error.

    The measure is lenient: a flat object that protrudes by h scores about h / 2, and a reversed one
    may pass the paper's threshold. See `Placement.strict_success`.

    Args:
        points: (m, 3) model points in the body frame.
        X_WGoal: the target pose.
        X_WActual: the pose reached.
    """
    # Import SciPy lazily.
    from scipy.spatial import cKDTree

    return _add_s(cKDTree(points), points, X_WGoal, X_WActual)


def _add_s(
    tree: cKDTree,
    points: NDArray[np.float64],
    X_WGoal: RigidTransform,
    X_WActual: RigidTransform,
) -> float:
    # Query in the actual body frame, so that one tree serves all poses.
    X_ActualGoal = X_WActual.InvertAndCompose(X_WGoal)
    goal_points = points @ X_ActualGoal.rotation().matrix().T + X_ActualGoal.translation()
    return float(tree.query(goal_points)[0].mean())


def evaluate_placements(
    objects: Sequence[PlacedObject],
    goals: Sequence[Goal],
    success: SuccessPredicate,
    poses: Sequence[RigidTransform],
    kept: Set[int] = frozenset(),
) -> list[Placement]:
    """Assigns objects to goals and measures their errors.

    The assignment (Hungarian method) fills as many goals as possible with objects within 5 cm of
    them, then minimizes the total `displacement`. Displacement alone does not suffice: if a spare
    object lies at the end of a correct row, every object could get its neighbour's goal.

    Args:
        objects: the n objects.
        goals: the goals of the task.
        success: decides when a goal is filled.
        poses: X_WB of each of the n objects.
        kept: indices of goals that count as filled when they are prerequisites of others (see
            `complete_stages`).

    Returns:
        One placement for each object, in order. The errors are infinite for an object without a
        goal, and for an object whose pose is not finite because the simulation diverged.
    """
    placements = [Placement() for _ in objects]
    for index, goal_index, pose_index in _assign(objects, goals, success, poses):
        goal = goals[goal_index]
        placements[index] = _measure(
            objects[index], goal, goal_index, pose_index, poses[index], success
        )
    filled = {item.goal for item in placements if item.success}

    def counts(goal: int) -> bool:
        return all(
            other in kept or (other in filled and counts(other)) for other in goals[goal].after
        )

    return [
        item if item.goal is None or counts(item.goal) else dataclasses.replace(item, share=0.0)
        for item in placements
    ]


def _assign(
    objects: Sequence[PlacedObject],
    goals: Sequence[Goal],
    success: SuccessPredicate,
    poses: Sequence[RigidTransform],
) -> list[tuple[int, int, int]]:
    """Indices (object, goal, pose of the goal) of each assigned pair."""
    # A forbidden pair costs more than any assignment of allowed pairs.
    cost = np.full((len(objects), len(goals)), 10.0 * _FAR * max(len(objects), 1))
    nearest = np.zeros(cost.shape, int)
    known = [np.isfinite(pose.GetAsMatrix34()).all() for pose in poses]
    for column, goal in enumerate(goals):
        for row in goal.objects:
            if not known[row]:
                continue
            distances = [
                displacement(objects[row], X_WGoal, poses[row], any_heading=goal.any_heading)
                for X_WGoal in goal.poses
            ]
            pose_index = int(np.argmin(distances))
            nearest[row, column] = pose_index
            cost[row, column] = min(distances[pose_index], _FAR)
            if len(goal.objects) > 1 and distances[pose_index] < _NEAR:
                measured = _measure(objects[row], goal, column, pose_index, poses[row], success)
                # Filling a goal outweighs all displacements.
                cost[row, column] -= _FAR * len(objects) * measured.share
    # Import SciPy lazily.
    from scipy.optimize import linear_sum_assignment

    return [
        (int(row), int(column), int(nearest[row, column]))
        for row, column in zip(*linear_sum_assignment(cost), strict=True)
        if row in goals[column].objects and known[row]
    ]


def displacement(
    item: PlacedObject, X_WGoal: RigidTransform, X_WB: RigidTransform, *, any_heading: bool = False
) -> float:
    """The mean distance of the corners of an object's bounding box from where they are at the goal
    pose, in metres.

    Of all rotations by the object's symmetry, the one with the smallest distance counts.

    Args:
        item: the object.
        X_WGoal: the object's goal pose.
        X_WB: the object's actual pose.
        any_heading: whether the goal accepts any heading.
    """
    here = X_WB.multiply(item.p_BCorners.T)
    order = _FREE_ANGLES if any_heading else item.symmetry
    return min(
        float(np.linalg.norm(here - X_WGoal.multiply(_turn(item, step, order).T), axis=0).mean())
        for step in range(order)
    )


def _turn(item: PlacedObject, step: int, order: int) -> NDArray[np.float64]:
    """(8, 3) the corners of the object's bounding box in B, rotated by `step` / `order` of a turn
    about the axis through its middle."""
    if step == 0:
        return item.p_BCorners
    R = RollPitchYaw(0, 0, step * math.tau / order).ToRotationMatrix().matrix()
    return (item.p_BCorners - item.p_BMiddle) @ R.T + item.p_BMiddle


def _measure(
    item: PlacedObject,
    goal: Goal,
    goal_index: int,
    pose_index: int,
    X_WB: RigidTransform,
    success: SuccessPredicate,
) -> Placement:
    X_WGoal = goal.poses[pose_index]
    offset = X_WB @ item.p_BMiddle - X_WGoal @ item.p_BMiddle
    tilted = is_tilted(X_WGoal)
    if tilted:
        offset = X_WGoal.rotation().matrix().T @ offset
    angle = 0.0
    if not goal.any_heading:
        angle = (
            heading(X_WGoal.InvertAndCompose(X_WB))
            if tilted
            else wrap_to_pi(heading(X_WB) - heading(X_WGoal))
        )
        if item.symmetry > 1:
            angle = math.remainder(angle, math.tau / item.symmetry)
    measured = Placement(
        goal=goal_index,
        pose=pose_index,
        add_s=item.add_s(X_WGoal, X_WB),
        position_error=float(np.linalg.norm(offset[:2])),
        angle_error=angle,
        height_error=float(offset[2]),
    )
    return dataclasses.replace(measured, share=success.share(measured, X_WB))


def complete_stages(
    goals: Sequence[Goal], placements: Sequence[Placement], kept: Set[int] = frozenset()
) -> frozenset[int]:
    """Finds the goals of all stages that are or were complete. A stage is the set of goals that are
    prerequisites of one other goal. It is complete when all of them are filled at the same time.

    As in the Ravens benchmark, the reward of a complete stage is kept even if its objects move
    later.

    Args:
        goals: the goals of the task.
        placements: the present placements, evaluated with `kept`.
        kept: indices of the goals of stages that were complete before; they are included in the
            result.
    """
    filled = kept | {item.goal for item in placements if item.success}
    return frozenset(kept).union(*(goal.after for goal in goals if filled >= {*goal.after}))


def total_reward(
    goals: Sequence[Goal], placements: Sequence[Placement], kept: Set[int] = frozenset()
) -> float:
    """The episode's score, 0 to 1.

    Args:
        goals: the goals of the task.
        placements: the present placements, evaluated with `kept`.
        kept: indices of goals that always count as filled (see `complete_stages`).
    """
    shares = {item.goal: item.share for item in placements if item.goal is not None}
    shares |= dict.fromkeys(kept, 1.0)
    return math.fsum(goals[goal].reward * share for goal, share in shares.items())


def strict_reward(goals: Sequence[Goal], placements: Sequence[Placement]) -> float:
    """The episode's score if only strict successes count, 0 to 1."""
    return math.fsum(
        goals[item.goal].reward
        for item in placements
        if item.goal is not None and item.strict_success
    )
