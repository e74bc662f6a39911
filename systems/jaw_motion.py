"""Computes the opening and the closing force of the jaws in each mode of the motion primitive."""

from systems.hand_motion import ramp
from systems.pick_place_parameters import Mode, PickPlaceParameters
from systems.planner_state import PlannerState

ROOM = 0.005
"""Distance of each pad from an object of known width before the jaws close, in m."""


class JawMotion:
    """Computes jaw openings and closing forces in all modes from the planner's state."""

    def __init__(self, parameters: PickPlaceParameters) -> None:
        """
        Args:
            parameters: openings, speeds and forces of the motion primitive.
        """
        self._parameters = parameters

    def open(self, state: PlannerState) -> None:
        """Sets the state to fully open jaws without closing force."""
        state.start_opening = state.goal_opening = self._parameters.open_width
        state.force_start_time = -self._parameters.force_ramp

    def wide(self, state: PlannerState) -> float:
        """The opening of the jaws before a grasp: the object's width plus some clearance, in m."""
        return min(self._parameters.open_width, state.width + 2 * ROOM)

    def begin_jaws(
        self, state: PlannerState, mode: Mode, time: float, opening: float | None
    ) -> None:
        """Starts the jaws' motion and force for a new mode. Call it before the state's mode
        changes.

        Args:
            state: the planner's state; modified.
            mode: the mode to begin.
            time: the present time, in s.
            opening: the opening at which the jaws stop, in m; if None, the presently commanded one.
        """
        parameters = self._parameters
        if opening is None:
            opening, _ = self.opening_at(state, time)
        state.start_opening = state.goal_opening = opening
        if mode == Mode.APPROACH:
            state.goal_opening = 0.0 if state.press else self.wide(state)
        elif mode == Mode.CLOSE:
            state.goal_opening = 0.0
        elif mode == Mode.RELEASE:
            state.goal_opening = min(
                state.start_opening + 2 * parameters.release_clearance, parameters.open_width
            )
        if mode == Mode.CHECK:
            self.set_force(state, time, parameters.grasp_force)
        elif mode in (Mode.RELEASE, Mode.RETREAT):
            self.set_force(state, time, 0.0)

    def set_force(self, state: PlannerState, time: float, force: float) -> None:
        """Ramps the closing force from its present value to `force`, in N."""
        if force != state.goal_force:
            state.start_force = self.force_at(state, time)
            state.goal_force, state.force_start_time = force, time

    def opening_at(self, state: PlannerState, time: float) -> tuple[float, float]:
        """Returns the opening between the pads at a time, in m, and its rate, in m/s."""
        return ramp(
            state.start_opening,
            state.goal_opening,
            2 * self._parameters.finger_speed,
            time - state.start_time,
        )

    def force_at(self, state: PlannerState, time: float) -> float:
        """The closing force at a time, in N."""
        fraction = 1.0
        if self._parameters.force_ramp > 0:
            elapsed = time - state.force_start_time
            fraction = min(max(elapsed / self._parameters.force_ramp, 0.0), 1.0)
        return float(state.start_force + fraction * (state.goal_force - state.start_force))

    def jaws_arrival(self, state: PlannerState, moved: float) -> float:
        """The time, in s, at which the hand, the jaws and their force have all reached the present
        mode's goals. `moved` is this time for the hand alone."""
        opening_time = abs(state.goal_opening - state.start_opening) / (
            2 * self._parameters.finger_speed
        )
        moved = max(moved, state.start_time + opening_time)
        return float(max(moved, state.force_start_time + self._parameters.force_ramp))
