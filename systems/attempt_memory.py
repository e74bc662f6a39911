"""Counts how often the oracle has picked each object, and with which of the object's grasps."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import Value
from pydrake.math import RigidTransform
from pydrake.systems.framework import Context, DiscreteValues, EventStatus, InputPort, LeafSystem

from systems.grasp import Grasp
from systems.pick_place_parameters import Mode
from systems.placement import PlacedObject, heading
from systems.signals import PickPlaceAction, PlanarPose

_PERIOD = 1 / 64
"""The planner's update period, in s. The memory reads the planner's mode at the same rate."""


_SET_DOWN = 0.3
"""An attempt counts as much if the object is set down where it was. So a grasp is tried four times
before another one."""


class AttemptMemory:
    """Counts an oracle's attempts by object and grasp, in the state of the oracle's system.

    It adds two optional input ports to the system:

    - `mode` (1): mode of the `PickPlacePlanner`; an action begins with `APPROACH`.
    - `accepted_action` (abstract, `PickPlaceAction`): the action that the planner began last.

    An attempt counts for the object whose grasp is nearest to the pick when the action begins. If
    the planner sets the object down where it was, the attempt counts less: with each attempt the
    planner allows a larger moment about the pads. If the ports are not connected, nothing is
    counted.
    """

    def __init__(
        self,
        system: LeafSystem,
        *,
        objects: Sequence[PlacedObject],
        grasps: Sequence[Sequence[Grasp]],
        body_poses: InputPort,
    ) -> None:
        """
        Args:
            system: the oracle, to which two ports, a state and a periodic event are added.
            objects: the n objects.
            grasps: for each of the n objects, its grasps.
            body_poses: the oracle's input port `body_poses`.
        """
        self._objects, self._grasps, self._body_poses = objects, grasps, body_poses
        self._most = max((len(choices) for choices in grasps), default=0)
        self._mode = system.DeclareVectorInputPort("mode", 1)
        self._accepted = system.DeclareAbstractInputPort(
            "accepted_action", Value(PickPlaceAction())
        )
        # The planner's last mode, the index of the last attempt's count (-1 if it had none), then
        # one row of counts for each object.
        counts = np.zeros(len(objects) * self._most)
        self._index = system.DeclareDiscreteState(np.concatenate([[0.0, -1.0], counts]))
        self.ticket = system.discrete_state_ticket(self._index)
        """Dependency ticket for outputs that depend on `attempts`."""
        system.DeclarePeriodicDiscreteUpdateEvent(_PERIOD, 0.0, self._update)

    def attempts(self, context: Context) -> NDArray[np.float64]:
        """(n, g) how often each grasp of each object was tried, rounded down; g is the largest
        number of grasps of an object."""
        values = context.get_discrete_state(self._index).get_value()
        return np.floor(values[2:].reshape(len(self._objects), self._most))

    def _update(self, context: Context, discrete_state: DiscreteValues) -> EventStatus:
        if not self._mode.HasValue(context):
            return EventStatus.DidNothing()
        mode = self._mode.Eval(context)[0]
        state = discrete_state.get_mutable_value(self._index)
        if mode == state[0]:
            return EventStatus.DidNothing()
        is_set_down = state[0] == Mode.LIFT and mode == Mode.LOWER
        state[0], counts = mode, state[2:]
        if is_set_down and state[1] >= 0:
            counts[int(state[1])] -= 1 - _SET_DOWN
        # `HasValue` evaluates the port, so call it only when the action is needed.
        if mode == Mode.APPROACH and self._accepted.HasValue(context):
            state[1] = self._find(context)
            if state[1] >= 0:
                counts[int(state[1])] += 1
        return EventStatus.Succeeded()

    def _find(self, context: Context) -> int:
        """The index of the count of the action that begins; -1 if it has none."""
        action = self._accepted.Eval(context)
        bodies = self._body_poses.Eval(context)
        poses = [bodies[int(item.body)] for item in self._objects]
        found = None if action.press else nearest_grasp(self._grasps, poses, action.pick)
        return -1 if found is None else found[0] * self._most + found[1]


def nearest_grasp(
    grasps: Sequence[Sequence[Grasp]], poses: Sequence[RigidTransform], pick: PlanarPose
) -> tuple[int, int] | None:
    """Finds the grasp that is nearest to a pick, and the object to which it belongs.

    The distance includes the angle, because an object may have several grasps at one point.

    Args:
        grasps: the grasps of each of the n objects, in its body frame B.
        poses: X_WB of each of the n objects.
        pick: the gripper's pose in the world.

    Returns:
        (index of the object, index of its grasp); None if no object has a grasp.
    """
    best: tuple[float, int, int] | None = None
    for index, (choices, X_WB) in enumerate(zip(grasps, poses, strict=True)):
        yaw = heading(X_WB)
        for number, grasp in enumerate(choices):
            x, y, _ = X_WB @ np.array([grasp.x, grasp.y, 0.0])
            turn = math.remainder(pick.theta - yaw - grasp.theta, math.pi)
            # An angle of 0.1 rad counts as much as a distance of 1 mm.
            cost = math.hypot(pick.x - x, pick.y - y) + 0.01 * abs(turn)
            if best is None or cost < best[0]:
                best = cost, index, number
    return None if best is None else best[1:]
