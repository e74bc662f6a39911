"""Computes the torques that accelerate a Franka arm and its hand."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from systems.arm_limits import JOINTS

if TYPE_CHECKING:
    # Motions can be planned without Drake, so import it for type checks only.
    from pydrake.multibody.plant import MultibodyPlant

_POINTS = 9
"""Number of points of a motion at which the mass matrix is computed; it is interpolated in
between."""


class ArmInertia:
    """Computes mass matrices, and from them the joint torques along a motion."""

    def __init__(self, arm: MultibodyPlant) -> None:
        """
        Args:
            arm: a plant that contains only the arm and its hand; the joints come before the
                fingers.
        """
        self._arm = arm
        # Scratch memory: each call overwrites the values before it reads them.
        self._scratch = arm.CreateDefaultContext()
        self._positions = arm.GetPositions(self._scratch)

    def mass(self, q: NDArray[np.float64]) -> NDArray[np.float64]:
        """(7, 7) joint-space mass matrix, in SI units, at joint positions (7) in rad."""
        positions = self._positions.copy()
        positions[:JOINTS] = q
        self._arm.SetPositions(self._scratch, positions)
        return np.asarray(self._arm.CalcMassMatrix(self._scratch)[:JOINTS, :JOINTS])

    def torques(
        self, q: NDArray[np.float64], acceleration: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """(n, 7) torques M(q) a that accelerate the joints in a motion, in N m. Coriolis and
        gravity terms are left out.

        Args:
            q: (n, 7) joint positions in the order of the motion, in rad.
            acceleration: (n, 7) joint accelerations, in rad/s^2.
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
