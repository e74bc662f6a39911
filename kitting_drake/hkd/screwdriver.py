"""Screwdrivers: a steel blade in a moulded handle with flats and flutes."""

from dataclasses import dataclass

import numpy as np

from kitting_drake.hkd.solids import (
    Part,
    Shape,
    across_x,
    circle,
    loft,
    rounded_rectangle,
)


@dataclass
class ScrewdriverParameters:
    """A flat-blade screwdriver, tip toward +x, the handle's front at x = 0. Lengths in mm."""

    # The round shaft: from the handle's front to the tip, and its diameter.
    shaft_length_mm: float = 88.0
    shaft_diameter_mm: float = 6.5
    # The flat tip: its length, its width where it flares and its thickness at the edge.
    tip_length_mm: float = 16.0
    tip_width_mm: float = 8.0
    tip_thickness_mm: float = 1.2
    # The hexagonal bolster on the shaft, across flats and along x.
    bolster_width_mm: float = 11.0
    bolster_length_mm: float = 9.0
    # The handle: length, width across its flats, and what it loses of it at the neck behind the
    # guard.
    handle_length_mm: float = 105.0
    handle_width_mm: float = 28.0
    neck_depth_mm: float = 3.5
    # Depth of the four flutes between the flats, and radius of the corners that they run in.
    flute_depth_mm: float = 3.0
    corner_radius_mm: float = 10.5
    # Keys of solids.MATERIALS.
    handle_material: str = "red_grip"
    accent_material: str = "black_rubber"
    shaft_material: str = "polished_steel"


def build_screwdriver(p: ScrewdriverParameters) -> list[Part]:
    """The parts of a screwdriver, in mm in the design frame."""
    shaft = _shaft(p)
    bolster = _bolster(p)
    grip, collar = _handle(p)
    return [
        Part("shaft", p.shaft_material, shaft.solid, shaft.hulls),
        Part("bolster", p.shaft_material, bolster.solid, bolster.hulls),
        Part("grip", p.handle_material, grip.solid, grip.hulls),
        Part("collar", p.accent_material, collar.solid, collar.hulls),
    ]


def _shaft(p: ScrewdriverParameters) -> Shape:
    """Tang, round shaft, and the tip: flared, then ground flat to a blunt edge."""
    radius, end = p.shaft_diameter_mm / 2, p.shaft_length_mm
    start = end - p.tip_length_mm
    round_section = circle(radius, segments=24)
    sections = [across_x(round_section, -0.55 * p.handle_length_mm), across_x(round_section, start)]
    for t in (0.25, 0.5, 0.75, 1.0):
        # Flare fast and stay wide; thin evenly, as a wedge does.
        width = radius + (p.tip_width_mm / 2 - radius) * min(1.0, 2 * t)
        thickness = radius + (p.tip_thickness_mm / 2 - radius) * t
        box = np.clip(1.35 * round_section / radius, -1.0, 1.0) * (width, thickness)
        sections.append(across_x(box, start + t * p.tip_length_mm))
    return loft(sections)


def _bolster(p: ScrewdriverParameters) -> Shape:
    """A hexagon on the shaft for a wrench, its ends chamfered."""
    hexagon = circle(p.bolster_width_mm / np.sqrt(3), segments=6)
    front = p.bolster_length_mm
    return loft(
        [
            across_x(scale * hexagon, x)
            for scale, x in ((1.0, -2.0), (1.0, front - 1.4), (0.82, front))
        ]
    )


def _handle_section(p: ScrewdriverParameters, x: float, width: float, flute: float) -> np.ndarray:
    """A square with round corners, a flute of depth `flute` pressed into each corner; (n, 3)."""
    profile = rounded_rectangle(width, width, p.corner_radius_mm * width / p.handle_width_mm, 8)
    angle = np.arctan2(profile[:, 1], profile[:, 0])
    # cos(4 angle) is -1 on the diagonals: the fourth power keeps the flutes off the flats.
    depth = flute * np.clip(-np.cos(4 * angle), 0.0, 1.0) ** 2
    reach = np.linalg.norm(profile, axis=1, keepdims=True)
    return across_x(profile * (1 - depth[:, None] / reach), x)


def _handle(p: ScrewdriverParameters) -> tuple[Shape, Shape]:
    """The fluted grip, and the smooth dark collar with the guard at its front."""
    length, width, neck = p.handle_length_mm, p.handle_width_mm, p.handle_width_mm - p.neck_depth_mm
    # Along the handle from the butt: share of the length, width, share of the flute's depth.
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
