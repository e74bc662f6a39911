"""The expert of section IV-B.4, which acts on ground-truth poses and annotated grasps."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import AbstractValue, Value
from pydrake.math import RigidTransform
from pydrake.systems.framework import Context, LeafSystem

from systems.action_quantizer import ActionQuantizer
from systems.attempt_memory import AttemptMemory
from systems.clutter_expert import ClutterExpert
from systems.cluttered_table import ClutteredTable
from systems.grasp import Grasp
from systems.hand_geometry import FINGER_LENGTH, FINGERTIP_DEPTH, MAX_OPENING
from systems.placement import (
    GONE,
    Goal,
    PlacedObject,
    Placement,
    SuccessPredicate,
    displacement,
    evaluate_placements,
    heading,
    is_tilted,
)
from systems.signals import PickPlaceAction, PlanarPose, SurfaceHeights, wrap_to_pi
from systems.weak_calc import weak_calc

_NEAR_GOAL = 0.03
"""An object within this distance of a goal's pose, in metres, counts as near it."""
_SAME_HEIGHT = 0.005
"""Objects whose heights differ by less than this, in metres, count as equally high."""


def gripper_pose(
    X_WB: RigidTransform, grasp: PlanarPose | Grasp, height: float = 0.0
) -> PlanarPose:
    """The world pose of a gripper that holds an object at X_WB by a grasp.

    Args:
        X_WB: the object's pose.
        grasp: the grasp in the object's frame B.
        height: z of the gripped point in B, in metres. It matters only if the object is tilted.
    """
    yaw = heading(X_WB)
    x, y, _ = X_WB @ np.array([grasp.x, grasp.y, height])
    return PlanarPose(x, y, yaw + grasp.theta)


def grasp_taken(X_WB: RigidTransform, gripper: PlanarPose) -> PlanarPose:
    """The grasp by which a gripper pose in the world holds an object that lies flat at X_WB.

    This is the inverse of `gripper_pose`.
    """
    yaw = heading(X_WB)
    dx, dy = np.array([gripper.x, gripper.y]) - X_WB.translation()[:2]
    cos, sin = math.cos(yaw), math.sin(yaw)
    return PlanarPose(cos * dx + sin * dy, cos * dy - sin * dx, gripper.theta - yaw)


@dataclass(frozen=True)
class _Plan:
    """The next move: an object, a grasp of it, and its goal pose."""

    index: int
    grasp: Grasp
    X_WGoal: RigidTransform
    goal: Goal


class OraclePolicy(LeafSystem):
    """Fills one goal after another, from ground truth.

    .. pydrake_system::

        name: OraclePolicy
        input_ports:
        - body_poses
        - kept_goals (optional)
        - failed_picks (optional)
        - mode (optional)
        - accepted_action (optional)
        output_ports:
        - action

    - `body_poses` (abstract, list of RigidTransform by body index): the plant's port of that name.
    - `kept_goals` (one element for each goal): the `PlacementMonitor`'s port of that name, which
      marks goals that count as filled for good. If it is not connected, no goal is kept.
    - `failed_picks` (abstract, a tuple of `PlanarPose`): the planner's port of that name. It is
      used only if objects may lie on each other.
    - `mode` (1) and `accepted_action` (abstract, `PickPlaceAction`): the planner's ports of those
      names, from which the oracle counts its attempts (see `AttemptMemory`).
    - `action` (abstract, `PickPlaceAction`): moves an object to a goal; `stop` when every goal is
      filled, or no goal can be filled.

    The law chooses, in this order:

    1. The goal: the first that is not filled and whose prerequisites are filled or kept. Goals
       whose object was tried less often come first, so that a tool that slips does not use up all
       actions. Goals that already have a misplaced object come last.
    2. The object: of the goal's objects that do not fill another goal, the highest one, since
       nothing lies on it. Of equally high ones, the one that `evaluate_placements` assigned to the
       goal.
    3. The goal pose: of the goal's unoccupied poses, the one that rotates the object least.
    4. The grasp: of those that keep the fingers clear of other objects at the pick and the place,
       the one that was tried least often. So after a slip the oracle tries another grasp.

    With a quantizer, the action is the best that a policy of the paper can choose. The pick is the
    rounded annotated grasp. The place is the gripper pose that brings the object, held by the
    *rounded* pick, to its goal. Position and rotation of the place are then rounded as well. A
    place network whose crop is centred on the pick needs these labels (section III-C.2).

    If objects may touch or lie on each other (`table` is given), `ClutterExpert` chooses the object
    and the grasp, and lays aside objects that are in the way. Its actions are not rounded, and
    carry surface heights.

    State: the number of attempts by object and grasp.
    """

    def __init__(
        self,
        *,
        objects: Sequence[PlacedObject],
        grasps: Sequence[Sequence[Grasp]],
        goals: Sequence[Goal],
        success: SuccessPredicate,
        quantizer: ActionQuantizer | None = None,
        tip_depth: float = 0.010,
        release_clearance: float = 0.006,
        open_width: float = MAX_OPENING,
        brings_heights: bool = True,
        table: ClutteredTable | None = None,
    ) -> None:
        """
        Args:
            objects: the n objects.
            grasps: for each of the n objects, its grasps, best first; empty for an object that can
                fill no goal.
            goals: the goals, in the order in which to fill them.
            success: decides when a goal is filled.
            quantizer: rounds the actions; None leaves them exact.
            tip_depth: how far below an object's top the fingertips reach, in m.
            release_clearance: how far each jaw opens to release an object, in m.
            open_width: opening of the jaws before a grasp, in m.
            brings_heights: whether actions carry surface heights; if not, the planner reads them
                off o_t.
            table: the table, if objects may lie on each other; None if they lie apart.

        Raises:
            ValueError: there are no goals, or an object of a goal has no grasp.
        """
        super().__init__()
        if not goals:
            raise ValueError("an oracle needs at least one goal")
        for index in {index for goal in goals for index in goal.objects}:
            if not grasps[index]:
                raise ValueError(f"{objects[index].name} may fill a goal, but has no grasp")
        self._objects, self._goals, self._success = tuple(objects), tuple(goals), success
        self._grasps = tuple(tuple(choices) for choices in grasps)
        self._quantizer, self._brings_heights = quantizer, brings_heights
        self._tip_depth, self._release_clearance = tip_depth, release_clearance
        self._open_width = open_width
        self._body_poses = self.DeclareAbstractInputPort("body_poses", Value([RigidTransform()]))
        self._kept_goals = self.DeclareVectorInputPort("kept_goals", len(goals))
        self._failed_picks = self.DeclareAbstractInputPort("failed_picks", Value(()))
        self._table = table
        self._memory = AttemptMemory(
            self, objects=self._objects, grasps=self._grasps, body_poses=self._body_poses
        )
        self.DeclareAbstractOutputPort(
            "action",
            lambda: Value(PickPlaceAction()),
            weak_calc(self._calc_action),
            {
                self._body_poses.ticket(),
                self._kept_goals.ticket(),
                self._failed_picks.ticket(),
                self._memory.ticket,
            },
        )

    def _calc_action(self, context: Context, output: AbstractValue) -> None:
        bodies = self._body_poses.Eval(context)
        poses = [bodies[int(item.body)] for item in self._objects]
        kept: frozenset[int] = frozenset()
        if self._kept_goals.HasValue(context):
            kept = frozenset(np.flatnonzero(self._kept_goals.Eval(context)).tolist())
        placements = evaluate_placements(self._objects, self._goals, self._success, poses, kept)
        action: PickPlaceAction | None = None
        if self._table is not None:
            failed = (
                self._failed_picks.Eval(context) if self._failed_picks.HasValue(context) else ()
            )
            tried = self._memory.attempts(context).sum(axis=1)
            action = self._act_in_clutter(self._table, poses, placements, kept, failed, tried)
        else:
            plan = self._plan(poses, placements, kept, self._memory.attempts(context))
            action = None if plan is None else self._action(plan, poses)
        if action is not None:
            output.set_value(action)
            return
        filled = {item.goal for item in placements if item.success}
        reason = "done" if len(filled - {None}) >= len(self._goals) else "gave up"
        output.set_value(PickPlaceAction(stop=True, reason=reason))

    def _plan(
        self,
        poses: list[RigidTransform],
        placements: list[Placement],
        kept: frozenset[int],
        attempts: NDArray[np.float64],
    ) -> _Plan | None:
        """The next move; None if every goal is filled, or no goal can be filled."""
        tried = attempts.sum(axis=1)
        for index in self._open_goals(poses, placements, kept, tried):
            goal = self._goals[index]
            item = self._choose_object(index, poses, placements)
            if item is not None:
                X_WGoal = self._choose_pose(goal, item, poses)
                grasp = self._choose_grasp(item, X_WGoal, poses, attempts[item])
                return _Plan(item, grasp, X_WGoal, goal)
        return None

    def _open_goals(
        self,
        poses: list[RigidTransform],
        placements: list[Placement],
        kept: frozenset[int],
        tried: NDArray[np.float64] | None = None,
    ) -> list[int]:
        """Indices of the goals that may be filled now. Goals with a misplaced object come last.
        Within both groups, goals whose object was tried less often come first.

        Args:
            poses: X_WB of each of the n objects.
            placements: the present placement of each object.
            kept: indices of goals that count as filled.
            tried: (n,) how often each object was tried; None if none was tried.
        """
        filled = kept | {item.goal for item in placements if item.success}
        failed_there = {
            item.goal
            for index, item in enumerate(placements)
            if item.goal is not None and self._is_near(index, item, poses[index])
        }
        open_goals = [
            index
            for index, goal in enumerate(self._goals)
            if index not in filled and filled.issuperset(goal.after)
        ]

        def order(index: int) -> tuple[bool, float]:
            item = self._choose_object(index, poses, placements)
            attempts = 0.0 if tried is None or item is None else float(tried[item])
            return index in failed_there, attempts

        return sorted(open_goals, key=order)

    def _act_in_clutter(
        self,
        table: ClutteredTable,
        poses: list[RigidTransform],
        placements: list[Placement],
        kept: frozenset[int],
        failed: Sequence[PlanarPose],
        tried: NDArray[np.float64],
    ) -> PickPlaceAction | None:
        """The next action if objects may lie on each other; None if nothing is left to do."""
        clutter = ClutterExpert(table, poses, failed)
        options = [
            (item, goal)
            for goal in self._open_goals(poses, placements, kept, tried)
            for item in [self._choose_object(goal, poses, placements)]
            if item is not None
        ]
        for item, index in options:
            goal = self._goals[index]
            X_WGoal = self._choose_pose(goal, item, poses)
            action = clutter.to_goal(item, X_WGoal, goal.rim_height or 0.0)
            if action is not None:
                return action
        return clutter.aside([item for item, _ in options])

    def _is_near(self, index: int, placement: Placement, X_WB: RigidTransform) -> bool:
        assert placement.goal is not None
        goal = self._goals[placement.goal]
        X_WGoal = goal.poses[placement.pose]
        item = self._objects[index]
        return displacement(item, X_WGoal, X_WB, any_heading=goal.any_heading) < _NEAR_GOAL

    def _choose_object(
        self, goal: int, poses: list[RigidTransform], placements: list[Placement]
    ) -> int | None:
        free = [
            index
            for index in self._goals[goal].objects
            if (not placements[index].success or placements[index].goal == goal)
            and np.linalg.norm(poses[index].translation()) < GONE
        ]
        if not free:
            return None
        heights = {i: float((poses[i] @ self._objects[i].p_BMiddle)[2]) for i in free}
        highest = max(heights.values())
        on_top = [index for index in free if heights[index] > highest - _SAME_HEIGHT]
        return min(on_top, key=lambda index: placements[index].goal != goal)

    def _choose_pose(self, goal: Goal, item: int, poses: list[RigidTransform]) -> RigidTransform:
        yaw = heading(poses[item])
        free = [X for X in goal.poses if not self._is_taken(X, item, poses)] or list(goal.poses)
        return min(free, key=lambda X: abs(wrap_to_pi(heading(X) - yaw)))

    def _is_taken(self, X_WGoal: RigidTransform, item: int, poses: list[RigidTransform]) -> bool:
        """Whether another object occupies this goal pose."""
        middle = X_WGoal @ self._objects[item].p_BMiddle
        return any(
            bool(np.linalg.norm(X_WB @ other.p_BMiddle - middle) < _NEAR_GOAL / 2)
            for index, (other, X_WB) in enumerate(zip(self._objects, poses, strict=True))
            if index != item
        )

    def _choose_grasp(
        self,
        item: int,
        X_WGoal: RigidTransform,
        poses: list[RigidTransform],
        tried: NDArray[np.float64],
    ) -> Grasp:
        grasps = self._grasps[item]
        if len(grasps) == 1:
            return grasps[0]
        others = np.concatenate(
            [np.zeros((0, 3))]
            + [
                X_WB.multiply(other.p_BPoints.T).T
                for index, (other, X_WB) in enumerate(zip(self._objects, poses, strict=True))
                if index != item
            ]
        )

        def obstruction(grasp: Grasp) -> int:
            tip, half = grasp.surface_height - self._tip_depth, grasp.width / 2
            return sum(
                _count_within_fingers(others, gripper_pose(X_WB, grasp), height, reach)
                for X_WB, height, reach in (
                    (
                        poses[item],
                        poses[item].translation()[2] + tip,
                        (half, self._open_width / 2 + FINGERTIP_DEPTH),
                    ),
                    (
                        X_WGoal,
                        X_WGoal.translation()[2] + tip,
                        (half, half + self._release_clearance + FINGERTIP_DEPTH),
                    ),
                )
            )

        obstructions = [obstruction(grasp) for grasp in grasps]
        best = min(
            range(len(grasps)),
            key=lambda index: (obstructions[index] > 0, tried[index], obstructions[index]),
        )
        return grasps[best]

    def _action(self, plan: _Plan, poses: list[RigidTransform]) -> PickPlaceAction:
        X_WB = poses[plan.index]
        pick = gripper_pose(X_WB, plan.grasp)
        held: PlanarPose | Grasp = plan.grasp
        quantizer = self._quantizer
        if quantizer is not None:
            pick = PlanarPose(*quantizer.position(pick.x, pick.y), quantizer.angle(pick.theta))
            held = grasp_taken(X_WB, pick)
        # The hand holds the object level, even over a tilted cavity. So its (x, y) can match the
        # goal pose at one height only: choose half of the object's height.
        height = plan.grasp.surface_height / 2 if is_tilted(plan.X_WGoal) else 0.0
        place = gripper_pose(plan.X_WGoal, held, height)
        theta = wrap_to_pi(pick.theta)
        rotation = wrap_to_pi(place.theta - pick.theta)
        if quantizer is not None:
            place = PlanarPose(*quantizer.position(place.x, place.y))
            rotation = quantizer.angle(rotation)
        return PickPlaceAction(
            pick=PlanarPose(pick.x, pick.y, theta),
            place=PlanarPose(place.x, place.y, theta + rotation),
            heights=self._heights(plan, poses) if self._brings_heights else None,
        )

    def _heights(self, plan: _Plan, poses: list[RigidTransform]) -> SurfaceHeights:
        tops = [
            float(X_WB.multiply(item.p_BPoints.T)[2].max())
            for item, X_WB in zip(self._objects, poses, strict=True)
        ]
        rim = plan.goal.rim_height
        bottom = poses[plan.index].translation()[2]
        rims = [goal.highest or goal.rim_height for goal in self._goals]
        highest = max(*tops, *(height for height in rims if height is not None), 0.0)
        return SurfaceHeights(
            pick_top=bottom + plan.grasp.surface_height,
            support=bottom,
            place_rim=0.0 if rim is None else rim,
            near_pick=highest,
            near_place=highest,
            highest=highest,
            width=plan.grasp.width,
        )


def _count_within_fingers(
    points: NDArray[np.float64], gripper: PlanarPose, tip: float, reach: tuple[float, float]
) -> int:
    """Counts the points that lie within the volume of the fingers.

    Args:
        points: (m, 3) in the world, in metres.
        gripper: the gripper's pose in the world.
        tip: world z of the fingertips, in metres.
        reach: distances of a finger's inner and outer side from the gripper's middle, in metres.
    """
    cos, sin = math.cos(gripper.theta), math.sin(gripper.theta)
    dx, dy = points[:, 0] - gripper.x, points[:, 1] - gripper.y
    along, across = np.abs(cos * dx + sin * dy), np.abs(cos * dy - sin * dx)
    inside = (along < FINGER_LENGTH / 2) & (across > reach[0]) & (across < reach[1])
    return int((inside & (points[:, 2] > tip)).sum())
