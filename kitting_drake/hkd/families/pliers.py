"""Generates pliers: two crossed levers on a rivet. They lie flat with the jaws toward +x."""

from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from manifold3d import CrossSection, Manifold
from scipy.interpolate import PchipInterpolator

from kitting_drake.common.errors import UserError
from kitting_drake.hkd.families.pliers_jaws import Jaws
from kitting_drake.hkd.families.pliers_levers import Levers, build_levers
from kitting_drake.hkd.families.pliers_locking import Locking, build_locking
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
)


@dataclass
class PliersParameters:
    """Slip-joint pliers with slightly open jaws and the rivet at the origin. Lengths in mm."""

    # The distances from the rivet to the tip of the jaws, and to the end of the handles.
    jaw_length_mm: float = 46.0
    handle_length_mm: float = 138.0
    # The thickness of joint and jaws.
    thickness_mm: float = 12.0
    # The width across the parallel flanks of the joint, and their lengths behind and in front of
    # the rivet.
    joint_width_mm: float = 30.0
    joint_back_mm: float = 29.0
    joint_front_mm: float = 8.0
    # The width across both closed jaws at the tip, and the opening at the tip.
    tip_width_mm: float = 15.0
    tip_gap_mm: float = 3.4
    # The depth and the pitch of the serrations of the jaws.
    tooth_depth_mm: float = 1.0
    tooth_pitch_mm: float = 2.4
    # The distance between the middle lines of the handles where they are farthest apart.
    handle_spread_mm: float = 43.0
    # The width of a steel handle; then the width, the thickness and the length of its grip.
    handle_width_mm: float = 9.5
    grip_width_mm: float = 14.5
    grip_thickness_mm: float = 13.5
    grip_length_mm: float = 96.0
    # The diameter of the rivet, and the bevel of the steel's outer edges.
    rivet_diameter_mm: float = 13.0
    bevel_mm: float = 0.9
    # The materials of the parts. Each is a key of solids.MATERIALS.
    steel_material: str = "steel"
    rivet_material: str = "polished_steel"
    grip_material: str = "red_grip"
    # For other kinds of pliers, `jaws` and `levers` together, or `locking` alone, replace all the
    # fields above. Each of the three may be given as a mapping of its class's fields.
    jaws: Jaws | dict[str, Any] | None = None
    levers: Levers | dict[str, Any] | None = None
    locking: Locking | dict[str, Any] | None = None


def _typed(kind: type, value: Any, field: str) -> Any:
    try:
        return kind(**value) if isinstance(value, dict) else value
    except TypeError as error:
        known = [f.name for f in fields(kind)]
        unknown = ", ".join(f"'{key}'" for key in value if key not in known)
        raise UserError(
            f"pliers: {field} has the unknown field {unknown}: give one of {', '.join(known)}"
        ) from error


def build_pliers(p: PliersParameters) -> list[Part]:
    """Builds the parts of a pair of pliers, in mm in the design frame.

    Raises:
        UserError: `jaws`, `levers` or `locking` has an unknown field.
    """
    if p.locking is not None:
        return build_locking(_typed(Locking, p.locking, "locking"))
    if p.jaws is not None or p.levers is not None:
        levers = _typed(Levers, p.levers or {}, "levers")
        return build_levers(levers, _typed(Jaws, p.jaws or {}, "jaws"))
    upper = _lever(p)
    # The second lever is a flipped copy.
    lower = upper.flipped()
    grip = _grip(p)
    other_grip = grip.flipped()
    rivet = _rivet(p)
    return [
        Part("rivet", p.rivet_material, rivet.solid, rivet.hulls),
        Part("upper_lever", p.steel_material, upper.solid, upper.hulls),
        Part("lower_lever", p.steel_material, lower.solid, lower.hulls),
        Part("upper_grip", p.grip_material, grip.solid, grip.hulls),
        Part("lower_grip", p.grip_material, other_grip.solid, other_grip.hulls),
    ]


def _handle_path(p: PliersParameters, count: int) -> np.ndarray:
    """Returns the middle line (count, 2) of the upper lever's handle (y < 0), from the joint
    outward."""
    inner = p.joint_width_mm / 2 - p.handle_width_mm / 2
    outer = p.handle_spread_mm / 2
    # The handle runs along the joint's flank, then outward; at its end it comes back a little.
    shares = np.array([0.0, 0.10, 0.42, 0.72, 1.0])
    ys = np.array([inner, inner + 0.2, inner + 0.72 * (outer - inner), outer, outer - 0.8])
    t = np.linspace(0.0, 1.0, count)
    start = -0.75 * p.joint_back_mm
    x = start - t * (p.handle_length_mm + start)
    return np.column_stack([x, -PchipInterpolator(shares, ys)(t)])


def _lever(p: PliersParameters) -> Shape:
    """Builds one lever: its jaw at y > 0, the upper half of the joint, and its handle at y < 0."""
    half, z = p.joint_width_mm / 2, p.thickness_mm / 2
    jaw = plate(_jaw_profile(p), -z, z, p.bevel_mm)
    path = _handle_path(p, 25)
    handle = plate(ribbon(path, np.full(len(path), p.handle_width_mm)), -z, z, p.bevel_mm)
    # Leave out the part of the handle that the grip hides.
    bare = path[path[:, 0] > p.grip_length_mm - p.handle_length_mm - 6.0]
    neck = plate(ribbon(bare, np.full(len(bare), p.handle_width_mm)), -z, z, p.bevel_mm)
    # The joint's flanks are parallel over the width of a finger; its corners are rounded.
    front, back = p.joint_front_mm, p.joint_back_mm
    lap_outline = fillet(
        [
            (-back, -half),
            (front, -half),
            (front + 7, -half + 5),
            (front + 7, half - 5),
            (front, half),
            (-0.45 * back, half),
            (-0.95 * back, 0.12 * half),
            (-back, -half + p.handle_width_mm),
        ],
        [1, 5, 4, 4, 5, 12, 3, 3],
    )
    lap = plate(lap_outline, 0.0, z, p.bevel_mm)
    # Make room for the other lever's half of the joint, with some play to turn.
    room = CrossSection([lap_outline]).mirror((0, 1)).offset(0.25, circular_segments=SEGMENTS)
    room = room.extrude(z + 1).translate((0, 0, -z - 1))
    return Shape(
        (jaw.solid + handle.solid) - room + lap.solid,
        jaw.hulls
        + neck.hulls
        + [h * sign for h in lap.hulls for sign in (np.ones(3), np.array([1.0, 1.0, -1.0]))],
    )


def _jaw_profile(p: PliersParameters) -> np.ndarray:
    """Returns the upper jaw's outline: a convex back, and an edge with fine teeth, a pipe grip and
    a throat."""
    length, half, tip = p.jaw_length_mm, p.joint_width_mm / 2, p.tip_width_mm / 2
    start = p.joint_front_mm

    def gap(x: float) -> float:
        """Returns half the opening at x; the jaws turn about the rivet."""
        return 0.5 * p.tip_gap_mm * x / length

    back = [
        (start - 6.0, half),
        (start, half),
        (0.5 * (start + length), 0.84 * half + 0.16 * tip),
        (length - 3.0, tip + 0.9),
        (length, tip - 2.0),
    ]
    rounded = fillet(
        [*back, (length, gap(length) + 0.4), (start - 6.0, 0.0)], [0, 14, 30, 3.5, 1.5, 0, 0]
    )
    back = [(float(x), float(y)) for x, y in rounded[:-1]]
    flat_end, pipe_end, pipe_start = length - 1.5, 0.60 * length, 0.26 * length
    bite: list[tuple[float, float]] = []
    for i in range(int((flat_end - pipe_end) / p.tooth_pitch_mm)):
        x = flat_end - i * p.tooth_pitch_mm
        bite += [(x, gap(x)), (x - 0.5 * p.tooth_pitch_mm, gap(x) + p.tooth_depth_mm)]
    middle, radius = 0.5 * (pipe_start + pipe_end), 0.5 * (pipe_end - pipe_start)
    for i, angle in enumerate(np.linspace(0.0, np.pi, 15)):
        depth = 0.38 * radius * np.sin(angle) + (p.tooth_depth_mm if i % 2 else 0.0)
        bite.append((middle + radius * np.cos(angle), gap(middle) + depth))
    bite += [(pipe_start - 2.0, gap(pipe_start)), (start - 6.0, 0.2)]
    # `back` and `bite` run clockwise: over the back to the tip, and along the biting edge.
    return np.array([*back, *bite])[::-1].copy()


def _grip(p: PliersParameters) -> Shape:
    """Builds the dipped sleeve of the upper lever: rounded, with a thumb stop and a closed end."""
    path = _handle_path(p, 60)
    # Extend the sleeve beyond the steel, so that it closes the handle's end.
    path = np.vstack([path, path[-1] + (path[-1] - path[-2]) * [[1.0], [1.6]]])
    tangent = np.gradient(path, axis=0)
    run = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
    start = run[-1] - p.grip_length_mm
    # Each row holds shares of the sleeve's length, of the grip's width and of the grip's thickness.
    stations = [
        (0.0, 0.80, 0.82),
        (0.012, 1.02, 0.92),
        (0.03, 1.16, 1.0),
        (0.055, 1.16, 1.0),
        (0.085, 1.02, 1.0),
        (0.12, 0.96, 1.0),
        (0.25, 0.96, 1.0),
        (0.4, 1.0, 1.0),
        (0.55, 1.0, 1.0),
        (0.7, 1.0, 1.0),
        (0.82, 1.0, 1.0),
        (0.92, 1.0, 1.0),
        (0.965, 0.96, 0.98),
        (0.988, 0.8, 0.86),
        (1.0, 0.5, 0.6),
    ]
    sections = []
    for share, width, thickness in stations:
        s = start + share * p.grip_length_mm
        point = [np.interp(s, run, path[:, k]) for k in (0, 1)]
        dx, dy = (np.interp(s, run, tangent[:, k]) for k in (0, 1))
        profile = rounded_rectangle(
            width * p.grip_width_mm,
            thickness * p.grip_thickness_mm,
            0.34 * p.grip_thickness_mm * thickness,
            5,
        )
        sections.append(across_path(profile, point, float(np.arctan2(dy, dx))))
    return loft(sections)


def _rivet(p: PliersParameters) -> Shape:
    """Builds the rivet: flush below, with a low chamfered head above."""
    radius, z = p.rivet_diameter_mm / 2, p.thickness_mm / 2

    def disc(r: float, height: float) -> np.ndarray:
        return np.column_stack([circle(r, segments=32), np.full(32, height)])

    rivet = loft([disc(radius, -z + 0.01), disc(radius, z + 0.6), disc(radius - 1.0, z + 1.3)])
    dimple = Manifold.cylinder(2.0, 0.5, 0.28 * radius + 1.4, SEGMENTS).translate((0, 0, z + 0.5))
    return Shape(rivet.solid - dimple, rivet.hulls)
