"""Screwdriver blades with tips other than the flat one: shaft and tip in one piece, along x."""

from collections.abc import Callable

import numpy as np
from manifold3d import CrossSection

from kitting_drake.hkd.tools.solids import Shape, across_x, circle, loft

_SEGMENTS = 24


def _round_blade(
    start: float, end: float, diameter: float, stations: list[tuple[float, float]]
) -> Shape:
    """Builds a round shaft from `start` to `end`; stations are (distance from the end,
    diameter)."""
    ring = 0.5 * circle(1.0, segments=_SEGMENTS)
    sections = [across_x(diameter * ring, start)]
    sections += [across_x(d * ring, end - x) for x, d in stations]
    return loft(sections)


def _phillips(start: float, end: float, diameter: float, length: float, width: float) -> Shape:
    """Builds a cone with a blunt point and four grooves that leave a cross."""
    cone = 0.9 * diameter
    blade = _round_blade(
        start,
        end,
        diameter,
        [
            (length, diameter),
            (cone, diameter),
            (0.25 * diameter, 0.42 * diameter),
            (0.0, 0.22 * diameter),
        ],
    )
    solid = blade.solid
    # Each groove is a triangular prism that lies on its edge and rises toward the shaft.
    root, deep = 0.5 * diameter, 0.15 * diameter
    for quarter in range(4):
        sections = []
        for back, lift in ((length, root), (-1.0, 0.0)):
            r = deep + lift
            profile = np.array(
                [(r, 0.0), (r + diameter, -0.8 * diameter), (r + diameter, 0.8 * diameter)]
            )
            sections.append(across_x(profile, end - back))
        groove = loft(sections).solid.rotate((90.0 * quarter + 45.0, 0.0, 0.0))
        solid -= groove
    return Shape(solid, blade.hulls)


def _prismatic(outline: CrossSection) -> Callable[[float, float, float, float, float], Shape]:
    """Returns a function that builds a tip of constant section. A round shaft tapers towards it.

    `outline` is the section for a tip of width 1.
    """

    def build(start: float, end: float, diameter: float, length: float, width: float) -> Shape:
        tip = outline.scale((width, width))
        points = np.vstack(tip.to_polygons())
        reach = 2 * float(np.linalg.norm(points, axis=1).max())
        blade = _round_blade(
            start,
            end - 0.8 * length,
            diameter,
            [(0.2 * length, diameter), (0.0, min(reach, diameter))],
        )
        prism = tip.extrude(length, 0, 0.0, (1.0, 1.0)).rotate((0.0, 90.0, 0.0))
        # Rotate the hull as the prism was rotated: x of the section has become -z.
        hull = CrossSection.hull_points(points).to_polygons()[0][:, ::-1] * (1.0, -1.0)
        ends = np.vstack([across_x(hull, end - length), across_x(hull, end)])
        return Shape(blade.solid + prism.translate((end - length, 0.0, 0.0)), [*blade.hulls, ends])

    return build


def _star() -> CrossSection:
    """Returns the six-lobed section of a torx tip of width 1."""
    angle = 2 * np.pi * np.arange(48) / 48
    radius = 0.5 * (0.86 + 0.14 * np.cos(6 * angle))
    return CrossSection([radius[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])])


def _socket(start: float, end: float, diameter: float, length: float, width: float) -> Shape:
    """Builds the socket of a nut driver: a thick tube of outer width `width` with a hexagonal
    mouth."""
    blade = _round_blade(
        start,
        end,
        diameter,
        [
            (length + 2.5, diameter),
            (length, width),
            (0.8, width),
            (0.0, 0.9 * width),
        ],
    )
    mouth = CrossSection([circle(0.40 * width, segments=6)]).extrude(0.7 * length + 1.0)
    mouth = mouth.rotate((0.0, 90.0, 0.0)).translate((end - 0.7 * length, 0.0, 0.0))
    return Shape(blade.solid - mouth, blade.hulls)


TIPS: dict[str, Callable[[float, float, float, float, float], Shape]] = {
    "phillips": _phillips,
    "square": _prismatic(CrossSection.square((1.0, 1.0), True)),
    "torx": _prismatic(_star()),
    "hex": _prismatic(CrossSection([circle(1.0 / np.sqrt(3), segments=6)]).rotate(30.0)),
    "socket": _socket,
}
"""Functions that build a blade. Their arguments are the shaft's start, end and diameter, and the
tip's length and width."""
