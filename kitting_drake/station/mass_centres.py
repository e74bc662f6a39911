"""Corrects the positions of free bodies that rotate while they are held.

Drake advances the origin of a body's frame along a straight line in each time step. If the body
rotates with angular velocity w about a point at a distance r from that origin, the body drifts
outward by r (w h)^2 / 2 in each step of length h. For example, a hammer that is held 45 mm from its
frame's origin by a hand that turns at 2.5 rad/s slides through the pads by 1.1 mm in a second. By
Newton's law it is the centre of mass, not the frame's origin, that should move straight.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import RigidBody
from pydrake.systems.framework import Context

_LEAST_RATE = 0.02
"""Rotations slower than this, in rad/s, are not corrected."""


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
        bodies: free bodies. Those that are locked or hardly rotate are not changed.
    """
    velocities = plant.GetVelocities(context)
    speeds = np.abs(velocities).tolist()
    for body in bodies:
        start = body.floating_velocities_start_in_v()
        rate = velocities[start : start + 3]
        if not max(speeds[start : start + 3]) > _LEAST_RATE or body.is_locked(context):
            continue
        p_BoBcm_B = body.CalcCenterOfMassInBodyFrame(context)
        X_WB: RigidTransform = body.EvalPoseInWorld(context)
        moved = drift(rate, X_WB.rotation() @ p_BoBcm_B, plant.time_step())
        X_WCorrected = RigidTransform(X_WB.rotation(), X_WB.translation() - moved)
        plant.SetFreeBodyPose(context, body, X_WCorrected)
