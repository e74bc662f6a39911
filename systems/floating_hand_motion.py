"""The floating hand's motion in each mode of the pick-and-place motion primitive."""

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from systems.guarded_marks import guarded_marks
from systems.hand_motion import (
    PARTS,
    Leg,
    MotionLimits,
    blended_legs,
    braking_time,
    motion_at,
    motion_duration,
    shortest_yaws,
    time_to_reach,
)
from systems.jaw_motion import JawMotion
from systems.pick_place_parameters import Mode, PickPlaceParameters
from systems.planner_state import YAW, PlannerState, X, Y, Z

YAW_LIMIT = 3.4
"""Largest yaw of the wrist in either direction, in rad; slightly less than its joint limit."""
_NEARLY_THERE = 0.02
"""Within this horizontal distance of its goal, in m, the hand may sink below the height at which it
crosses the table."""
TRIAL = 0.010
"""How far an object is lifted for a trial of the grasp, in m: just clear of the table."""
_OVERSHOOT = 0.05
"""The goal of a lift is this far above the travel height (see `MotionHeights`), in m, so that the
hand does not stop there."""
_ASIDE_SPEED = 0.25
"""The largest speed, in m/s, at which the hand lifts an object that it lays aside. The object may
turn in the jaws and then hit the kit or another object."""
_HOLDING = (Mode.LIFT, Mode.CARRY, Mode.LOWER, Mode.SEARCH)
"""The modes in which an object is in the hand."""


class HandMotion(JawMotion):
    """Implements `RobotMotion` for the floating hand."""

    size = 12
    # Deviations of the hand from its command decay with a time constant of about 22 ms.
    settles = 0.05

    def __init__(self, parameters: PickPlaceParameters) -> None:
        """
        Args:
            parameters: heights, speeds and forces of the motion primitive.
        """
        super().__init__(parameters)
        self._limits = parameters.motion_limits()

    def initial_state(self) -> NDArray[np.float64]:
        """A state in which the hand waits at home with open jaws."""
        vector = np.zeros(PlannerState.size)
        state = PlannerState(vector)
        state.start = state.goal = self._parameters.home
        self.open(state)
        return vector

    def view(self, vector: NDArray[np.float64]) -> PlannerState:
        """Returns a view of a state vector with named fields. See `RobotMotion`."""
        return PlannerState(vector)

    def prepare(self, state: PlannerState) -> bool:
        """Chooses, among equivalent yaws at pick and place, those that rotate the wrist least.
        Returns True, because the hand can do every action."""
        state.pick[2], state.place[2] = shortest_yaws(
            float(state.pick[2]), float(state.place[2]), float(state.goal[YAW]), YAW_LIMIT
        )
        return True

    def begin(
        self,
        state: PlannerState,
        mode: Mode,
        time: float,
        z: float | None = None,
        opening: float | None = None,
        at: NDArray[np.float64] | None = None,
    ) -> None:
        """Starts a mode from the motion that is commanded now. See `RobotMotion`."""
        now, rate, _ = np.split(self.motion_at(state, time), 3)
        if z is not None:
            now[2] = z
            rate = np.zeros(4)
        if at is not None:
            now, rate = np.array(at), np.zeros(4)
        self.begin_jaws(state, mode, time, opening)
        state.mode = mode
        self._begin_at(state, time, now, rate)

    def _begin_at(
        self, state: PlannerState, time: float, now: NDArray[np.float64], rate: NDArray[np.float64]
    ) -> None:
        """Starts the motion of the present mode from a position (4) and a velocity (4)."""
        state.start_time = time
        state.start = now
        state.start_rate = rate
        # The default goal is where the hand comes to rest if it brakes.
        state.goal = now + rate * braking_time(rate, self._limits_of(state)) / 2
        self._set_goals(state, Mode(int(state.mode)))
        self.set_times(state)

    def _set_goals(self, state: PlannerState, mode: Mode) -> None:
        """Sets the goal of a mode. Axes that the mode does not set keep the default goal."""
        parameters = self._parameters
        if mode == Mode.APPROACH:
            state.goal = (*state.pick[:2], state.pick_hover_z, state.pick[2])
        elif mode == Mode.DESCEND:
            state.goal[Z] = state.grasp_z
            if state.press:
                state.goal[Z] = state.pick_top_z - parameters.press_depth
        elif mode == Mode.LIFT:
            trial = max(state.hold_z + TRIAL, float(state.goal[Z]))
            state.goal[Z] = trial if state.doubts_grip else state.travel_z + _OVERSHOOT
        elif mode == Mode.CARRY:
            state.goal = (*state.place[:2], state.place_hover_z, state.place[2])
        elif mode == Mode.LOWER:
            state.goal[Z] = state.table_z + parameters.floor_clearance
        elif mode == Mode.SEARCH:
            x, y, yaw = parameters.search.offset(int(state.search_step))
            state.goal[X], state.goal[Y] = state.place[0] + x, state.place[1] + y
            state.goal[YAW] = min(max(state.place[2] + yaw, -YAW_LIMIT), YAW_LIMIT)
            state.goal[Z] = state.touch_z - parameters.search.press
        elif mode == Mode.RETREAT:
            state.goal[X], _, home_z, _ = parameters.home
            state.goal[Z] = max(home_z, state.travel_z)

    def set_times(self, state: PlannerState) -> None:
        """Sets the delays and the duration of the present mode's motion."""
        mode = Mode(int(state.mode))
        limits = self._limits_of(state)
        rate = state.start_rate
        braking = braking_time(rate, limits)
        # An axis that still moves brakes before it travels.
        delays = np.array([braking * bool(rate[part].any()) for part in PARTS])
        ways = np.abs(state.goal - state.start - rate * braking / 2)
        across, height = float(np.linalg.norm(ways[:2])), float(ways[2])
        of_plane, of_height, _ = limits.of_parts()
        if mode == Mode.CARRY:
            # Travel across only when the lift is almost complete: half of its braking time is over.
            delays = np.maximum(delays, braking / 2)
        if mode in (Mode.APPROACH, Mode.CARRY):
            # Delay the descent until the hand is near its goal.
            clear = state.clear_z if mode == Mode.APPROACH else state.travel_z
            nearly_there = delays[0] + time_to_reach(across - _NEARLY_THERE, across, *of_plane)
            sinks = height - (clear - state.goal[Z])
            delays[1] = max(delays[1], nearly_there - time_to_reach(sinks, height, *of_height))
        elif mode == Mode.RETREAT:
            # Delay the horizontal motion until the hand has risen.
            rises = height - (state.goal[Z] - state.travel_z)
            delays[0] = max(delays[0], delays[1] + time_to_reach(rises, height, *of_height))
        state.delays = delays
        state.leg_ways = state.leg_delays = np.zeros(3)
        if mode in (Mode.DESCEND, Mode.LOWER):
            self._set_legs(state, mode)
        legs = self._legs(state)
        state.duration = motion_duration(state.start, state.goal, rate, limits, delays, legs)

    def _set_legs(self, state: PlannerState, mode: Mode) -> None:
        """Divides a downward motion into legs: fast above all surfaces, then slower, and slowest
        where contact is expected."""
        first, expected = guarded_marks(state, mode, self._parameters)
        marks = [float(state.start[Z])]
        for mark in (first, expected, float(state.goal[Z])):
            marks.append(max(min(mark, marks[-1]), float(state.goal[Z])))
        ways = np.diff(marks).tolist()
        legs = blended_legs(ways, self._leg_speeds(mode), self._limits_of(state).acceleration)
        for index, leg in enumerate(legs):
            state.leg_ways[index], state.leg_delays[index] = leg.way, leg.delay

    def _leg_speeds(self, mode: Mode) -> tuple[float, float, float]:
        parameters, fast = self._parameters, self._limits[mode].speed
        return fast, min(fast, parameters.contact_speed), min(fast, parameters.touch_speed)

    def _legs(self, state: PlannerState) -> tuple[Leg, ...]:
        mode = Mode(int(state.mode))
        if mode not in (Mode.DESCEND, Mode.LOWER):
            return ()
        speeds = self._leg_speeds(mode)
        return tuple(
            Leg(way, speed, delay)
            for way, speed, delay in zip(
                state.leg_ways.tolist(), speeds, state.leg_delays.tolist(), strict=True
            )
            if way
        )

    def _limits_of(self, state: PlannerState) -> MotionLimits:
        """The limits of the present mode's motion."""
        mode = Mode(int(state.mode))
        limits, share = self._limits[mode], float(state.gentleness)
        if mode not in _HOLDING:
            return limits
        share = share or 1.0
        most = _ASIDE_SPEED if mode == Mode.LIFT and state.aside else math.inf
        return replace(
            limits,
            speed=min(share * limits.speed, most),
            acceleration=share * limits.acceleration,
            yaw_acceleration=share * limits.yaw_acceleration,
        )

    def slow_down(self, state: PlannerState, time: float, share: float) -> None:
        """Continues the present motion with less acceleration and speed. See `RobotMotion`."""
        now, rate, _ = np.split(self.motion_at(state, time), 3)
        opening, _ = self.opening_at(state, time)
        state.start_opening = state.goal_opening = opening
        state.gentleness = share
        self._begin_at(state, time, now, rate)

    def back_off(self, state: PlannerState, distance: float) -> None:
        """Raises the goal of the present mode. See `RobotMotion`."""
        state.goal[Z] += distance
        self.set_times(state)

    def motion_at(self, state: PlannerState, time: float) -> NDArray[np.float64]:
        """(12) the hand's desired position, velocity and acceleration in the present mode, each as
        x, y, z, yaw, in m, rad and s."""
        if time >= state.start_time + state.duration:
            return np.concatenate([state.goal, np.zeros(8)])
        return motion_at(
            state.start,
            state.goal,
            state.start_rate,
            self._limits_of(state),
            state.delays,
            time - state.start_time,
            self._legs(state),
        )

    def hand_acceleration(
        self, state: PlannerState, time: float, desired: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """(3) acceleration of the fingertips in the world, in m/s^2, taken from `desired`."""
        return desired[8:11]

    def arrival(self, state: PlannerState) -> float:
        """The time at which the present mode is complete. See `RobotMotion`."""
        return self.jaws_arrival(state, state.start_time + state.duration)

    def brakes_above(self, state: PlannerState, time: float, height: float) -> bool:
        """Whether the hand would stop above a height if it began to brake now."""
        now, rate, _ = np.split(self.motion_at(state, time), 3)
        return bool(now[2] + rate[2] * braking_time(rate, self._limits_of(state)) / 2 >= height)
