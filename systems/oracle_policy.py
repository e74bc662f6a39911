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
from systems.signals import PickPlaceAction, PixelGrid, PlanarPose, wrap_to_pi


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
    rim_height: float | None = None
    """See `PickPlaceAction`."""


def gripper_pose(X_WB: RigidTransform, grasp: PlanarPose) -> PlanarPose:
    """The gripper pose in the world that holds an object at X_WB by its grasp."""
    yaw = heading(X_WB)
    x, y, _ = X_WB @ np.array([grasp.x, grasp.y, 0.0])
    return PlanarPose(x, y, yaw + grasp.theta)


def grasp_taken(X_WB: RigidTransform, gripper: PlanarPose) -> PlanarPose:
    """The grasp by which a gripper in the world holds an object that lies flat at X_WB.

    The inverse of `gripper_pose`: what a pick off the annotated grasp holds the object by.
    """
    yaw = heading(X_WB)
    dx, dy = np.array([gripper.x, gripper.y]) - X_WB.translation()[:2]
    cos, sin = math.cos(yaw), math.sin(yaw)
    return PlanarPose(cos * dx + sin * dy, cos * dy - sin * dx, gripper.theta - yaw)


@dataclass(frozen=True)
class Rounding:
    """How finely a policy of the paper can say an action (section III-A)."""

    grid: PixelGrid
    """Positions are centres of its pixels."""
    orientations: int
    """N: angles are among 2 pi i / N."""

    def position(self, x: float, y: float) -> tuple[float, float]:
        """The nearest pixel centre, in metres."""
        pixel = np.clip(np.round(self.grid.to_pixel((x, y))), 0, np.array(self.grid.shape) - 1)
        rounded_x, rounded_y = self.grid.to_world(pixel)
        return float(rounded_x), float(rounded_y)

    def angle(self, theta: float) -> float:
        """The nearest of the N orientations, in radians."""
        return round(theta * self.orientations / math.tau) * math.tau / self.orientations


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

    With a rounding it answers the best that a network can say: the pick is the annotated grasp,
    rounded; the place is where the gripper, *holding the object as the rounded pick does*, brings
    it to its goal, and its position and the object's turn are rounded in their turn. That is how
    a place network is labelled whose crop is centred on the pick (section III-C.2).

    Stateless: an object whose grasp failed still lies where it lay, and is the answer again.
    """

    def __init__(
        self,
        *,
        targets: Sequence[OracleTarget],
        done_distance: float = 0.03,
        rounding: Rounding | None = None,
    ) -> None:
        """
        Args:
            targets: the objects, in the order in which they are to be placed.
            done_distance: an object this close to its goal is left alone, in metres.
            rounding: of the answers; exact when None.

        Raises:
            ValueError: no targets.
        """
        super().__init__()
        if not targets:
            raise ValueError("an oracle needs at least one target")
        self._targets = tuple(targets)
        self._done_distance = done_distance
        self._rounding = rounding
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
            pick, place = self._poses(X_WB, target)
            output.set_value(
                PickPlaceAction(
                    pick=pick,
                    place=place,
                    surface_height=X_WB.translation()[2] + target.surface_height,
                    rim_height=target.rim_height,
                )
            )
            return
        output.set_value(PickPlaceAction(stop=True))

    def _poses(self, X_WB: RigidTransform, target: OracleTarget) -> tuple[PlanarPose, PlanarPose]:
        """Pick and place of an object at X_WB."""
        pick, grasp = gripper_pose(X_WB, target.grasp), target.grasp
        rounding = self._rounding
        if rounding is not None:
            pick = PlanarPose(*rounding.position(pick.x, pick.y), rounding.angle(pick.theta))
            grasp = grasp_taken(X_WB, pick)
        place = gripper_pose(target.X_WGoal, grasp)
        theta = wrap_to_pi(pick.theta)
        turn = wrap_to_pi(place.theta - pick.theta)
        if rounding is not None:
            place = PlanarPose(*rounding.position(place.x, place.y))
            turn = rounding.angle(turn)
        return PlanarPose(pick.x, pick.y, theta), PlanarPose(place.x, place.y, theta + turn)
