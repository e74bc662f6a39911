"""Scores placements: ADD-S (equation 9 of the paper) and the errors that explain it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import Value
from pydrake.math import RigidTransform
from pydrake.multibody.tree import BodyIndex
from pydrake.systems.framework import BasicVector, Context, LeafSystem
from scipy.spatial import cKDTree

from systems.signals import wrap_to_pi


@dataclass(frozen=True)
class PlacementGoal:
    """Where one object belongs."""

    name: str
    body: BodyIndex
    """The object's body B, whose frame the points and the goal refer to."""
    X_WGoal: RigidTransform
    """The pose that B should have."""
    p_BPoints: NDArray[np.float64]
    """(m, 3) points of the object's surface, in metres. Sample them by area: the score must not
    depend on how finely a mesh is cut."""

    @property
    def p_BMiddle(self) -> NDArray[np.float64]:
        """(3,) the middle of the points' bounding box, where positions are compared. It lies on the
        axis of a round object; the origin of B need not, and would wander as the object rolls."""
        return (self.p_BPoints.min(axis=0) + self.p_BPoints.max(axis=0)) / 2


def add_s(points: NDArray[np.float64], X_WGoal: RigidTransform, X_WActual: RigidTransform) -> float:
    """The average distance for symmetric objects, equation 9 of the paper, in metres.

    The mean, over the model's points at the goal pose, of the distance to the *nearest* model point
    at the actual pose: a turn that maps the *points* onto themselves costs nothing, one that maps
    the surface onto itself costs no more than the distance between neighbouring points.

    It forgives much: a flat object that stands proud of its goal by h scores about h / 2, and one
    turned about may score less than the paper's threshold. See `height_error`, `angle_error`.

    Args:
        points: (m, 3) model points in the body frame.
        X_WGoal: the target pose.
        X_WActual: the pose reached.
    """
    return _add_s(cKDTree(points), points, X_WGoal, X_WActual)


def _add_s(
    tree: cKDTree,
    points: NDArray[np.float64],
    X_WGoal: RigidTransform,
    X_WActual: RigidTransform,
) -> float:
    # Distances do not depend on the frame: asked in the actual body frame, one tree serves always.
    X_ActualGoal = X_WActual.InvertAndCompose(X_WGoal)
    goal_points = points @ X_ActualGoal.rotation().matrix().T + X_ActualGoal.translation()
    return float(tree.query(goal_points)[0].mean())


class PlacementMonitor(LeafSystem):
    """Compares where objects are with where they belong.

    .. pydrake_system::

        name: PlacementMonitor
        input_ports:
        - body_poses
        output_ports:
        - add_s
        - position_error
        - angle_error
        - height_error

    - `body_poses` (abstract, list of RigidTransform by body index): the plant's port of that name.
    - `add_s` (n): equation 9, metres, one for each goal in the order given.
    - `position_error` (n): horizontal distance of the middles (`PlacementGoal.p_BMiddle`), metres.
    - `angle_error` (n): heading (of body x about world z) beyond the goal's, radians in [-pi, pi].
    - `height_error` (n): how far the middle is above the goal's, metres, signed.

    Stateless, pulled.
    """

    def __init__(self, *, goals: Sequence[PlacementGoal]) -> None:
        """
        Args:
            goals: n of them, at least one.

        Raises:
            ValueError: no goals, or a goal without points.
        """
        super().__init__()
        if not goals:
            raise ValueError("a placement monitor needs at least one goal")
        for goal in goals:
            if goal.p_BPoints.ndim != 2 or goal.p_BPoints.shape[1] != 3 or not len(goal.p_BPoints):
                raise ValueError(f"the points of {goal.name} must be (m, 3) with m > 0")
        self._goals = tuple(goals)
        self._trees = tuple(cKDTree(goal.p_BPoints) for goal in goals)
        poses = self.DeclareAbstractInputPort("body_poses", Value([RigidTransform()]))
        self._body_poses = poses
        for name, calc in {
            "add_s": self._calc_add_s,
            "position_error": self._calc_position_error,
            "angle_error": self._calc_angle_error,
            "height_error": self._calc_height_error,
        }.items():
            self.DeclareVectorOutputPort(name, len(goals), calc, {poses.ticket()})

    @property
    def goals(self) -> tuple[PlacementGoal, ...]:
        """The goals, in the order of the output ports' elements."""
        return self._goals

    def _actual(self, context: Context) -> list[RigidTransform]:
        poses = self._body_poses.Eval(context)
        return [poses[int(goal.body)] for goal in self._goals]

    def _calc_add_s(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(
            [
                _add_s(tree, goal.p_BPoints, goal.X_WGoal, X_WActual)
                for tree, goal, X_WActual in zip(
                    self._trees, self._goals, self._actual(context), strict=True
                )
            ]
        )

    def _offsets(self, context: Context) -> NDArray[np.float64]:
        return np.array(
            [
                X_WActual @ goal.p_BMiddle - goal.X_WGoal @ goal.p_BMiddle
                for goal, X_WActual in zip(self._goals, self._actual(context), strict=True)
            ]
        )

    def _calc_position_error(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(np.linalg.norm(self._offsets(context)[:, :2], axis=1))

    def _calc_height_error(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(self._offsets(context)[:, 2])

    def _calc_angle_error(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(
            [
                wrap_to_pi(heading(X_WActual) - heading(goal.X_WGoal))
                for goal, X_WActual in zip(self._goals, self._actual(context), strict=True)
            ]
        )


def heading(X_WB: RigidTransform) -> float:
    """The direction of body x seen from above, about world +z, in radians."""
    x_axis = X_WB.rotation().col(0)
    return float(np.arctan2(x_axis[1], x_axis[0]))
