"""Controls the Franka hand along a desired motion."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from pydrake.systems.framework import BasicVector, Context, LeafSystem

HAND_AXES = 4
"""x, y, z and yaw of the point midway between the fingertips."""
FINGERS = 2


class TrajectoryController(LeafSystem):
    r"""Computes generalized forces from a desired hand motion and jaw opening.

    .. pydrake_system::

        name: TrajectoryController
        input_ports:
        - hand_state
        - desired_motion
        - desired_opening
        - closing_force (optional)
        output_ports:
        - actuation

    - `hand_state` (12): positions then velocities of (x, y, z, yaw, left finger, right finger), in
      m, rad, m/s, rad/s: the state of the hand's model instance.
    - `desired_motion` (12): q_d, v_d, a_d of (x, y, z, yaw).
    - `desired_opening` (2): opening w_d between the pads in m, and its rate in m/s.
    - `closing_force` (1): f, the force of each pad *in addition to* the force that holds the
      opening, in N; zero if not connected.
    - `actuation` (6): forces on the four axes and the two fingers, in N and N m.

    The axes follow computed-torque control of a body with decoupled axes,

        u = clip(M a_d + g + k_p (q_d - q) + k_d (v_d - v), -u_max, u_max),

    with M the effective inertia of each axis and g the hand's own weight on z. The payload is
    unknown and causes a sag of payload weight / k_p.

    The fingers (q_L, q_R; opening w = q_L + q_R, closed at zero) follow

        u_finger = clip(k_w (w_d - w)/2 + d_w (w_d' - w')/2 - f, -f_max, f_max)

    each. The plant's mimic constraint centres the pair.

    Stateless.
    """

    def __init__(
        self,
        *,
        inertia: NDArray[np.float64],
        weight: float,
        stiffness: NDArray[np.float64],
        damping: NDArray[np.float64],
        force_limit: NDArray[np.float64],
        finger_stiffness: float,
        finger_damping: float,
        finger_force_limit: float,
    ) -> None:
        """All arrays are (4): x, y, z, yaw.

        Args:
            inertia: M, in kg and kg m^2.
            weight: gravity on the moving mass, in N, held by the z axis.
            stiffness: k_p, in N/m and N m/rad.
            damping: k_d, in N s/m and N m s/rad.
            force_limit: u_max, in N and N m.
            finger_stiffness: k_w, in N/m.
            finger_damping: d_w, in N s/m.
            finger_force_limit: f_max of each finger, in N.

        Raises:
            ValueError: an array has the wrong size, or a limit is not positive.
        """
        super().__init__()
        for name, value in {
            "inertia": inertia,
            "stiffness": stiffness,
            "damping": damping,
            "force_limit": force_limit,
        }.items():
            if np.shape(value) != (HAND_AXES,):
                raise ValueError(f"{name} must hold {HAND_AXES} numbers, not {np.shape(value)}")
        if np.any(np.asarray(force_limit) <= 0) or finger_force_limit <= 0:
            raise ValueError("force limits must be positive")
        # For each axis: inertia, weight, stiffness, damping, force limit.
        self._axes = [
            tuple(map(float, axis))
            for axis in zip(
                inertia, (0.0, 0.0, weight, 0.0), stiffness, damping, force_limit, strict=True
            )
        ]
        self._finger_stiffness = finger_stiffness
        self._finger_damping = finger_damping
        self._finger_force_limit = finger_force_limit

        self._hand_state = self.DeclareVectorInputPort("hand_state", 2 * (HAND_AXES + FINGERS))
        self._desired_motion = self.DeclareVectorInputPort("desired_motion", 3 * HAND_AXES)
        self._desired_opening = self.DeclareVectorInputPort("desired_opening", 2)
        self._closing_force = self.DeclareVectorInputPort("closing_force", 1)
        self.DeclareVectorOutputPort("actuation", HAND_AXES + FINGERS, self._calc_actuation)

    def _calc_actuation(self, context: Context, output: BasicVector) -> None:
        # Plain floats: this runs at every step, and NumPy is slower for four elements.
        state = self._hand_state.Eval(context).tolist()
        desired = self._desired_motion.Eval(context).tolist()
        forces = []
        for i, (inertia, weight, stiffness, damping, limit) in enumerate(self._axes):
            force = (
                inertia * desired[2 * HAND_AXES + i]
                + weight
                + stiffness * (desired[i] - state[i])
                + damping * (desired[HAND_AXES + i] - state[HAND_AXES + FINGERS + i])
            )
            forces.append(min(max(force, -limit), limit))
        opening, opening_rate = self._desired_opening.Eval(context).tolist()
        press = self._closing_force.Eval(context)[0] if self._closing_force.HasValue(context) else 0
        finger = (
            self._finger_stiffness * (opening - state[4] - state[5]) / 2
            + self._finger_damping * (opening_rate - state[10] - state[11]) / 2
            - press
        )
        limit = self._finger_force_limit
        finger = min(max(finger, -limit), limit)
        output.SetFromVector([*forces, *[finger] * FINGERS])
