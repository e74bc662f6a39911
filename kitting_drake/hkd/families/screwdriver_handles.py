"""Handles of screwdrivers: lofts through sections along the length.

Every section is flat below and on both sides, so that a handle does not roll and can be gripped.
"""

import itertools
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from kitting_drake.hkd.tools.solids import Shape, across_x, fillet, loft, rounded_rectangle


class HandleSection(NamedTuple):
    """A section of a handle."""

    # The position as a share of the handle's length: 0 at the rear end, 1 at the front.
    place: float
    # The size as a share of the handle's width and height.
    size: float
    # The depth of the flutes in this section, as a share of their full depth.
    flute: float = 0.0


class Zone(NamedTuple):
    """A part of a handle's length that has one material."""

    # The kind of material: grip, accent or metal.
    material: str
    stations: Sequence[HandleSection]
    # Whether the zone has fine rings, which its hulls ignore.
    knurled: bool = False


class Style(NamedTuple):
    """The shape of a handle and its zones of different materials."""

    # A function of width, height and flute depth that returns the profile (n, 2), always with the
    # same n.
    section: Callable[[float, float, float], np.ndarray]
    zones: Sequence[Zone]


def _pressed(
    profile: np.ndarray, flutes: int, depth: float, phase: float, sharpness: float
) -> np.ndarray:
    """Presses `flutes` grooves into a profile (n, 2), the first at angle `phase`."""
    angle = np.arctan2(profile[:, 1], profile[:, 0])
    press = depth * np.clip(np.cos(flutes * (angle - phase)), 0.0, 1.0) ** sharpness
    reach = np.linalg.norm(profile, axis=1)
    return profile * (1.0 - press / reach)[:, None]


def _resampled(profile: np.ndarray, count: int) -> np.ndarray:
    """Returns the points (count, 2) of a profile at equal angles about the origin."""
    closed = np.vstack([profile, profile[:1]])
    fine = np.vstack([a + t * (b - a) for a, b in itertools.pairwise(closed) for t in _FINE])
    angle = np.arctan2(fine[:, 1], fine[:, 0])
    order = np.argsort(angle)
    radius = np.linalg.norm(fine, axis=1)[order]
    at = 2 * np.pi * np.arange(count) / count
    reach = np.interp(at, angle[order], radius, period=2 * np.pi)
    return reach[:, None] * np.column_stack([np.cos(at), np.sin(at)])


_FINE = np.linspace(0.0, 1.0, 24, endpoint=False)


def _square(width: float, height: float, flute: float) -> np.ndarray:
    """Returns a square with large round corners and a flute along each corner."""
    profile = rounded_rectangle(width, height, 0.3 * min(width, height), 3)
    return _pressed(profile, 4, flute, np.pi / 4, 2)


def _octagon(width: float, height: float, flute: float) -> np.ndarray:
    """Returns the octagonal section of a planed wooden handle."""
    y, z = width / 2, height / 2
    a, b = 0.42 * y, 0.42 * z
    corners = [(-a, -z), (a, -z), (y, -b), (y, b), (a, z), (-a, z), (-y, b), (-y, -b)]
    return fillet(corners, 0.08 * width, 2)


def _ribbed(width: float, height: float, flute: float) -> np.ndarray:
    """Returns a section with eight ribs and round flutes between them; the lower and side ribs are
    flat."""
    y, z = width / 2, height / 2
    profile = _resampled(rounded_rectangle(width, height, 0.7 * min(y, z), 8), 64)
    return _pressed(profile, 8, flute, np.pi / 8, 1)


def _three_lobed(width: float, height: float, flute: float) -> np.ndarray:
    """Returns a triangle with large round corners, one side down; its lower corners are cut off
    vertically."""
    y, z = width / 2, height / 2
    corners = [
        (-0.62 * y, -z),
        (0.62 * y, -z),
        (y, -0.66 * z),
        (y, -0.1 * z),
        (0.34 * y, z),
        (-0.34 * y, z),
        (-y, -0.1 * z),
        (-y, -0.66 * z),
    ]
    return fillet(corners, 0.16 * width, 3)


def _oval(width: float, height: float, flute: float) -> np.ndarray:
    """Returns an oval with narrow flats above, below and at the sides."""
    y, z = width / 2, height / 2
    return rounded_rectangle(width, height, 0.75 * min(y, z), 3)


S = HandleSection
STYLES: dict[str, Style] = {
    # A hard core with soft sides, a waist for the fingertips, and a guard in front of the waist.
    "two_tone": Style(
        _square,
        [
            Zone("grip", [S(0.0, 0.6), S(0.02, 0.8), S(0.06, 0.9), S(0.14, 0.92)]),
            Zone(
                "accent",
                [S(0.14, 0.92), S(0.17, 1.0), S(0.22, 1.0, 1.0), S(0.76, 1.0, 1.0), S(0.80, 1.0)]
                + [S(0.85, 0.82), S(0.90, 0.8), S(0.94, 1.0)],
            ),
            Zone("grip", [S(0.94, 1.0), S(0.975, 1.0), S(1.0, 0.7)]),
        ],
    ),
    # Clear plastic with ribs, and a smooth bulb at the rear end.
    "ribbed": Style(
        _ribbed,
        [
            Zone("grip", [S(0.0, 0.5), S(0.025, 0.82), S(0.07, 0.97), S(0.12, 1.0), S(0.16, 1.0)]),
            Zone("grip", [S(0.16, 1.0), S(0.20, 1.0, 1.0), S(0.86, 1.0, 1.0), S(0.90, 1.0)]),
            Zone("accent", [S(0.90, 0.86), S(0.965, 0.86), S(1.0, 0.62)]),
        ],
    ),
    "three_lobed": Style(
        _three_lobed,
        [
            Zone("accent", [S(0.0, 0.62), S(0.03, 0.86), S(0.08, 0.94)]),
            Zone("grip", [S(0.08, 0.94), S(0.16, 1.0), S(0.80, 1.0), S(0.87, 0.84)]),
            Zone("accent", [S(0.87, 0.84), S(0.91, 0.84), S(0.94, 1.0), S(0.98, 1.0)]),
            Zone("accent", [S(0.98, 1.0), S(1.0, 0.7)]),
        ],
    ),
    # Planed wood with a swell for the palm, and a metal ferrule at the front.
    "wood": Style(
        _octagon,
        [
            Zone("grip", [S(0.0, 0.66), S(0.02, 0.8), S(0.10, 0.96), S(0.22, 1.0), S(0.84, 1.0)]),
            Zone("grip", [S(0.84, 1.0), S(0.89, 0.88), S(0.92, 0.7)]),
            Zone("metal", [S(0.92, 0.64), S(0.985, 0.56), S(1.0, 0.5)]),
        ],
    ),
    # A cabinet maker's oval bulb, which narrows toward a metal ferrule.
    "cabinet": Style(
        _oval,
        [
            Zone("grip", [S(0.0, 0.5), S(0.02, 0.7), S(0.08, 0.88), S(0.17, 0.97), S(0.25, 1.0)]),
            Zone("grip", [S(0.25, 1.0), S(0.51, 1.0), S(0.59, 0.93), S(0.71, 0.68), S(0.80, 0.54)]),
            Zone("grip", [S(0.80, 0.54), S(0.88, 0.5)]),
            Zone("metal", [S(0.88, 0.47), S(0.98, 0.45), S(1.0, 0.4)]),
        ],
    ),
    # Wood; the blade runs through it and ends in a steel striking cap.
    "striking": Style(
        _octagon,
        [
            Zone("metal", [S(0.0, 0.72), S(0.012, 0.8), S(0.075, 0.8), S(0.085, 0.72)]),
            Zone("grip", [S(0.085, 0.9), S(0.11, 1.0), S(0.86, 1.0), S(0.88, 0.9)]),
            Zone("metal", [S(0.88, 0.96), S(0.98, 0.96), S(1.0, 0.86)]),
        ],
    ),
    # An impact driver, whose blade turns a little at each hammer blow. It has a striking cap and
    # rings.
    "impact": Style(
        _octagon,
        [
            Zone("accent", [S(0.0, 0.84), S(0.015, 0.92), S(0.10, 0.92)]),
            Zone("grip", [S(0.10, 0.98), S(0.115, 1.0), S(0.14, 1.0)]),
            Zone("grip", [S(0.14 + 0.02 * i, 0.98 if i % 2 else 1.0) for i in range(13)], True),
            Zone("grip", [S(0.38, 1.0), S(0.765, 1.0), S(0.78, 0.98)]),
            Zone("accent", [S(0.78, 0.92), S(0.90, 0.92), S(0.91, 0.86)]),
            Zone("metal", [S(0.91, 0.70), S(0.98, 0.70), S(1.0, 0.6)]),
        ],
    ),
    # An insulated handle, with a guard at the front that keeps the hand off live parts.
    "insulated": Style(
        _oval,
        [
            Zone("accent", [S(0.0, 0.6), S(0.03, 0.84), S(0.08, 0.92), S(0.12, 0.93)]),
            Zone("grip", [S(0.12, 0.93), S(0.20, 0.94), S(0.42, 0.80), S(0.84, 0.80)]),
            Zone("accent", [S(0.84, 0.80), S(0.88, 1.0), S(0.93, 1.0), S(0.96, 0.7), S(1.0, 0.5)]),
        ],
    ),
    # A square bar.
    "square": Style(
        _square,
        [
            Zone("grip", [S(0.0, 0.8), S(0.025, 0.94), S(0.06, 1.0), S(0.10, 1.0, 1.0)]),
            Zone("grip", [S(0.10, 1.0, 1.0), S(0.84, 1.0, 1.0), S(0.88, 1.0), S(0.91, 0.9)]),
            Zone("metal", [S(0.91, 0.66), S(0.98, 0.66), S(1.0, 0.56)]),
        ],
    ),
    # A thick, pear-shaped handle for the palm.
    "bulb": Style(
        _square,
        [
            Zone("accent", [S(0.0, 0.6), S(0.04, 0.82), S(0.11, 0.95), S(0.20, 1.0)]),
            Zone("grip", [S(0.20, 1.0), S(0.26, 1.0, 1.0), S(0.74, 1.0, 1.0), S(0.80, 0.97)]),
            Zone(
                "grip",
                [
                    S(0.80, 0.97),
                    S(0.88, 0.74),
                    S(0.92, 0.74),
                    S(0.95, 1.0),
                    S(0.98, 1.0),
                    S(1.0, 0.8),
                ],
            ),
        ],
    ),
    # Slim metal, knurled for the fingers, with a rotating cap for the palm.
    "precision": Style(
        _octagon,
        [
            Zone("accent", [S(0.0, 0.9), S(0.015, 1.0), S(0.06, 1.0), S(0.075, 0.9)]),
            Zone("metal", [S(0.075, 0.5), S(0.105, 0.5)]),
            Zone("grip", [S(0.105, 0.92), S(0.115, 1.0), S(0.62, 1.0)]),
            Zone(
                "grip",
                [S(0.62 + 0.012 * i, 0.95 if i % 2 else 1.0) for i in range(19)] + [S(0.87, 1.0)],
                True,
            ),
            Zone("metal", [S(0.87, 0.9), S(0.90, 0.8), S(1.0, 0.45)]),
        ],
    ),
}
del S


def handle(
    style: str, length: float, width: float, height: float, flute: float
) -> list[tuple[str, Shape]]:
    """Builds the zones of a handle, with the handle's front at x = 0. Lengths in mm.

    Returns:
        The kind of material and the shape of each zone.

    Raises:
        ValueError: the style is not known.
    """
    if style not in STYLES:
        raise ValueError(
            f"the handle must be one of fluted, tee, offset, {', '.join(STYLES)}, not {style!r}"
        )
    section, zones = STYLES[style]
    result = []
    for zone in zones:
        rings = [
            across_x(section(s.size * width, s.size * height, s.flute * flute), x)
            for s in zone.stations
            for x in [(s.place - 1.0) * length]
        ]
        shape = loft(rings)
        if zone.knurled:
            shape = Shape(shape.solid, loft([rings[0], rings[-1]]).hulls)
        result.append((zone.material, shape))
    return result
