"""How the hand moves in each mode of the pick-and-place motion primitive: from where the commands
stood as the mode began, to where it goes."""

from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray
from pydrake.common.containers import namedview

from systems.hand_motion import (
    PARTS,
    MotionLimits,
    braking_time,
    motion_at,
    motion_duration,
    ramp,
    time_to_reach,
)
from systems.pick_place_parameters import Mode, PickPlaceParameters

_FIELDS = (
    ["mode", "start_time", "duration"]
    + [f"start_{axis}" for axis in ("x", "y", "z", "yaw")]
    + [f"goal_{axis}" for axis in ("x", "y", "z", "yaw")]
    + [f"start_rate_{axis}" for axis in ("x", "y", "z", "yaw")]
    + ["delay_xy", "delay_z", "delay_yaw"]
    + ["start_opening", "goal_opening", "start_force", "goal_force", "force_start_time"]
    + ["pick_x", "pick_y", "pick_yaw", "place_x", "place_y", "place_yaw", "grasp_z"]
    + ["travel_z", "clear_z", "pick_top_z"]
    + ["pick_hover_z", "place_hover_z", "table_z", "support_z", "rim_z"]
    + ["hold_z", "touch_z", "search_step"]
    + ["payload", "actions", "missed", "dropped", "press"]
)
PlannerState = namedview("PlannerState", _FIELDS)
"""A view on the planner's state vector, in SI units: what was read off o_t and the hand, and the
motion of the present mode."""
State: TypeAlias = Any
"""A `PlannerState`, which is made at run time and is no type to a type checker."""

_START, _GOAL, _START_RATE, _DELAYS = slice(3, 7), slice(7, 11), slice(11, 15), slice(15, 18)

YAW_LIMIT = 3.4
"""How far the wrist may rotate either way, in rad: just short of its joint limit."""
_NEARLY_THERE = 0.02
"""So near to where it goes, in m, the hand may sink below what the rest of the way has to clear."""
_OVERSHOOT = 0.05
"""How far above the travel height a lift aims, in m, as the hand crosses that without a stop."""


class PickPlaceMotion:
    """The motions, jaw openings and closing forces of all modes, as functions of the state."""

    def __init__(self, parameters: PickPlaceParameters) -> None:
        """
        Args:
            parameters: heights, speeds, forces.
        """
        self._parameters = parameters
        self._limits = parameters.motion_limits()

    def initial_state(self) -> NDArray[np.float64]:
        """A state in which the hand waits at home with open jaws."""
        vector = np.zeros(len(_FIELDS))
        state = PlannerState(vector)
        state[_START] = state[_GOAL] = self._parameters.home
        state.start_opening = state.goal_opening = self._parameters.open_width
        state.force_start_time = -self._parameters.force_ramp
        return vector

    def begin(
        self,
        state: State,
        mode: Mode,
        time: float,
        z: float | None = None,
        opening: float | None = None,
    ) -> None:
        """Starts a mode from where the commands now stand.

        Args:
            state: the planner's state, written.
            mode: the mode to begin.
            time: now, in s.
            z: hold the fingertips at this height from now on, in m.
            opening: hold the jaws at this opening from now on, in m.
        """
        now, rate, _ = np.split(self.motion_at(state, time), 3)
        now_opening, _ = self.opening_at(state, time)
        if z is not None:
            now[2] = z
            rate = np.zeros(4)
        if opening is not None:
            now_opening = opening
        state.mode = mode
        state.start_time = time
        state[_START] = now
        state[_START_RATE] = rate
        # Unless the mode says otherwise: come to rest.
        state[_GOAL] = now + rate * braking_time(rate, self._limits_of(state)) / 2
        state.start_opening = state.goal_opening = now_opening
        self._set_goals(state, mode)
        if mode == Mode.CHECK:
            self.set_force(state, time, self._parameters.grasp_force)
        elif mode in (Mode.RELEASE, Mode.RETREAT):
            self.set_force(state, time, 0.0)
        self.set_times(state)

    def _set_goals(self, state: State, mode: Mode) -> None:
        """Sets where a mode leads, where that is not where the hand comes to rest by itself."""
        parameters = self._parameters
        if mode == Mode.APPROACH:
            state[_GOAL] = (state.pick_x, state.pick_y, state.pick_hover_z, state.pick_yaw)
            state.goal_opening = 0.0 if state.press else parameters.open_width
        elif mode == Mode.DESCEND:
            state.goal_z = state.grasp_z
            if state.press:
                state.goal_z = state.pick_top_z - parameters.press_depth
        elif mode == Mode.CLOSE:
            state.goal_opening = 0.0
        elif mode == Mode.LIFT:
            state.goal_z = state.travel_z + _OVERSHOOT
        elif mode == Mode.CARRY:
            state[_GOAL] = (state.place_x, state.place_y, state.place_hover_z, state.place_yaw)
        elif mode == Mode.LOWER:
            state.goal_z = state.table_z + parameters.floor_clearance
        elif mode == Mode.SEARCH:
            x, y, yaw = parameters.search.offset(int(state.search_step))
            state.goal_x, state.goal_y = state.place_x + x, state.place_y + y
            state.goal_yaw = min(max(state.place_yaw + yaw, -YAW_LIMIT), YAW_LIMIT)
            state.goal_z = state.touch_z - parameters.search.press
        elif mode == Mode.RELEASE:
            state.goal_opening = min(
                state.start_opening + 2 * parameters.release_clearance, parameters.open_width
            )
        elif mode == Mode.RETREAT:
            state.goal_x, _, home_z, _ = parameters.home
            state.goal_z = max(home_z, state.travel_z)

    def set_times(self, state: State) -> None:
        """Sets when each part of the present mode's motion begins, and how long all of it takes."""
        mode = Mode(int(state.mode))
        limits = self._limits_of(state)
        rate = np.asarray(state[_START_RATE])
        braking = braking_time(rate, limits)
        # What moves comes to rest first.
        delays = np.array([braking * bool(rate[part].any()) for part in PARTS])
        ways = np.abs(state[_GOAL] - state[_START] - rate * braking / 2)
        across, height = float(np.linalg.norm(ways[:2])), float(ways[2])
        of_plane, of_height, _ = limits.of_parts()
        if mode == Mode.CARRY:
            # The lift that it goes on from is all but done by half of the braking.
            delays = np.maximum(delays, braking / 2)
        if mode in (Mode.APPROACH, Mode.CARRY):
            # Sink when it is nearly there.
            clear = state.clear_z if mode == Mode.APPROACH else state.travel_z
            nearly_there = delays[0] + time_to_reach(across - _NEARLY_THERE, across, *of_plane)
            sinks = height - (clear - state.goal_z)
            delays[1] = max(delays[1], nearly_there - time_to_reach(sinks, height, *of_height))
        elif mode == Mode.RETREAT:
            # Rise first.
            rises = height - (state.goal_z - state.travel_z)
            delays[0] = max(delays[0], delays[1] + time_to_reach(rises, height, *of_height))
        state[_DELAYS] = delays
        state.duration = motion_duration(
            np.asarray(state[_START]), np.asarray(state[_GOAL]), rate, limits, delays
        )

    def _limits_of(self, state: State) -> MotionLimits:
        """The limits of the present mode's motion."""
        mode = Mode(int(state.mode))
        # In a period of a faster one the force would rise by more than is asked for.
        return self._limits[Mode.LOWER if state.press and mode == Mode.DESCEND else mode]

    def set_force(self, state: State, time: float, force: float) -> None:
        """Lets the closing force go to another value, from what it is now."""
        if force != state.goal_force:
            state.start_force = self.force_at(state, time)
            state.goal_force, state.force_start_time = force, time

    def motion_at(self, state: State, time: float) -> NDArray[np.float64]:
        """q_d, v_d, a_d (12) of the present mode's motion."""
        if time >= state.start_time + state.duration:
            return np.concatenate([state[_GOAL], np.zeros(8)])
        return motion_at(
            state[_START],
            state[_GOAL],
            state[_START_RATE],
            self._limits_of(state),
            state[_DELAYS],
            time - state.start_time,
        )

    def opening_at(self, state: State, time: float) -> tuple[float, float]:
        """The opening between the pads in m, and its rate."""
        return ramp(
            state.start_opening,
            state.goal_opening,
            2 * self._parameters.finger_speed,
            time - state.start_time,
        )

    def force_at(self, state: State, time: float) -> float:
        """The closing force, in N."""
        fraction = 1.0
        if self._parameters.force_ramp > 0:
            elapsed = time - state.force_start_time
            fraction = min(max(elapsed / self._parameters.force_ramp, 0.0), 1.0)
        return float(state.start_force + fraction * (state.goal_force - state.start_force))

    def arrival(self, state: State) -> float:
        """When the motion, the jaws and the force of the present mode have arrived, in s."""
        opening_time = abs(state.goal_opening - state.start_opening) / (
            2 * self._parameters.finger_speed
        )
        moved = state.start_time + max(state.duration, opening_time)
        return float(max(moved, state.force_start_time + self._parameters.force_ramp))

    def brakes_above(self, state: State, time: float, height: float) -> bool:
        """Whether the hand, braking from now on, would come to rest above a height."""
        now, rate, _ = np.split(self.motion_at(state, time), 3)
        return bool(now[2] + rate[2] * braking_time(rate, self._limits[Mode.LIFT]) / 2 >= height)
