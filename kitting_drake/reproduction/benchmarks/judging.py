"""Judges a decision on a static scene by geometry, without physics."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from manifold3d import CrossSection, Manifold
from numpy.typing import NDArray
from pydrake.math import RigidTransform, RollPitchYaw
from scipy.spatial import cKDTree

from kitting_drake.hkd.generation.random_tools import RandomTool
from kitting_drake.policies.matching.jaw_clearance import tip_height
from kitting_drake.static_scenes.drawing import LooseTool, Obstacle
from kitting_drake.tasks.kitting.convex_bodies import solid_of
from kitting_drake.tasks.kitting.tool_poses import rectangle_at
from systems.hand_geometry import FINGER_LENGTH, FINGERTIP_DEPTH, MAX_OPENING, PAD_LENGTH
from systems.pick_place_parameters import PickPlaceParameters
from systems.signals import PickPlaceAction, PlanarPose

Array = NDArray[np.float64]

_SPACING = 0.002
"""The distance between the points of an outline, in metres."""
_TOUCHED, _HELD = 4e-6, 2e-5
"""Areas of overlap in square metres, seen from above. A finger touches an object if they overlap by
more than `_TOUCHED`. The jaws hold an object if the part of it between the pads is larger than
`_HELD`."""
_TALL = 1.0
"""Larger than the height of any object, in metres."""
PLACE_OFF = 0.0035
"""A place is right if 95 % of the placed outline is within this distance, in metres, of the outline
at the goal."""


def judge(action: PickPlaceAction, loose: Sequence[LooseTool], planner: PickPlaceParameters) -> str:
    """Judges whether an action would put a tool into its cavity.

    Args:
        action: the pick and place, in the world.
        loose: the tools that are not in their cavities yet.
        planner: parameters of the motion, which say how deep the fingers grip.

    Returns:
        `right`, or what is wrong: `no tool` (the action picks nothing that belongs in a cavity),
            `grasp` (the hand cannot hold the tool there) or `place` (the place is wrong).
    """
    picked = _picked(action, loose)
    if picked is None:
        return "no tool"
    if not _is_grasp(action, picked, planner):
        return "grasp"
    here, there = (_outline(picked.tool.footprint, X) for X in (picked.X_WT, picked.X_WGoal))
    turn = action.place.theta - action.pick.theta
    c, s = math.cos(turn), math.sin(turn)
    arm = here - (action.pick.x, action.pick.y)
    moved = arm @ np.array([[c, s], [-s, c]]) + (action.place.x, action.place.y)
    away = np.concatenate([cKDTree(there).query(moved)[0], cKDTree(moved).query(there)[0]])
    return "right" if np.percentile(away, 95) <= PLACE_OFF else "place"


def covering(action: PickPlaceAction, loose: Sequence[LooseTool]) -> list[PlanarPose]:
    """Returns poses all over the tool that an action picks.

    A policy that gets them as failed picks takes another tool next.
    """
    picked = _picked(action, loose)
    if picked is None:
        return [action.pick]
    points = _outline(picked.tool.footprint, picked.X_WT)[::6]
    return [action.pick, *(PlanarPose(float(x), float(y)) for x, y in points)]


def _picked(action: PickPlaceAction, loose: Sequence[LooseTool]) -> LooseTool | None:
    """Returns the tool with the largest part between the open jaws; None if no tool is there."""
    pick = action.pick
    between = rectangle_at((PAD_LENGTH, MAX_OPENING), pick.x, pick.y, pick.theta)
    held = [(between ^ _placed(item.tool.footprint, item.X_WT)).area() for item in loose]
    if not held or max(held) < _HELD:
        return None
    return loose[int(np.argmax(held))]


def _is_grasp(action: PickPlaceAction, picked: LooseTool, planner: PickPlaceParameters) -> bool:
    """Whether the open fingers come down beside the tool and touch no other object."""
    pick = action.pick
    outline = _placed(picked.tool.footprint, picked.X_WT)
    side = (MAX_OPENING + FINGERTIP_DEPTH) / 2
    across = np.array([-math.sin(pick.theta), math.cos(pick.theta)])
    tip = _tip_height(pick, picked, planner)
    for sign in (1, -1):
        x, y = np.array([pick.x, pick.y]) + sign * side * across
        finger = rectangle_at((FINGER_LENGTH, FINGERTIP_DEPTH), x, y, pick.theta)
        if (finger ^ outline).area() > _TOUCHED:
            return False
        if any(_touches(finger, tip, other) for other in picked.around):
            return False
    return True


def _tip_height(pick: PlanarPose, picked: LooseTool, planner: PickPlaceParameters) -> float:
    """Returns the height of the fingertips at a pick, in metres above the table."""
    between = rectangle_at((PAD_LENGTH, MAX_OPENING), pick.x, pick.y, pick.theta)
    held = _world_solid(picked.tool, picked.X_WT) ^ between.extrude(2 * _TALL).translate(
        (0, 0, -_TALL)
    )
    low, high = (held.bounding_box()[k] for k in (2, 5))
    return float(tip_height(np.array(high), max(low, 0.0), planner))


def _touches(finger: CrossSection, tip: float, other: Obstacle) -> bool:
    """Whether a finger that comes down to the height `tip` touches an obstacle."""
    if (finger ^ other.outline).area() <= _TOUCHED:
        return False
    if other.tool is None or other.X_WT is None:
        return True
    above = _world_solid(other.tool, other.X_WT).trim_by_plane((0, 0, 1), tip)
    return bool((finger ^ above.project()).area() > _TOUCHED)


def _world_solid(tool: RandomTool, X_WT: RigidTransform) -> Manifold:
    return solid_of(tool).transform(X_WT.GetAsMatrix34())


def _placed(footprint: CrossSection, X_W: RigidTransform) -> CrossSection:
    yaw = RollPitchYaw(X_W.rotation()).yaw_angle()
    return footprint.rotate(math.degrees(yaw)).translate(tuple(X_W.translation()[:2]))


def _outline(footprint: CrossSection, X_W: RigidTransform) -> Array:
    """Returns evenly spaced points (n, 2) of a footprint's outline at a pose."""
    points = []
    for polygon in _placed(footprint, X_W).to_polygons():
        ends = np.roll(polygon, -1, axis=0)
        for start, end in zip(polygon, ends, strict=True):
            count = max(1, math.ceil(np.linalg.norm(end - start) / _SPACING))
            points.append(start + (end - start) * (np.arange(count) / count)[:, None])
    return np.concatenate(points)
