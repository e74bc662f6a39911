"""Force-guided search for a cavity, for a lowered object that stands on the cavity's rim."""

import math
from dataclasses import dataclass

from systems.bounds import bounded

_YAWS = (0.5, -0.5, 1.0, -1.0, 0.0)
"""The yaw offsets that the search tries first, in order, as fractions of `amplitude`."""
_GOLDEN = math.pi * (3 - math.sqrt(5))
_SPIRAL = tuple(
    (math.sqrt(n / 16) * math.cos(n * _GOLDEN), math.sqrt(n / 16) * math.sin(n * _GOLDEN))
    for n in range(1, 17)
)
"""The position offsets (x, y) that the search tries after the yaw offsets, as fractions of `reach`:
a spiral of evenly spread points, from the middle outward."""
_LEAST_RIM = 0.004
"""Least height of a cavity's rim above the table, in metres. It exceeds the noise of heights in
the observation o_t."""
_BACK = (0.0, 0.0)
"""The last offset, which returns to the start of the search."""


@dataclass
class InsertionSearch:
    """Parameters of the search. The hand presses lightly, rotates to and fro, and then follows a
    spiral, until the object slips into the cavity."""

    # Amplitude of the yaw oscillation, in rad. The closing jaws may have rotated the tool a little;
    # the oscillation undoes this. Zero disables it; if `reach` is zero as well, the object is
    # released without a search.
    amplitude: float = bounded(0.12, 0.0, 0.5)

    # Radius of the spiral, in m, about as large as the calibration error. Zero disables the spiral.
    reach: float = bounded(0.004, 0.0, 0.02)

    # Rotation speed, in rad/s. It is slow enough for the object to slip in where the clearance is
    # about 3 degrees.
    yaw_speed: float = bounded(0.3, 0.01, 2.5)

    # Speed along the spiral, in m/s.
    speed: float = bounded(0.03, 0.001, 0.5)

    # The hand is commanded this far below the contact height, in m. Its stiffness turns this into a
    # light force.
    press: float = bounded(0.001, 0.0, 0.01)

    # An object in contact stands on the rim unless its bottom is at least this far below it, in m.
    rim_margin: float = bounded(0.0007, 0.0, 0.01)

    @property
    def steps(self) -> int:
        """How many offsets are tried before the object is released."""
        spiral = len(_SPIRAL) + 1 if self.reach > 0 else 0
        return (len(_YAWS) if self.amplitude > 0 else 0) + spiral

    def offset(self, step: int) -> tuple[float, float, float]:
        """Offset from the place at a step of the search: x and y in m, yaw in rad."""
        if self.amplitude > 0:
            if step < len(_YAWS):
                return 0.0, 0.0, _YAWS[step] * self.amplitude
            step -= len(_YAWS)
        x, y = (*_SPIRAL, _BACK)[step]
        return self.reach * x, self.reach * y, 0.0

    def is_on_rim(self, bottom: float, rim: float, table: float) -> bool:
        """Whether an object stands on the rim of a cavity.

        Args:
            bottom: height of the object's bottom, in metres.
            rim: height of the highest surface around its place, in metres. If that is about the
                table's height, there is no cavity.
            table: height of the table, in metres.
        """
        return rim > table + _LEAST_RIM and bottom > rim - self.rim_margin

    def has_slipped_in(self, z: float, touched_at: float) -> bool:
        """Whether the hand, at height z, is clearly below its height at contact; both in metres."""
        return z < touched_at - self.press / 2
