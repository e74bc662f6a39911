"""Chooses the next object to appear in tasks where objects come one at a time."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import Value
from pydrake.math import RigidTransform
from pydrake.multibody.tree import BodyIndex
from pydrake.systems.framework import BasicVector, Context, LeafSystem

from systems.pick_place_parameters import Mode

_FREE_MODES = (Mode.RETREAT, Mode.OBSERVE)
"""The modes in which an object may appear: the hand is empty and does not approach an object."""
_STILL_THERE = 1.0
"""An object within this distance, in metres, of its waiting position is still waiting."""


class ObjectFeeder(LeafSystem):
    """Chooses the object that appears next when the area in which objects appear is clear.

    .. pydrake_system::

        name: ObjectFeeder
        input_ports:
        - body_poses
        - mode
        output_ports:
        - arriving

    - `body_poses` (abstract, list of RigidTransform by body index): the plant's port of that name.
    - `mode` (1): the planner's port of that name.
    - `arriving` (1): the index in `waiting` of the object to appear now, or -1.

    The law: if the hand retreats or observes, and no object's origin is over `area`, the first
    object that still waits is the one to appear. The station then moves the body. Stateless.
    """

    def __init__(
        self,
        *,
        waiting: Sequence[tuple[BodyIndex, NDArray[np.float64]]],
        others: Sequence[BodyIndex],
        area: tuple[tuple[float, float], tuple[float, float]],
    ) -> None:
        """
        Args:
            waiting: the bodies that appear, in order, and the position p_WB (3,) at which each one
                waits.
            others: the bodies that are present from the beginning.
            area: lower and upper (x, y) corners, in the world and in metres, of the area in which
                objects appear.
        """
        super().__init__()
        self._waiting = [(int(body), p_WWait) for body, p_WWait in waiting]
        self._bodies = [*(body for body, _ in self._waiting), *(int(body) for body in others)]
        self._lower, self._upper = np.array(area)
        self._body_poses = self.DeclareAbstractInputPort("body_poses", Value([RigidTransform()]))
        self._mode = self.DeclareVectorInputPort("mode", 1)
        self.DeclareVectorOutputPort(
            "arriving", 1, self._calc_arriving, {self._body_poses.ticket(), self._mode.ticket()}
        )

    def _calc_arriving(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector([self._arriving(context)])

    def _arriving(self, context: Context) -> int:
        if self._mode.Eval(context)[0] not in _FREE_MODES:
            return -1
        poses = self._body_poses.Eval(context)
        if any(self._is_over_area(poses[body].translation()) for body in self._bodies):
            return -1
        for index, (body, p_WWait) in enumerate(self._waiting):
            if np.linalg.norm(poses[body].translation() - p_WWait) < _STILL_THERE:
                return index
        return -1

    def _is_over_area(self, p_WB: NDArray[np.float64]) -> bool:
        return bool((p_WB[:2] >= self._lower).all() and (p_WB[:2] <= self._upper).all())
