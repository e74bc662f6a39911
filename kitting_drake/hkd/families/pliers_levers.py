"""Pliers with any jaws: two crossed levers, a joint with parallel flanks, and sleeved handles."""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from manifold3d import CrossSection, JoinType, Manifold, OpType

from kitting_drake.hkd.families.pliers_jaws import Jaws, bent, upper_jaw
from kitting_drake.hkd.tools.collision import runs
from kitting_drake.hkd.tools.solids import (
    SEGMENTS,
    Part,
    Shape,
    across_path,
    circle,
    fillet,
    loft,
    plate,
    ribbon,
    rounded_rectangle,
    without_holes,
)

# Tolerances of the hulls of full-size pliers, in mm: for the outline, and for heights. The hulls of
# a sleeve are inset, because chords stick out of its concave side.
_OUTLINE_MM, _HEIGHT_MM, _INSET_MM = 0.22, 1.0, 0.08


@dataclass
class Levers:
    """The joint and the handles. Lengths in mm of the full-size tool with the rivet at the
    origin."""

    thickness_mm: float = 12.0
    # The width across the parallel flanks of the joint, and the flanks' length behind the rivet.
    joint_width_mm: float = 28.0
    joint_back_mm: float = 22.0
    # The handles continue in line with the flanks to this distance behind the rivet.
    parallel_mm: float = 44.0
    # The length of the joint in front of the rivet.
    joint_front_mm: float = 9.0
    # The distance from the rivet to the end of the handles.
    handle_length_mm: float = 130.0
    # The distances between the middle lines of the handles at the shoulder and at the ends, and the
    # shoulder's position (0: at the end of the parallel part, 1: at the end of the handle).
    spread_mm: float = 42.0
    end_spread_mm: float = 44.0
    shoulder_share: float = 0.4
    # The radius of the bend at the shoulder.
    bend_radius_mm: float = 28.0
    handle_width_mm: float = 9.0
    # The width, the thickness and the length of a sleeve (length 0: no sleeve), and whether the
    # sleeve widens at its front.
    grip_width_mm: float = 13.0
    grip_thickness_mm: float = 13.0
    grip_length_mm: float = 90.0
    guard: bool = False
    rivet_diameter_mm: float = 12.0
    bevel_mm: float = 0.8
    # The number of curved grooves in the joint, and whether there is a leaf spring.
    grooves: int = 0
    spring: bool = False
    # The materials of the parts. Each is a key of solids.MATERIALS.
    steel_material: str = "steel"
    rivet_material: str = "polished_steel"
    grip_material: str = "red_grip"


def build_levers(v: Levers, j: Jaws) -> list[Part]:
    """Builds the parts of a pair of pliers, in mm in the design frame."""
    upper, lower = _lever(v, j, True), _lever(v, j, False)
    steel = Part("steel", v.steel_material, upper + lower, _steel_hulls(v, j))
    rivet = _rivet(v)
    # The rivet needs no hull if sleeves that are higher than its head keep other bodies off it.
    hidden = v.grip_length_mm and v.grip_thickness_mm > v.thickness_mm + 2.6
    parts = [Part("rivet", v.rivet_material, rivet.solid, [] if hidden else rivet.hulls), steel]
    if v.grip_length_mm:
        sleeve = _sleeve(v)
        for name, s in (("upper_grip", sleeve), ("lower_grip", sleeve.flipped())):
            parts.append(Part(name, v.grip_material, s.solid, s.hulls))
    if v.spring:
        parts.append(Part("spring", v.rivet_material, _spring(v)))
    return parts


def handle_path(v: Levers) -> np.ndarray:
    """Returns the middle line (n, 2) of the handle at y < 0, from inside the joint to its end."""
    start = (-0.45 * v.joint_back_mm, -0.5 * (v.joint_width_mm - v.handle_width_mm))
    shoulder_x = -v.parallel_mm - v.shoulder_share * (v.handle_length_mm - v.parallel_mm)
    corners = [
        start,
        (-v.parallel_mm, start[1]),
        (shoulder_x, -v.spread_mm / 2),
        (-v.handle_length_mm, -v.end_spread_mm / 2),
    ]
    # Close the polygon far away, so that the two ends of the line are not rounded.
    far = [(-v.handle_length_mm, -400.0), (start[0], -400.0)]
    return fillet([*corners, *far], [0, 8.0, v.bend_radius_mm, 0, 0, 0], 6)[:-2]


def _even(path: np.ndarray, step: float) -> np.ndarray:
    """Resamples a path (n, 2) at roughly equal steps."""
    run = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
    s = np.linspace(0.0, run[-1], max(2, int(run[-1] / step)))
    return np.column_stack([np.interp(s, run, path[:, k]) for k in (0, 1)])


def _band(v: Levers, bare_only: bool) -> np.ndarray:
    """Returns the outline of the steel handle at y < 0.

    If `bare_only` is set, the part inside the sleeve is left out.
    """
    path = _even(handle_path(v), 4.0)
    if bare_only and v.grip_length_mm:
        path = path[path[:, 0] > v.grip_length_mm - v.handle_length_mm - 9.0]
    if not v.grip_length_mm:
        # A bare handle widens toward its end.
        run = np.linspace(0.0, 1.0, len(path))
        swell = np.interp(run, [0.0, 0.4, 0.55, 0.97, 1.0], [1.0, 1.0, 1.25, 1.25, 0.9])
        return ribbon(path, v.handle_width_mm * swell)
    return ribbon(path, np.full(len(path), v.handle_width_mm))


def _lap_outline(v: Levers) -> np.ndarray:
    """Returns the outline of the joint's half that belongs to the handle at y < 0."""
    half, front, back = v.joint_width_mm / 2, v.joint_front_mm, v.joint_back_mm
    return fillet(
        [
            (-back, -half),
            (front, -half),
            (front + 6, -half + 5),
            (front + 6, half - 5),
            (front, half),
            (-0.95 * back, half),
            (-back, 0.70 * half),
            (-back, -half + v.handle_width_mm),
        ],
        [1, 5, 4, 4, 5, 3, 3, 3],
    )


def _jaw_outlines(v: Levers, j: Jaws) -> tuple[np.ndarray, np.ndarray]:
    """Returns the outlines of the upper and the lower jaw, turned and bent."""
    outline = upper_jaw(j, v.joint_front_mm, v.joint_width_mm / 2)
    other = upper_jaw(j, v.joint_front_mm, v.joint_width_mm / 2, j.lower_kind)
    mirrored = (other * np.array([1.0, -1.0]))[::-1]
    upper, lower = (bent(j, o, v.joint_front_mm) for o in (outline, mirrored))
    return upper, lower


def _tapered(solid: Manifold, v: Levers, j: Jaws) -> Manifold:
    """Makes the jaws thinner toward the tip, equally from above and below."""
    if not j.tip_thickness_mm:
        return solid
    thick, thin = v.thickness_mm / 2, j.tip_thickness_mm / 2
    start = v.joint_front_mm + 4.0
    slope = (thick - thin) / (j.length_mm - start)
    normal = np.array([-slope, 0.0, -1.0]) / np.hypot(slope, 1.0)
    offset = normal @ np.array([start, 0.0, thick])
    up = solid.trim_by_plane(tuple(normal), offset)
    return up.trim_by_plane((normal[0], 0.0, -normal[2]), offset)


def _lever(v: Levers, j: Jaws, upper: bool) -> Manifold:
    """Builds one lever: a jaw, its half of the joint, and its handle on the other side."""
    z = v.thickness_mm / 2
    outline = _jaw_outlines(v, j)[0 if upper else 1]
    jaw = _tapered(plate(outline, -z, z, v.bevel_mm).solid, v, j)
    if j.kind in ("diagonal", "nipper", "snips"):
        jaw -= _edge_bevel(v, j)
    band = plate(_band(v, True), -z, z, v.bevel_mm).solid
    if v.grip_length_mm:
        # Add the end of the handle that lies inside the sleeve.
        tang = plate(_band(v, False), -0.45 * z, 0.45 * z, 0.3).solid
        band += tang
    lap = plate(_lap_outline(v), 0.0, z, v.bevel_mm).solid
    room = CrossSection([_lap_outline(v)]).mirror((0, 1)).offset(0.25, circular_segments=SEGMENTS)
    gap = room.extrude(z + 1).translate((0, 0, -z - 1))
    if not upper:
        band, lap, gap = (s.rotate((180, 0, 0)) for s in (band, lap, gap))
    lever = (jaw + band) - gap + lap
    for i in range(v.grooves if upper else 0):
        lever -= _groove(v, 0.40 * v.joint_width_mm + 5.0 * i)
    return lever


def _groove(v: Levers, radius: float) -> Manifold:
    """Builds a channel in the top of the joint, in an arc about a point in front of the rivet."""
    ring = CrossSection([circle(radius + 1.1)]) - CrossSection([circle(radius - 1.1)])
    shape = ring.translate((v.joint_front_mm + 4.0, 0.35 * v.joint_width_mm))
    window = CrossSection([_lap_outline(v)]).offset(-2.0, JoinType.Miter)
    return (shape ^ window).extrude(3.0).translate((0, 0, v.thickness_mm / 2 - 0.9))


def _edge_bevel(v: Levers, j: Jaws) -> Manifold:
    """Builds the V-shaped bevel of cutting edges, above and below."""
    length, z = j.length_mm, v.thickness_mm / 2
    wide = {"diagonal": 0.30 * v.joint_width_mm, "snips": 4.0, "nipper": 5.0}[j.kind]
    start = v.joint_front_mm + (8.0 if j.kind != "nipper" else 0.0)
    if j.kind == "nipper":
        # A nipper cuts with its front edge, which runs across the tool: bevel this edge.
        flat = [(length - 5.0, z + 0.1), (length + 5.0, z + 0.1), (length + 5.0, -0.2 * z)]
        rings = [np.array([(x, y, h) for x, h in flat]) for y in (-40.0, 40.0)]
    else:
        rings = [
            np.array([(x, -w, z + 0.1), (x, w, z + 0.1), (x, 0.0, 0.35 * z)])
            for x, w in ((start, wide), (length + 3.0, 0.8 * wide))
        ]
    wedge = loft(rings).solid
    return wedge if j.kind != "diagonal" else wedge + wedge.rotate((180, 0, 0))


def _steel_hulls(v: Levers, j: Jaws) -> list[np.ndarray]:
    """Returns a few convex prisms that cover the steel and fill its small gaps."""
    z = v.thickness_mm / 2
    band, lap = _band(v, True), _lap_outline(v)
    outlines = [
        *_jaw_outlines(v, j),
        *(o for half in (band, lap) for o in (half, (half * np.array([1.0, -1.0]))[::-1])),
    ]
    if v.spring:
        outlines.append(_leaf(v))
    whole = CrossSection.batch_boolean([CrossSection([o]) for o in outlines], OpType.Add)
    half = v.joint_width_mm / 2
    flanks = [(2.0 - v.parallel_mm, v.joint_front_mm - 2.0, y) for y in (-half, half)]
    hulls = slab_hulls(whole, -z, z, v.bevel_mm, flanks)
    if not j.tip_thickness_mm:
        return hulls
    trimmed = [_tapered(Manifold.hull_points(h), v, j) for h in hulls]
    return [np.asarray(t.to_mesh64().vert_properties)[:, :3] for t in trimmed]


def slab_hulls(
    profile: CrossSection,
    z_low: float,
    z_high: float,
    bevel: float,
    flanks: Sequence[tuple[float, float, float]] = (),
    tolerance: float = 0.24,
) -> list[np.ndarray]:
    """Returns a few convex prisms that cover a plate with a bevelled lower rim.

    Holes and narrow gaps in the plate are filled. The profile is cut across x into bands, each as
    long as possible, and each piece of a band is replaced by its convex hull.

    Args:
        profile: the outline of the plate, in mm.
        z_low: the lower face, in mm.
        z_high: the upper face, in mm.
        bevel: the bevel of the lower rim, in mm.
        flanks: (x start, x end, y) of the gripped flanks, which the hulls exceed by at most 0.05
            mm.
        tolerance: how far the hulls may extend beyond the profile, in mm.
    """

    def grown(p: CrossSection, d: float) -> CrossSection:
        return p.offset(d, JoinType.Round, circular_segments=SEGMENTS)

    filled = without_holes(grown(grown(profile, 1.8), -1.8)).simplify(0.02)
    allowed = grown(filled, tolerance)
    left, low, right, high = filled.bounds()
    for start, end, y in flanks:
        strip = CrossSection.square((end - start, 50.0))
        allowed -= strip.translate((start, y + 0.05 if y > 0 else y - 50.05))

    def pieces(start: float, end: float) -> list[CrossSection]:
        band = CrossSection.square((end - start, high - low + 2)).translate((start, low - 1))
        parts = [p for p in (filled ^ band).decompose() if p.area() > 0.05 * (end - start)]
        return [p.hull() for p in parts]

    def fits(start: float, end: float) -> bool:
        return all((p - allowed).area() < 0.08 for p in pieces(start, end))

    step = 0.25
    edges, count = [0], int(np.ceil((right - left) / step))
    while edges[-1] < count:
        shorter, longer = edges[-1] + 1, count
        while shorter < longer:
            middle = (shorter + longer + 1) // 2
            if fits(left + step * edges[-1], left + step * middle):
                shorter = middle
            else:
                longer = middle - 1
        edges.append(shorter)
    levels = [(z_low, bevel), (z_low + bevel, 0.0), (z_high, 0.0)]
    inset = grown(filled, tolerance).offset(-bevel - tolerance, JoinType.Miter)
    result = []
    for start, end in itertools.pairwise(edges):
        for piece in pieces(left + step * start, left + step * end):
            rings = [
                np.column_stack([p, np.full(len(p), height)])
                for height, cut in levels
                for p in ((piece ^ inset) if cut else piece).to_polygons()
            ]
            result.append(np.vstack(rings))
    return result


def _sleeve(v: Levers) -> Shape:
    """Builds the dipped sleeve of the handle at y < 0: rounded, with a closed end."""
    path = _even(handle_path(v), 2.0)
    path = np.vstack([path, path[-1] + (path[-1] - path[-2]) * [[1.0], [1.6]]])
    run = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
    tangent = np.gradient(path, axis=0)
    stations = [(0.0, 0.84, 0.84), (0.012, 1.0, 0.96), (0.03, 1.0, 1.0)]
    if v.guard:
        stations = [(0.0, 0.9, 0.9), (0.015, 1.3, 1.0), (0.06, 1.3, 1.0), (0.11, 1.0, 1.0)]
    stations += [(float(t), 1.0, 1.0) for t in np.linspace(0.16, 0.93, 9)]
    stations += [(0.972, 0.94, 0.98), (0.99, 0.8, 0.86), (1.0, 0.55, 0.6)]

    def rings(segments: int, inset: float) -> list[np.ndarray]:
        result = []
        for share, width, thickness in stations:
            s = run[-1] - (1.0 - share) * v.grip_length_mm
            point = [np.interp(s, run, path[:, k]) for k in (0, 1)]
            dx, dy = (np.interp(s, run, tangent[:, k]) for k in (0, 1))
            profile = rounded_rectangle(
                width * v.grip_width_mm - 2 * inset,
                thickness * v.grip_thickness_mm,
                0.36 * min(v.grip_thickness_mm * thickness, v.grip_width_mm * width),
                segments,
            )
            result.append(across_path(profile, point, float(np.arctan2(dy, dx))))
        return result

    coarse = runs(rings(1, _INSET_MM), _OUTLINE_MM + _INSET_MM, _HEIGHT_MM)
    return Shape(loft(rings(4, 0.0)).solid, coarse)


def _rivet(v: Levers) -> Shape:
    """Builds the rivet: flush below, with a low chamfered head and a dimple above."""
    radius, z = v.rivet_diameter_mm / 2, v.thickness_mm / 2

    def disc(r: float, height: float, segments: int) -> np.ndarray:
        return np.column_stack([circle(r, segments=segments), np.full(segments, height)])

    solid = loft(
        [disc(radius, -z + 0.01, 32), disc(radius, z + 0.6, 32), disc(radius - 1.0, z + 1.2, 32)]
    ).solid
    dimple = Manifold.cylinder(2.0, 0.5, 0.28 * radius + 1.4, 24).translate((0, 0, z + 0.5))
    low, high = disc(radius, 0.0, 8), disc(radius - 0.6, z + 1.2, 8)
    return Shape(solid - dimple, [np.vstack([low, high])])


def _leaf(v: Levers) -> np.ndarray:
    """Returns the outline of a bowed leaf spring between the handles, behind the joint."""
    ends = 0.5 * (v.joint_width_mm - v.handle_width_mm)
    t = np.linspace(-1.0, 1.0, 21)
    x = -v.joint_back_mm - 2.0 - 9.0 * (1 - t**2)
    return ribbon(np.column_stack([x, -t * ends]), np.full(len(t), 1.6))


def _spring(v: Levers) -> Manifold:
    return plate(_leaf(v), -2.5, 2.5, 0.2).solid
