"""Checks whether an arm reaches the objects and goals of a scene."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable

import numpy as np
from pydrake.math import RigidTransform

from kitting_drake.common.errors import UserError
from kitting_drake.tasks.task import Scene, SceneObject
from systems.arm_motion import ArmMotion
from systems.arm_postures import HandStop
from systems.arm_reach import hand_stops, reach_problem
from systems.motion_heights import motion_heights
from systems.oracle_policy import gripper_pose
from systems.pick_place_parameters import PickPlaceParameters
from systems.robot_motion import RobotMotion
from systems.signals import PlanarPose, SurfaceHeights
from systems.surface_heights import WRIST_REACH


def check_scene_reach(scene: Scene, motion: RobotMotion, parameters: PickPlaceParameters) -> None:
    """Raises an error if an arm reaches none of a scene's objects, or none of its goals. A floating
    hand reaches all.

    It is no error if some objects or goals are out of reach: actions on them are refused during the
    episode.

    Raises:
        UserError: all goals, or all objects that can fill a goal, are out of reach.
    """
    if not isinstance(motion, ArmMotion):
        return
    for what, problems in (
        ("objects", _object_problems(scene, motion, parameters)),
        ("goals", _goal_problems(scene, motion, parameters)),
    ):
        first = ""
        for problem in problems:
            if not problem:
                break
            first = first or problem
        else:
            if first:
                raise UserError(
                    f"robot.base: the arm reaches none of the scene's {what}: {first}; "
                    "`benchmark reach` finds a better base"
                )


def scene_problems(scene: Scene, motion: ArmMotion, parameters: PickPlaceParameters) -> list[str]:
    """A sentence for each object and goal of a scene that an arm cannot reach."""
    found = (
        *_object_problems(scene, motion, parameters),
        *_goal_problems(scene, motion, parameters),
    )
    return [problem for problem in found if problem]


def _object_problems(
    scene: Scene, motion: ArmMotion, parameters: PickPlaceParameters
) -> Iterable[str]:
    poses = {index: scene.objects[index].X_WB for index in scene.goal_objects}
    if scene.arrivals is not None:
        poses |= dict(zip(scene.arrivals.objects, scene.arrivals.poses, strict=True))
    for index, X_WB in poses.items():
        item = scene.objects[index]
        yield _first_problem(_stops(item, X_WB, item.name, scene, parameters), motion)


def _goal_problems(
    scene: Scene, motion: ArmMotion, parameters: PickPlaceParameters
) -> Iterable[str]:
    for goal in scene.goals:
        stops = (
            stop
            for index in goal.objects
            for X_WGoal in goal.poses
            for stop in _stops(scene.objects[index], X_WGoal, goal.name, scene, parameters)
        )
        yield _first_problem(stops, motion)


def _first_problem(stops: Iterable[HandStop], motion: ArmMotion) -> str:
    """Returns "" if an arm can reach one of the stops; if not, why it cannot reach the first."""
    first = ""
    for stop in stops:
        problem = reach_problem(motion.postures, [stop])
        if not problem:
            return ""
        first = first or problem
    return first


def _stops(
    item: SceneObject,
    X_WB: RigidTransform,
    name: str,
    scene: Scene,
    parameters: PickPlaceParameters,
) -> Iterable[HandStop]:
    """Yields, for each grasp of an object at a pose, where the hand goes down."""
    highest = _highest(scene)
    bottom = float(X_WB.translation()[2])
    for grasp in item.grasps:
        pose = gripper_pose(X_WB, grasp)
        surfaces = SurfaceHeights(
            pick_top=bottom + grasp.surface_height,
            support=bottom,
            place_rim=highest,
            near_pick=highest,
            near_place=highest,
            highest=highest,
        )
        heights = motion_heights(surfaces, parameters)
        at = PlanarPose(*(float(value) for value in pose.as_array()))
        around = _highest(scene, at)
        (pick, _) = hand_stops(at, at, heights, 0.0, parameters, (around, around))
        yield dataclasses.replace(pick, name=name)


def _highest(scene: Scene, around: PlanarPose | None = None) -> float:
    """World z of the highest point of fixtures with cavities and of the objects that are present,
    in m. If `around` is given, only the parts of objects count that are below an arm's wrist when
    the hand is there."""
    late = () if scene.arrivals is None else scene.arrivals.objects
    present = [item for index, item in enumerate(scene.objects) if index not in late]
    tops = np.concatenate(
        [np.zeros((3, 1)), *(item.X_WB @ item.p_BPoints.T for item in present)], 1
    )
    if around is not None:
        away = np.abs(tops[:2] - np.array([[around.x], [around.y]])).max(axis=0)
        tops = tops[:, away <= WRIST_REACH]
    rims = [goal.highest or goal.rim_height for goal in scene.goals]
    return max(tops[2].max(initial=0.0), *(rim for rim in rims if rim is not None), 0.0)
