"""Controls a Franka arm and its hand along a desired motion of the joints."""

from __future__ import annotations

import numpy as np
from pydrake.multibody.math import SpatialForce
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import MultibodyForces
from pydrake.systems.framework import (
    BasicVector,
    Context,
    DiscreteValues,
    EventStatus,
    LeafSystem,
)

from systems.arm_limits import JOINTS
from systems.hand_geometry import FINGERTIP_DISTANCE
from systems.trajectory_controller import FINGERS, FingerLaw

_FOLLOWS = 0.05
"""Time constant with which the compensated load f follows the port `payload`, in s."""
_EQUAL = 1e-3
"""Loads that differ by less than this, in N, count as equal."""


class JointController(LeafSystem):
    r"""Computes joint impedance control with computed torque, as libfranka offers it, and the
    fingers' force.

    .. pydrake_system::

        name: JointController
        input_ports:
        - robot_state
        - desired_motion
        - desired_opening
        - closing_force (optional)
        - payload (optional)
        output_ports:
        - desired_state
        - feedforward
        - finger_force

    - `robot_state` (18): positions of the seven joints and both fingers, then their velocities.
    - `desired_motion` (21): positions q_d, velocities v_d and accelerations a_d of the joints, in
      rad and s.
    - `desired_opening` (2), `closing_force` (1): as in `TrajectoryController`.
    - `payload` (1): the vertical force of the held object on the hand, as the planner knows it, in
      N; it is negative, and zero for an empty hand.
    - `desired_state` (14): positions q_n and velocities v_n, for the plant's port `desired_state`.
    - `feedforward` (7): u_ff, for the plant's actuation port, in N m.
    - `finger_force` (2): actuation of the fingers, in N.

    The arm's torque is

        u = clip(u_ff + K (q_n - q) + D (v_n - v), -u_max, u_max),
        u_ff = M(q) a_d + C(q, v) v - J_z(q)^T f,
        v_n = v_d + h a_d / 2,   q_n = q_d + h v_n.

    The plant computes the first line itself, with the q and v at the *end* of its step of length h,
    so that stiff joints are stable: give it K and D by `JointActuator.set_controller_gains`, and
    u_max as effort limit. Hence q_n is the position at the end of the step, and v_n the velocity
    with which the plant's integration, q + h v, gets there.

    The model's gravity is not compensated here: a Franka compensates its own weight, so the plant's
    arm has no gravity. The weight of a payload must be set, as with libfranka's `setLoad`: f
    follows `payload` smoothly. J_z is the Jacobian of the fingertips' height.

    The fingers follow the `FingerLaw`.

    State (discrete): the load f, in N.
    """

    def __init__(self, *, arm: MultibodyPlant, step: float, fingers: FingerLaw) -> None:
        """
        Args:
            arm: a plant that contains only the arm and its hand, without gravity; the joints come
                before the fingers.
            step: h, the time step of the plant that is controlled, in s.
            fingers: the control law of the fingers.

        Raises:
            ValueError: the plant does not have seven joints and two fingers.
        """
        super().__init__()
        if arm.num_positions() != JOINTS + FINGERS:
            raise ValueError(
                f"arm must have 9 positions (7 joints and 2 fingers), not {arm.num_positions()}"
            )
        self._arm, self._step, self._fingers = arm, step, fingers
        # Scratch memory: each call overwrites the values before it reads them.
        self._scratch, self._forces = arm.CreateDefaultContext(), MultibodyForces(arm)
        self._hand = arm.GetBodyByName("hand")
        joints, size = JOINTS, JOINTS + FINGERS
        self._load_index = self.DeclareDiscreteState(1)
        self.DeclarePeriodicDiscreteUpdateEvent(step, 0.0, self._follow_payload)
        self._robot_state = self.DeclareVectorInputPort("robot_state", 2 * size)
        self._desired_motion = self.DeclareVectorInputPort("desired_motion", 3 * joints)
        self._desired_opening = self.DeclareVectorInputPort("desired_opening", 2)
        self._closing_force = self.DeclareVectorInputPort("closing_force", 1)
        self._payload = self.DeclareVectorInputPort("payload", 1)
        load = self.discrete_state_ticket(self._load_index)
        robot, motion, opening, closing = (
            self.input_port_ticket(port.get_index())
            for port in (
                self._robot_state,
                self._desired_motion,
                self._desired_opening,
                self._closing_force,
            )
        )
        self.DeclareVectorOutputPort("desired_state", 2 * joints, self._calc_desired, {motion})
        self.DeclareVectorOutputPort(
            "feedforward", joints, self._calc_feedforward, {robot, motion, load}
        )
        self.DeclareVectorOutputPort(
            "finger_force", FINGERS, self._calc_fingers, {robot, opening, closing}
        )

    def _follow_payload(self, context: Context, discrete_state: DiscreteValues) -> EventStatus:
        load = discrete_state.get_mutable_value(self._load_index)
        given = self._payload.Eval(context)[0] if self._payload.HasValue(context) else 0.0
        if given == load[0]:
            return EventStatus.DidNothing()
        load[0] += (given - load[0]) * self._step / (self._step + _FOLLOWS)
        if abs(given - load[0]) < _EQUAL:
            load[0] = given
        return EventStatus.Succeeded()

    def _calc_desired(self, context: Context, output: BasicVector) -> None:
        q, v, a = self._desired_motion.Eval(context).reshape(3, JOINTS)
        v_next = v + self._step / 2 * a
        output.SetFromVector(np.concatenate([q + self._step * v_next, v_next]))

    def _calc_feedforward(self, context: Context, output: BasicVector) -> None:
        arm, scratch = self._arm, self._scratch
        a_d = self._desired_motion.Eval(context)[2 * JOINTS :]
        arm.SetPositionsAndVelocities(scratch, self._robot_state.Eval(context))
        self._forces.SetZero()
        load = context.get_discrete_state(self._load_index).value()[0]
        if load:
            R_WHand = self._hand.EvalPoseInWorld(scratch).rotation()
            self._hand.AddInForce(
                scratch,
                p_BP_E=R_WHand @ np.array([0.0, 0.0, FINGERTIP_DISTANCE]),
                F_Bp_E=SpatialForce(np.zeros(3), np.array([0.0, 0.0, load])),
                frame_E=arm.world_frame(),
                forces=self._forces,
            )
        wanted = np.concatenate([a_d, np.zeros(FINGERS)])
        output.SetFromVector(arm.CalcInverseDynamics(scratch, wanted, self._forces)[:JOINTS])

    def _calc_fingers(self, context: Context, output: BasicVector) -> None:
        state = self._robot_state.Eval(context)
        size = JOINTS + FINGERS
        press = self._closing_force.Eval(context)[0] if self._closing_force.HasValue(context) else 0
        force = self._fingers.force(
            (*state[JOINTS:size].tolist(), *state[size + JOINTS :].tolist()),
            self._desired_opening.Eval(context).tolist(),
            float(press),
        )
        output.SetFromVector([force] * FINGERS)
