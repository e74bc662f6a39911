"""Generates screwdrivers: a steel blade in a moulded handle with flats and flutes."""

from dataclasses import dataclass

import numpy as np

from kitting_drake.hkd.families.screwdriver_handles import handle
from kitting_drake.hkd.families.screwdriver_tips import TIPS
from kitting_drake.hkd.tools.solids import (
    Part,
    Shape,
    across_path,
    across_x,
    circle,
    loft,
    rounded_rectangle,
)


@dataclass
class ScrewdriverParameters:
    """A screwdriver with its tip toward +x and the handle's front at x = 0. Lengths in mm."""

    # The kind of handle: fluted, tee (a bar across the end), offset (a bar with an angled tip at
    # each end, without a handle) or a key of screwdriver_handles.STYLES.
    handle: str = "fluted"
    # The kind of tip: flat, phillips, square, torx, hex or socket (a nut driver).
    tip: str = "flat"
    # The round shaft's length from the handle's front to the tip, and its diameter.
    shaft_length_mm: float = 88.0
    shaft_diameter_mm: float = 6.5
    # The flat tip's length, its width where it is widest, and its thickness at the edge.
    tip_length_mm: float = 16.0
    tip_width_mm: float = 8.0
    tip_thickness_mm: float = 1.2
    # The width across flats and the length of the hexagon on the shaft; length 0 for none.
    bolster_width_mm: float = 11.0
    bolster_length_mm: float = 9.0
    # The handle's length, its width across flats, and the difference between this width and the
    # width of the neck behind the guard.
    handle_length_mm: float = 105.0
    handle_width_mm: float = 28.0
    neck_depth_mm: float = 3.5
    # The depth of the four flutes between the flats, and the radius of the corners that the flutes
    # cut.
    flute_depth_mm: float = 3.0
    corner_radius_mm: float = 10.5
    # The height of the handle; None: the same as its width.
    handle_height_mm: float | None = None
    # The diameter of a coloured sleeve on the shaft (0 for none), and the length of the shaft in
    # front of the sleeve.
    sleeve_diameter_mm: float = 0.0
    bare_mm: float = 25.0
    # The materials of the parts. Each is a key of solids.MATERIALS.
    handle_material: str = "red_grip"
    accent_material: str = "black_rubber"
    shaft_material: str = "polished_steel"


def build_screwdriver(p: ScrewdriverParameters) -> list[Part]:
    """Builds the parts of a screwdriver, in mm in the design frame.

    Raises:
        ValueError: `handle` or `tip` is not a known kind.
    """
    if p.handle == "offset":
        return _offset_driver(p)
    parts = _shaft_parts(p)
    if p.bolster_length_mm > 0:
        bolster = _bolster(p)
        parts.append(Part("bolster", p.shaft_material, bolster.solid, bolster.hulls))
    materials = {"grip": p.handle_material, "accent": p.accent_material, "metal": p.shaft_material}
    height = p.handle_height_mm or p.handle_width_mm
    if p.handle == "fluted":
        grip, collar = _handle(p)
        zones = [("grip", grip), ("accent", collar)]
    elif p.handle == "tee":
        zones = _tee(p, height)
    else:
        zones = handle(p.handle, p.handle_length_mm, p.handle_width_mm, height, p.flute_depth_mm)
    return parts + [
        Part("collar" if zone == "accent" else zone, materials[zone], shape.solid, shape.hulls)
        for zone, shape in zones
    ]


def _shaft_parts(p: ScrewdriverParameters) -> list[Part]:
    """Builds the blade and its optional sleeve."""
    if p.tip == "flat":
        shaft = _shaft(p)
    elif p.tip in TIPS:
        shaft = TIPS[p.tip](
            -0.55 * p.handle_length_mm,
            p.shaft_length_mm,
            p.shaft_diameter_mm,
            p.tip_length_mm,
            p.tip_width_mm,
        )
    else:
        raise ValueError(f"the tip must be one of flat, {', '.join(TIPS)}, not {p.tip!r}")
    parts = [Part("shaft", p.shaft_material, shaft.solid, shaft.hulls)]
    if p.sleeve_diameter_mm > 0:
        end = p.shaft_length_mm - p.bare_mm
        ring = circle(p.sleeve_diameter_mm / 2, segments=24)
        sleeve = loft([across_x(ring, -2.0), across_x(ring, end - 1.0), across_x(0.9 * ring, end)])
        parts.append(Part("sleeve", p.handle_material, sleeve.solid, sleeve.hulls))
    return parts


def _tee(p: ScrewdriverParameters, height: float) -> list[tuple[str, Shape]]:
    """Builds a bar across the end of the shaft, flat above and below, and the hub around the shaft.

    The bar is `handle_width_mm` long, and the hub is `handle_length_mm` long.
    """
    depth = 0.36 * p.handle_width_mm
    sections = []
    for y, size in (
        (-0.5, 0.6),
        (-0.47, 0.86),
        (-0.42, 1.0),
        (0.42, 1.0),
        (0.47, 0.86),
        (0.5, 0.6),
    ):
        profile = size * rounded_rectangle(depth, height, 0.3 * height, 4)
        y_mm = np.full(len(profile), y * p.handle_width_mm)
        x = -p.handle_length_mm - depth / 2 - profile[:, 0]
        sections.append(np.column_stack([x, y_mm, profile[:, 1]]))
    hub = [
        across_x(rounded_rectangle(w, w, 0.25 * w, 4), x)
        for x, w in (
            (-p.handle_length_mm - 0.5 * depth, 0.85 * height),
            (-4.0, 0.85 * height),
            (0.0, 0.6 * height),
        )
    ]
    return [("grip", loft(sections)), ("accent", loft(hub))]


def _offset_driver(p: ScrewdriverParameters) -> list[Part]:
    """Builds a square bar whose ends bend to opposite sides and are ground to flat tips."""
    half, size = p.shaft_length_mm / 2, p.shaft_diameter_mm
    reach = p.tip_length_mm
    parts = []
    bar = rounded_rectangle(size, size, 0.16 * size, 2)
    for side in (1, -1):
        # The points run from the middle of the bar around the bend to the tip.
        bend = np.radians(np.linspace(0.0, 90.0, 5))
        radius = 0.9 * size
        turn = np.column_stack(
            [half - radius + radius * np.sin(bend), radius - radius * np.cos(bend)]
        )
        path = [((0.0, 0.0), 0.0), *((tuple(q), a) for q, a in zip(turn, bend, strict=True))]
        sections = [across_path(bar, point, angle) for point, angle in path]
        for share, width, thick in ((0.3, 1.0, 0.7), (0.85, 1.0, 0.22), (1.0, 1.0, 0.18)):
            # One tip is upright and the other one is flat, as on real offset screwdrivers.
            profile = bar * ((thick, width) if side > 0 else (width, thick))
            sections.append(
                across_path(profile, (half, radius + share * (reach - radius)), bend[-1])
            )
        rotated = [s * (side, side, 1.0) for s in sections]
        shape = loft(rotated)
        parts.append(Part("blade", p.shaft_material, shape.solid, shape.hulls))
    if p.handle_length_mm > 0:
        grip = rounded_rectangle(p.handle_width_mm, p.handle_width_mm, p.corner_radius_mm, 3)
        end = p.handle_length_mm / 2
        sleeve = loft(
            [
                across_x(size * grip, x)
                for x, size in ((-end, 0.9), (1.2 - end, 1.0), (end - 1.2, 1.0), (end, 0.9))
            ]
        )
        parts.append(Part("grip", p.handle_material, sleeve.solid, sleeve.hulls))
    return parts


def _shaft(p: ScrewdriverParameters) -> Shape:
    """Builds the round shaft with its end inside the handle, and the flat tip, which widens and is
    then ground to a blunt edge."""
    radius, end = p.shaft_diameter_mm / 2, p.shaft_length_mm
    start = end - p.tip_length_mm
    round_section = circle(radius, segments=24)
    sections = [across_x(round_section, -0.55 * p.handle_length_mm), across_x(round_section, start)]
    for t in (0.25, 0.5, 0.75, 1.0):
        # The width quickly reaches its maximum and stays there; the thickness decreases linearly.
        width = radius + (p.tip_width_mm / 2 - radius) * min(1.0, 2 * t)
        thickness = radius + (p.tip_thickness_mm / 2 - radius) * t
        box = np.clip(1.35 * round_section / radius, -1.0, 1.0) * (width, thickness)
        sections.append(across_x(box, start + t * p.tip_length_mm))
    return loft(sections)


def _bolster(p: ScrewdriverParameters) -> Shape:
    """Builds a hexagon on the shaft for a wrench, with chamfered ends."""
    hexagon = circle(p.bolster_width_mm / np.sqrt(3), segments=6)
    front = p.bolster_length_mm
    return loft(
        [
            across_x(scale * hexagon, x)
            for scale, x in ((1.0, -2.0), (1.0, front - 1.4), (0.82, front))
        ]
    )


def _handle_section(p: ScrewdriverParameters, x: float, width: float, flute: float) -> np.ndarray:
    """Returns a square section (n, 3) with round corners and a flute of depth `flute` in each
    corner."""
    profile = rounded_rectangle(width, width, p.corner_radius_mm * width / p.handle_width_mm, 8)
    angle = np.arctan2(profile[:, 1], profile[:, 0])
    # -cos(4 angle) is 1 on the diagonals, where the corners are. Its square is a narrower peak, so
    # that the flutes do not cut into the flat sides.
    depth = flute * np.clip(-np.cos(4 * angle), 0.0, 1.0) ** 2
    reach = np.linalg.norm(profile, axis=1, keepdims=True)
    return across_x(profile * (1 - depth[:, None] / reach), x)


def _handle(p: ScrewdriverParameters) -> tuple[Shape, Shape]:
    """Builds the fluted grip, and the smooth dark collar with a guard at its front."""
    length, width, neck = p.handle_length_mm, p.handle_width_mm, p.handle_width_mm - p.neck_depth_mm
    # Each row: the distance from the rear end (as a share of the length), the width, and the depth
    # of the flutes (as a share of their full depth).
    stations = [
        (0.0, 0.55 * width, 0.0),
        (0.012, 0.72 * width, 0.0),
        (0.035, 0.87 * width, 0.0),
        (0.065, 0.96 * width, 0.0),
        (0.10, width, 0.0),
        (0.13, width, 0.35),
        (0.17, width, 1.0),
        (0.80, width, 1.0),
    ]
    grip = loft(
        [_handle_section(p, (t - 1) * length, w, f * p.flute_depth_mm) for t, w, f in stations]
    )
    stations = [
        (0.80, width, 1.0),
        (0.84, width, 0.35),
        (0.87, width, 0.0),
        (0.895, 0.97 * width, 0.0),
        (0.925, neck, 0.0),
        (0.945, neck, 0.0),
        (0.965, 0.93 * width, 0.0),
        (0.98, 0.93 * width, 0.0),
        (0.992, 0.84 * width, 0.0),
        (1.0, 0.7 * width, 0.0),
    ]
    collar = loft(
        [_handle_section(p, (t - 1) * length, w, f * p.flute_depth_mm) for t, w, f in stations]
    )
    return grip, collar
