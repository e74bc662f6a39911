"""What a policy answered, how far that was from the truth, and why a tool is not where it belongs.

Everything here is decided from true poses: a policy sees none of it.
"""

import dataclasses
import math
from collections.abc import Sequence

import numpy as np
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.systems.framework import Context

from kitting_drake.cell.cell import Cell
from systems.oracle_policy import gripper_pose
from systems.pick_place_parameters import Mode
from systems.placement_monitor import heading
from systems.signals import PlanarPose, wrap_to_pi

CAUSES = (
    "missed grasp",
    "slipped",
    "jammed",
    "wrong cavity",
    "flipped",
    "misplaced",
    "never picked",
)
"""Why an object is not where it belongs; `find_cause` tells them apart."""

_NEAR = 0.030
"""An object this close to a cavity is over it: half the distance of two cavities, in m."""
_ALIGNED = math.radians(20.0)
"""Turned no further than this from a cavity, an object lies along it."""
_TILTED = math.radians(60.0)
"""Tilted further than this, an object does not lie on the side on which it should."""
_LIFTED = 0.010
"""An object that rose by this while the hand went up is in the hand, in m."""


@dataclasses.dataclass
class ActionRecord:
    """One pick and place, against what the oracle would have done. Keys of `results.json`."""

    object: str
    """The object that was lifted; if none was, the one nearest to the pick."""
    category: str
    """Of the object."""
    outcome: str
    """`placed`, `missed` (nothing was grasped), `dropped` (on the way), or `unfinished`."""
    pick: PlanarPose
    place: PlanarPose
    pick_position_error_mm: float
    """From the annotated grasp of the object."""
    pick_angle_error_deg: float
    """Likewise, half turns being the same: 0 to 90."""
    place_position_error_mm: float
    """How far from its goal the action would bring the middle of the object as it lay before the
    pick."""
    place_angle_error_deg: float
    """Likewise, 0 to 180: beyond 90 the object would arrive the wrong way round."""


class ActionRecorder:
    """Watches an episode step by step and writes down its actions."""

    def __init__(self, cell: Cell) -> None:
        """
        Args:
            cell: the cell that the episode runs.
        """
        self._cell = cell
        self._middles = [goal.p_BMiddle for goal in cell.monitor.goals]
        self._mode = Mode.OBSERVE
        self._before: list[RigidTransform] = []
        self.records: list[ActionRecord] = []

    def look(self, root_context: Context, mode: Mode) -> None:
        """To be called after every step with the planner's mode."""
        previous, self._mode = self._mode, mode
        if mode == previous:
            return
        if mode == Mode.APPROACH:
            self._before = object_poses(self._cell, root_context)
            pick, place = self._cell.planner.action(
                self._cell.planner.GetMyContextFromRoot(root_context)
            )
            self.records.append(self._record(self._nearest(pick), pick, place))
        elif mode == Mode.CARRY:
            rises = [
                now.translation()[2] - before.translation()[2]
                for now, before in zip(
                    object_poses(self._cell, root_context), self._before, strict=True
                )
            ]
            last = self.records[-1]
            if max(rises) > _LIFTED:
                self.records[-1] = self._record(int(np.argmax(rises)), last.pick, last.place)
        elif mode == Mode.RELEASE:
            self.records[-1].outcome = "placed"
        elif mode == Mode.RETREAT and previous != Mode.RELEASE:
            self.records[-1].outcome = "missed" if previous == Mode.CHECK else "dropped"

    def _nearest(self, pick: PlanarPose) -> int:
        """The object whose surface, seen from above, comes nearest to a pick."""
        distances = []
        for goal, X_WB in zip(self._cell.monitor.goals, self._before, strict=True):
            points = X_WB.multiply(goal.p_BPoints.T)[:2]
            distances.append(np.hypot(points[0] - pick.x, points[1] - pick.y).min())
        return int(np.argmin(distances))

    def _record(self, index: int, pick: PlanarPose, place: PlanarPose) -> ActionRecord:
        """The record of an action on the given object, still unfinished."""
        scene = self._cell.scene
        tool, X_WB, X_WGoal = scene.tools[index], self._before[index], scene.X_WGoals[index]
        annotated = PlanarPose(tool.grasp.x, tool.grasp.y, tool.grasp.theta)
        best = gripper_pose(X_WB, annotated)
        turned_jaws = wrap_to_pi(2 * (pick.theta - best.theta)) / 2
        arrival = _arrival(X_WB, pick, place)
        return ActionRecord(
            object=tool.name,
            category=tool.category,
            outcome="unfinished",
            pick=pick,
            place=place,
            pick_position_error_mm=1e3 * math.hypot(pick.x - best.x, pick.y - best.y),
            pick_angle_error_deg=math.degrees(abs(turned_jaws)),
            place_position_error_mm=1e3 * _gap(arrival, X_WGoal, self._middles[index]),
            place_angle_error_deg=math.degrees(
                abs(wrap_to_pi(heading(arrival) - heading(X_WGoal)))
            ),
        )


def _arrival(X_WB: RigidTransform, pick: PlanarPose, place: PlanarPose) -> RigidTransform:
    """Where an object at X_WB comes to lie that moves with the gripper from pick to place."""
    return _pose(place) @ _pose(pick).inverse() @ X_WB


def _pose(planar: PlanarPose) -> RigidTransform:
    return RigidTransform(RollPitchYaw(0, 0, planar.theta), [planar.x, planar.y, 0])


def object_poses(cell: Cell, root_context: Context) -> list[RigidTransform]:
    """The true poses of the objects in the world, in the order in which an oracle takes them."""
    context = cell.plant.GetMyContextFromRoot(root_context)
    return [body.EvalPoseInWorld(context) for body in cell.tool_bodies]


def find_cause(
    cell: Cell, index: int, X_WB: RigidTransform, records: Sequence[ActionRecord]
) -> str:
    """Why an object that did not end as it should did not: one of `CAUSES`.

    - `never picked`: no action on it came to an end.
    - `missed grasp`: it was tried, and never held.
    - `flipped`: at its cavity, but the wrong way round or on the wrong side.
    - `jammed`: over its cavity, but standing proud or off.
    - `slipped`: lost on the way; or left outside the kit by an action that was right.
    - `wrong cavity`: over another object's.
    - `misplaced`: put anywhere else.

    Args:
        cell: the episode's.
        index: of the object, in the order in which an oracle takes them.
        X_WB: where it ended.
        records: the episode's actions.
    """
    scene = cell.scene
    tool = scene.tools[index]
    own = [item for item in records if item.object == tool.name and item.outcome != "unfinished"]
    held = [item for item in own if item.outcome != "missed"]
    if not held:
        return "missed grasp" if own else "never picked"
    last = held[-1]

    X_WGoal = scene.X_WGoals[index]
    turn = abs(wrap_to_pi(heading(X_WB) - heading(X_WGoal)))
    middles = [goal.p_BMiddle for goal in cell.monitor.goals]
    grasp_point = np.array([tool.grasp.x, tool.grasp.y, 0.0])
    # A half turn about the grasp leaves the grasp where it was and takes the middle away.
    if min(_gap(X_WB, X_WGoal, middles[index]), _gap(X_WB, X_WGoal, grasp_point)) < _NEAR:
        if turn > math.pi - _ALIGNED or _tilt(X_WB) > _TILTED:
            return "flipped"
        if turn < _ALIGNED:
            return "jammed"
    if last.outcome == "dropped":
        return "slipped"
    p_WMiddle = X_WB @ middles[index]
    if any(
        np.linalg.norm((p_WMiddle - X_WOther @ middle)[:2]) < _NEAR and _is_along(X_WB, X_WOther)
        for other, (X_WOther, middle) in enumerate(zip(scene.X_WGoals, middles, strict=True))
        if other != index
    ):
        return "wrong cavity"
    meant_well = (
        last.place_position_error_mm < 1e3 * _NEAR
        and last.place_angle_error_deg < math.degrees(_ALIGNED)
    )
    return "slipped" if meant_well and not _is_over_kit(cell, X_WB) else "misplaced"


def _gap(X_WB: RigidTransform, X_WGoal: RigidTransform, point: np.ndarray) -> float:
    """Horizontal distance of a body's point (3) from where it belongs, in m."""
    return float(np.linalg.norm((X_WB @ point - X_WGoal @ point)[:2]))


def _tilt(X_WB: RigidTransform) -> float:
    """The angle between body z and world z, in radians."""
    return math.acos(np.clip(X_WB.rotation().matrix()[2, 2], -1.0, 1.0))


def _is_along(X_WB: RigidTransform, X_WGoal: RigidTransform) -> bool:
    """Whether a body lies along a cavity, either way round."""
    return abs(wrap_to_pi(2 * (heading(X_WB) - heading(X_WGoal)))) / 2 < _ALIGNED


def _is_over_kit(cell: Cell, X_WB: RigidTransform) -> bool:
    block = cell.scene.kit.parameters
    x, y, _ = cell.scene.X_WKit.inverse() @ X_WB.translation()
    return abs(x) < block.length / 2 and abs(y) < block.width / 2
