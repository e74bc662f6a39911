"""The kinds of simple parts, their proportions, and the limits of what the hand can hold.

Lengths are in mm.
"""

from collections.abc import Callable
from dataclasses import dataclass

from kitting_drake.hkd.families.parts import (
    THINNEST_MM,
    WIDEST_MM,
    PartDesign,
    PartError,
    bit,
    board,
    bolt,
    bracket,
    disc,
    pin,
    plate_part,
    ring,
    rod,
    socket,
)
from kitting_drake.hkd.tools.tool import LONGEST_MM, SHORTEST_MM


@dataclass(frozen=True)
class PartKind:
    """A kind of part: its design function and its proportions."""

    design: Callable[..., PartDesign]
    dimensions: str
    """The names of the dimensions, for messages."""
    default: tuple[float, ...]
    scaled: Callable[[float, float, float], tuple[float, ...]]
    """A function that returns the dimensions of a part of a given length.

    Its other two arguments are numbers from 0 to 1 that vary the part's shape.
    """
    longest: float = LONGEST_MM
    shortest: float = SHORTEST_MM


def _between(low: float, high: float, share: float) -> float:
    return low + share * (high - low)


def _scaled_ring(length: float, u: float, v: float) -> tuple[float, ...]:
    if length <= WIDEST_MM:
        return length, _between(0.35, 0.6, u) * length, _height(length, 0.2, 0.4, v)
    rim = _between(8.0, 13.0, u)
    return length, length - 2 * rim, _between(8.0, 14.0, v)


def _height(length: float, low: float, high: float, share: float) -> float:
    """Returns the length times a factor, within the limits of the hand and a kit.

    The factor is `low` for a share of 0, and `high` for a share of 1.
    """
    return min(max(_between(low, high, share) * length, THINNEST_MM + 1.0), 30.0)


def _width(length: float, low: float, high: float, share: float) -> float:
    return min(max(_between(low, high, share) * length, 8.0), 60.0)


PART_KINDS: dict[str, PartKind] = {
    "ring": PartKind(ring, "outer x inner x height", (40.0, 20.0, 12.0), _scaled_ring),
    "disc": PartKind(
        disc,
        "diameter x height",
        (35.0, 10.0),
        lambda length, u, v: (length, _height(length, 0.2, 0.45, v)),
        longest=WIDEST_MM,
    ),
    "cylinder": PartKind(
        disc,
        "diameter x height",
        (30.0, 40.0),
        lambda length, u, v: (length, min(_between(0.8, 1.3, v) * length, 40.0)),
        longest=50.0,
    ),
    "rod": PartKind(
        rod,
        "length x diameter",
        (100.0, 14.0),
        lambda length, u, v: (length, min(max(_between(0.12, 0.3, u) * length, 6.0), 25.0)),
    ),
    "plate": PartKind(
        plate_part,
        "length x width x height",
        (100.0, 50.0, 6.0),
        lambda length, u, v: (
            length,
            _width(length, 0.4, 0.8, u),
            min(_height(length, 0.05, 0.12, v), 10.0),
        ),
    ),
    "block": PartKind(
        plate_part,
        "length x width x height",
        (40.0, 25.0, 20.0),
        lambda length, u, v: (
            length,
            min(_width(length, 0.5, 0.9, u), 40.0),
            _height(length, 0.3, 0.6, v),
        ),
    ),
    "board": PartKind(
        board,
        "length x width x height",
        (85.0, 56.0, 16.0),
        lambda length, u, v: (
            length,
            _width(length, 0.5, 0.8, u),
            min(_height(length, 0.15, 0.3, v) + 2.0, 16.0),
        ),
    ),
    "bolt": PartKind(
        bolt,
        "length x diameter",
        (30.0, 10.0),
        lambda length, u, v: (min(length, 45.0), max(_between(0.35, 0.6, u) * length, 6.0)),
        longest=45.0,
    ),
    "pin": PartKind(
        pin,
        "length x diameter",
        (40.0, 8.0),
        lambda length, u, v: (length, min(max(_between(0.15, 0.28, u) * length, 5.0), 20.0)),
    ),
    "socket": PartKind(
        socket,
        "diameter x height",
        (22.0, 26.0),
        lambda length, u, v: (length, min(max(_between(0.7, 1.2, v) * length, 10.0), 40.0)),
        longest=55.0,
    ),
    "bit": PartKind(
        bit,
        "length x flats",
        (25.0, 6.35),
        lambda length, u, v: (length, min(max(_between(0.2, 0.3, u) * length, 6.0), 12.0)),
        longest=100.0,
    ),
    "bracket": PartKind(
        bracket,
        "length x width x height",
        (60.0, 36.0, 12.0),
        lambda length, u, v: (
            length,
            max(min(_between(0.5, 0.8, u) * length, 90.0), 12.0),
            min(_height(length, 0.15, 0.35, v), 16.0),
        ),
        shortest=20.0,
    ),
}
"""The kinds of parts by name."""


def design_part(kind: str, dimensions: tuple[float, ...]) -> PartDesign:
    """Designs a part.

    Args:
        kind: a key of `PART_KINDS`.
        dimensions: the dimensions in mm, in the order of `PartKind.dimensions`.

    Raises:
        PartError: the dimensions do not make a part that the hand can hold.
    """
    known = PART_KINDS[kind]
    if len(dimensions) != len(known.default):
        raise PartError(f"give the dimensions {known.dimensions} in mm")
    if not all(2.0 <= value <= LONGEST_MM for value in dimensions):
        raise PartError(f"each dimension must be 2 to {LONGEST_MM:g} mm")
    design = known.design(*dimensions)
    top = max(float(hull[:, 2].max()) for part in design.parts for hull in part.hulls)
    if top < THINNEST_MM - 1e-6:
        raise PartError(
            f"the part is {top:g} mm high, but the hand needs at least {THINNEST_MM:g} mm"
        )
    if not 3.0 <= design.grasp.width_mm <= WIDEST_MM:
        raise PartError(
            f"the part is {design.grasp.width_mm:.1f} mm wide where it is held, but the jaws hold "
            f"3 to {WIDEST_MM:g} mm"
        )
    return design
