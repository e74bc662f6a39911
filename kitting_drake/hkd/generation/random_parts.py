"""Random solids for training: flat outlines, rings, plates, discs, rods and bolts.

`random_tools` mixes them with random hand tools, so that networks train on more than hand tools.
"""

import math

import numpy as np
from manifold3d import CrossSection, Manifold
from numpy.typing import NDArray

Array = NDArray[np.float64]

_SIZES_MM = (18.0, 140.0)
"""The range of the solids' lengths, in mm."""
_SEGMENTS = 48
_THICK_MM = (5.0, 40.0)
"""The range of a flat solid's thickness, in mm."""


def draw_solid(rng: np.random.Generator) -> Manifold:
    """Draws a random solid in its resting pose, in mm.

    Args:
        rng: the random generator of all draws.
    """
    length = math.exp(rng.uniform(*np.log(_SIZES_MM)))
    if rng.random() < 0.2:
        return _rod(length, rng)
    kinds = (_polygon, _blob, _letter, _ring, _plate, _star)
    outline = kinds[int(rng.choice(len(kinds), p=[0.2, 0.2, 0.25, 0.1, 0.15, 0.1]))](rng)
    low_x, low_y, high_x, high_y = outline.bounds()
    scale = length / max(high_x - low_x, high_y - low_y)
    outline = outline.scale((scale, scale))
    radius = 0.03 * length
    # Round the corners, as on milled and moulded parts.
    outline = outline.offset(-radius).offset(2 * radius, circular_segments=16).offset(-radius)
    thickness = float(np.clip(rng.uniform(0.1, 0.8) * length, *_THICK_MM))
    solid = outline.extrude(thickness)
    if rng.random() < 0.2:
        # Add a step, as on a flange.
        inner = outline.offset(-rng.uniform(0.1, 0.25) * length)
        solid += inner.extrude(thickness * rng.uniform(1.1, 1.6))
    return solid


def _polygon(rng: np.random.Generator) -> CrossSection:
    """Draws a regular or an irregular polygon with 3 to 9 corners."""
    count = int(rng.integers(3, 10))
    angles = np.arange(count) * math.tau / count
    radii = np.ones(count)
    if rng.random() < 0.6:
        angles += rng.uniform(-0.3, 0.3, count) * math.tau / count
        radii = rng.uniform(0.5, 1.0, count)
    stretch = (1.0, rng.uniform(0.5, 1.0))
    return CrossSection([np.column_stack([radii * np.cos(angles), radii * np.sin(angles)])]).scale(
        stretch
    )


def _blob(rng: np.random.Generator) -> CrossSection:
    """Draws a smooth outline: a circle with random waves."""
    angles = np.arange(96) * math.tau / 96
    radius = np.ones(96)
    for order in range(1, 6):
        size, phase = rng.normal(0, 0.35 / order), rng.uniform(0, math.tau)
        radius += size * np.cos(order * angles + phase)
    radius = np.clip(radius, 0.25, None)
    return CrossSection([np.column_stack([radius * np.cos(angles), radius * np.sin(angles)])])


def _letter(rng: np.random.Generator) -> CrossSection:
    """Draws a few joined bars, as in letters and brackets."""
    width = rng.uniform(0.18, 0.35)
    bar = CrossSection.square((1.0, width), True)
    whole = bar
    for _ in range(int(rng.integers(1, 4))):
        length = rng.uniform(0.4, 1.0)
        arm = CrossSection.square((length, width * rng.uniform(0.8, 1.2)), True)
        angle = float(rng.choice([45, 60, 90, -90]))
        arm = arm.translate((length / 2 - width / 2, 0)).rotate(angle)
        whole += arm.translate((float(rng.choice([-0.5, 0.0, 0.5])) * (1 - width), 0))
    return whole


def _ring(rng: np.random.Generator) -> CrossSection:
    ring = CrossSection.circle(0.5, _SEGMENTS)
    return ring - CrossSection.circle(0.5 * rng.uniform(0.3, 0.8), _SEGMENTS)


def _plate(rng: np.random.Generator) -> CrossSection:
    """Draws a rectangle or a disc, which may have a hole."""
    if rng.random() < 0.3:
        return CrossSection.circle(0.5, _SEGMENTS)
    width = rng.uniform(0.25, 1.0)
    plate = CrossSection.square((1.0, width), True)
    if rng.random() < 0.4:
        hole = CrossSection.circle(rng.uniform(0.05, 0.3) * width, 24)
        plate -= hole.translate((rng.uniform(-0.3, 0.3), 0))
    return plate


def _star(rng: np.random.Generator) -> CrossSection:
    """Draws a star, a gear or a cross."""
    count = int(rng.integers(4, 9))
    inner = rng.uniform(0.4, 0.8)
    angles = np.arange(2 * count) * math.pi / count
    radii = np.where(np.arange(2 * count) % 2, inner, 1.0)
    return CrossSection([np.column_stack([radii * np.cos(angles), radii * np.sin(angles)])])


def _rod(length: float, rng: np.random.Generator) -> Manifold:
    """Draws a lying cylinder, which may have a thicker head like a bolt."""
    radius = float(np.clip(length * rng.uniform(0.08, 0.3), 3.0, 20.0))
    rod = Manifold.cylinder(length, radius, circular_segments=_SEGMENTS)
    if rng.random() < 0.5:
        sides = int(rng.choice([6, _SEGMENTS]))
        head = min(radius * rng.uniform(1.3, 2.0), 22.0)
        rod += Manifold.cylinder(length * rng.uniform(0.1, 0.3), head, circular_segments=sides)
    return rod.rotate((0, 90, 0)).translate((-length / 2, 0, 0))
