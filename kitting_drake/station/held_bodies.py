"""Corrects the positions of free bodies that are held, which Drake moves along straight lines.

In each time step h, Drake advances the origin of a free body's frame along a straight line. Two
corrections follow.

`correct_drift`: a body that rotates with angular velocity w about a point at a distance r from that
origin drifts outward by r (w h)^2 / 2 in each step. For example, a hammer that is held 45 mm from
its frame's origin by a hand that turns at 2.5 rad/s slides through the pads by 1.1 mm in a second.
By Newton's law it is the centre of mass, not the frame's origin, that should move straight.

`ArmPath`: an arm's hand moves along the arc on which the joints move it. A held body therefore
slides through the pads with a speed of h/2 times the hand's centripetal acceleration, for example
20 mm/s at 5 m/s^2 and h = 1/128 s. The floating hand, which moves on straight axes, has no such
arc.
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

_LEAST_ROTATION = 0.02
"""Rotations slower than this, in rad/s, are not corrected."""
_LEAST_JOINT_RATE = 0.05
"""If all joints are slower than this, in rad/s, no position is corrected."""
_SAME_SPEED = 0.02
"""A body counts as carried by the hand if their velocities differ by less than this, in m/s, plus
5 % of the hand's velocity."""


def drift(
    rate: NDArray[np.float64], p_BoBcm: NDArray[np.float64], step: float
) -> NDArray[np.float64]:
    """Returns the drift (3,) of a frame's origin relative to the centre of mass in one step, in
    metres.

    Args:
        rate: (3,) the body's angular velocity in rad/s, in the world.
        p_BoBcm: (3,) vector from the origin to the centre of mass, in the world, in metres.
        step: the time step, in s.
    """
    return 0.5 * step**2 * np.array(_cross(rate.tolist(), _cross(rate.tolist(), p_BoBcm.tolist())))


def _cross(a: Sequence[float], b: Sequence[float]) -> tuple[float, float, float]:
    """The cross product of two vectors; `np.cross` takes over ten times as long for one pair."""
    return (
        a[1] * b[2] - a[2] * b[1],
        a[2] * b[0] - a[0] * b[2],
        a[0] * b[1] - a[1] * b[0],
    )


def correct_drift(plant: MultibodyPlant, context: Context, bodies: Sequence[RigidBody]) -> None:
    """Undoes the last time step's drift of free bodies. Call it once after each step.

    Args:
        plant: the plant, which must be discrete.
        context: the plant's context; modified.
        bodies: free bodies that are not locked. Those that hardly rotate are not changed.
    """
    velocities = plant.GetVelocities(context)
    speeds = np.abs(velocities).tolist()
    for body in bodies:
        start = body.floating_velocities_start_in_v()
        rate = velocities[start : start + 3]
        if not max(speeds[start : start + 3]) > _LEAST_ROTATION:
            continue
        p_BoBcm_B = body.CalcCenterOfMassInBodyFrame(context)
        X_WB: RigidTransform = body.EvalPoseInWorld(context)
        moved = drift(rate, X_WB.rotation() @ p_BoBcm_B, plant.time_step())
        X_WCorrected = RigidTransform(X_WB.rotation(), X_WB.translation() - moved)
        plant.SetFreeBodyPose(context, body, X_WCorrected)


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
            bodies: free bodies that are not locked. Those that do not move with the hand are not
                changed.
        """
        q, v = state[:9], state[9:]
        if not np.abs(v[:7]).max() > _LEAST_JOINT_RATE:
            return
        arm, scratch, h = self._arm, self._scratch, self._step
        arm.SetPositionsAndVelocities(scratch, np.concatenate([q - h * v, v]))
        X_WG0: RigidTransform = self._gripper.CalcPoseInWorld(scratch)
        V_WG = self._gripper.CalcSpatialVelocityInWorld(scratch)
        arm.SetPositions(scratch, q)
        X_moved = self._gripper.CalcPoseInWorld(scratch) @ X_WG0.inverse()
        R_moved = X_moved.rotation() @ _rotation(-h * V_WG.rotational())
        velocities = plant.GetVelocities(context)
        for body in bodies:
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
