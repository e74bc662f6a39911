"""The expert of section IV-B.4: knows where everything is and where it is best held."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from pydrake.common.value import AbstractValue, Value
from pydrake.math import RigidTransform
from pydrake.multibody.tree import BodyIndex
from pydrake.systems.framework import Context, LeafSystem

from systems.placement_monitor import heading
from systems.signals import PickPlaceAction, PlanarPose, wrap_to_pi


@dataclass(frozen=True)
class OracleTarget:
    """One object, where it belongs and how it is held."""

    name: str
    body: BodyIndex
    """The object's body B."""
    X_WGoal: RigidTransform
    """The pose that B should have."""
    grasp: PlanarPose
    """The annotated grasp in the plane of B: (x, y) in metres; at theta zero the jaws close along
    B's y."""
    surface_height: float
    """Height of the object's top at the grasp, above B's origin, in metres."""


def gripper_pose(X_WB: RigidTransform, grasp: PlanarPose) -> PlanarPose:
    """The gripper pose in the world that holds an object at X_WB by its grasp."""
    yaw = heading(X_WB)
    x, y, _ = X_WB @ np.array([grasp.x, grasp.y, 0.0])
    return PlanarPose(x, y, yaw + grasp.theta)


class OraclePolicy(LeafSystem):
    """Picks each object by its annotated grasp and places it at its goal, from the ground truth.

    .. pydrake_system::

        name: OraclePolicy
        input_ports:
        - body_poses
        output_ports:
        - action

    - `body_poses` (abstract, list of RigidTransform by body index): the plant's port of that name.
    - `action` (abstract, `PickPlaceAction`): for the first object, in the order given, that is
      further from its goal than `done_distance` horizontally; `stop` when there is none.

    Stateless: an object whose grasp failed still lies where it lay, and is the answer again.
    """

    def __init__(self, *, targets: Sequence[OracleTarget], done_distance: float = 0.03) -> None:
        """
        Args:
            targets: the objects, in the order in which they are to be placed.
            done_distance: an object this close to its goal is left alone, in metres.

        Raises:
            ValueError: no targets.
        """
        super().__init__()
        if not targets:
            raise ValueError("an oracle needs at least one target")
        self._targets = tuple(targets)
        self._done_distance = done_distance
        poses = self.DeclareAbstractInputPort("body_poses", Value([RigidTransform()]))
        self._body_poses = poses
        self.DeclareAbstractOutputPort(
            "action", lambda: Value(PickPlaceAction()), self._calc_action, {poses.ticket()}
        )

    def _calc_action(self, context: Context, output: AbstractValue) -> None:
        poses = self._body_poses.Eval(context)
        for target in self._targets:
            X_WB = poses[int(target.body)]
            offset = X_WB.translation() - target.X_WGoal.translation()
            if math.hypot(offset[0], offset[1]) < self._done_distance:
                continue
            pick = gripper_pose(X_WB, target.grasp)
            place = gripper_pose(target.X_WGoal, target.grasp)
            theta = wrap_to_pi(pick.theta)
            turn = wrap_to_pi(place.theta - pick.theta)
            output.set_value(
                PickPlaceAction(
                    pick=PlanarPose(pick.x, pick.y, theta),
                    place=PlanarPose(place.x, place.y, theta + turn),
                    surface_height=X_WB.translation()[2] + target.surface_height,
                )
            )
            return
        output.set_value(PickPlaceAction(stop=True))
