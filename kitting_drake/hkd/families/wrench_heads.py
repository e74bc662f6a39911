"""Heads of wrenches, which are the ends of a shank."""

from dataclasses import dataclass, field

import numpy as np
from manifold3d import CrossSection

from kitting_drake.hkd.tools.solids import (
    Part,
    across_x,
    circle,
    fillet,
    loft,
    plate,
    ribbon,
    rounded_rectangle,
)


@dataclass
class Head:
    """One end of a wrench. Lengths in mm."""

    # The kind of head:
    # - open, box, adjustable, pipe;
    # - ratchet: a box with a geared ring;
    # - flare_nut: a box with a gap for the pipe;
    # - hook: the end of a hook spanner;
    # - tail: a round end with a hole;
    # - spike: a taper to align holes;
    # - bar: a handle or striking block across the end.
    kind: str = "open"
    # The hexagon's width across flats. For some kinds this field is another size:
    # - adjustable, pipe: the opening of the jaws;
    # - tail: the diameter of the hole;
    # - hook: the length of its nose;
    # - spike: the length of the spike;
    # - bar: the depth of the bar along the shank.
    size_mm: float = 17.0
    # The head's diameter. For some kinds this field is another size:
    # - adjustable, pipe: the width across the head;
    # - spike: the diameter of its base;
    # - bar: the length of the bar.
    diameter_mm: float = 38.0
    thickness_mm: float = 8.8
    # The angle between the head's axis and the shank, in degrees.
    angle_deg: float = 0.0
    # The number of points of a closed head: 6 (one hexagon) or 12 (two hexagons).
    points: int = 12
    # The distance from the head's centre at which straight shoulders meet the shank; 0 for no
    # shoulders.
    neck_mm: float = 0.0


@dataclass
class HeadShape:
    """A placed head, seen from above, with its inserts."""

    # The forged outline, which is merged with the shank's outline.
    profile: CrossSection
    # The region that is cut out after the merge: the slot of an open end, or the hole of a box.
    cut: CrossSection
    # Separate parts that replace forged material: jaws, screws and rings.
    inserts: list[Part] = field(default_factory=list)
    # Regions that cut the head into convex parts for collision. If there are none, the head is cut
    # into triangles.
    cells: list[CrossSection] = field(default_factory=list)


def head_shape(head: Head, x: float, heading_deg: float, bevel_mm: float) -> HeadShape:
    """Returns the shape of a head whose centre is at (x, 0).

    The head's axis is turned from +x by `heading_deg` plus the head's own angle.

    Raises:
        ValueError: the kind of head is not known.
    """
    if head.kind not in _KINDS:
        raise ValueError(f"the head must be one of {', '.join(_KINDS)}, not {head.kind!r}")
    return _KINDS[head.kind](head, x, heading_deg + head.angle_deg, bevel_mm)


def _rectangle(x_low: float, x_high: float, y_low: float, y_high: float) -> CrossSection:
    return CrossSection.square((x_high - x_low, y_high - y_low)).translate((x_low, y_low))


def _put(profile: CrossSection, x: float, turn_deg: float) -> CrossSection:
    return profile.rotate(turn_deg).translate((x, 0.0))


def _set(part: Part, x: float, turn_deg: float) -> Part:
    """Moves a part to a head. The part was built about the origin, with its axis along +x."""
    c, s = np.cos(np.radians(turn_deg)), np.sin(np.radians(turn_deg))
    R = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    solid = part.solid.rotate((0.0, 0.0, turn_deg)).translate((x, 0.0, 0.0))
    return Part(part.name, part.material, solid, [h @ R.T + (x, 0.0, 0.0) for h in part.hulls])


def _flat_part(
    name: str, material: str, profile: CrossSection, thickness: float, bevel: float
) -> Part:
    shape = plate(profile, -thickness / 2, thickness / 2, bevel)
    return Part(name, material, shape.solid, shape.hulls)


def _open(head: Head, x: float, turn_deg: float, bevel: float) -> HeadShape:
    """Draws a disc with two jaws in front.

    The slot has parallel flanks, slightly flared lips, and a floor of two facets, as for a nut.
    """
    radius = head.diameter_mm / 2
    cheek = (0.82 if head.neck_mm else 0.9) * radius
    jaws = fillet(
        [
            (-0.2 * radius, -0.97 * radius),
            (0.62 * radius, -cheek),
            (1.12 * radius, -0.52 * radius),
            (1.12 * radius, 0.52 * radius),
            (0.62 * radius, cheek),
            (-0.2 * radius, 0.97 * radius),
        ],
        0.35 * radius,
    )
    disc = CrossSection([circle(radius, segments=64)]) + CrossSection([jaws])
    half, depth = head.size_mm / 2, 0.42 * radius
    # Heads with straight shoulders get straight outlines, which convex pieces fill well.
    apex, corner = (0.12 * half, 0.12 * half) if head.neck_mm else (2.0 * half, 0.35 * half)
    slot = fillet(
        [
            (-depth - 0.3 * half, 0.0),
            (-depth + 0.2 * half, -half),
            (1.0 * radius, -half),
            (1.4 * radius, -half - 0.12 * radius),
            (1.4 * radius, half + 0.12 * radius),
            (1.0 * radius, half),
            (-depth + 0.2 * half, half),
        ],
        [apex, corner, 1.0, 0.0, 0.0, 1.0, corner],
    )
    # Use one cell for each jaw, and one for each half of the disc behind the slot.
    far, floor = 2.0 * radius, -depth + 0.2 * half
    cells = [
        _rectangle(floor, far, half, far),
        _rectangle(floor, far, -far, -half),
        _rectangle(-far, floor, 0.0, far),
        _rectangle(-far, floor, -far, 0.0),
    ]
    return HeadShape(
        _put(disc, x, turn_deg),
        _put(CrossSection([slot]), x, turn_deg),
        cells=[_put(cell, x, turn_deg) for cell in cells] if head.neck_mm else [],
    )


def _socket(head: Head) -> CrossSection:
    """Returns a closed hole: a hexagon for 6 points, two hexagons for 12."""
    hexagon = CrossSection([circle(head.size_mm / np.sqrt(3), segments=6)])
    return hexagon if head.points == 6 else hexagon + hexagon.rotate(30)


def _box(head: Head, x: float, turn_deg: float, bevel: float) -> HeadShape:
    disc = CrossSection([circle(head.diameter_mm / 2, (x, 0.0), 64)])
    return HeadShape(disc, _socket(head).translate((x, 0.0)))


def _ratchet(head: Head, x: float, turn_deg: float, bevel: float) -> HeadShape:
    """Draws a round housing with a dark geared ring, and a reversing lever on top."""
    shape = _box(head, x, turn_deg, bevel)
    top, outer = head.thickness_mm / 2, head.diameter_mm / 2 - bevel
    radius = 0.68 * head.size_mm + 0.8
    # The ring lies a little below the housing's surface.
    bore = CrossSection([circle(radius)])
    ring = plate(CrossSection([circle(radius + 0.02)]) - _socket(head), -top + 0.6, top - 0.6, 0.4)
    shape.cut = bore.translate((x, 0.0))
    wall = outer - radius
    lever = fillet(
        [
            (-outer + 0.12 * wall, -0.6 * wall),
            (-radius - 0.2 * wall, -0.6 * wall),
            (-radius - 0.1 * wall, 0.7 * wall),
            (-outer + 0.2 * wall, 0.7 * wall),
        ],
        0.25 * wall,
    )
    switch = plate(CrossSection([lever]), top - 1.0, top + 0.4, 0.3).solid
    shape.inserts = [
        _set(Part("ring", "dark_steel", ring.solid), x, turn_deg),
        _set(Part("lever", "dark_steel", switch), x, turn_deg),
    ]
    return shape


def _flare_nut(head: Head, x: float, turn_deg: float, bevel: float) -> HeadShape:
    """Draws a 6-point box with a gap for the pipe; the gap is narrower than the nut."""
    radius, half_gap = head.diameter_mm / 2, 0.36 * head.size_mm
    disc = CrossSection([circle(radius, segments=48)])
    gap = [(0.0, -half_gap), (1.4 * radius, -half_gap), (1.4 * radius, half_gap), (0.0, half_gap)]
    cut = CrossSection([circle(head.size_mm / np.sqrt(3), segments=6)]) + CrossSection(
        [np.array(gap)]
    )
    # Use one cell for each sixth of the ring.
    cells = []
    for i in range(6):
        start, end = np.radians([60.0 * i, 60.0 * i + 60.0])
        corners = [(0.0, 0.0), (np.cos(start), np.sin(start)), (np.cos(end), np.sin(end))]
        cells.append(CrossSection([3.0 * radius * np.array(corners)]))
    return HeadShape(
        _put(disc, x, turn_deg),
        _put(cut, x, turn_deg),
        cells=[_put(cell, x, turn_deg) for cell in cells],
    )


def _tail(head: Head, x: float, turn_deg: float, bevel: float) -> HeadShape:
    """Draws a round end with a hole to hang up the wrench."""
    disc = CrossSection([circle(head.diameter_mm / 2, (x, 0.0), 32)])
    return HeadShape(disc, CrossSection([circle(head.size_mm / 2, (x, 0.0), 32)]))


def _knurled(radius: float, length: float, ridges: int) -> Part:
    """Builds a ridged screw along x about the origin."""
    ring = circle(radius, segments=20)
    stations = np.linspace(-length / 2, length / 2, 2 * ridges + 1)
    sections = [
        across_x(ring * (1.0 if i % 2 else 0.86), stations[i]) for i in range(len(stations))
    ]
    return Part("screw", "dark_steel", loft(sections).solid)


def _adjustable(head: Head, x: float, turn_deg: float, bevel: float) -> HeadShape:
    """Draws a forged fixed jaw, a sliding jaw, and the knurled screw that moves it.

    The origin is the foot of the jaws, which point to +x; the fixed jaw is at +y.
    """
    s, gap = head.diameter_mm / 42.0, head.size_mm
    body = s * fillet(
        [
            (-26.0, -6.0),
            (-17.0, -16.5),
            (-9.0, -20.0),
            (0.5, -20.0),
            (0.5, 0.0),
            (24.0, 5.0),
            (25.0, 8.6),
            (20.0, 15.0),
            (6.0, 21.0),
            (-9.0, 20.0),
            (-22.0, 11.0),
        ],
        [s * r for r in (8.0, 8.0, 5.0, 1.0, 0.0, 0.5, 2.0, 10.0, 12.0, 12.0, 10.0)],
    )
    foot, mouth = 0.0, 5.0 * s
    cut = CrossSection(
        [
            np.array(
                [(foot, -60.0 * s), (60.0 * s, -60.0 * s), (60.0 * s, mouth), (foot, mouth)],
                dtype=float,
            )
        ]
    )
    low, high = -16.0 * s, -3.5 * s
    window = rounded_rectangle(11.5 * s, high - low, 2.0 * s) + (-9.5 * s, 0.5 * (low + high))
    face = mouth - gap
    jaw = [
        (-5.0 * s, face - 8.0 * s),
        (foot, -19.8 * s),
        (4.0 * s, -19.5 * s),
        (14.0 * s, face - 9.0 * s),
        (23.0 * s, face - 5.5 * s),
        (24.0 * s, face - 2.5 * s),
        (23.4 * s, face),
        (-5.0 * s, face),
    ]
    sliding = _flat_part(
        "sliding_jaw",
        "steel",
        CrossSection([fillet(jaw, [0.0, 0.5, 3.0, 9.0, 2.0, 0.8, 0.4, 0.0])]),
        0.9 * head.thickness_mm,
        bevel,
    )
    screw = _knurled(4.9 * s, high - low - 0.4, 6)
    screw.solid = screw.solid.rotate((0, 0, 90)).translate((-9.5 * s, 0.5 * (low + high), 0.0))
    return HeadShape(
        _put(CrossSection([body]), x, turn_deg),
        _put(cut + CrossSection([window]), x, turn_deg),
        [_set(sliding, x, turn_deg), _set(screw, x, turn_deg)],
    )


def _pipe(head: Head, x: float, turn_deg: float, bevel: float) -> HeadShape:
    """Draws a toothed fixed jaw, and a hook jaw in a housing with a knurled nut.

    The origin is the middle of the fixed jaw's face, which faces +x.
    """
    s, gap = head.diameter_mm / 34.0, head.size_mm
    body = s * fillet(
        [
            (-46.0, -6.0),
            (-36.0, -17.5),
            (-6.0, -17.5),
            (-5.0, -7.0),
            (0.0, -6.0),
            (0.0, 13.0),
            (-5.0, 10.0),
            (-36.0, 10.0),
            (-46.0, 6.0),
        ],
        [s * r for r in (8.0, 3.0, 1.0, 1.0, 0.5, 1.0, 4.0, 4.0, 8.0)],
    )
    mouth = CrossSection.square((60.0 * s, 80.0 * s)).translate((-1.1 * s, -40.0 * s))
    window = rounded_rectangle(9.6 * s, 20.0 * s, 1.5 * s) + (-17.0 * s, -10.6 * s)
    low, high = -15.2 * s, -6.2 * s
    hook = [
        (-24.0 * s, low),
        (gap + 4.0 * s, low - 0.4 * s),
        (gap + 14.5 * s, low + 7.0 * s),
        (gap + 15.5 * s, 3.0 * s),
        (gap + 9.0 * s, 14.0 * s),
        (gap, 14.0 * s),
        (gap, high),
        (-24.0 * s, high),
    ]
    jaw = _flat_part(
        "hook_jaw",
        "steel",
        CrossSection([fillet(hook, [s * r for r in (0.0, 6.0, 9.0, 9.0, 5.0, 0.8, 2.0, 0.0)], 4)]),
        0.78 * head.thickness_mm,
        bevel,
    )
    pitch, height = 1.6 * s, 4.0 * head.thickness_mm
    notch = CrossSection([np.array([(0.0, -0.5), (0.9, 0.0), (0.0, 0.5)]) * (s, pitch)])
    for i in range(8):
        tooth = notch.translate((gap - 0.01, (i - 1.5) * pitch)).extrude(height)
        jaw.solid -= tooth.translate((0.0, 0.0, -height / 2))
    heel = [(-4.0, -5.6), (0.0, -5.6), (0.0, 12.9), (-4.0, 12.9)]
    insert = _flat_part(
        "heel_jaw", "steel", CrossSection([s * np.array(heel)]), head.thickness_mm, 0.3
    )
    for i in range(9):
        tooth = notch.mirror((1.0, 0.0)).translate((0.01, (i - 2.0) * pitch)).extrude(height)
        insert.solid -= tooth.translate((0.0, 0.0, -height / 2))
    nut = _knurled(0.5 * head.thickness_mm - 0.1, 8.8 * s, 5)
    nut.solid = nut.solid.translate((-17.0 * s, 0.5 * (low + high), 0.0))
    nut.hulls = [np.asarray(nut.solid.hull().to_mesh64().vert_properties)[:, :3]]
    return HeadShape(
        _put(CrossSection([body]), x, turn_deg),
        _put(mouth + CrossSection([window]), x, turn_deg),
        [_set(part, x, turn_deg) for part in (jaw, insert, nut)],
    )


def _hook(head: Head, x: float, turn_deg: float, bevel: float) -> HeadShape:
    """Draws a third of a ring that ends in a nose pointing at the ring's centre.

    The ring starts in the direction of the shank's axis and bends to +y.
    """
    radius = head.diameter_mm / 2
    angles = np.radians(np.linspace(-96.0, 40.0, 25))
    path = radius * np.column_stack([np.cos(angles), 1.0 + np.sin(angles)])
    widths = np.interp(angles, angles[[0, -1]], (0.66 * radius, 0.3 * radius))
    arc = CrossSection([ribbon(path, widths)])
    nose = fillet(
        [
            (radius - 0.17 * radius - head.size_mm, -2.4),
            (radius, -2.4),
            (radius, 2.4),
            (radius - 0.17 * radius - head.size_mm, 2.4),
        ],
        [0.6, 0.0, 0.0, 0.6],
    )
    hook = CrossSection([nose]).rotate(34.0).translate((0.0, radius))
    return HeadShape(_put(arc + hook, x, turn_deg), CrossSection())


def _spike(head: Head, x: float, turn_deg: float, bevel: float) -> HeadShape:
    """Draws a taper to a blunt point."""
    foot, point = head.diameter_mm / 2, 0.2 * head.diameter_mm
    rings = [circle(foot, segments=32), circle(point, (head.size_mm - point, 0.0), 32)]
    return HeadShape(_put(CrossSection.hull_points(np.vstack(rings)), x, turn_deg), CrossSection())


def _bar(head: Head, x: float, turn_deg: float, bevel: float) -> HeadShape:
    """Draws a bar with rounded ends across the shank."""
    depth, length = head.size_mm, head.diameter_mm
    outline = rounded_rectangle(depth, length, 0.2 * min(depth, length), 5)
    return HeadShape(_put(CrossSection([outline]), x, turn_deg), CrossSection())


_KINDS = {
    "open": _open,
    "box": _box,
    "ratchet": _ratchet,
    "flare_nut": _flare_nut,
    "tail": _tail,
    "adjustable": _adjustable,
    "pipe": _pipe,
    "hook": _hook,
    "spike": _spike,
    "bar": _bar,
}
