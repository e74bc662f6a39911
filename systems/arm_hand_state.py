"""Computes the state of a Franka's hand from its joints."""

from __future__ import annotations

from pydrake.systems.framework import BasicVector, Context, LeafSystem

from systems.arm_kinematics import ArmBase, hand_state
from systems.arm_limits import JOINTS

_FINGERS = 2


class ArmHandState(LeafSystem):
    """Converts the joint state of an arm to the state that a floating hand at the same pose would
    have.

    .. pydrake_system::

        name: ArmHandState
        input_ports:
        - robot_state
        output_ports:
        - hand_state

    - `robot_state` (18): positions of the seven joints and both fingers, then their velocities.
    - `hand_state` (12): positions then velocities of (x, y, z, yaw, left finger, right finger).

    All values are in m, rad and s.

    Stateless.
    """

    def __init__(self, base: ArmBase) -> None:
        """
        Args:
            base: pose of the arm's base in the world.
        """
        super().__init__()
        self._base = base
        self._robot_state = self.DeclareVectorInputPort("robot_state", 2 * (JOINTS + _FINGERS))
        self.DeclareVectorOutputPort("hand_state", 12, self._calc_state)

    def _calc_state(self, context: Context, output: BasicVector) -> None:
        # Use plain floats instead of NumPy for speed: this runs at every step.
        state = self._robot_state.Eval(context).tolist()
        size = JOINTS + _FINGERS
        found = hand_state(state[:JOINTS], state[size : size + JOINTS], self._base)
        fingers, rates = state[JOINTS:size], state[size + JOINTS :]
        output.SetFromVector([*found[:4], *fingers, *found[4:], *rates])
