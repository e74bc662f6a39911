"""Handles of hammers: a shaft through the head's eye and a grip, along x."""

from dataclasses import dataclass

import numpy as np
from manifold3d import Manifold

from kitting_drake.hkd.families.hammer_heads import HEIGHT_MM, OUTLINE_MM
from kitting_drake.hkd.tools.collision import runs
from kitting_drake.hkd.tools.solids import Part, Shape, across_x, fillet, loft, rounded_rectangle

# How far the handle protrudes from the top of the eye, in mm.
PROUD_MM = 1.4


@dataclass
class Shaft:
    """A handle. Lengths in mm of the full-size tool."""

    # The kind of handle: plain (for instance wood), ribbed (a rubber sleeve) or rings (stacked
    # leather).
    kind: str = "plain"
    length_mm: float = 320.0
    # The widths along y: of the straight neck behind the head, of the throat where the grip begins,
    # of the grip's swell, and of its end. Then the thicknesses along z of the neck and of the grip,
    # as shares of their widths.
    neck_width_mm: float = 25.0
    throat_width_mm: float = 23.0
    swell_width_mm: float = 32.0
    end_width_mm: float = 34.0
    flatness: float = 0.76
    grip_flatness: float = 0.76
    # The distances from the handle's upper end to the grip and to the grip's swell, as shares of
    # the handle's length.
    neck_share: float = 0.5
    swell_share: float = 0.72
    # The roundness of a section's corners (0 is square, 1 is round), and whether the corners are
    # cut off straight.
    roundness: float = 0.55
    octagonal: bool = False
    # The distance by which the handle's middle line bows toward the face. At the handle's lower
    # end, the line is about half as far off in the other direction.
    bow_mm: float = 0.0
    # The number of grooves in the grip.
    ribs: int = 7
    # Whether the broad sides of the neck have hollows, as on some steel handles.
    fullered: bool = False
    # The materials of the parts. Each is a key of solids.MATERIALS.
    material: str = "hickory"
    grip_material: str = "hickory"
    accent_material: str = "dark_steel"


def _section(width: float, thickness: float, roundness: float, segments: int) -> np.ndarray:
    return rounded_rectangle(width, thickness, 0.5 * roundness * thickness, segments)


def octagon_corners(width: float, thickness: float) -> list[tuple[float, float]]:
    """Returns the corners of an octagon: a rectangle around the origin with cut corners."""
    y, z, cut = width / 2, thickness / 2, 0.27 * thickness
    return [
        (-y + cut, -z), (y - cut, -z), (y, -z + cut), (y, z - cut),
        (y - cut, z), (-y + cut, z), (-y, z - cut), (-y, -z + cut),
    ]  # fmt: skip


def build_shaft(s: Shaft, top: float) -> list[Part]:
    """Builds the parts of a handle whose upper end is at x = `top`."""
    neck = [
        (0.0, 0.9 * s.neck_width_mm),
        (0.004, s.neck_width_mm),
        (0.33, s.neck_width_mm),
        (0.5 * (0.33 + s.neck_share), 0.5 * (s.neck_width_mm + s.throat_width_mm)),
        (s.neck_share, s.throat_width_mm),
    ]
    if s.neck_share < 0.36:
        neck = [*neck[:2], (s.neck_share, s.neck_width_mm)]
    bare = _loft(s, top, [(u, w, s.flatness * w) for u, w in neck])
    if s.fullered:
        bare = Shape(bare.solid - _hollows(s, top), bare.hulls)
    grip = _grip_stations(s)
    smooth = [(u, w, s.grip_flatness * w) for u, w in grip]
    sleeve = _loft(s, top, smooth)
    parts = [Part("shaft", s.material, bare.solid, bare.hulls)]
    if s.kind == "plain":
        return [*parts, Part("grip", s.grip_material, sleeve.solid, sleeve.hulls)]
    # The hulls of the grip ignore its grooves, which are too narrow for other objects to enter.
    first, last = grip[2][0], grip[-5][0]
    edges = np.linspace(first, last, 2 * s.ribs + 2)
    grooved = sleeve.solid
    rings = None
    for a, b in zip(edges[1::2], edges[2::2], strict=False):
        # Keep the grooves so narrow that the outlines of cavities bridge them.
        middle, half = 0.5 * (a + b), min(0.3 * (b - a), 1.3 / s.length_mm)
        a, b = middle - half, middle + half
        widths = np.interp([a, b], [u for u, _ in grip], [w for _, w in grip])
        depth = 1.1 if s.kind == "ribbed" else 0.5
        core = _loft(
            s,
            top,
            [
                (u, w - 2 * depth, s.grip_flatness * w - 2 * depth)
                for u, w in ((a - 1e-4, widths[0]), (b + 1e-4, widths[1]))
            ],
        ).solid
        low, high = top - b * s.length_mm, top - a * s.length_mm
        band = grooved.trim_by_plane((1, 0, 0), low).trim_by_plane((-1, 0, 0), -high)
        grooved = grooved - (band - core)
        rings = core if rings is None else rings + core
    if s.kind == "rings" and rings is not None:
        # Dark washers fill the grooves between the leather rings.
        return [
            *parts,
            Part("washers", s.accent_material, rings),
            Part("grip", s.grip_material, grooved, sleeve.hulls),
        ]
    return [*parts, Part("grip", s.grip_material, grooved, sleeve.hulls)]


def _grip_stations(s: Shaft) -> list[tuple[float, float]]:
    """Returns pairs along the grip: a distance from the handle's upper end, as a share of the
    handle's length, and a width."""
    a, swell, end = s.neck_share, s.swell_width_mm, s.end_width_mm

    def at(t: float) -> float:
        return a + t * (1.0 - a)

    middle = (s.swell_share - a) / (1.0 - a)
    tail = [(0.94, end), (0.965, 0.985 * end), (0.985, 0.93 * end), (1.0, 0.80 * end)]
    waist = 0.5 * (middle + 0.94)
    if s.kind == "plain":
        lead = [(0.0, s.throat_width_mm), (0.10, 1.02 * s.throat_width_mm)]
        lead.append((0.55 * middle, 0.5 * (s.throat_width_mm + swell)))
    else:
        collar = 1.16 * s.throat_width_mm
        lead = [(0.0, 0.97 * collar), (0.02, collar), (0.10, collar)]
    stations = [
        *lead,
        (middle, swell),
        (waist, min(0.5 * (swell + end), 1.02 * swell)),
        *tail,
    ]
    return [(at(t), w) for t, w in stations]


def _loft(s: Shaft, top: float, stations: list[tuple[float, float, float]]) -> Shape:
    """Makes a loft through stations. Each has a distance from the handle's upper end (as a share of
    the handle's length), a width and a thickness.

    The collision hulls have fewer corners than the solid.
    """

    def rings(segments: int) -> list[np.ndarray]:
        result = []
        for u, width, thickness in stations:
            if s.octagonal:
                corners, cut = octagon_corners(width, thickness), 0.27 * thickness
                soft = fillet(corners, 0.35 * cut, 3) if segments > 1 else np.array(corners)
            else:
                soft = _section(width, thickness, s.roundness, segments)
            result.append(across_x(soft, top - u * s.length_mm, _bow(s, u)))
        return result

    coarse = rings(2 if s.roundness > 0.6 else 1)
    return Shape(loft(rings(4)).solid, runs(coarse, OUTLINE_MM, HEIGHT_MM))


def _bow(s: Shaft, u: float) -> float:
    """Returns the offset of the middle line toward the face, in mm. `u` is the distance from the
    handle's upper end, as a share of the handle's length."""
    t = max(0.0, (u - 0.36) / 0.64)
    return s.bow_mm * (np.sin(np.pi * min(1.0, 1.25 * t)) * 1.0 - 1.2 * max(0.0, t - 0.55))


def _hollows(s: Shaft, top: float) -> Manifold:
    """Builds the hollows in the broad sides of the neck, between head and grip."""
    start, end = 0.13 * s.length_mm, (s.neck_share - 0.015) * s.length_mm
    thickness = s.flatness * s.neck_width_mm
    half = 0.24 * s.neck_width_mm
    outline = fillet([(start, -half), (end, -half), (end, half), (start, half)], 0.9 * half)
    below = [
        np.column_stack([top - outline[:, 0], outline[:, 1], np.full(len(outline), z)])
        for z in (0.27 * thickness, thickness)
    ]
    above = [ring * np.array([1.0, 1.0, -1.0]) for ring in below]
    return loft(below).solid + loft(above).solid
