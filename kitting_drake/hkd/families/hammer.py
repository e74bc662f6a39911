"""Generates hammers: a forged head on a handle. They lie on their side with the face toward +y."""

from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from manifold3d import Manifold, OpType

from kitting_drake.common.errors import UserError
from kitting_drake.hkd.families.hammer_heads import HeadEnd, build_head
from kitting_drake.hkd.families.hammer_shafts import PROUD_MM, Shaft, build_shaft, octagon_corners
from kitting_drake.hkd.tools.solids import (
    Part,
    Shape,
    across_path,
    across_x,
    fillet,
    loft,
    rounded_rectangle,
)


@dataclass
class HammerParameters:
    """A claw hammer with the handle along x and the eye at the origin. Lengths in mm."""

    # The distance from the top of the eye (the hole for the handle) to the end of the handle.
    length_mm: float = 330.0
    # The distance from the eye's middle to the striking face.
    face_reach_mm: float = 56.0
    # The thickness along z of the cheeks, which are the block around the eye.
    head_thickness_mm: float = 30.0
    # The cheeks' height along x and their length along y.
    cheek_height_mm: float = 32.0
    cheek_length_mm: float = 32.0
    # The diameter of the striking face, the diameter of the neck behind it, and the bevel around
    # the face.
    face_diameter_mm: float = 29.0
    neck_diameter_mm: float = 22.0
    face_bevel_mm: float = 2.0
    # The claw's curve: its radius and angle. The claw's tips: their thickness, their width along z,
    # and the largest gap between them.
    claw_radius_mm: float = 66.0
    claw_angle_deg: float = 60.0
    claw_tip_mm: float = 3.5
    claw_width_mm: float = 31.0
    claw_gap_mm: float = 11.0
    # The handle's widths along y at the eye, at the throat (the thinnest point) and at the swell of
    # the grip. Then the handle's thickness along z as a share of these widths.
    eye_width_mm: float = 25.0
    throat_width_mm: float = 23.0
    swell_width_mm: float = 34.0
    handle_flatness: float = 0.76
    # The materials of the parts. Each is a key of solids.MATERIALS.
    head_material: str = "steel"
    face_material: str = "polished_steel"
    handle_material: str = "hickory"
    grip_material: str = "painted_wood"
    # Other kinds of hammers have `front`, `back` and `shaft`, which replace the face, the claw and
    # the handle above. Each of these is a HeadEnd or a Shaft, or a mapping of its fields.
    front: HeadEnd | dict[str, Any] | None = None
    back: HeadEnd | dict[str, Any] | None = None
    shaft: Shaft | dict[str, Any] | None = None
    # The roundness of the cheeks' corners: 0 is square, 1 is round.
    cheek_roundness: float = 0.3


def _typed(kind: type[HeadEnd | Shaft], value: Any, field: str) -> Any:
    try:
        return kind(**value) if isinstance(value, dict) else value
    except TypeError as error:
        known = [f.name for f in fields(kind)]
        unknown = ", ".join(f"'{key}'" for key in value if key not in known)
        raise UserError(
            f"hammer: {field} has the unknown field {unknown}: give one of {', '.join(known)}"
        ) from error


def build_hammer(p: HammerParameters) -> list[Part]:
    """Builds the parts of a hammer, in mm in the design frame.

    Raises:
        UserError: `front`, `back` or `shaft` has an unknown field.
    """
    if p.front or p.back or p.shaft:
        return _assembled(p)
    # The wedge spreads the handle in the eye. It protrudes a little, so that it is visible.
    wedge = Manifold.cube((12.0, 0.5 * p.eye_width_mm, 2.2), True)
    wedge = wedge.translate((p.cheek_height_mm / 2 + PROUD_MM - 5.8, 0.0, 0.0))
    wood, dipped = _handle(p)
    poll, face = _poll(p)
    head = _cheeks(p), poll, _claw(p)
    return [
        Part("wedge", p.face_material, wedge),
        Part("handle", p.handle_material, wood.solid, wood.hulls),
        Part("grip", p.grip_material, dipped.solid, dipped.hulls),
        Part("face", p.face_material, face.solid, face.hulls),
        Part(
            "head",
            p.head_material,
            Manifold.batch_boolean([s.solid for s in head], OpType.Add),
            [h for s in head for h in s.hulls],
        ),
    ]


def _assembled(p: HammerParameters) -> list[Part]:
    """Builds the parts of a hammer with given ends and a given shaft."""
    shaft: Shaft = _typed(Shaft, p.shaft or {}, "shaft")
    top = p.cheek_height_mm / 2 + PROUD_MM
    parts = build_shaft(shaft, top)
    head = build_head(
        cheek_height=p.cheek_height_mm,
        cheek_length=p.cheek_length_mm,
        thickness=p.head_thickness_mm,
        cheek_roundness=p.cheek_roundness,
        front=_typed(HeadEnd, p.front or {}, "front"),
        back=_typed(HeadEnd, p.back or {}, "back"),
        material=p.head_material,
    )
    if shaft.material in ("hickory", "painted_wood"):
        wedge = Manifold.cube((12.0, 0.5 * shaft.neck_width_mm, 2.2), True)
        wedge = wedge.translate((top - 5.8, 0.0, 0.0))
        parts.insert(0, Part("wedge", p.face_material, wedge))
    return [*parts, *head]


def _octagon(width: float, thickness: float) -> np.ndarray:
    """Returns an octagonal section (n, 2) of a handle with softened corners."""
    return fillet(octagon_corners(width, thickness), 0.35 * (0.27 * thickness), 3)


def _handle(p: HammerParameters) -> tuple[Shape, Shape]:
    """Builds the bare handle from the eye to the throat, and the grip with the swell."""
    top = p.cheek_height_mm / 2 + PROUD_MM
    end = top - p.length_mm
    eye, throat, swell = p.eye_width_mm, p.throat_width_mm, p.swell_width_mm
    # Each row: the distance from the handle's end (as a share of its length), and the width.
    # Behind the head the flanks are parallel, because a gripper holds the handle there.
    bare = [
        (1.0, 0.86 * eye),
        (0.995, 0.9 * eye),
        (0.91, 0.92 * eye),
        (0.905, eye),
        (0.70, eye),
        (0.64, 0.99 * eye),
        (0.58, 0.5 * (eye + throat)),
        (0.52, throat),
        (0.46, throat),
    ]
    dipped = [
        (0.46, throat),
        (0.40, 1.02 * throat),
        (0.32, 0.5 * (throat + 0.86 * swell)),
        (0.24, 0.86 * swell),
        (0.15, 0.88 * swell),
        (0.09, 0.93 * swell),
        (0.045, swell),
        (0.022, 0.98 * swell),
        (0.008, 0.92 * swell),
        (0.0, 0.82 * swell),
    ]

    def along(stations: list[tuple[float, float]]) -> Shape:
        return loft(
            [
                across_x(_octagon(w, p.handle_flatness * w), end + t * p.length_mm)
                for t, w in stations
            ]
        )

    return along(bare), along(dipped)


def _across_y(profile: np.ndarray, y: float) -> np.ndarray:
    """Returns a section (n, 3) of a loft along y; the profile's axes become -x and z."""
    return np.column_stack([-profile[:, 0], np.full(len(profile), y), profile[:, 1]])


def _cheeks(p: HammerParameters) -> Shape:
    """Builds the block around the eye, which narrows toward the face and the claw."""
    half, height, thickness = p.cheek_length_mm / 2, p.cheek_height_mm, p.head_thickness_mm
    sections = [(-1.0, 0.8), (-0.72, 1.0), (0.72, 1.0), (1.0, 0.8)]
    return loft(
        [
            _across_y(rounded_rectangle(height * (0.5 + 0.5 * s), thickness * s, 5.0 * s), y * half)
            for y, s in sections
        ]
    )


def _poll(p: HammerParameters) -> tuple[Shape, Shape]:
    """Builds the neck with the bell at its end, and the striking face with its bevel and slight
    crown."""
    start, end, bevel = 0.4 * p.cheek_length_mm, p.face_reach_mm, p.face_bevel_mm
    neck, face = p.neck_diameter_mm, p.face_diameter_mm
    bell = end - 0.3 * face - bevel
    root = 0.85 * p.head_thickness_mm

    def section(diameter: float, y: float, roundness: float = 1.0) -> np.ndarray:
        return _across_y(rounded_rectangle(diameter, diameter, roundness * diameter / 2, 10), y)

    poll = loft(
        [
            section(root, start, 0.5),
            section(0.5 * (root + neck), 0.6 * start + 0.4 * (bell - 7), 0.8),
            section(neck, bell - 7),
            section(neck, bell - 4),
            section(0.93 * face, bell - 0.5),
            section(face, bell + 1.5),
            section(face, end - bevel - 1.5),
        ]
    )
    crown = loft(
        [
            section(face, end - bevel - 1.5),
            section(face, end - bevel),
            section(face - 2 * bevel, end - 0.4),
            section(0.4 * face, end),
        ]
    )
    return poll, crown


def _claw(p: HammerParameters) -> Shape:
    """Builds the claw: a tapered band that bends toward the handle and is split at its tips."""
    start = 0.3 * p.cheek_length_mm
    root = 0.84 * p.cheek_height_mm
    turn = np.radians(p.claw_angle_deg)
    sections = []
    for t in np.linspace(0.0, 1.0, 13):
        # The outer edge follows a circle, and the thickness extends inward.
        angle = -np.pi / 2 - t * turn
        thickness = p.claw_tip_mm + (root - p.claw_tip_mm) * (1 - t) ** 1.15
        width = p.head_thickness_mm * 0.8 + (p.claw_width_mm - 0.8 * p.head_thickness_mm) * min(
            1.0, 2 * t
        )
        reach = p.claw_radius_mm - thickness / 2
        center = (root / 2 - p.claw_radius_mm, -start) - reach * np.array(
            [-np.cos(t * turn), np.sin(t * turn)]
        )
        sections.append(
            across_path(
                rounded_rectangle(thickness, width, min(2.0, 0.4 * thickness)), center, angle
            )
        )
    band = loft(sections)
    return Shape(band.solid - _split(p, start), band.hulls)


def _split(p: HammerParameters, start: float) -> Manifold:
    """Builds the V-shaped gap between the tips of the claw, which narrows to a round root."""
    reach = start + p.claw_radius_mm
    root = start + 0.32 * p.claw_radius_mm
    outline = fillet(
        [
            (-reach - 5, -p.claw_gap_mm / 2),
            (-root, -1.0),
            (-root, 1.0),
            (-reach - 5, p.claw_gap_mm / 2),
        ],
        [0.0, 0.9, 0.9, 0.0],
    )
    height = 4 * p.cheek_height_mm
    prism = loft([np.column_stack([np.full(len(outline), x), outline]) for x in (-height, height)])
    return prism.solid
