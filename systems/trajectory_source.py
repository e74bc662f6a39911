"""Feeds a planned joint trajectory to an arm's controller."""

from __future__ import annotations

from pydrake.systems.framework import BasicVector, Context, LeafSystem

from systems.arm_limits import JOINTS
from systems.arm_trajectory import ArmTrajectory


class TrajectorySource(LeafSystem):
    """Plays a joint trajectory through the same output ports that the planner has for the
    controller.

    .. pydrake_system::

        name: TrajectorySource
        output_ports:
        - desired_motion
        - desired_opening
        - closing_force

    - `desired_motion` (21): positions q_d, velocities v_d and accelerations a_d of the joints: the
      result of `ArmTrajectory.at` at the context's time.
    - `desired_opening` (2): the opening between the pads in m, and its rate in m/s. The opening
      ramps to the width of the last jaw command, with the command's speed.
    - `closing_force` (1): the force of the last jaw command, in N.

    The arm rests before the start and after the end. Stateless.
    """

    def __init__(self, trajectory: ArmTrajectory) -> None:
        """
        Args:
            trajectory: the trajectory to play; it starts at time zero.
        """
        super().__init__()
        self._trajectory = trajectory
        time = {self.time_ticket()}
        self.DeclareVectorOutputPort("desired_motion", 3 * JOINTS, self._calc_motion, time)
        self.DeclareVectorOutputPort("desired_opening", 2, self._calc_opening, time)
        self.DeclareVectorOutputPort("closing_force", 1, self._calc_force, time)

    def _calc_motion(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(self._trajectory.at(context.get_time()))

    def _calc_opening(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(self._trajectory.width_at(context.get_time()))

    def _calc_force(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector([self._trajectory.force_at(context.get_time())])
