"""The curves of a drawing, in mm."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

FLAT_MM = 0.01
"""The approximate tolerance in mm of the polylines that replace curves."""

UNITS_MM = {
    "mm": 1.0,
    "cm": 10.0,
    "m": 1000.0,
    "inches": 25.4,
    "pt": 25.4 / 72,
    "px": 25.4 / 96,
}
"""The length in mm of each unit that a drawing may use."""


@dataclass(frozen=True)
class Curve:
    """A curve of a drawing."""

    points: NDArray[np.float64]
    """Points (n, 2) in mm, with y up."""
    filled: bool = False
    """Whether the drawing fills the curve. A filled curve looks closed even if it is open."""
    element: int | None = None
    """The number of the filled element to which the curve belongs.

    The inner curves of an element are holes. None: the curve is not filled, or its element is not
    known.
    """


@dataclass(frozen=True)
class DrawnCurves:
    """The curves of a drawing, and how its scale was found."""

    curves: list[Curve]
    measured: str
    """A phrase for the user that says what gives the scale, such as `by its width and height`."""
    page_mm: tuple[float, float] | None = None
    """The size of the page in mm, if the drawing has one."""
    notes: list[str] = field(default_factory=list)
    """Phrases for the user on curves that were left out."""
