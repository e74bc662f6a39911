"""Computes the contact forces on a robot from its motion."""

from __future__ import annotations

import numpy as np
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import JointIndex, MultibodyForces
from pydrake.systems.framework import BasicVector, Context, LeafSystem


class ContactTorque(LeafSystem):
    r"""Computes the generalized forces of contacts on a robot from its motion.

    .. pydrake_system::

        name: ContactTorque
        input_ports:
        - robot_state
        - acceleration
        - actuation
        output_ports:
        - contact_torque

    - `robot_state` (2 n): positions q, then velocities v, of the robot's n joints.
    - `acceleration` (n): the accelerations a in the plant's last step.
    - `actuation` (n): the actuation u in the plant's last step.
    - `contact_torque` (k): of the first k joints, the generalized contact forces tau_c in the
      plant's last step, in N or N m. They are what the equation of motion lacks:

          M(q0) a + C(q0, v0) v0 + D v = tau_g(q0) + u + tau_c,  q0 = q - h v,  v0 = v - h a,

      with the mass matrix M, Coriolis terms C, the joints' damping D, gravity tau_g, and the length
      h of a step. Before the first step, tau_c is zero.

    A robot's controller estimates external torques in this way. The plant's own port of contact
    forces is not used, because it sometimes reports friction that does not fit the motion. Forces
    of joint limits count as contact forces.

    Acceleration and actuation must come from the plant's sampled ports, the default of Drake.

    Stateless.
    """

    def __init__(self, *, robot: MultibodyPlant, joints: int, step: float) -> None:
        """
        Args:
            robot: a finalized plant that contains only the robot, whose joints have one degree of
                freedom each, in the order of the ports. The first k joints must not be coupled to
                others, because the forces of couplers would count as contact forces.
            joints: the number k.
            step: the time step h of the simulated plant, in s.
        """
        super().__init__()
        size = robot.num_velocities()
        self._robot, self._joints, self._step = robot, joints, step
        self._damping = np.zeros(size)
        for number in range(robot.num_joints()):
            joint = robot.get_joint(JointIndex(number))
            if joint.num_velocities():
                self._damping[joint.velocity_start()] = joint.default_damping_vector()[0]
        # Scratch memory: each call overwrites the values before it reads them.
        self._scratch = robot.CreateDefaultContext()
        self._forces = MultibodyForces(robot)
        self._state = self.DeclareVectorInputPort("robot_state", 2 * size)
        self._acceleration = self.DeclareVectorInputPort("acceleration", size)
        self._actuation = self.DeclareVectorInputPort("actuation", size)
        self.DeclareVectorOutputPort(
            "contact_torque", joints, self._calc_torque, {self.all_input_ports_ticket()}
        )

    def _calc_torque(self, context: Context, output: BasicVector) -> None:
        acceleration = self._acceleration.Eval(context)
        actuation = self._actuation.Eval(context)
        if not acceleration.any() and not actuation.any():
            output.SetFromVector(np.zeros(self._joints))
            return
        q, v = np.split(self._state.Eval(context), 2)
        robot, scratch = self._robot, self._scratch
        robot.SetPositions(scratch, q - self._step * v)
        robot.SetVelocities(scratch, v - self._step * acceleration)
        robot.CalcForceElementsContribution(scratch, self._forces)
        needed = robot.CalcInverseDynamics(scratch, acceleration, self._forces)
        # The plant damps the velocities after the step, and the force elements those before it.
        needed = needed + self._damping * self._step * acceleration
        output.SetFromVector((needed - actuation)[: self._joints])
