"""Simple parts that kits may hold besides hand tools: rings, discs, plates, boards, bolts and
others.

A part's name is its kind and its dimensions, such as `ring_40x20x10`. A kind without dimensions has
default ones. A part's frame has z up in its resting pose, z = 0 at its bottom, and the origin in
the middle of its bounding box. Lengths are in mm.
"""

import math
from dataclasses import dataclass

import numpy as np
from manifold3d import CrossSection

from kitting_drake.hkd.tools.mass import mass_properties
from kitting_drake.hkd.tools.solids import (
    MATERIALS,
    Part,
    Shape,
    across_x,
    circle,
    loft,
    plate,
)
from kitting_drake.hkd.tools.tool import LONGEST_MM

THINNEST_MM = 4.0
"""The least height of a part: the jaws' pads reach down only to 1.5 mm above the table."""
WIDEST_MM = 70.0
"""The largest width of a part between the jaws, which open to 80 mm."""

_BEVEL = 0.4
_FRAME = 5.0
"""The height of the frame around a circuit board.

A bare board is 1.6 mm thick, which is too thin for the jaws: their pads stay 1.5 mm above the
table.
"""
_SEGMENTS = 36
_SECTORS = 12
_ROUND = 24
"""The order of rotational symmetry that stands for a round part."""
_PAD = 17.6
"""The length of the jaws' pads."""
_INNER_REACH = 58.0
"""The distance from the grasp to the far side of an open finger, plus a margin of 3 mm."""
_HEX = 2 / math.sqrt(3)
"""The ratio of a hexagon's width across corners to its width across flats."""


@dataclass(frozen=True)
class PartGrasp:
    """A grasp in the part's frame. The jaws close along the y axis, rotated by theta about z."""

    width_mm: float
    top_mm: float
    """The part's height at the grasp."""
    x_mm: float = 0.0
    y_mm: float = 0.0
    theta_deg: float = 0.0


@dataclass(frozen=True)
class PartDesign:
    """The geometry of a part, in mm."""

    parts: list[Part]
    grasp: PartGrasp
    symmetry: int
    """The order of the rotational symmetry about z; 24 for a round part."""


class PartError(ValueError):
    """Raised if the dimensions make no part that the hand can hold; the message says why."""


def ring(outer: float, inner: float, height: float) -> PartDesign:
    """Designs a bearing or a washer, in mm.

    A ring up to 70 mm wide is held between opposite points of its outside. A larger ring is held by
    its rim, with one finger in the bore.
    """
    if not 2.0 <= inner <= outer - 4.0:
        raise PartError(
            f"the bore of {inner:g} mm must be at least 2 mm wide, and at least 4 mm narrower than "
            f"the ring of {outer:g} mm"
        )
    big, small = outer / 2, inner / 2
    profile = CrossSection([circle(big, segments=_SEGMENTS)]) - CrossSection(
        [circle(small, segments=_SEGMENTS)]
    )
    solid = plate(profile, 0.0, height, _BEVEL).solid
    hulls = plate(
        CrossSection([circle(big, segments=_SEGMENTS)]), 0.0, height, _BEVEL, _sectors(big, small)
    ).hulls
    if outer <= WIDEST_MM:
        return PartDesign(
            [Part("ring", "polished_steel", solid, hulls)], PartGrasp(outer, height), _ROUND
        )
    if small <= _PAD or (big + small) / 2 - _INNER_REACH < -math.sqrt(small**2 - 110.0):
        raise PartError(
            f"a ring wider than {WIDEST_MM:g} mm is gripped at its rim, with one finger in the "
            f"bore, but a bore of {inner:g} mm is too narrow for the finger: give a wider bore, or "
            "a smaller ring"
        )
    # The two ends of the inner pad touch the bore.
    chord = math.sqrt(small**2 - (_PAD / 2) ** 2)
    grasp = PartGrasp(big - chord, height, (big + chord) / 2, 0.0, 90.0)
    return PartDesign([Part("ring", "amber_plastic", solid, hulls)], grasp, _ROUND)


def disc(diameter: float, height: float) -> PartDesign:
    """Designs a round plate, or a cylinder that stands on its end, in mm."""
    shape = _prism(circle(diameter / 2, segments=_SEGMENTS), height)
    return PartDesign(
        [Part("disc", "steel", shape.solid, shape.hulls)], PartGrasp(diameter, height), _ROUND
    )


def rod(length: float, diameter: float) -> PartDesign:
    """Designs a cylinder that lies on its side, on one of 24 narrow flats, in mm."""
    section = circle(diameter / 2 / math.cos(math.pi / 24), segments=24)
    section = section @ _turn(math.pi / 24) + (0.0, diameter / 2)
    shape = loft([across_x(section, -length / 2), across_x(section, length / 2)])
    return PartDesign(
        [Part("rod", "polished_steel", shape.solid, shape.hulls)],
        PartGrasp(diameter, diameter),
        2,
    )


def plate_part(length: float, width: float, height: float) -> PartDesign:
    """Designs a rectangular plate or block, in mm."""
    shape = _prism(_rectangle(length, width), height)
    return PartDesign(
        [Part("plate", _light(length), shape.solid, shape.hulls)],
        PartGrasp(width, height),
        4 if math.isclose(length, width) else 2,
    )


def board(length: float, width: float, height: float) -> PartDesign:
    """Designs a circuit board in a frame 5 mm high, with components up to `height`, in mm.

    Its cavity is a rectangle, so the board also counts as placed when it is turned by a half turn.
    """
    if height < _FRAME + 1.0:
        raise PartError(
            f"a board with its components must be at least {_FRAME + 1:g} mm high, and is "
            f"{height:g} mm"
        )
    base = _prism(_rectangle(length, width), _FRAME)
    parts = [Part("board", "green_grip", base.solid, base.hulls)]
    # Add a connector at one end, a chip and a smaller component, which show the board's heading.
    for number, (x, y, long, wide, share) in enumerate(
        ((0.36, 0.0, 0.16, 0.7, 1.0), (-0.15, 0.12, 0.28, 0.4, 0.45), (-0.38, -0.3, 0.1, 0.16, 0.7))
    ):
        top = _FRAME + share * (height - _FRAME)
        box = _rectangle(long * length, wide * width) + (x * length, y * width)
        item = plate(box, _FRAME - 0.5, top, 0.2, [CrossSection([box])])
        parts.append(Part(f"part_{number}", "black_rubber", item.solid, item.hulls))
    return PartDesign(parts, PartGrasp(width, _FRAME), 2)


def bolt(length: float, diameter: float) -> PartDesign:
    """Designs a bolt that stands on its hexagonal head, in mm; `length` is the whole height.

    A bolt that lies on its side is a `pin`.
    """
    # The fingertips reach 10 mm below the top. Keep the head below them.
    head = min(0.65 * diameter, length - 11.0)
    if head < 2.0:
        raise PartError(
            "a standing bolt must be at least 13 mm long and 3.1 mm thick, and is "
            f"{length:g} by {diameter:g} mm"
        )
    hexagon = _hexagon(1.6 * diameter)
    shank = circle(diameter / 2, segments=24)
    lower, upper = _prism(hexagon, head), plate(shank, head - 0.2, length, _BEVEL, [_around(shank)])
    return PartDesign(
        [
            Part("head", "dark_steel", lower.solid, lower.hulls),
            Part("shank", "steel", upper.solid, upper.hulls),
        ],
        PartGrasp(diameter, length),
        6,
    )


def pin(length: float, diameter: float) -> PartDesign:
    """Designs a lying pin with a square collar at one end, in mm.

    The collar is as high as the shank, so the pin lies level.
    """
    section = circle(diameter / 2 / math.cos(math.pi / 24), segments=24)
    section = section @ _turn(math.pi / 24) + (0.0, diameter / 2)
    collar = 0.18 * length
    shank = loft([across_x(section, -length / 2), across_x(section, length / 2)])
    wide = _rectangle(collar, 1.7 * diameter) + (length / 2 - collar / 2, 0.0)
    block = plate(wide, 0.0, diameter, _BEVEL, [CrossSection([wide])])
    parts = [
        Part("collar", "dark_steel", block.solid, block.hulls),
        Part("shank", "steel", shank.solid, shank.hulls),
    ]
    x = _middle_of_mass(parts)[0]
    # On a short pin, the pads touch the collar, which is wider than the shank.
    on_collar = x + _PAD / 2 > length / 2 - collar
    return PartDesign(parts, PartGrasp((1.7 if on_collar else 1.0) * diameter, diameter, x), 1)


def socket(diameter: float, height: float) -> PartDesign:
    """Designs a ratchet's socket that stands on its drive end, in mm.

    A wide collar is at the bottom, and a narrower, hexagonal mouth at the top.
    """
    neck = 0.55 * height
    low, high = (circle(s * diameter / 2, segments=_SEGMENTS) for s in (1.0, 0.86))
    base = plate(low, 0.0, neck, _BEVEL, [_around(low)])
    mouth = plate(high, neck - 0.2, height, _BEVEL, [_around(high)])
    bore = CrossSection([_hexagon(0.5 * diameter)]).extrude(height).translate((0, 0, 0.4 * height))
    return PartDesign(
        [
            Part("collar", "polished_steel", base.solid - bore, base.hulls),
            Part("mouth", "polished_steel", mouth.solid - bore, mouth.hulls),
        ],
        PartGrasp(diameter if neck > height - 8.0 else 0.86 * diameter, height),
        6,
    )


def bit(length: float, flats: float) -> PartDesign:
    """Designs a lying screwdriver bit in mm: a hexagonal shank and a narrower, flattened tip."""
    # The hexagon lies on a flat, and its corners point toward the jaws.
    section = _hexagon(flats) + (0.0, flats / 2)
    start, end = -length / 2, length / 2
    shoulder = start + 0.68 * length
    tip = np.array([1.0, 0.55]) * (section - (0.0, flats / 2)) * 0.6 + (0.0, flats / 2)
    shape = loft(
        [across_x(section, start), across_x(section, shoulder), across_x(tip, end)],
    )
    return PartDesign(
        [Part("bit", "dark_steel", shape.solid, shape.hulls)],
        PartGrasp(flats * _HEX, flats, start + 0.42 * length),
        1,
    )


def bracket(length: float, width: float, height: float) -> PartDesign:
    """Designs an L in mm: a long leg along x and a short one along y, each `width / 3` thick."""
    thick = max(width / 3, THINNEST_MM)
    long_leg = _rectangle(length, thick) + (0.0, (thick - width) / 2)
    short_leg = _rectangle(thick, width) + ((length - thick) / 2, 0.0)
    profile = CrossSection([long_leg]) + CrossSection([short_leg])
    cells = [CrossSection([leg]) for leg in (long_leg, short_leg)]
    shape = plate(profile, 0.0, height, _BEVEL, cells)
    parts = [Part("bracket", _light(length), shape.solid, shape.hulls)]
    # The fingers close beside the short leg.
    x = min(_middle_of_mass(parts)[0], length / 2 - thick - 12.0)
    if x < -length / 2:
        raise PartError(
            f"the long leg must be at least {thick + 12:g} mm long, and is {length:g} mm"
        )
    return PartDesign(parts, PartGrasp(thick, height, x, (thick - width) / 2), 1)


def _light(length: float) -> str:
    """Returns the material of a solid part: steel, or painted aluminium for a large part."""
    return "red_enamel" if length > 60 else "steel"


def _middle_of_mass(parts: list[Part]) -> np.ndarray:
    """Returns the centre of mass (3,) of parts, in mm."""
    return (
        1e3 * mass_properties([(part.solid, MATERIALS[part.material].density) for part in parts])[1]
    )


def _prism(profile: np.ndarray, height: float) -> Shape:
    """Makes a bevelled prism over a convex profile."""
    return plate(profile, 0.0, height, min(_BEVEL, height / 5), [_around(profile)])


def _around(profile: np.ndarray) -> CrossSection:
    """Returns a square larger than any part. A `plate` with this square as its only cell has one
    collision hull."""
    return CrossSection.square((2 * LONGEST_MM, 2 * LONGEST_MM), True)


def _rectangle(length: float, width: float) -> np.ndarray:
    return np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]) * (length / 2, width / 2)


def _hexagon(flats: float) -> np.ndarray:
    """Returns a hexagon of a given width across flats, with its first corner toward +x."""
    return circle(flats * _HEX / 2, segments=6)


def _turn(angle: float) -> np.ndarray:
    """Returns the matrix (2, 2) that turns row vectors counter-clockwise by an angle in radians."""
    cos, sin = math.cos(angle), math.sin(angle)
    return np.array([[cos, sin], [-sin, cos]])


def _sectors(outer: float, inner: float) -> list[CrossSection]:
    """Returns cells that divide a ring into sectors. Their inner edges are chords of the bore."""
    angles = 2 * np.pi * np.arange(_SECTORS + 1) / _SECTORS
    unit = np.column_stack([np.cos(angles), np.sin(angles)])
    middle = np.column_stack(
        [np.cos(angles[:-1] + np.pi / _SECTORS), np.sin(angles[:-1] + np.pi / _SECTORS)]
    )
    far = 1.2 * outer
    return [
        CrossSection(
            [
                np.array(
                    [
                        inner * unit[i],
                        far * unit[i],
                        far * middle[i],
                        far * unit[i + 1],
                        inner * unit[i + 1],
                    ]
                )
            ]
        )
        for i in range(_SECTORS)
    ]
