"""Heads of hammers: a block around the eye, with a front end and a back end.

The head's axis is y. A section's height is along x, and its thickness along z. Both ends are built
toward +y, the side of the striking face. The back end is then flipped.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from manifold3d import Manifold, OpType

from kitting_drake.hkd.tools.collision import runs
from kitting_drake.hkd.tools.solids import (
    Part,
    Shape,
    across_path,
    fillet,
    loft,
    rounded_rectangle,
)

# Tolerances of the hulls of a full-size head or shaft, in mm: for the outline, and for heights.
OUTLINE_MM, HEIGHT_MM = 0.4, 1.2


@dataclass
class HeadEnd:
    """One end of a head. Lengths in mm of the full-size tool."""

    # The kind of end: bell, plain, ball, wedge, point, claw or capped.
    kind: str = "bell"
    # The distance from the eye's middle to the end.
    reach_mm: float = 56.0
    # The extents of the end along x (for a face: the diameter) and along z (0: the same as along
    # x).
    size_mm: float = 29.0
    thickness_mm: float = 0.0
    # The size of the neck behind a bell or a ball, or of the root of a claw, wedge or point.
    neck_mm: float = 22.0
    # The roundness of a section's corners (1 is round, 0 is square), and whether the corners are
    # cut off straight.
    roundness: float = 1.0
    octagonal: bool = False
    # The drop of the tip toward the handle, and the exponent of the curve that the drop follows.
    drop_mm: float = 0.0
    curve: float = 2.0
    # The gap between the two tips of a split end; 0 for no split.
    gap_mm: float = 0.0
    # Whether the striking face has a milled waffle pattern.
    milled: bool = False
    # The material of the outermost few millimetres, such as a face or a plastic cap: a key of
    # solids.MATERIALS.
    tip_material: str = "polished_steel"


class Section(NamedTuple):
    """A section of a head in mm: position along y, height along x, thickness along z, offset along
    x."""

    y: float
    height: float
    thickness: float
    roundness: float = 1.0
    x: float = 0.0


def head_loft(stations: Sequence[Section], octagonal: bool = False) -> Shape:
    """Makes a loft through sections. The collision hulls have fewer corners than the solid."""

    def sections(segments: int) -> list[np.ndarray]:
        rings = []
        for s in stations:
            radius = max(0.05, 0.5 * s.roundness * min(s.height, s.thickness))
            profile = rounded_rectangle(s.height, s.thickness, radius, segments)
            rings.append(
                np.column_stack([s.x - profile[:, 0], np.full(len(profile), s.y), profile[:, 1]])
            )
        return rings

    fine = loft(sections(1 if octagonal else 7))
    round_enough = max(s.roundness for s in stations) > 0.6
    coarse = sections(2 if round_enough and not octagonal else 1)
    return Shape(fine.solid, runs(coarse, OUTLINE_MM, HEIGHT_MM))


def build_head(
    *,
    cheek_height: float,
    cheek_length: float,
    thickness: float,
    cheek_roundness: float,
    front: HeadEnd,
    back: HeadEnd,
    material: str,
) -> list[Part]:
    """Builds the parts of a head with its eye at the origin: first the tips, then the steel
    body."""
    half = cheek_length / 2
    cheeks = head_loft(
        [
            Section(
                y * half,
                cheek_height * (0.5 + 0.5 * s),
                thickness * (0.35 + 0.65 * s),
                cheek_roundness,
            )
            for y, s in ((-1.0, 0.8), (-0.74, 1.0), (0.74, 1.0), (1.0, 0.8))
        ],
        octagonal=front.octagonal,
    )
    root = (0.94 * cheek_height, 0.9 * thickness, 0.8 * half)
    parts, steel = [], [cheeks]
    for name, end, flipped in (("front", front, False), ("back", back, True)):
        body, tip = ENDS[end.kind](end, *root)
        if flipped:
            # Flip about x, so that the handle keeps its direction.
            body, tip = body.flipped(), tip.flipped() if tip else None
        steel.append(body)
        if tip:
            parts.append(Part(f"{name}_tip", end.tip_material, tip.solid, tip.hulls))
    solid = Manifold.batch_boolean([s.solid for s in steel], OpType.Add)
    return [*parts, Part("head", material, solid, [h for s in steel for h in s.hulls])]


def _bell(e: HeadEnd, height: float, thickness: float, start: float) -> tuple[Shape, Shape]:
    """Builds a neck that widens to a round, square or octagonal face with a bevel and a slight
    crown."""
    size, neck, end, r = e.size_mm, e.neck_mm, e.reach_mm, e.roundness
    deep = e.thickness_mm or size
    ratio = deep / size
    bell = end - 0.30 * size
    body = head_loft(
        [
            Section(start, height, thickness, 0.5 * r),
            Section(bell - 2.5, neck, neck * ratio, r),
            Section(bell + 2.0, size, deep, r),
            Section(end - 3.0, size, deep, r),
        ],
        e.octagonal,
    )
    return body, _face(e, end - 3.0)


def _face(e: HeadEnd, start: float) -> Shape:
    """Builds the last millimetres of a striking end. Its hulls omit the milled pattern."""
    size, deep, end = e.size_mm, e.thickness_mm or e.size_mm, e.reach_mm
    rim = [
        Section(start, size, deep, e.roundness),
        Section(end - 1.6, size, deep, e.roundness),
        Section(end - 0.3, size - 3.0, deep - 3.0, e.roundness),
    ]
    crown = Section(end, 0.45 * size, 0.45 * deep, e.roundness)
    shape = head_loft([*rim, crown], e.octagonal)
    solid = shape.solid
    if e.milled:
        pitch = size / 8.0
        for i in np.arange(-3, 4) * pitch:
            solid -= Manifold.cube((1.2, 2.4, 2 * deep), True).translate((i, end, 0.0))
            solid -= Manifold.cube((2 * size, 2.4, 1.2), True).translate((0.0, end, i))
    return Shape(solid, shape.hulls)


def _plain(e: HeadEnd, height: float, thickness: float, start: float) -> tuple[Shape, Shape]:
    """Builds a block of constant section from the cheeks to the face, as on a sledgehammer."""
    size, deep, r = e.size_mm, e.thickness_mm or e.size_mm, e.roundness
    body = head_loft(
        [
            Section(start, min(height, size), min(thickness, deep), r),
            Section(start + 0.25 * (e.reach_mm - start), size, deep, r),
            Section(e.reach_mm - 5.0, size, deep, r),
        ],
        e.octagonal,
    )
    return body, _face(e, e.reach_mm - 5.0)


def _capped(e: HeadEnd, height: float, thickness: float, start: float) -> tuple[Shape, Shape]:
    """Builds a steel socket and a soft cap. The cap takes 44 % of the length of the end."""
    size, deep = e.size_mm, e.thickness_mm or e.size_mm
    seam = e.reach_mm - 0.44 * (e.reach_mm - start)
    neck = e.neck_mm
    body = head_loft(
        [
            Section(start, height, thickness, e.roundness),
            Section(start + 0.35 * (seam - start), neck, neck, e.roundness),
            Section(seam - 4.0, neck, neck, e.roundness),
            Section(seam - 2.5, 0.95 * size, 0.95 * deep, e.roundness),
            Section(seam, 0.95 * size, 0.95 * deep, e.roundness),
        ]
    )
    cap = head_loft(
        [
            Section(seam, size, deep, e.roundness),
            Section(e.reach_mm - 4.0, size, deep, e.roundness),
            Section(e.reach_mm - 1.2, size - 1.6, deep - 1.6, e.roundness),
            Section(e.reach_mm, size - 6.0, deep - 6.0, e.roundness),
        ]
    )
    return body, cap


def _ball(e: HeadEnd, height: float, thickness: float, start: float) -> tuple[Shape, Shape]:
    """Builds a ball on a neck."""
    radius, neck = e.size_mm / 2, e.neck_mm
    center = e.reach_mm - radius
    join = np.arcsin(0.8 * neck / e.size_mm)
    body = head_loft(
        [
            Section(start, height, thickness, 0.6),
            Section(start + 0.4 * (center - start), 0.9 * neck, 0.9 * neck),
            Section(center - radius * np.cos(join), 0.8 * neck, 0.8 * neck),
        ]
    )
    angles = np.linspace(join, np.pi - 0.12, 12)
    ball = head_loft(
        [Section(center - radius * np.cos(a), *[e.size_mm * np.sin(a)] * 2) for a in angles]
    )
    # Use fewer rings for the collision hulls, which need less detail.
    keep = head_loft(
        [
            Section(center - radius * np.cos(a), *[e.size_mm * np.sin(a)] * 2)
            for a in (join, 1.0, 1.3, np.pi / 2, 1.84, 2.1, 2.45, np.pi - 0.3)
        ]
    )
    return body, Shape(ball.solid, keep.hulls)


def _wedge(e: HeadEnd, height: float, thickness: float, start: float) -> tuple[Shape, None]:
    """Builds a peen, chisel or blade.

    The edge measures `size_mm` along x and `thickness_mm` along z.
    """
    deep = e.thickness_mm or e.size_mm
    stations = []
    for t in np.linspace(0.0, 1.0, 9):
        y = start + 4.0 + t * (e.reach_mm - start - 4.0)
        stations.append(
            Section(
                y,
                e.size_mm + (e.neck_mm - e.size_mm) * (1 - t),
                deep + (0.88 * thickness - deep) * (1 - t),
                0.25,
                -e.drop_mm * t**e.curve,
            )
        )
    first = Section(start, height, thickness, 0.4)
    last = stations[-1]
    round_edge = Section(
        last.y + min(1.0, 0.3 * min(last.height, last.thickness)),
        0.55 * last.height if last.height < last.thickness else last.height - 1.0,
        0.55 * last.thickness if last.thickness <= last.height else last.thickness - 1.0,
        0.25,
        last.x,
    )
    return head_loft([first, *stations, round_edge]), None


def _point(e: HeadEnd, height: float, thickness: float, start: float) -> tuple[Shape, None]:
    """Builds a square or round spike."""
    deep = e.neck_mm
    return head_loft(
        [
            Section(start, height, thickness, 0.5),
            Section(start + 7.0, e.neck_mm, deep, e.roundness),
            Section(start + 0.35 * (e.reach_mm - start), 0.92 * e.neck_mm, deep, e.roundness),
            Section(e.reach_mm - 2.0, e.size_mm, e.thickness_mm or e.size_mm, e.roundness),
            Section(e.reach_mm, 0.5 * e.size_mm, 0.5 * (e.thickness_mm or e.size_mm), e.roundness),
        ]
    ), None


def _claw(e: HeadEnd, height: float, thickness: float, start: float) -> tuple[Shape, None]:
    """Builds a tapered band that bends toward the handle and may be split at its edge."""
    root, wide = min(height, e.neck_mm), e.thickness_mm or thickness
    top = root / 2

    def sections(count: int, segments: int, inset: float = 0.0) -> list[np.ndarray]:
        rings = []
        for t in np.linspace(0.0, 1.0, count):
            y = start + t * (e.reach_mm - start)
            slope = e.curve * e.drop_mm * t ** (e.curve - 1) / (e.reach_mm - start)
            along = np.arctan2(1.0, -slope)
            band = e.size_mm + (root - e.size_mm) * (1 - t) ** 1.15 - inset
            normal = np.array([-np.sin(along), np.cos(along)])
            center = np.array([top - e.drop_mm * t**e.curve, y]) + 0.5 * band * normal
            width = 0.85 * thickness + (wide - 0.85 * thickness) * min(1.0, 2 * t)
            profile = rounded_rectangle(band, width, min(2.0, 0.4 * band), segments)
            rings.append(across_path(profile, center, float(along)))
        return rings

    # The chords of the concave inner edge lie partly outside the edge, so inset them.
    inset = min(0.4, 0.1 * e.size_mm)
    hulls = runs(sections(17, 1, inset), OUTLINE_MM + inset, HEIGHT_MM)
    solid = loft(sections(13, 4)).solid
    if e.gap_mm:
        mouth, close = e.reach_mm + 6.0, start + 0.30 * (e.reach_mm - start)
        outline = fillet(
            [(close, -0.9), (mouth, -e.gap_mm / 2), (mouth, e.gap_mm / 2), (close, 0.9)],
            [0.8, 0.0, 0.0, 0.8],
        )
        far = 4 * height
        solid -= loft(
            [np.column_stack([np.full(len(outline), x), outline]) for x in (-far, far)]
        ).solid
    return Shape(solid, hulls), None


ENDS: dict[str, Callable[[HeadEnd, float, float, float], tuple[Shape, Shape | None]]] = {
    "bell": _bell,
    "plain": _plain,
    "capped": _capped,
    "ball": _ball,
    "wedge": _wedge,
    "point": _point,
    "claw": _claw,
}
