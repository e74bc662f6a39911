"""Feeling for a cavity by force, when what is lowered stands on its rim."""

from dataclasses import dataclass

from systems.bounds import bounded

_STEPS = (0.5, -0.5, 1.0, -1.0, 0.0)
"""The headings that the search tries one after another, in parts of its amplitude."""


@dataclass
class InsertionSearch:
    """The hand presses lightly and rotates to and fro until the resistance ends."""

    # How far the hand rotates to and fro, in rad: a tool that the closing jaws rotated a little
    # slips into its cavity then. At zero there is no search: it is let go where it is.
    amplitude: float = bounded(0.12, 0.0, 0.5)

    # Rotation speed, in rad/s: the free space around a tool is about 3 degrees wide, and is not to
    # be missed.
    yaw_speed: float = bounded(0.3, 0.01, 2.5)

    # While searching, the hand is commanded this far below where it was stopped, in m: its
    # stiffness makes a light force of it.
    press: float = bounded(0.001, 0.0, 0.01)

    # An object that touches something stands on the rim unless its bottom is this far below, in m.
    rim_margin: float = bounded(0.0007, 0.0, 0.01)

    @property
    def steps(self) -> int:
        """How many headings are tried before the object is let go."""
        return len(_STEPS) if self.amplitude > 0 else 0

    def yaw_offset(self, step: int) -> float:
        """By how much the hand is rotated from the place's yaw at a step, in rad."""
        return _STEPS[step] * self.amplitude

    def is_on_rim(self, bottom: float, rim: float) -> bool:
        """Whether an object with its bottom at a height stands on the rim, in metres."""
        return bottom > rim - self.rim_margin

    def has_slipped_in(self, z: float, touched_at: float) -> bool:
        """Whether the hand at a height has gone down from where it was stopped, in metres."""
        return z < touched_at - self.press / 2
