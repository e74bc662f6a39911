"""The interface between the planner and the robot that moves the hand."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from systems.pick_place_parameters import Mode
from systems.planner_state import PlannerState


class RobotMotion(Protocol):
    """The motions of all modes, as functions of the planner's state; keeps no memory.

    Implementations: `HandMotion`, `ArmMotion`. The planner speaks of modes, heights and hand poses
    only. Times are in s, lengths in m.
    """

    size: int
    """Number of elements of the desired motion."""
    settles: float
    """After this time at rest the hand is still; infinite if the parameters say how long."""

    def initial_state(self) -> NDArray[np.float64]:
        """A state in which the hand waits at home with open jaws."""

    def view(self, vector: NDArray[np.float64]) -> PlannerState:
        """The fields of a state vector."""

    def prepare(self, state: PlannerState) -> bool:
        """Chooses how to execute an action before it begins.

        Pick, place and heights are in the state; their yaws may be exchanged for equivalent ones.

        Returns:
            Whether the robot can reach everything. If not, it must not move in `APPROACH`.
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
        """Starts a mode from the present commands.

        Args:
            state: the planner's state; modified.
            mode: the mode to begin.
            time: the present time.
            z: stop the fingertips at this height.
            opening: stop the jaws at this opening.
            at: (4) stop the hand at this x, y, z and yaw.
        """

    def back_off(self, state: PlannerState, distance: float) -> None:
        """Raises the goal of the present mode, a straight line of the hand, by a distance."""

    def motion_at(self, state: PlannerState, time: float) -> NDArray[np.float64]:
        """(size) q_d, v_d, a_d of the robot's joints."""

    def hand_acceleration(
        self, state: PlannerState, time: float, desired: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """(3) of the motion `desired`, which is that of `motion_at`, in m/s^2."""

    def arrival(self, state: PlannerState) -> float:
        """When motion, jaws and force of the present mode have all arrived."""

    def brakes_above(self, state: PlannerState, time: float, height: float) -> bool:
        """Whether the hand, in `LIFT`, stays above a height if `CARRY` begins now."""

    def set_force(self, state: PlannerState, time: float, force: float) -> None:
        """Ramps the closing force from its present value to another, in N."""

    def opening_at(self, state: PlannerState, time: float) -> tuple[float, float]:
        """The opening between the pads, and its rate."""

    def force_at(self, state: PlannerState, time: float) -> float:
        """The closing force, in N."""
