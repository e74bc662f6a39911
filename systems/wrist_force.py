"""Estimates the contact force on a Franka's hand from its joint torques."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import Frame, JacobianWrtVariable
from pydrake.systems.framework import BasicVector, Context, LeafSystem

from systems.arm_limits import JOINTS
from systems.trajectory_controller import FINGERS

_STREAM = 17
"""Number of this module's random stream: a generator is seeded with [seed, number, time]."""


class WristForce(LeafSystem):
    r"""Estimates the contact force on the hand from external joint torques.

    .. pydrake_system::

        name: WristForce
        input_ports:
        - robot_state
        - joint_contact_torque
        - finger_contact_force
        output_ports:
        - wrist_force
        - wrist_moment

    - `robot_state` (18): positions of the seven joints and both fingers, then their velocities.
    - `joint_contact_torque` (7): tau, the torques that contacts cause in the joints, in N m. A
      Franka estimates them as the measured torques minus those that its dynamics model predicts.
    - `finger_contact_force` (2): the contact forces on the fingers' joints, in N.
    - `wrist_force` (6): contact forces along x, y, z (N), the moment about z (N m), and the force
      on each finger (N), at the gripper frame G and in the world's axes. It is the input
      `hand_contact_force` of the `PickPlacePlanner`.
    - `wrist_moment` (1): the moment of the contact forces at G about G's y axis, along which the
      jaws close, in N m. It is the planner's input of that name.

    The spatial force F on the hand at G solves, in the sense of least squares,

        J(q - h v)^T F = tau + n,

    with J the Jacobian of G and n white noise, drawn anew at each time. The plant's contacts are
    those at the beginning of its last step, of length h, when the joints were at q - h v. F is
    exact without noise, if nothing touches the arm itself. It includes the weight of a held object.

    Stateless: the noise is a function of seed and time.
    """

    def __init__(
        self,
        *,
        arm: MultibodyPlant,
        gripper: Frame,
        step: float,
        noise: float = 0.0,
        seed: int = 0,
    ) -> None:
        """
        Args:
            arm: a plant that contains only the arm and its hand, at its pose in the world; the
                joints come before the fingers.
            gripper: the frame G of that plant.
            step: time step h of the controlled plant, in s.
            noise: the standard deviation of n, in N m.
            seed: the seed of the noise.
        """
        super().__init__()
        self._arm, self._gripper = arm, gripper
        # Scratch memory: each call overwrites the values before it reads them.
        self._scratch = arm.CreateDefaultContext()
        self._step, self._noise, self._seed = step, noise, seed
        size = JOINTS + FINGERS
        self._robot_state = self.DeclareVectorInputPort("robot_state", 2 * size)
        self._torque = self.DeclareVectorInputPort("joint_contact_torque", JOINTS)
        self._finger_force = self.DeclareVectorInputPort("finger_contact_force", FINGERS)
        tickets = {self.all_input_ports_ticket()}
        if noise > 0:
            tickets.add(self.time_ticket())
        self.DeclareVectorOutputPort("wrist_force", 4 + FINGERS, self._calc_force, tickets)
        self.DeclareVectorOutputPort("wrist_moment", 1, self._calc_moment, tickets)

    def _calc_force(self, context: Context, output: BasicVector) -> None:
        _, _, about_z, x, y, z = self._spatial_force(context).tolist()
        fingers = self._finger_force.Eval(context).tolist()
        output.SetFromVector([x, y, z, about_z, *fingers])

    def _calc_moment(self, context: Context, output: BasicVector) -> None:
        moment = self._spatial_force(context)[:3]
        # `_spatial_force` has set the positions in the scratch context.
        jaws = self._gripper.CalcPoseInWorld(self._scratch).rotation().col(1)
        output.SetFromVector([moment @ jaws])

    def _spatial_force(self, context: Context) -> NDArray[np.float64]:
        """The spatial force F (6): moment, then force. Sets the scratch context's positions."""
        torque = self._torque.Eval(context)
        if self._noise > 0:
            # The time in microseconds identifies the step, and so seeds its noise.
            moment = round(1e6 * context.get_time())
            rng = np.random.default_rng([self._seed, _STREAM, moment])
            torque = torque + rng.normal(0.0, self._noise, JOINTS)
        if not torque.any():
            return np.zeros(6)
        arm, state = self._arm, self._robot_state.Eval(context)
        q, v = state[: JOINTS + FINGERS], state[JOINTS + FINGERS :]
        arm.SetPositions(self._scratch, q - self._step * v)
        world = arm.world_frame()
        jacobian = arm.CalcJacobianSpatialVelocity(
            self._scratch, JacobianWrtVariable.kV, self._gripper, np.zeros(3), world, world
        )[:, :JOINTS]
        # Solve the normal equations; J has full rank while the hand points down.
        return np.linalg.solve(jacobian @ jacobian.T, jacobian @ torque)
