"""Records a policy's actions, and how far they deviate from the expert's.

The records use true poses, which policies cannot see.
"""

import dataclasses
import math

import numpy as np
from pydrake.math import RigidTransform, RollPitchYaw

from kitting_drake.episode.events import ModeChange
from kitting_drake.station import KittingStation
from kitting_drake.tasks.task import ActionRecord, PeakForce
from systems.oracle_policy import gripper_pose
from systems.pick_place_parameters import Mode
from systems.placement import Goal, PlacedObject, displacement, heading
from systems.signals import PlanarPose, wrap_to_pi

_LIFTED = 0.010
"""An object that rises by at least this, in m, counts as lifted."""


def nearest_object(station: KittingStation, poses: list[RigidTransform], pick: PlanarPose) -> int:
    """The index of the object whose surface is nearest to a pick, seen from above.

    Args:
        station: the station of the episode.
        poses: X_WB of each object.
        pick: the gripper's pose at the pick, in the world.
    """
    distances = []
    for item, X_WB in zip(station.objects, poses, strict=True):
        points = X_WB.multiply(item.p_BPoints.T)[:2]
        distances.append(np.hypot(points[0] - pick.x, points[1] - pick.y).min())
    return int(np.argmin(distances))


class ActionLog:
    """Records the actions of an episode. Pass its method `observe` as an `EpisodeObserver`."""

    def __init__(self, station: KittingStation) -> None:
        """
        Args:
            station: the station of the episode.
        """
        self._station = station
        self._before: list[RigidTransform] = []
        self._placed: list[bool] = []
        self._stopped = 0
        self.records: list[ActionRecord] = []

    def observe(self, event: ModeChange) -> None:
        """Updates the records when the planner's mode changes."""
        if not event.is_last:
            self._follow(event)
        if self.records:
            vertical, lateral, mode = self._station.peak_force(event.root_context)
            self.records[-1].peak_force_n = PeakForce(vertical, lateral, mode.name)
            stopped = self._station.counts(event.root_context)[3]
            if stopped > self._stopped:
                self.records[-1].outcome, self._stopped = "stopped", stopped

    def _follow(self, event: ModeChange) -> None:
        if event.is_action_start:
            self._before = self._station.object_poses(event.root_context)
            placements = self._station.placements(event.root_context)
            self._placed = [placement.strict_success for placement in placements]
            action = self._station.accepted_action(event.root_context)
            index = nearest_object(self._station, self._before, action.pick)
            self.records.append(self._record(index, action.pick, action.place))
        elif event.mode == Mode.CARRY:
            self._find_lifted(event)
        elif self.records and self.records[-1].outcome == "stopped":
            return
        elif event.mode == Mode.RELEASE:
            self.records[-1].outcome = "placed"
        elif event.mode == Mode.RETREAT and self.records:
            self.records[-1].outcome = self._outcome(event)
            if event.previous == Mode.DESCEND:
                self.records[-1] = dataclasses.replace(
                    self.records[-1],
                    pick_position_error_mm=None,
                    pick_angle_error_deg=None,
                    place_position_error_mm=None,
                    place_angle_error_deg=None,
                )

    def _outcome(self, event: ModeChange) -> str:
        """The outcome of the present action, when the hand retreats: as the planner has recorded
        it, else as the modes show it."""
        history = self._station.history(event.root_context)
        if history:
            return history[-1].outcome
        by_mode = {
            Mode.APPROACH: "unreachable",
            Mode.CHECK: "missed",
            Mode.DESCEND: "pressed",
            Mode.RELEASE: "placed",
        }
        return by_mode.get(event.previous, "dropped")

    def _find_lifted(self, event: ModeChange) -> None:
        now = self._station.object_poses(event.root_context)
        rises = [
            X_WB.translation()[2] - X_before.translation()[2]
            for X_WB, X_before in zip(now, self._before, strict=True)
        ]
        if max(rises) > _LIFTED:
            last = self.records[-1]
            self.records[-1] = self._record(int(np.argmax(rises)), last.pick, last.place)

    def _record(self, index: int, pick: PlanarPose, place: PlanarPose) -> ActionRecord:
        """Makes a new record, with outcome "unfinished", of an action on the given object."""
        scene_object, item = self._station.scene.objects[index], self._station.objects[index]
        record = ActionRecord(
            object=scene_object.name,
            category=scene_object.category,
            outcome="unfinished",
            pick=pick,
            place=place,
            pick_position_error_mm=None,
            pick_angle_error_deg=None,
            place_position_error_mm=None,
            place_angle_error_deg=None,
            was_placed=self._placed[index],
        )
        X_WB = self._before[index]
        best = [gripper_pose(X_WB, grasp) for grasp in scene_object.grasps]
        if best:
            nearest = min(best, key=lambda pose: math.hypot(pick.x - pose.x, pick.y - pose.y))
            # Several grasps may be at the nearest point. Use the one nearest in angle to the pick.
            here = [p for p in best if math.hypot(p.x - nearest.x, p.y - nearest.y) < 1e-6]
            angle = min(abs(wrap_to_pi(2 * (pick.theta - p.theta))) / 2 for p in here)
            distance = math.hypot(pick.x - nearest.x, pick.y - nearest.y)
            record = dataclasses.replace(
                record,
                pick_position_error_mm=1e3 * distance,
                pick_angle_error_deg=math.degrees(angle),
            )
        arrival = _arrival(X_WB, pick, place)
        errors = [
            _place_errors(item, goal, X_WGoal, arrival)
            for goal in self._station.scene.goals
            if index in goal.objects
            for X_WGoal in goal.poses
        ]
        if errors:
            _, position, angle = min(errors)
            record = dataclasses.replace(
                record,
                place_position_error_mm=1e3 * position,
                place_angle_error_deg=math.degrees(angle),
            )
        return record


def _place_errors(
    item: PlacedObject, goal: Goal, X_WGoal: RigidTransform, arrival: RigidTransform
) -> tuple[float, float, float]:
    """Returns how an object's pose after the action differs from its goal pose: the `displacement`
    (m), the distance of the object's middle from where it should be (m), and the angle (rad).

    Only the planar pose after the action is known, so heights are not compared.
    """
    flat = RigidTransform(
        X_WGoal.rotation(), [*X_WGoal.translation()[:2], arrival.translation()[2]]
    )
    offset = (arrival @ item.p_BMiddle - X_WGoal @ item.p_BMiddle)[:2]
    angle = wrap_to_pi(heading(arrival) - heading(X_WGoal))
    if item.symmetry > 1:
        angle = math.remainder(angle, math.tau / item.symmetry)
    return (
        displacement(item, flat, arrival, any_heading=goal.any_heading),
        float(np.linalg.norm(offset)),
        0.0 if goal.any_heading else abs(angle),
    )


def _arrival(X_WB: RigidTransform, pick: PlanarPose, place: PlanarPose) -> RigidTransform:
    """The pose of an object at X_WB after moving rigidly with the gripper from pick to place."""
    return _pose(place) @ _pose(pick).inverse() @ X_WB


def _pose(planar: PlanarPose) -> RigidTransform:
    return RigidTransform(RollPitchYaw(0, 0, planar.theta), [planar.x, planar.y, 0])
