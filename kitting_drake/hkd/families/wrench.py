"""Generates wrenches: flat forgings with a head at each end of a shank."""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np
from manifold3d import CrossSection, Manifold

from kitting_drake.hkd.families.wrench_heads import Head, head_shape
from kitting_drake.hkd.tools.solids import Part, Shape, blend, circle, fillet, plate, ribbon

# The distance of each bend of an S-shaped shank from the shank's middle, as a share of half the
# distance between the heads' centres.
_BEND = 0.56


@dataclass
class WrenchParameters:
    """A combination wrench with its heads toward +x and -x. Lengths in mm."""

    # The distance between the centres of the two heads.
    center_distance_mm: float = 172.0
    # The heads toward +x and -x; each may be given as a mapping of a Head's fields.
    front: Head = field(
        default_factory=lambda: Head("open", diameter_mm=38.0, thickness_mm=8.8, angle_deg=15.0)
    )
    back: Head = field(
        default_factory=lambda: Head("box", diameter_mm=28.0, thickness_mm=11.0, points=12)
    )
    # The widths of the shank at the front and the back, its thickness, and the radius of its
    # transition to the heads.
    shank_width_front_mm: float = 16.0
    shank_width_back_mm: float = 15.0
    shank_thickness_mm: float = 7.8
    blend_radius_mm: float = 16.0
    # The sideways distance of each bend of an S-shaped shank from the line between the heads; 0 for
    # a straight shank.
    swing_mm: float = 0.0
    # The depth of the recessed panel on each broad side of the shank (negative: the height of a
    # raised panel), and the panel's width as a share of the shank's width.
    panel_depth_mm: float = 0.9
    panel_share: float = 0.58
    # The bevel of the heads' outer edges, and the bevel of the shank's edges (None: the same).
    bevel_mm: float = 0.9
    shank_bevel_mm: float | None = None
    # The material, a key of solids.MATERIALS.
    material: str = "polished_steel"

    def __post_init__(self) -> None:
        self.front, self.back = _head(self.front, "front"), _head(self.back, "back")


def _head(value: Head | dict[str, Any], name: str) -> Head:
    if not isinstance(value, dict):
        return value
    try:
        return Head(**value)
    except TypeError as error:
        known = [f.name for f in fields(Head)]
        unknown = ", ".join(f"'{key}'" for key in value if key not in known)
        raise ValueError(
            f"{name} has the unknown field {unknown}: give one of {', '.join(known)}"
        ) from error


def build_wrench(p: WrenchParameters) -> list[Part]:
    """Builds the parts of a wrench, in mm in the design frame."""
    x_front, x_back = p.center_distance_mm / 2, -p.center_distance_mm / 2
    front = head_shape(p.front, x_front, 0.0, p.bevel_mm)
    back = head_shape(p.back, x_back, 180.0, p.bevel_mm)
    shank = CrossSection([_shank(p)])
    for head, side in ((p.front, 1), (p.back, -1)):
        if head.neck_mm and not p.swing_mm:
            shank += _shoulders(p, head, side)
    # Round the transitions between shank and heads in one outline. Thicker heads are added later.
    outline = blend(front.profile + shank + back.profile, p.blend_radius_mm)
    outline = outline - front.cut - back.cut
    bevel = p.bevel_mm if p.shank_bevel_mm is None else p.shank_bevel_mm
    body = _slab(outline, p.shank_thickness_mm, bevel, _shank_cells(p))

    solid, hulls = body.solid, list(body.hulls)
    for head, shape in ((p.front, front), (p.back, back)):
        if head.thickness_mm > p.shank_thickness_mm:
            slab = _slab(shape.profile - shape.cut, head.thickness_mm, p.bevel_mm, shape.cells)
            solid += slab.solid
            hulls += slab.hulls
    for side in (1, -1):
        if p.panel_depth_mm > 0:
            solid -= _panel(p, side)
        elif p.panel_depth_mm < 0:
            # The raised panel is lower than the heads, so it needs no collision hulls.
            solid += _panel(p, side)
    return [*front.inserts, *back.inserts, Part("wrench", p.material, solid, hulls)]


def _slab(
    profile: CrossSection, thickness: float, bevel: float, cells: Sequence[CrossSection]
) -> Shape:
    # Round sharp corners first, because the bevel would fold over itself there.
    profile = blend(profile, 0.3, 1.4 * bevel)
    return plate(profile, -thickness / 2, thickness / 2, bevel, cells)


def _half_width(p: WrenchParameters, x: float) -> float:
    """Returns half the width of the shank at x."""
    share = x / p.center_distance_mm + 0.5
    return 0.5 * (p.shank_width_back_mm + share * (p.shank_width_front_mm - p.shank_width_back_mm))


def _shoulders(p: WrenchParameters, head: Head, side: int) -> CrossSection:
    """Returns the convex taper from the head at side +1 or -1 to the shank."""
    x = side * (p.center_distance_mm / 2 - head.neck_mm)
    half = _half_width(p, x)
    # The taper starts at the side of a box head, but behind the jaws of an open head.
    radius = (0.37 if head.kind in ("open", "flare_nut") else 0.49) * head.diameter_mm
    disc = circle(radius, (side * p.center_distance_mm / 2, 0.0), 64)
    return CrossSection.hull_points(np.vstack([disc, [(x, -half), (x, half)]]))


def _shank_cells(p: WrenchParameters) -> list[CrossSection]:
    """Returns regions that cut the shank into convex parts.

    They leave out what a head covers. If a head of a straight shank lacks shoulders, the list is
    empty. Tails and spikes need no shoulders.
    """
    half, far = p.center_distance_mm / 2, 100.0
    if p.swing_mm:
        # Cut just inside the bends, so that the middle cell, where jaws grip, is almost straight.
        bend = _BEND * half - 0.7
        return [_rectangle(-bend, bend), *_swung_ends(p, bend)]
    joints: list[float] = []
    for head, side in ((p.back, -1), (p.front, 1)):
        if head.kind in ("tail", "spike"):
            joints.append(side * (half + max(far, 2.0 * head.size_mm)))
            continue
        if not head.neck_mm:
            return []
        disc = CrossSection([circle(0.5 * head.diameter_mm, (side * half, 0.0), 64)])
        bare = (_shoulders(p, head, side) - disc).bounds()
        end = (bare[2] if side > 0 else -bare[0]) - 0.2 * p.blend_radius_mm
        joints += [side * (half - head.neck_mm), side * end]
    return [_rectangle(start, end) for start, end in itertools.pairwise(sorted(joints))]


def _rectangle(x_low: float, x_high: float) -> CrossSection:
    """Returns a rectangle, wider than any wrench, between two values of x."""
    return CrossSection.square((x_high - x_low, 200.0)).translate((x_low, -100.0))


def _swung_ends(p: WrenchParameters, bend: float) -> list[CrossSection]:
    """Returns the two regions of an S-shaped shank that lie between a bend and the nearest head."""
    half = p.center_distance_mm / 2
    cells = []
    for head, side in ((p.front, 1), (p.back, -1)):
        angle = np.degrees(np.arctan2(p.swing_mm, (1.0 - _BEND) * half))
        start = np.sqrt((head.diameter_mm / 2) ** 2 - _half_width(p, side * half) ** 2)
        beyond = _rectangle(-150.0, -start - 0.2 * p.blend_radius_mm).rotate(angle)
        if side < 0:
            beyond = beyond.rotate(180.0)
        cells.append(beyond.translate((side * half, 0.0)) ^ _between(side * bend, side * 150.0))
    return cells


def _between(x_a: float, x_b: float) -> CrossSection:
    return _rectangle(min(x_a, x_b), max(x_a, x_b))


def _shank(p: WrenchParameters) -> np.ndarray:
    """Returns the outline of the shank alone, between the centres of the heads."""
    x_front, x_back = p.center_distance_mm / 2, -p.center_distance_mm / 2
    if p.swing_mm:
        path = _swung(p)
        return ribbon(path, np.array([2 * _half_width(p, x) for x in path[:, 0]]))
    return np.array(
        [
            (x_back, -p.shank_width_back_mm / 2),
            (x_front, -p.shank_width_front_mm / 2),
            (x_front, p.shank_width_front_mm / 2),
            (x_back, p.shank_width_back_mm / 2),
        ]
    )


def _swung(p: WrenchParameters) -> np.ndarray:
    """Returns the middle line (n, 2) of an S-shaped shank. It is straight in the middle, where a
    gripper holds the wrench."""
    half = p.center_distance_mm / 2
    corners = [(-half, 0.0), (-_BEND * half, p.swing_mm), (_BEND * half, -p.swing_mm), (half, 0.0)]
    # Close the loop far below, so that only the two bends are rounded.
    loop = [*corners, (half, -4 * half), (-half, -4 * half)]
    line = fillet(loop, [0.0, 0.1 * half, 0.1 * half, 0.0, 0.0, 0.0], 8)
    return line[:-2]


def _panel(p: WrenchParameters, side: int) -> Manifold:
    """Builds the panel of one broad side (+1 or -1) of the shank. A recessed panel is to be
    subtracted, a raised one to be added."""
    start = -p.center_distance_mm / 2 + 0.85 * p.back.diameter_mm
    end = p.center_distance_mm / 2 - 0.85 * p.front.diameter_mm
    half_start = 0.5 * p.panel_share * p.shank_width_back_mm
    half_end = 0.5 * p.panel_share * p.shank_width_front_mm
    if p.swing_mm:
        path = _swung(p)
        path = path[(path[:, 0] > start) & (path[:, 0] < end)]
        outline = ribbon(path, np.linspace(2 * half_start, 2 * half_end, len(path)))
        outline = fillet(outline.tolist(), 0.95 * half_start)
    else:
        outline = fillet(
            [(start, -half_start), (end, -half_end), (end, half_end), (start, half_start)],
            0.95 * half_start,
        )
    top = p.shank_thickness_mm / 2
    # The bevel slopes the panel's walls, as on a forged wrench.
    if p.panel_depth_mm > 0:
        panel = plate(outline, top - p.panel_depth_mm, top + 4.0, 0.6).solid
    else:
        height = -p.panel_depth_mm
        panel = plate(outline, top - 1.0, top + height, 0.6).solid
    return panel if side > 0 else panel.mirror((0, 0, 1))
