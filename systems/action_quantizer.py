"""Rounding to the discrete actions of the paper's policies (section III-A)."""

import math
from dataclasses import dataclass

import numpy as np

from systems.signals import PixelGrid


@dataclass(frozen=True)
class ActionQuantizer:
    """Rounds positions to pixel centres and rotations to N orientations."""

    grid: PixelGrid
    """The pixel grid; positions are rounded to the centres of its pixels."""
    orientations: int
    """N, the number of orientations; angles are rounded to multiples of 2 pi / N."""

    def position(self, x: float, y: float) -> tuple[float, float]:
        """Rounds a point to the nearest pixel centre (x, y). Both are in the world, in metres."""
        pixel = np.clip(np.round(self.grid.to_pixel((x, y))), 0, np.array(self.grid.shape) - 1)
        rounded_x, rounded_y = self.grid.to_world(pixel)
        return float(rounded_x), float(rounded_y)

    def angle(self, theta: float) -> float:
        """Rounds an angle, in radians, to the nearest of the N orientations."""
        return round(theta * self.orientations / math.tau) * math.tau / self.orientations
