"""Wrenches: flat forgings with a head at each end of a shank."""

from dataclasses import dataclass

import numpy as np
from manifold3d import CrossSection, Manifold

from kitting_drake.hkd.solids import Part, Shape, blend, circle, fillet, plate


@dataclass
class WrenchParameters:
    """A combination wrench: an open end toward +x, a box end toward -x. Lengths in mm."""

    # Size of the hexagon that it turns, across flats.
    size_mm: float = 17.0
    # From the centre of one head to the centre of the other.
    center_distance_mm: float = 172.0
    # Angle of the open end's slot to the shank, in degrees.
    open_angle_deg: float = 15.0
    # Diameter and thickness of the open head.
    open_diameter_mm: float = 38.0
    open_thickness_mm: float = 8.8
    # Diameter and thickness of the box head, and the points of its hole (6 or 12).
    box_diameter_mm: float = 28.0
    box_thickness_mm: float = 11.0
    box_points: int = 12
    # Width of the shank at the open end and at the box end, its thickness, and the radius that
    # blends it into the heads.
    shank_width_open_mm: float = 16.0
    shank_width_box_mm: float = 15.0
    shank_thickness_mm: float = 7.8
    blend_radius_mm: float = 16.0
    # Depth of the recessed panel on each broad side of the shank.
    panel_depth_mm: float = 0.9
    # Bevel of all outer edges.
    bevel_mm: float = 0.9
    # A key of solids.MATERIALS.
    material: str = "polished_steel"


def build_wrench(p: WrenchParameters) -> list[Part]:
    """The parts of a wrench, in mm in the design frame."""
    x_open, x_box = p.center_distance_mm / 2, -p.center_distance_mm / 2
    slot = _open_slot(p, x_open)
    head = _open_head(p, x_open)
    box = CrossSection([circle(p.box_diameter_mm / 2, (x_box, 0.0), 64)])

    shank = CrossSection(
        [
            np.array(
                [
                    (x_box, -p.shank_width_box_mm / 2),
                    (x_open, -p.shank_width_open_mm / 2),
                    (x_open, p.shank_width_open_mm / 2),
                    (x_box, p.shank_width_box_mm / 2),
                ]
            )
        ]
    )
    # Blend shank and heads as one outline, so that the forging flows; the heads then stand on it.
    outline = blend(head + shank + box, p.blend_radius_mm) - slot
    socket = _socket(p, x_box)

    body = _slab(outline - socket, p.shank_thickness_mm, p.bevel_mm)
    open_end = _slab(head - slot, p.open_thickness_mm, p.bevel_mm)
    box_end = _slab(box - socket, p.box_thickness_mm, p.bevel_mm)
    solid = body.solid + open_end.solid + box_end.solid
    for side in (1, -1):
        solid -= _panel(p, side)
    return [Part("wrench", p.material, solid, body.hulls + open_end.hulls + box_end.hulls)]


def _slab(profile: CrossSection, thickness: float, bevel: float) -> Shape:
    # Corners sharper than the bevel is wide would fold it over.
    return plate(blend(profile, 0.3, 1.4 * bevel), -thickness / 2, thickness / 2, bevel)


def _open_head(p: WrenchParameters, x: float) -> CrossSection:
    """The open head before its slot is cut: a disc with the two jaws drawn forward."""
    radius = p.open_diameter_mm / 2
    jaws = fillet(
        [
            (-0.2 * radius, -0.97 * radius),
            (0.62 * radius, -0.9 * radius),
            (1.12 * radius, -0.52 * radius),
            (1.12 * radius, 0.52 * radius),
            (0.62 * radius, 0.9 * radius),
            (-0.2 * radius, 0.97 * radius),
        ],
        0.35 * radius,
    )
    head = CrossSection([circle(radius, segments=64)]) + CrossSection([jaws])
    return head.rotate(p.open_angle_deg).translate((x, 0.0))


def _open_slot(p: WrenchParameters, x: float) -> CrossSection:
    """The slot: parallel flanks, a floor of two facets of the hexagon, and slightly opened lips."""
    half, radius = p.size_mm / 2, p.open_diameter_mm / 2
    depth = 0.42 * radius
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
        [2.0 * half, 0.35 * half, 1.0, 0.0, 0.0, 1.0, 0.35 * half],
    )
    return CrossSection([slot]).rotate(p.open_angle_deg).translate((x, 0.0))


def _socket(p: WrenchParameters, x: float) -> CrossSection:
    """The box end's hole: one hexagon for 6 points, two of them for 12."""
    hexagon = CrossSection([circle(p.size_mm / np.sqrt(3), segments=6)])
    hole = hexagon if p.box_points == 6 else hexagon + hexagon.rotate(30)
    return hole.translate((x, 0.0))


def _panel(p: WrenchParameters, side: int) -> Manifold:
    """The recess of one broad side of the shank: a tapered plate to subtract; side is +1 or -1."""
    start = -p.center_distance_mm / 2 + 0.85 * p.box_diameter_mm
    end = p.center_distance_mm / 2 - 0.85 * p.open_diameter_mm
    half_start, half_end = 0.29 * p.shank_width_box_mm, 0.29 * p.shank_width_open_mm
    outline = fillet(
        [(start, -half_start), (end, -half_end), (end, half_end), (start, half_start)],
        0.95 * half_start,
    )
    top = p.shank_thickness_mm / 2
    # Its own bevel slopes the recess's walls, as a forging die leaves them.
    cutter = plate(outline, top - p.panel_depth_mm, top + 4.0, 0.6).solid
    return cutter if side > 0 else cutter.mirror((0, 0, 1))
