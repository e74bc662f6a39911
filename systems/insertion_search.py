"""Feeling for a cavity by force, when what is lowered stands on its rim."""

import math
from dataclasses import dataclass

from systems.bounds import bounded

_YAWS = (0.5, -0.5, 1.0, -1.0, 0.0)
"""The headings that the search tries one after another, in parts of its amplitude."""
_GOLDEN = math.pi * (3 - math.sqrt(5))
_SPIRAL = tuple(
    (math.sqrt(n / 16) * math.cos(n * _GOLDEN), math.sqrt(n / 16) * math.sin(n * _GOLDEN))
    for n in range(1, 17)
)
"""Then the positions, evenly spread over a disc from its middle outward, in parts of its radius."""
_LEAST_RIM = 0.004
"""The rim of a cavity is at least this high above the table, in m; noise is less."""
_BACK = (0.0, 0.0)
"""At last it is where it began."""


@dataclass
class InsertionSearch:
    """The hand presses lightly, rotates to and fro, then strays in a spiral, until the resistance
    ends."""

    # How far the hand rotates to and fro, in rad: a tool that the closing jaws rotated a little
    # slips into its cavity then. At zero it does not; with `reach` zero too there is no search: it
    # is let go where it is.
    amplitude: float = bounded(0.12, 0.0, 0.5)

    # How far from the place it strays, in m: about what calibration may be off. At zero it rotates
    # only.
    reach: float = bounded(0.004, 0.0, 0.02)

    # Rotation speed, in rad/s: the free space around a tool is about 3 degrees wide, and is not to
    # be missed.
    yaw_speed: float = bounded(0.3, 0.01, 2.5)

    # Speed along the spiral, in m/s.
    speed: float = bounded(0.03, 0.001, 0.5)

    # While searching, the hand is commanded this far below where it was stopped, in m: its
    # stiffness makes a light force of it.
    press: float = bounded(0.001, 0.0, 0.01)

    # An object that touches something stands on the rim unless its bottom is this far below, in m.
    rim_margin: float = bounded(0.0007, 0.0, 0.01)

    @property
    def steps(self) -> int:
        """How many headings and positions are tried before the object is let go."""
        spiral = len(_SPIRAL) + 1 if self.reach > 0 else 0
        return (len(_YAWS) if self.amplitude > 0 else 0) + spiral

    def offset(self, step: int) -> tuple[float, float, float]:
        """By how much the hand is off the place's x and y, in m, and yaw, in rad, at a step."""
        if self.amplitude > 0:
            if step < len(_YAWS):
                return 0.0, 0.0, _YAWS[step] * self.amplitude
            step -= len(_YAWS)
        x, y = (*_SPIRAL, _BACK)[step]
        return self.reach * x, self.reach * y, 0.0

    def is_on_rim(self, bottom: float, rim: float, table: float) -> bool:
        """Whether an object with its bottom at a height stands on the rim of a cavity.

        Args:
            bottom: of the object, in metres.
            rim: the highest around its place, in metres. What is no higher than the table has no
                cavity: an object that is laid there has arrived.
            table: of the table's top, in metres.
        """
        return rim > table + _LEAST_RIM and bottom > rim - self.rim_margin

    def has_slipped_in(self, z: float, touched_at: float) -> bool:
        """Whether the hand at a height has gone down from where it was stopped, in metres."""
        return z < touched_at - self.press / 2
