"""Corrects the positions of free bodies that an arm's hand carries along an arc.

In each time step h, Drake advances a free body along a straight line, but the hand along the arc on
which the joints move it. A held body therefore slides through the pads with a speed of h/2 times
the hand's centripetal acceleration, for example 20 mm/s at 5 m/s^2 and h = 1/128 s. The floating
hand, which moves on straight axes, has no such arc.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from pydrake.common.eigen_geometry import AngleAxis
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.math import SpatialVelocity
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import Frame, RigidBody
from pydrake.systems.framework import Context

_LEAST_RATE = 0.05
"""If all joints are slower than this, in rad/s, no position is corrected."""
_SAME_SPEED = 0.02
"""A body counts as carried by the hand if their velocities differ by less than this, in m/s, plus
5 % of the hand's velocity."""


class ArmPath:
    """Computes the arc on which an arm has moved its hand in the last time step."""

    def __init__(self, arm: MultibodyPlant, gripper: Frame, step: float) -> None:
        """
        Args:
            arm: a plant that contains only the arm and its hand.
            gripper: a frame of the hand.
            step: the time step of the plant that is corrected, in s.
        """
        self._arm, self._gripper, self._step = arm, gripper, step
        # Scratch memory: each call overwrites the values before it reads them.
        self._scratch = arm.CreateDefaultContext()

    def correct(
        self,
        plant: MultibodyPlant,
        context: Context,
        state: NDArray[np.float64],
        bodies: Sequence[RigidBody],
    ) -> None:
        """Moves carried bodies onto the hand's arc. Call it once after each step.

        Args:
            plant: the plant, which must be discrete.
            context: the plant's context; modified.
            state: (18) positions of the arm's joints and fingers, then their velocities.
            bodies: free bodies. Those that are locked or do not move with the hand are not changed.
        """
        q, v = state[:9], state[9:]
        if not np.abs(v[:7]).max() > _LEAST_RATE:
            return
        free = [body for body in bodies if not body.is_locked(context)]
        if not free:
            return
        arm, scratch, h = self._arm, self._scratch, self._step
        arm.SetPositionsAndVelocities(scratch, np.concatenate([q - h * v, v]))
        X_WG0: RigidTransform = self._gripper.CalcPoseInWorld(scratch)
        V_WG = self._gripper.CalcSpatialVelocityInWorld(scratch)
        arm.SetPositions(scratch, q)
        X_moved = self._gripper.CalcPoseInWorld(scratch) @ X_WG0.inverse()
        R_moved = X_moved.rotation() @ _rotation(-h * V_WG.rotational())
        velocities = plant.GetVelocities(context)
        for body in free:
            start = body.floating_velocities_start_in_v()
            V_WB = SpatialVelocity(velocities[start : start + 6])
            X_WB: RigidTransform = body.EvalPoseInWorld(context)
            p_BoBcm = X_WB.rotation() @ body.CalcCenterOfMassInBodyFrame(context)
            v_WBcm = V_WB.Shift(p_BoBcm).translational()
            p_WBcm0 = X_WB.translation() + p_BoBcm - h * v_WBcm
            carried = V_WG.Shift(p_WBcm0 - X_WG0.translation()).translational()
            apart = np.linalg.norm(v_WBcm - carried)
            if apart > _SAME_SPEED + 0.05 * np.linalg.norm(carried):
                continue
            arc = X_moved @ p_WBcm0 - (p_WBcm0 + h * carried)
            R_WB = RotationMatrix.ProjectToRotationMatrix((R_moved @ X_WB.rotation()).matrix())
            p_WBo = X_WB.translation() + p_BoBcm + arc - R_moved @ p_BoBcm
            plant.SetFreeBodyPose(context, body, RigidTransform(R_WB, p_WBo))


def _rotation(vector: NDArray[np.float64]) -> RotationMatrix:
    """The rotation about a vector, by as many radians as the vector is long."""
    angle = float(np.linalg.norm(vector))
    return RotationMatrix(AngleAxis(angle, vector / angle)) if angle else RotationMatrix()
