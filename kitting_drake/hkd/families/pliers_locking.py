"""Locking pliers: a body with an adjusting screw, a toggle handle and a release lever."""

from dataclasses import dataclass

import numpy as np
from manifold3d import CrossSection, OpType

from kitting_drake.hkd.families.pliers_levers import slab_hulls
from kitting_drake.hkd.tools.solids import (
    Part,
    Shape,
    across_x,
    blend,
    circle,
    fillet,
    loft,
    plate,
    rounded_rectangle,
)


@dataclass
class Locking:
    """Locking pliers with the jaw's pivot near the origin. Lengths in mm of the full-size tool."""

    # The distances from the pivot to the tip of the jaws, and to the end of the body without the
    # screw.
    jaw_length_mm: float = 46.0
    body_length_mm: float = 150.0
    # The thickness of the body, the thickness of the jaws, and the width across the parallel flanks
    # behind the pivot.
    thickness_mm: float = 15.0
    jaw_thickness_mm: float = 11.0
    flank_width_mm: float = 38.0
    # The extents of the body and of the handle along y.
    body_depth_mm: float = 15.0
    handle_depth_mm: float = 12.0
    # The distance between the outer edges of the body and of the handle at the end of the tool.
    spread_mm: float = 52.0
    screw_diameter_mm: float = 13.0
    body_material: str = "polished_steel"
    jaw_material: str = "steel"
    lever_material: str = "dark_steel"


def _outlines(k: Locking) -> dict[str, np.ndarray]:
    """Returns the outlines (n, 2) of the flat parts by name, in mm in the design frame."""
    half, end = k.flank_width_mm / 2, -k.body_length_mm
    body_inner = half - k.body_depth_mm
    body = fillet(
        [
            (14.0, half),
            (end, half),
            (end, half - k.body_depth_mm),
            (-44.0, body_inner),
            (-34.0, -0.3 * half),
            (-6.0, -0.35 * half),
            (8.0, 0.15 * half),
            (14.0, 0.4 * half),
        ],
        [3, 4, 4, 12, 6, 6, 4, 3],
        5,
    )
    low = half - k.spread_mm
    handle = fillet(
        [
            (4.0, -0.2 * half),
            (-8.0, 0.1 * half),
            (-36.0, -half + k.handle_depth_mm + 3.0),
            (-62.0, -half + 0.8 * k.handle_depth_mm),
            (0.82 * end, low + k.handle_depth_mm),
            (0.97 * end, low + 0.8 * k.handle_depth_mm),
            (0.97 * end, low),
            (0.80 * end, low),
            (-46.0, -half),
            (2.0, -half),
            (6.0, -0.7 * half),
        ],
        [3, 3, 10, 20, 20, 4, 4, 30, 20, 4, 4],
        5,
    )
    release = fillet(
        [
            (-66.0, -half + 0.8 * k.handle_depth_mm),
            (-74.0, body_inner - 6.0),
            (0.60 * end, body_inner - 6.5),
            (0.86 * end, low + k.handle_depth_mm + 9.0),
            (0.88 * end, low + k.handle_depth_mm + 4.0),
            (-80.0, low + k.handle_depth_mm + 1.0),
        ],
        [2, 4, 16, 2, 2, 4],
        5,
    )[::-1]
    link = fillet(
        [(0.30 * end, body_inner + 3), (0.62 * end, body_inner + 4),
         (0.62 * end, body_inner - 3), (0.36 * end, -half + 5), (0.30 * end, -half + 5)],
        2.0,
    )  # fmt: skip
    tip = k.jaw_length_mm
    upper = _jaw([(2.0, half - 1.0), (0.45 * tip, half + 1.0), (0.86 * tip, 0.62 * half),
                  (tip, 0.30 * half)], tip, 3.0, half)  # fmt: skip
    lower = (_jaw([(-10.0, half - 2.0), (0.40 * tip, half - 1.0), (0.84 * tip, 0.66 * half),
                   (0.98 * tip, 0.34 * half)], 0.98 * tip, 3.0, half) * [1.0, -1.0])  # fmt: skip

    return {
        "body": body,
        "handle": handle,
        "release": release,
        "link": link,
        "upper": upper,
        "lower": lower,
    }


def build_locking(k: Locking) -> list[Part]:
    """Builds the parts of locking pliers, in mm in the design frame; the body is at y > 0."""
    z, zj, half = k.thickness_mm / 2, k.jaw_thickness_mm / 2, k.flank_width_mm / 2
    outlines = _outlines(k)

    def flat(name: str, low: float, high: float, bevel: float) -> Shape:
        outline = outlines[name]
        profile = CrossSection([outline])
        profile = profile if profile.area() > 0 else CrossSection([outline[::-1]])
        return plate(blend(profile, 0.5), low, high, bevel)

    body, handle = flat("body", -z, z, 1.2), flat("handle", -z + 0.8, z - 0.8, 1.2)
    release = flat("release", -0.5 * z, 0.5 * z, 0.6)
    link = flat("link", -0.4 * z, 0.4 * z, 0.4)
    upper, lower = (flat(name, -zj, zj, 0.8) for name in ("upper", "lower"))
    screw, knob = _screw(k, -k.body_length_mm, half - k.body_depth_mm / 2)
    rivets = [
        plate(circle(r, (x, y), 24), -height + 0.1, height + 0.3, 0.3).solid
        for x, y, r, height in (
            (2.0, -0.55 * half, 4.0, z - 0.8),
            (8.0, 0.68 * half, 3.2, z),
            (-24.0, 0.55 * half, 3.2, z),
            (-70.0, -half + 0.35 * k.handle_depth_mm - 1.5, 2.6, z - 0.8),
        )
    ]

    # One set of hulls, as thick as the body, covers all flat parts except the jaws.
    def together(*names: str) -> CrossSection:
        profiles = [
            CrossSection([outlines[name]]) + CrossSection([outlines[name][::-1]]) for name in names
        ]
        return CrossSection.batch_boolean(profiles, OpType.Add)

    slab = slab_hulls(together("body", "handle", "release", "link"), -z, z, 1.2)
    front = slab_hulls(together("upper", "lower"), -zj, zj, 0.8)
    return [
        *(Part(f"rivet_{i}", k.jaw_material, r) for i, r in enumerate(rivets)),
        Part("body", k.body_material, body.solid, slab),
        Part("handle", k.body_material, handle.solid),
        Part("jaws", k.jaw_material, upper.solid + lower.solid, front),
        Part("release", k.lever_material, release.solid),
        Part("link", k.jaw_material, link.solid),
        Part("screw", k.jaw_material, screw.solid, screw.hulls),
        Part("knob", k.jaw_material, knob.solid, knob.hulls),
    ]


def _jaw(back: list[tuple[float, float]], tip: float, gap: float, half: float) -> np.ndarray:
    """Returns the outline (n, 2) of a curved jaw with coarse teeth, clockwise over its back."""
    soft = fillet([*back, (tip, gap / 2), (back[0][0], 0.0)], [4, 14, 8, 2, 0, 0])
    bite = []
    for i, x in enumerate(np.linspace(tip - 0.5, 14.0, 17)):
        hollow = 0.30 * half * np.sin(np.pi * np.clip((0.80 * tip - x) / (0.62 * tip), 0, 1))
        bite.append((x, gap / 2 + hollow + (1.0 if i % 2 else 0.0)))
    return np.vstack([soft[:-2], bite, [(10.0, 0.25 * half), (back[0][0], 0.25 * half)]])


def _screw(k: Locking, end: float, y: float) -> tuple[Shape, Shape]:
    """Builds the adjusting screw behind the body: a thread and a knurled knob."""
    radius = k.screw_diameter_mm / 2

    def revolved(stations: list[tuple[float, float]], segments: int) -> list[np.ndarray]:
        return [across_x(circle(r, segments=segments), x, y) for x, r in stations]

    thread = [(end + 4.0, 0.6 * radius)]
    for i in range(5):
        x = end - 0.4 - 2.2 * i
        thread += [(x, 0.64 * radius), (x - 1.1, 0.52 * radius)]
    thread.append((end - 13.0, 0.6 * radius))
    stem = np.vstack([across_x(rounded_rectangle(1.2 * radius, 1.2 * radius, 0.3 * radius, 1), x, y)
                      for x in (end + 4.0, end - 13.0)])  # fmt: skip
    knob = [(end - 12.0, 0.8 * radius), (end - 13.0, radius), (end - 21.0, radius),
            (end - 22.5, 0.8 * radius)]  # fmt: skip
    solid = loft(revolved(knob, 24)).solid
    for angle in np.arange(0.0, 360.0, 30.0):
        notch = plate(circle(0.7, segments=8), -20.0, 0.0, 0.1).solid.rotate((0, 90, 0))
        notch = notch.translate((end - 2.0, 0.0, radius)).rotate((angle, 0, 0))
        solid -= notch.translate((0.0, y, 0.0))
    hull = np.vstack(revolved(knob, 8))
    return Shape(loft(revolved(thread, 20)).solid, [stem]), Shape(solid, [hull])
