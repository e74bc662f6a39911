"""The hand's motion in each mode of the pick-and-place motion primitive."""

import numpy as np
from numpy.typing import NDArray

from systems.hand_motion import (
    PARTS,
    Leg,
    MotionLimits,
    blended_legs,
    braking_time,
    motion_at,
    motion_duration,
    ramp,
    time_to_reach,
)
from systems.pick_place_parameters import Mode, PickPlaceParameters
from systems.vector_view import Array, Number, VectorView

X, Y, Z, YAW = range(4)
"""Indices of the hand's axes in `PlannerState.start` and `goal`."""


RECENT = 16
"""How many contact forces the state keeps."""


class PlannerState(VectorView):
    """The planner's state vector, in SI units."""

    mode = Number()
    start_time = Number()
    duration = Number()
    start = Array(4)
    """x, y, z and yaw at the start of the present motion."""
    goal = Array(4)
    """x, y, z and yaw at its end."""
    start_rate = Array(4)
    """The velocities at its start."""
    delays = Array(3)
    """When each of the motion's `PARTS` begins, after `start_time`."""
    leg_ways = Array(3)
    """The ways of a guarded motion along z, in order; zero if there is none."""
    leg_delays = Array(3)
    start_opening = Number()
    goal_opening = Number()
    start_force = Number()
    goal_force = Number()
    force_start_time = Number()
    pick = Array(3)
    """x, y and yaw of the hand at the pick. Likewise `place`."""
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
    floor_z = Number()
    doubt = Number()
    """The uncertainty of these heights."""
    hold_z = Number()
    """Height of the hand when it gripped; `touch_z`: when the object touched a cavity's rim."""
    touch_z = Number()
    search_step = Number()
    payload = Number()
    """The vertical force of the payload, in N."""
    weighings = Number()
    """How many samples the payload is the mean of."""
    beyond = Number()
    """For how long the contact force has been beyond the limit, in s."""
    recent = Array(3 * RECENT)
    """x, y and z of the last contact forces, latest first, without weight and inertia of the held
    object, in N."""
    peak_vertical = Number()
    """The largest contact forces of the action, in N."""
    peak_lateral = Number()
    peak_mode = Number()
    """The mode in which the larger one rose."""
    actions = Number()
    missed = Number()
    dropped = Number()
    stopped = Number()
    stops = Number()
    """1 if the force guard has ended the action, else 0."""
    press = Number()
    """1 if the action presses, else 0."""
    aside = Number()
    """1 if the action lays the object aside, else 0."""
    lever = Number()
    """How far the centre of mass of an object that is set down lies from the pads' middle along
    them, in m."""
    doubts_grip = Number()
    """1 if the object seems to turn between the pads, and is set down again if it does, else 0."""
    set_downs = Number()
    """How many earlier actions have set this object down."""
    stop = Number()
    """0 while there are actions; then 1 plus the index of the reason in `STOP_REASONS`."""


YAW_LIMIT = 3.4
"""Largest yaw of the wrist either way, in rad, just short of its joint limit."""
_NEARLY_THERE = 0.02
"""Within this horizontal distance of its goal, in m, the hand may sink below the clear height."""
_TRIAL = 0.010
"""How far an object is lifted to see how it hangs, in m: clear of the table, but not much more."""
_OVERSHOOT = 0.05
"""How far above the travel height a lift aims, in m, so that the hand passes it without a stop."""


class PickPlaceMotion:
    """Motions, jaw openings and closing forces of all modes, as functions of the state."""

    def __init__(self, parameters: PickPlaceParameters) -> None:
        """
        Args:
            parameters: heights, speeds, forces.
        """
        self._parameters = parameters
        self._limits = parameters.motion_limits()

    def initial_state(self) -> NDArray[np.float64]:
        """A state in which the hand waits at home with open jaws."""
        vector = np.zeros(PlannerState.size)
        state = PlannerState(vector)
        state.start = state.goal = self._parameters.home
        state.start_opening = state.goal_opening = self._parameters.open_width
        state.force_start_time = -self._parameters.force_ramp
        return vector

    def begin(
        self,
        state: PlannerState,
        mode: Mode,
        time: float,
        z: float | None = None,
        opening: float | None = None,
        at: NDArray[np.float64] | None = None,
    ) -> None:
        """Starts a mode from the present commands.

        Args:
            state: the planner's state; modified.
            mode: the mode to begin.
            time: the present time, in s.
            z: stop the fingertips at this height, in m.
            opening: stop the jaws at this opening, in m.
            at: (4) stop the hand at this x, y, z and yaw.
        """
        now, rate, _ = np.split(self.motion_at(state, time), 3)
        now_opening, _ = self.opening_at(state, time)
        if z is not None:
            now[2] = z
            rate = np.zeros(4)
        if at is not None:
            now, rate = np.array(at), np.zeros(4)
        if opening is not None:
            now_opening = opening
        state.mode = mode
        state.start_time = time
        state.start = now
        state.start_rate = rate
        # Default: brake to rest.
        state.goal = now + rate * braking_time(rate, self._limits_of(state)) / 2
        state.start_opening = state.goal_opening = now_opening
        self._set_goals(state, mode)
        if mode == Mode.CHECK:
            self.set_force(state, time, self._parameters.grasp_force)
        elif mode in (Mode.RELEASE, Mode.RETREAT):
            self.set_force(state, time, 0.0)
        self.set_times(state)

    def _set_goals(self, state: PlannerState, mode: Mode) -> None:
        """Sets the goals of a mode, unless the hand only brakes to rest."""
        parameters = self._parameters
        if mode == Mode.APPROACH:
            state.goal = (*state.pick[:2], state.pick_hover_z, state.pick[2])
            state.goal_opening = 0.0 if state.press else parameters.open_width
        elif mode == Mode.DESCEND:
            state.goal[Z] = state.grasp_z
            if state.press:
                state.goal[Z] = state.pick_top_z - parameters.press_depth
        elif mode == Mode.CLOSE:
            state.goal_opening = 0.0
        elif mode == Mode.LIFT:
            trial = max(state.hold_z + _TRIAL, float(state.goal[Z]))
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
        elif mode == Mode.RELEASE:
            state.goal_opening = min(
                state.start_opening + 2 * parameters.release_clearance, parameters.open_width
            )
        elif mode == Mode.RETREAT:
            state.goal[X], _, home_z, _ = parameters.home
            state.goal[Z] = max(home_z, state.travel_z)

    def set_times(self, state: PlannerState) -> None:
        """Sets the delays and the duration of the present mode's motion."""
        mode = Mode(int(state.mode))
        limits = self._limits_of(state)
        rate = state.start_rate
        braking = braking_time(rate, limits)
        # An axis that still moves brakes first.
        delays = np.array([braking * bool(rate[part].any()) for part in PARTS])
        ways = np.abs(state.goal - state.start - rate * braking / 2)
        across, height = float(np.linalg.norm(ways[:2])), float(ways[2])
        of_plane, of_height, _ = limits.of_parts()
        if mode == Mode.CARRY:
            # After half of the braking time the preceding lift is almost complete.
            delays = np.maximum(delays, braking / 2)
        if mode in (Mode.APPROACH, Mode.CARRY):
            # Sink near the goal only.
            clear = state.clear_z if mode == Mode.APPROACH else state.travel_z
            nearly_there = delays[0] + time_to_reach(across - _NEARLY_THERE, across, *of_plane)
            sinks = height - (clear - state.goal[Z])
            delays[1] = max(delays[1], nearly_there - time_to_reach(sinks, height, *of_height))
        elif mode == Mode.RETREAT:
            # Rise first.
            rises = height - (state.goal[Z] - state.travel_z)
            delays[0] = max(delays[0], delays[1] + time_to_reach(rises, height, *of_height))
        state.delays = delays
        state.leg_ways = state.leg_delays = np.zeros(3)
        if mode in (Mode.DESCEND, Mode.LOWER):
            self._set_legs(state, mode)
        legs = self._legs(state)
        state.duration = motion_duration(state.start, state.goal, rate, limits, delays, legs)

    def _set_legs(self, state: PlannerState, mode: Mode) -> None:
        """Divides a guarded motion: fast above all surfaces, then slower, and slowest where contact
        is expected."""
        parameters = self._parameters
        margin = parameters.slow_margin + state.doubt
        hover = state.pick_hover_z if mode == Mode.DESCEND else state.place_hover_z
        first = hover - parameters.hover_clearance + margin
        # Either the object reaches its floor, or the fingertips beside it the rim.
        hanging = state.hold_z - state.support_z
        expected = max(state.floor_z + hanging, state.rim_z + state.doubt) + margin
        if mode == Mode.DESCEND:
            # The jaws should touch nothing, except to press.
            expected = state.pick_top_z + margin if state.press else state.goal[Z]
        marks = [float(state.start[Z])]
        for mark in (first, expected, float(state.goal[Z])):
            marks.append(max(min(mark, marks[-1]), float(state.goal[Z])))
        ways = np.diff(marks).tolist()
        legs = blended_legs(ways, self._leg_speeds(mode), self._limits[mode].acceleration)
        for index, leg in enumerate(legs):
            state.leg_ways[index], state.leg_delays[index] = leg.way, leg.delay

    def _leg_speeds(self, mode: Mode) -> tuple[float, float, float]:
        parameters, fast = self._parameters, self._limits[mode].speed
        return fast, min(fast, parameters.contact_speed), min(fast, parameters.touch_speed)

    def _legs(self, state: PlannerState) -> tuple[Leg, ...]:
        speeds = self._leg_speeds(Mode(int(state.mode)))
        return tuple(
            Leg(way, speed, delay)
            for way, speed, delay in zip(
                state.leg_ways.tolist(), speeds, state.leg_delays.tolist(), strict=True
            )
            if way
        )

    def _limits_of(self, state: PlannerState) -> MotionLimits:
        """The limits of the present mode's motion."""
        return self._limits[Mode(int(state.mode))]

    def set_force(self, state: PlannerState, time: float, force: float) -> None:
        """Ramps the closing force from its present value to another."""
        if force != state.goal_force:
            state.start_force = self.force_at(state, time)
            state.goal_force, state.force_start_time = force, time

    def motion_at(self, state: PlannerState, time: float) -> NDArray[np.float64]:
        """q_d, v_d, a_d (12) of the present mode's motion."""
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

    def opening_at(self, state: PlannerState, time: float) -> tuple[float, float]:
        """The opening between the pads in m, and its rate."""
        return ramp(
            state.start_opening,
            state.goal_opening,
            2 * self._parameters.finger_speed,
            time - state.start_time,
        )

    def force_at(self, state: PlannerState, time: float) -> float:
        """The closing force, in N."""
        fraction = 1.0
        if self._parameters.force_ramp > 0:
            elapsed = time - state.force_start_time
            fraction = min(max(elapsed / self._parameters.force_ramp, 0.0), 1.0)
        return float(state.start_force + fraction * (state.goal_force - state.start_force))

    def arrival(self, state: PlannerState) -> float:
        """When motion, jaws and force of the present mode have all arrived, in s."""
        opening_time = abs(state.goal_opening - state.start_opening) / (
            2 * self._parameters.finger_speed
        )
        moved = state.start_time + max(state.duration, opening_time)
        return float(max(moved, state.force_start_time + self._parameters.force_ramp))

    def brakes_above(self, state: PlannerState, time: float, height: float) -> bool:
        """Whether the hand would stop above a height if it began to brake now."""
        now, rate, _ = np.split(self.motion_at(state, time), 3)
        return bool(now[2] + rate[2] * braking_time(rate, self._limits[Mode.LIFT]) / 2 >= height)
