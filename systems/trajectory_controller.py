"""Controls the Franka hand along a desired motion."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydrake.systems.framework import BasicVector, Context, LeafSystem

HAND_AXES = 4
"""Number of the hand's axes: x, y, z and yaw of the point midway between the fingertips."""
FINGERS = 2


@dataclass(frozen=True)
class FingerLaw:
    """Computes the force of each finger's drive.

    For the opening w = q_L + q_R (zero if closed), the desired opening w_d and the closing force f,

        u_finger = clip(k_w (w_d - w)/2 + d_w (w_d' - w')/2 - f, -f_max, f_max).

    The plant's mimic constraint keeps both fingers at the same distance from the middle.
    """

    stiffness: float
    """Stiffness k_w, in N/m."""
    damping: float
    """Damping d_w, in N s/m."""
    force_limit: float
    """Largest force f_max of a finger's drive, in N."""

    def force(self, state: Sequence[float], opening: Sequence[float], closing: float) -> float:
        """The force u_finger, in N.

        Args:
            state: positions q_L and q_R of the fingers and their rates, in m and m/s.
            opening: desired opening w_d and its rate, in m and m/s.
            closing: closing force f, in N.
        """
        left, right, left_rate, right_rate = state
        wanted, rate = opening
        force = (
            self.stiffness * (wanted - left - right) / 2
            + self.damping * (rate - left_rate - right_rate) / 2
            - closing
        )
        return min(max(force, -self.force_limit), self.force_limit)


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
    - `desired_motion` (12): positions q_d, velocities v_d and accelerations a_d of (x, y, z, yaw).
    - `desired_opening` (2): opening w_d between the pads in m, and its rate in m/s.
    - `closing_force` (1): f, the force of each pad *in addition to* the force that holds the
      opening, in N; zero if not connected.
    - `actuation` (6): forces on the four axes and the two fingers, in N and N m.

    The axes follow computed-torque control of a body with decoupled axes,

        u = clip(M a_d + g + k_p (q_d - q) + k_d (v_d - v), -u_max, u_max),

    with M the effective inertia of each axis and g the hand's own weight on z. The payload is
    unknown and causes a sag of payload weight / k_p.

    The fingers follow the `FingerLaw`.

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
        fingers: FingerLaw,
    ) -> None:
        """All arrays have 4 elements, for x, y, z and yaw.

        Args:
            inertia: effective inertia M of each axis, in kg and kg m^2.
            weight: weight of the moving mass, in N, which the z axis holds.
            stiffness: stiffness k_p, in N/m and N m/rad.
            damping: damping k_d, in N s/m and N m s/rad.
            force_limit: largest force u_max, in N and N m.
            fingers: the control law of the fingers.

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
                raise ValueError(
                    f"{name} must have the shape ({HAND_AXES},), not {np.shape(value)}"
                )
        if np.any(np.asarray(force_limit) <= 0) or fingers.force_limit <= 0:
            raise ValueError(
                f"force limits must be positive, not {force_limit} and {fingers.force_limit:g}"
            )
        # For each axis: inertia, weight, stiffness, damping, force limit.
        self._axes = [
            tuple(map(float, axis))
            for axis in zip(
                inertia, (0.0, 0.0, weight, 0.0), stiffness, damping, force_limit, strict=True
            )
        ]
        self._fingers = fingers

        self._hand_state = self.DeclareVectorInputPort("hand_state", 2 * (HAND_AXES + FINGERS))
        self._desired_motion = self.DeclareVectorInputPort("desired_motion", 3 * HAND_AXES)
        self._desired_opening = self.DeclareVectorInputPort("desired_opening", 2)
        self._closing_force = self.DeclareVectorInputPort("closing_force", 1)
        self.DeclareVectorOutputPort("actuation", HAND_AXES + FINGERS, self._calc_actuation)

    def _calc_actuation(self, context: Context, output: BasicVector) -> None:
        # Use plain floats: this runs at every step, and NumPy is slower for four elements.
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
        press = self._closing_force.Eval(context)[0] if self._closing_force.HasValue(context) else 0
        finger = self._fingers.force(
            (*state[4:6], *state[10:12]), self._desired_opening.Eval(context).tolist(), float(press)
        )
        output.SetFromVector([*forces, *[finger] * FINGERS])
