"""The interface between the planner and the robot that moves the hand."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from systems.pick_place_parameters import Mode
from systems.planner_state import PlannerState


class RobotMotion(Protocol):
    """Computes the motions of all modes as functions of the planner's state. It keeps no state of
    its own.

    `HandMotion` and `ArmMotion` implement it. The planner deals only with modes, heights and hand
    poses. Times are in s, lengths in m.
    """

    size: int
    """Number of elements of the vector that `motion_at` returns."""
    settles: float
    """Time after the end of a motion until the hand no longer vibrates, in s. The hand rests for
    this time, or for `tare_settle` if that is shorter, before it checks its grip or tares the
    payload."""

    def initial_state(self) -> NDArray[np.float64]:
        """A state in which the hand waits at home with open jaws."""

    def view(self, vector: NDArray[np.float64]) -> PlannerState:
        """Returns a view of a state vector with named fields, without a copy."""

    def prepare(self, state: PlannerState) -> bool:
        """Chooses how to execute an action before it begins.

        Pick, place and heights are in the state. This function may replace the yaws of pick and
        place by equivalent ones.

        Returns:
            Whether the robot can reach pick and place. If not, it must not move in `APPROACH`.
        """

    def begin(
        self,
        state: PlannerState,
        mode: Mode,
        time: float,
        z: float | None = None,
        opening: float | None = None,
        at: NDArray[np.float64] | None = None,
    ) -> None:
        """Starts a mode from the motion that is commanded now.

        Args:
            state: the planner's state; modified.
            mode: the mode to begin.
            time: the present time.
            z: if given, the fingertips stop at this height.
            opening: if given, the jaws stop at this opening.
            at: if given, (4) x, y, z and yaw at which the hand stops.
        """

    def back_off(self, state: PlannerState, distance: float) -> None:
        """Raises the goal of the present mode by a distance. Call it only in a mode in which the
        hand moves straight."""

    def slow_down(self, state: PlannerState, time: float, share: float) -> None:
        """Continues with less speed and acceleration, in this and later modes that move the object.

        Args:
            state: the planner's state; modified.
            time: the present time.
            share: the fraction of the limits of speed and acceleration that the motion may use.
        """

    def motion_at(self, state: PlannerState, time: float) -> NDArray[np.float64]:
        """(size) desired positions, velocities and accelerations of the robot's joints at a time,
        in m, rad and s."""

    def hand_acceleration(
        self, state: PlannerState, time: float, desired: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """(3) acceleration of the fingertips in the world, in m/s^2. `desired` is the result of
        `motion_at` at this time."""

    def arrival(self, state: PlannerState) -> float:
        """The time at which motion, jaws and closing force of the present mode have all reached
        their goals."""

    def brakes_above(self, state: PlannerState, time: float, height: float) -> bool:
        """Whether the hand, in `LIFT`, stays above a height if `CARRY` begins now."""

    def set_force(self, state: PlannerState, time: float, force: float) -> None:
        """Ramps the closing force from its present value to `force`, in N."""

    def opening_at(self, state: PlannerState, time: float) -> tuple[float, float]:
        """The opening between the pads at a time, in m, and its rate, in m/s."""

    def force_at(self, state: PlannerState, time: float) -> float:
        """The closing force at a time, in N."""
