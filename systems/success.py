"""The success predicates of the tasks: the paper's measure and those of Ravens."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform

from systems.placement import Placement


@dataclass(frozen=True)
class AddS:
    """Success by the paper's measure (section IV-C): ADD-S below a threshold."""

    threshold: float = 0.0035
    """ADD-S must be below this, in metres."""

    @property
    def description(self) -> str:
        return f"ADD-S below {1e3 * self.threshold:g} mm"

    def share(self, placement: Placement, X_WB: RigidTransform) -> float:
        return float(placement.add_s < self.threshold)


@dataclass(frozen=True)
class PoseWithin:
    """Success as in Ravens: pose errors below thresholds."""

    position: float = 0.01
    """The horizontal distance from the goal must be below this, in metres."""
    angle: float = math.radians(15.0)
    """The heading error, modulo the object's symmetry, must be below this, in radians."""
    height: float | None = None
    """The height error must be below this, in metres; None if heights are not compared."""

    @property
    def description(self) -> str:
        position, angle = f"{1e3 * self.position:g} mm", f"{math.degrees(self.angle):g} degrees"
        if self.height is None:
            return f"within {position} and {angle}"
        return f"within {position}, {angle} and {1e3 * self.height:g} mm in height"

    def share(self, placement: Placement, X_WB: RigidTransform) -> float:
        near = placement.position_error < self.position
        high = self.height is not None and not abs(placement.height_error) < self.height
        return float(near and abs(placement.angle_error) < self.angle and not high)


@dataclass(frozen=True)
class InZone:
    """Success as in the Ravens tasks with zones: an object earns the share of its volume that lies
    in a box."""

    X_WZone: RigidTransform
    """The zone's frame, with its origin at the middle of the zone's bottom."""
    size: tuple[float, float, float]
    """Extents of the zone along the axes of its frame, in metres."""
    p_BVolume: NDArray[np.float64] = field(repr=False)
    """(m, 3) points that fill an object evenly, in its frame, in metres."""

    @property
    def description(self) -> str:
        length, width, height = (1e3 * side for side in self.size)
        return f"inside a zone of {length:g} x {width:g} x {height:g} mm"

    def share(self, placement: Placement, X_WB: RigidTransform) -> float:
        points = self.X_WZone.InvertAndCompose(X_WB).multiply(self.p_BVolume.T).T
        half = np.array([self.size[0] / 2, self.size[1] / 2])
        inside = (np.abs(points[:, :2]) <= half).all(axis=1)
        inside &= (points[:, 2] >= 0) & (points[:, 2] <= self.size[2])
        return float(inside.mean())
