"""Judges a decision on a static scene by geometry, without physics."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

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
from systems.hand_geometry import FINGER_LENGTH, FINGERTIP_DEPTH, PAD_LENGTH
from systems.jaw_motion import ROOM
from systems.pick_place_parameters import PickPlaceParameters
from systems.signals import Observation, PickPlaceAction, PlanarPose
from systems.surface_heights import read_surface_heights

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


def judge(
    action: PickPlaceAction,
    loose: Sequence[LooseTool],
    planner: PickPlaceParameters,
    observation: Observation,
) -> str:
    """Judges whether an action would put a tool into its cavity.

    Args:
        action: the pick and place, in the world.
        loose: the tools that are not in their cavities yet.
        planner: parameters of the motion, which say how deep the fingers grip.
        observation: the observation o_t, in which the planner measures how wide to open the jaws.

    Returns:
        `right`, or what is wrong: `no tool` (the action picks nothing that belongs in a cavity),
            `grasp` (the hand cannot hold the tool there) or `place` (the place is wrong).
    """
    jaws = _jaws(action, planner, observation)
    picked, tip = _picked(jaws, loose, planner)
    if picked is None:
        return "no tool"
    if not _is_grasp(jaws, picked, tip):
        return "grasp"
    here, there = (_outline(picked.tool.footprint, X) for X in (picked.X_WT, picked.X_WGoal))
    turn = action.place.theta - action.pick.theta
    c, s = math.cos(turn), math.sin(turn)
    arm = here - (action.pick.x, action.pick.y)
    moved = arm @ np.array([[c, s], [-s, c]]) + (action.place.x, action.place.y)
    away = np.concatenate([cKDTree(there).query(moved)[0], cKDTree(moved).query(there)[0]])
    return "right" if np.percentile(away, 95) <= PLACE_OFF else "place"


@dataclass(frozen=True)
class _Jaws:
    """The open jaws at a pick."""

    pose: PlanarPose
    opening: float
    """The distance between the pads, in metres."""

    @property
    def between(self) -> CrossSection:
        """The area between the pads, seen from above."""
        return rectangle_at((PAD_LENGTH, self.opening), self.pose.x, self.pose.y, self.pose.theta)

    @property
    def fingers(self) -> list[CrossSection]:
        """The areas of both fingers, seen from above."""
        side = (self.opening + FINGERTIP_DEPTH) / 2
        across = side * np.array([-math.sin(self.pose.theta), math.cos(self.pose.theta)])
        middles = [np.array([self.pose.x, self.pose.y]) + sign * across for sign in (1, -1)]
        size = (FINGER_LENGTH, FINGERTIP_DEPTH)
        return [rectangle_at(size, x, y, self.pose.theta) for x, y in middles]


def _jaws(action: PickPlaceAction, planner: PickPlaceParameters, observation: Observation) -> _Jaws:
    width = read_surface_heights(observation, action.pick, action.place).width
    return _Jaws(action.pick, min(planner.open_width, width + 2 * ROOM))


def _picked(
    jaws: _Jaws, loose: Sequence[LooseTool], planner: PickPlaceParameters
) -> tuple[LooseTool | None, float]:
    """Returns the tool with the largest part between the pads, and the height of the fingertips in
    metres above the table. The tool is None if there is none.

    The fingertips come down beside the highest tool. What lies lower is not gripped.
    """
    between = jaws.between
    column = between.extrude(2 * _TALL).translate((0, 0, -_TALL))
    near = [
        (item, _world_solid(item.tool, item.X_WT) ^ column)
        for item in loose
        if (between ^ _placed(item.tool.footprint, item.X_WT)).area() > _HELD
    ]
    if not near:
        return None, 0.0
    low, high = max((held.bounding_box()[2::3] for _, held in near), key=lambda ends: ends[1])
    tip = float(tip_height(np.array(high), max(low, 0.0), planner))
    gripped = [held.trim_by_plane((0, 0, 1), tip).project().area() for _, held in near]
    return near[int(np.argmax(gripped))][0], tip


def _is_grasp(jaws: _Jaws, picked: LooseTool, tip: float) -> bool:
    """Whether the open fingers come down without touching the picked tool or another object."""
    itself = Obstacle(_placed(picked.tool.footprint, picked.X_WT), picked.tool, picked.X_WT)
    return not any(
        _touches(finger, tip, other)
        for finger in jaws.fingers
        for other in (itself, *picked.around)
    )


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
