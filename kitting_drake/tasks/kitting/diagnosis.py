"""Finds out why a tool was not kitted, from true poses, which policies cannot see."""

import math
from collections.abc import Sequence

import numpy as np
from pydrake.math import RigidTransform

from kitting_drake.tasks.task import (
    MISPLACED,
    MISSED_GRASP,
    NEVER_PICKED,
    SLIPPED,
    ActionRecord,
    Scene,
    last_action_on,
)
from systems.placement import Placement, heading
from systems.signals import wrap_to_pi

BLOCKED = "insertion blocked"
WRONG_CAVITY = "wrong cavity"
REVERSED = "reversed"

CAUSES = (MISSED_GRASP, SLIPPED, BLOCKED, WRONG_CAVITY, REVERSED, MISPLACED, NEVER_PICKED)

_NEAR = 0.030
"""A tool within this distance of a cavity, in m, counts as over the cavity. It is half the distance
between neighbouring cavities of the paper's kits."""
_BORDER = 0.015
"""Width of the kit's border around the seated tools, in m."""
_ALIGNED = math.radians(20.0)
"""Largest difference of heading, in radians, at which a tool counts as lying along a cavity."""
_TILTED = math.radians(60.0)
"""A tool tilted by more than this, in radians, lies on the wrong side."""


def find_cause(
    scene: Scene,
    index: int,
    X_WB: RigidTransform,
    placement: Placement,
    records: Sequence[ActionRecord],
) -> str:
    """Returns why a tool was not placed, one of `CAUSES`.

    - `never picked`: no attempt to grasp the tool was completed.
    - `missed grasp`: every attempt to grasp the tool failed.
    - `reversed`: the tool is at its cavity, but rotated by 180 degrees or on the wrong side.
    - `insertion blocked`: the tool is over its cavity, but protrudes or is displaced.
    - `slipped`: the tool was lost on the way, or left outside the kit by a correct action.
    - `wrong cavity`: the tool is over another tool's cavity.
    - `misplaced`: the tool is anywhere else.

    Args:
        scene: the scene of the episode.
        index: the index of the tool among the scene's objects.
        X_WB: final pose of the tool.
        placement: the placement of the tool, with respect to the goal assigned to it.
        records: the episode's actions.
    """
    item = scene.objects[index]
    last = last_action_on(item.name, records)
    if isinstance(last, str):
        return last
    middle = (item.p_BPoints.min(axis=0) + item.p_BPoints.max(axis=0)) / 2
    goal = scene.goals[placement.goal] if placement.goal is not None else None
    if goal is not None:
        X_WGoal = goal.poses[placement.pose]
        grasp_point = np.array([item.grasps[0].x, item.grasps[0].y, 0.0])
        # Compare the grasp point as well: half a turn about the grasp displaces the tool's
        # middle, but not the grasp.
        if min(_gap(X_WB, X_WGoal, middle), _gap(X_WB, X_WGoal, grasp_point)) < _NEAR:
            # `angle_error` is modulo the tool's symmetry: half a turn of a symmetric tool gives 0.
            rotation = abs(placement.angle_error)
            if rotation > math.pi - _ALIGNED or _tilt(X_WB) > _TILTED:
                return REVERSED
            if rotation < _ALIGNED:
                return BLOCKED
    if last.outcome == "dropped":
        return SLIPPED
    if any(_is_over(X_WB @ middle, X_WB, X) for g in scene.goals if g is not goal for X in g.poses):
        return WRONG_CAVITY
    meant_well = (last.place_position_error_mm or 0.0) < 1e3 * _NEAR and (
        last.place_angle_error_deg or 0.0
    ) < math.degrees(_ALIGNED)
    return SLIPPED if meant_well and not _is_over_kit(scene, X_WB @ middle) else MISPLACED


def _gap(X_WB: RigidTransform, X_WGoal: RigidTransform, point: np.ndarray) -> float:
    """Horizontal distance of a body-fixed point (3) from its position at the goal, in m."""
    return float(np.linalg.norm((X_WB @ point - X_WGoal @ point)[:2]))


def _tilt(X_WB: RigidTransform) -> float:
    """The angle between body z and world z, in radians."""
    return math.acos(np.clip(X_WB.rotation().matrix()[2, 2], -1.0, 1.0))


def _is_over(p_WMiddle: np.ndarray, X_WB: RigidTransform, X_WGoal: RigidTransform) -> bool:
    """Whether a tool lies over and along a cavity, in either direction."""
    along = abs(wrap_to_pi(2 * (heading(X_WB) - heading(X_WGoal)))) / 2 < _ALIGNED
    return along and float(np.linalg.norm((p_WMiddle - X_WGoal.translation())[:2])) < _NEAR


def _is_over_kit(scene: Scene, p_WPoint: np.ndarray) -> bool:
    """Whether a point is over a kit: within the bounding box of the kit's seated tools, plus a
    border."""
    return any(_is_over_one(scene, kit, p_WPoint) for kit in {goal.fixture for goal in scene.goals})


def _is_over_one(scene: Scene, kit: int, p_WPoint: np.ndarray) -> bool:
    """Whether a point is over the kit with the index `kit` among the scene's fixtures."""
    X_KW = scene.fixtures[kit].X_WF.inverse()
    seated = np.concatenate(
        [
            (X_KW @ goal.poses[0]).multiply(scene.objects[goal.objects[0]].p_BPoints.T).T
            for goal in scene.goals
            if goal.fixture == kit
        ]
    )
    low, high = seated.min(axis=0)[:2] - _BORDER, seated.max(axis=0)[:2] + _BORDER
    point = (X_KW @ p_WPoint)[:2]
    return bool((point >= low).all() and (point <= high).all())
