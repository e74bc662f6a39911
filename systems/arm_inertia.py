"""The inertia of a Franka arm and its hand, felt in the joints."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from systems.arm_limits import JOINTS

if TYPE_CHECKING:
    # The planning of motions works without Drake.
    from pydrake.multibody.plant import MultibodyPlant

_POINTS = 9
"""At so many points of a motion the mass matrix is computed; it is interpolated in between."""


class ArmInertia:
    """Tells how fast the torques change in a motion."""

    def __init__(self, arm: MultibodyPlant) -> None:
        """
        Args:
            arm: a plant of nothing but the arm and its hand; the joints come before the fingers.
        """
        self._arm = arm
        # Scratch memory: no value outlives the call that sets it.
        self._scratch = arm.CreateDefaultContext()
        self._positions = arm.GetPositions(self._scratch)

    def mass(self, q: NDArray[np.float64]) -> NDArray[np.float64]:
        """(7, 7) mass matrix of the joints at joint positions (7)."""
        positions = self._positions.copy()
        positions[:JOINTS] = q
        self._arm.SetPositions(self._scratch, positions)
        return np.asarray(self._arm.CalcMassMatrix(self._scratch)[:JOINTS, :JOINTS])

    def torques(
        self, q: NDArray[np.float64], acceleration: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """(n, 7) torques that accelerate the joints in a motion, without Coriolis terms, in N m.

        Args:
            q: (n, 7) positions in the order of the motion. Likewise `acceleration`.
        """
        at = np.linspace(0, len(q) - 1, min(_POINTS, len(q))).astype(int)
        masses = np.array([self.mass(q[i]) for i in at])
        share = np.interp(np.arange(len(q)), at, np.arange(len(at)))
        before = np.minimum(share.astype(int), max(len(at) - 2, 0))
        after = np.minimum(before + 1, len(at) - 1)
        weight = (share - before)[:, None]
        first, second = (
            np.einsum("nij,nj->ni", masses[index], acceleration) for index in (before, after)
        )
        return np.asarray(first + weight * (second - first))
