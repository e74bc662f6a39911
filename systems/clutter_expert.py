"""Chooses the oracle's next action if objects touch each other or lie on each other."""

from __future__ import annotations

import math
from collections.abc import Sequence

from pydrake.math import RigidTransform

from systems.cluttered_table import (
    ClutteredTable,
    HeldFromAbove,
    in_the_way,
    middle,
)
from systems.grasp import Grasp
from systems.ledge import moved_gripper
from systems.placement import displacement, heading
from systems.signals import PickPlaceAction, PlanarPose, wrap_to_pi

_NEAR_BEST = 0.035
"""A grasp further than this from the object's best grasp, in metres, is used only to lay the object
aside."""
_ANY = math.radians(65.0)
"""If an object has no better grasp, its gripped faces may be tilted from the vertical by at most
this, in radians."""
_ENOUGH = 3
"""After this number of failed picks near an object, other objects come first."""
_NEAR = 0.06
"""A pick closer than this to the middle of an object, in metres, was near it."""
_IN_CAVITY = 0.03
"""An object displaced less than this from its goal, in metres, lies in or over its cavity."""


class ClutterExpert:
    """Chooses actions for one state of the table.

    An object goes to its goal if it lies flat and the right way up, has nothing on top of it, and
    can be gripped near its best grasp. If there is no such object, an object with nothing on top of
    it is laid aside on a free part of the table. If it does not come to rest flat and uncovered, it
    is laid aside again.
    """

    def __init__(
        self,
        table: ClutteredTable,
        poses: Sequence[RigidTransform],
        failed: Sequence[PlanarPose] = (),
    ) -> None:
        """
        Args:
            table: the objects and their grasps.
            poses: X_WB of each object.
            failed: gripper poses of earlier failed picks, in the world.
        """
        self._table, self._poses, self._failed = table, list(poses), failed
        self._points = table.points(poses)
        self._covered = table.covered(self._points)
        self._highest = max(
            [float(points[:, 2].max()) for points in (*self._points, *table.fixtures)]
        )

    def to_goal(self, index: int, X_WGoal: RigidTransform, rim: float) -> PickPlaceAction | None:
        """The action that brings an object to its goal; None if it must be laid aside first.

        Args:
            index: index of the object.
            X_WGoal: the object's goal pose in the world.
            rim: world z of the cavity's rim, in metres.
        """
        yaw = self._table.flat_heading(index, self._poses[index])
        if self._covered[index] or yaw is None:
            return None
        best = self._table.grasps[index][0]
        for hold in self._holds(index, X_WGoal):
            near = math.hypot(hold.grasp.x - best.x, hold.grasp.y - best.y) < _NEAR_BEST
            place = self._place(index, hold, X_WGoal, yaw)
            if near and not hold.obstruction and self._may_let_go(index, hold.grasp, place, rim):
                return self._action(hold, place, rim)
        return None

    def aside(self, items: Sequence[int]) -> PickPlaceAction | None:
        """The action that lays one of the given objects aside; None if none can be laid aside.

        It prefers objects with nothing on top of them, then the least obstructed grasp, then the
        highest object. An object near which `_ENOUGH` picks failed is left for later. If there is
        no other, all take turns.
        """
        if not items:
            return None
        new = [index for index in items if self._failures(index) < _ENOUGH]
        in_turn = [items[len(self._failed) % len(items)]]
        choices = [index for index in new if not self._covered[index]] or new or in_turn
        found = []
        for index in choices:
            top = float(self._points[index][:, 2].max())
            for rank, hold in enumerate(self._holds(index, None)):
                found.append((hold.obstruction, -top, rank, index, hold))
        for _, _, _, index, hold in sorted(found, key=lambda row: row[:4]):
            place = self._table.aside(index, hold, self._poses, self._points)
            if place is not None:
                return self._action(hold, place, 0.0, aside=True)
        return None

    def _failures(self, index: int) -> int:
        """How many picks failed near an object."""
        x, y, _ = (self._poses[index] @ self._table.objects[index].p_BMiddle).tolist()
        return sum(math.dist((x, y), (pick.x, pick.y)) < _NEAR for pick in self._failed)

    def _holds(self, index: int, X_WGoal: RigidTransform | None) -> list[HeldFromAbove]:
        in_cavity = False
        if X_WGoal is not None:
            item = self._table.objects[index]
            in_cavity = displacement(item, X_WGoal, self._poses[index]) < _IN_CAVITY
        arguments = (index, self._poses, self._points)
        holds = self._table.holds(*arguments, self._failed, ignores_fixtures=in_cavity)
        # If every grasp has failed, try them all again. If the object has no good grasp, try grasps
        # that may slip: they at least move the object.
        return (
            holds
            or self._table.holds(*arguments, ignores_fixtures=in_cavity)
            or self._table.holds(*arguments, ignores_fixtures=in_cavity, steepest=_ANY)
        )

    def _place(
        self, index: int, hold: HeldFromAbove, X_WGoal: RigidTransform, yaw: float
    ) -> PlanarPose:
        x, y, _ = X_WGoal @ self._table.objects[index].p_BMiddle
        goal = PlanarPose(float(x), float(y), heading(X_WGoal))
        return moved_gripper(hold.gripper, middle(self._points[index], yaw), yaw, goal)

    def _may_let_go(self, index: int, grasp: Grasp, place: PlanarPose, rim: float) -> bool:
        """Whether no other object is in the way of the jaws as they open."""
        halves = (grasp.width / 2, grasp.width / 2 + self._table.planner.release_clearance)
        return not any(
            in_the_way(points, place, rim + 0.003, halves)
            for other, points in enumerate(self._points)
            if other != index
        )

    def _action(
        self, hold: HeldFromAbove, place: PlanarPose, rim: float, *, aside: bool = False
    ) -> PickPlaceAction:
        theta = wrap_to_pi(hold.gripper.theta)
        turn = wrap_to_pi(place.theta - hold.gripper.theta)
        return PickPlaceAction(
            pick=PlanarPose(hold.gripper.x, hold.gripper.y, theta),
            place=PlanarPose(place.x, place.y, theta + turn),
            heights=hold.heights(self._highest, rim),
            aside=aside,
        )
