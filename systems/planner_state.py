"""The state of the pick-and-place motion primitive."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from systems.motion_heights import MotionHeights
from systems.signals import SurfaceHeights
from systems.vector_view import Array, Number, VectorView

X, Y, Z, YAW = range(4)
"""Indices of the hand's axes in `PlannerState.start` and `goal`."""


RECENT = 16
"""Number of the latest contact forces that the state keeps."""


class PlannerState(VectorView):
    """The planner's state vector, in SI units.

    Fields with the ending `_z` are heights in the world. Those without a docstring come from
    `MotionHeights` and `SurfaceHeights`.
    """

    mode = Number()
    start_time = Number()
    duration = Number()
    start = Array(4)
    """x, y, z and yaw of the hand at the start of the present motion."""
    goal = Array(4)
    """x, y, z and yaw of the hand at the end of the present motion."""
    start_rate = Array(4)
    """Velocities of x, y, z and yaw at the start of the present motion."""
    delays = Array(3)
    """Times, after `start_time`, at which (x, y), z and yaw begin to travel."""
    leg_ways = Array(3)
    """Displacements along z of the legs of a guarded motion, in order; zero for unused legs."""
    leg_delays = Array(3)
    start_opening = Number()
    goal_opening = Number()
    start_force = Number()
    goal_force = Number()
    force_start_time = Number()
    pick = Array(3)
    """x, y and yaw of the hand at the pick; `place` holds those at the place."""
    place = Array(3)
    grasp_z = Number()
    travel_z = Number()
    clear_z = Number()
    pick_top_z = Number()
    pick_hover_z = Number()
    place_hover_z = Number()
    table_z = Number()
    support_z = Number()
    rim_z = Number()
    """Lower bound of the height of the rim around the place."""
    floor_z = Number()
    around_pick_z = Number()
    """Height of the highest surface below an arm's wrist at the pick; `around_place_z` is that at
    the place."""
    around_place_z = Number()
    doubt = Number()
    """The uncertainty of the surface heights."""
    width = Number()
    """The width of the object at the pick; infinite if unknown."""
    hold_z = Number()
    """Height of the fingertips just after the jaws gripped the object. `touch_z` is the height at
    which the object touched a cavity's rim."""
    touch_z = Number()
    held_width = Number()
    """The opening of the jaws just after they gripped the object, in m."""
    steady_weight = Number()
    """The weight that the hand felt as it rose, in N, when it changed last. `steady_z` is the
    height of the fingertips then. `latest_weight` is the weight felt in the latest step."""
    latest_weight = Number()
    steady_z = Number()
    hanging = Number()
    """How far the object hangs below the height at which it was gripped, in m."""
    gentleness = Number()
    """The fraction of the limits of speed and acceleration that is used to move the held object; 0
    stands for 1."""
    search_step = Number()
    payload = Number()
    """The vertical force of the payload on the hand, in N; negative or zero."""
    felt_payload = Number()
    """An estimate of `payload`, in N, which is updated until the weighing begins."""
    weighings = Number()
    """Number of samples in the mean that gives `payload`."""
    beyond = Number()
    """Time for which the contact force has exceeded the limit without interruption, in s."""
    recent = Array(3 * RECENT)
    """x, y and z of the latest contact forces, latest first, without the weight and inertia of the
    held object, in N."""
    peak_vertical = Number()
    """The largest vertical contact force of the action, in N. `peak_lateral` is the largest lateral
    one."""
    peak_lateral = Number()
    peak_mode = Number()
    """The mode in which the larger of the two peak forces occurred."""
    actions = Number()
    missed = Number()
    dropped = Number()
    stopped = Number()
    """Number of actions that the force guard stopped. `actions`, `missed` and `dropped` are the
    numbers of actions begun, grasps missed and objects dropped."""
    stops = Number()
    """1 if the force guard has ended the action, else 0."""
    refused = Number()
    """1 if the robot cannot reach the action's poses, else 0."""
    press = Number()
    """1 if the action presses, else 0."""
    aside = Number()
    """1 if the action lays the object aside, else 0."""
    middle = Array(2)
    """The action's `middle`, in m; NaN if it is None."""
    spread = Array(3)
    """The action's `spread`, in m^2; NaN if it is None."""
    let_go_z = Number()
    """Height of the fingertips when the hand began to retreat. `carries_since` is the time since
    which it has felt the weight of an object in the retreat; infinite if it feels none."""
    carries_since = Number()
    layings = Number()
    """How often the hand went down again in this action, to rid itself of an object."""
    lowers_next = Number()
    """1 while the hand brakes before it goes down again, else 0."""
    lever = Number()
    """Position of the object's centre of mass relative to the pads' middle, along the pads, in m.
    It is recorded in the history if the object is set down again."""
    trial_weight = Number()
    """The largest weight felt in the trial lift, in N. It is felt when the table bears the least of
    the object's weight."""
    doubts_grip = Number()
    """1 during a trial lift of an object that may turn between the pads, else 0."""
    trusts_grip = Number()
    """1 if the trial lift has shown that the object will not turn on the way, else 0."""
    set_downs = Number()
    """Number of earlier actions that lifted the present object and set it down again."""
    free_actions = Number()
    """Number of actions that do not count against the limit, because they only lifted an object and
    set it down again."""
    stop = Number()
    """0 until the planner stops; then 1 plus the index of the reason in `STOP_REASONS`."""

    def set_heights(self, motion: MotionHeights, surfaces: SurfaceHeights) -> None:
        """Stores the heights of an action in the state."""
        self.grasp_z, self.pick_top_z = motion.grasp, surfaces.pick_top
        self.table_z, self.support_z = surfaces.table, surfaces.support
        # The measured rim may be too high. Store the least height that it may have, so that an
        # object that seems to be slightly below the rim still counts as standing on it.
        self.rim_z = surfaces.place_rim - surfaces.doubt
        self.floor_z, self.doubt = surfaces.place_floor, surfaces.doubt
        self.around_pick_z = min(surfaces.around_pick, surfaces.highest)
        self.around_place_z = min(surfaces.around_place, surfaces.highest)
        self.width = surfaces.width
        self.clear_z, self.travel_z = motion.clear, motion.travel
        self.pick_hover_z, self.place_hover_z = motion.pick_hover, motion.place_hover


@dataclass(slots=True)
class Moment:
    """The inputs of one step of the state machine."""

    state: PlannerState
    """The planner's state, which the step modifies."""
    time: float
    hand: NDArray[np.float64]
    """(12) value of the planner's port `hand_state`."""
    contact: NDArray[np.float64]
    """(6) value of the planner's port `hand_contact_force`."""
    wrist_moment: float | None = None
    """Value of the planner's port `wrist_moment`, in N m; None if it is not connected or
    the mode is not `LIFT`."""
