"""Cuts finger notches: half-round recesses beside a tool, to lift it out of its cavity by hand."""

import itertools
import math
from collections.abc import Iterator, Sequence

import numpy as np
from manifold3d import CrossSection, JoinType
from numpy.typing import NDArray

from kitting_drake.hkd.fabrication.recess import Recess
from kitting_drake.hkd.kits.block import ARC_SEGMENTS, Cavity
from kitting_drake.hkd.kits.kit import Kit

RADII = (0.012, 0.010, 0.008)
"""The radii of notches, in metres, in the order in which they are tried."""
DEEPEST = 0.020
"""The largest depth of a notch in metres: the reach of a finger."""

_WALL = 0.003
"""The least thickness of the walls around a notch, in metres.

If the kit's own walls are thinner, their thickness is the limit instead.
"""
_SLIDES = tuple(sign * step for step in np.arange(0.0, 0.041, 0.004) for sign in (1, -1))
"""The distances from the grasp, along the tool, at which a notch is tried, in metres."""
_SHARES = (0.85, 1.15)
"""A notch counts as half round if its area outside the cavity, divided by the area of a half disc,
is in this range."""
_FINS = 1.6
"""The limit for thin fins between a notch and its cavity.

The closing in `_notch` fills fins, and a little of the two corners between notch and cavity. A
notch is rejected if the filled area is more than this many times the area that the closing fills at
two right-angled corners.
"""
_OVERLAP = 0.001
"""The overlap of a notch with its cavity, in metres, so that no thin skin is left between them."""


def cut_notches(
    kit: Kit, cavities: Sequence[Cavity], taken: Sequence[Recess]
) -> tuple[list[Recess], list[str]]:
    """Cuts notches for each tool of a kit, on both sides of the tool where they fit.

    Args:
        kit: the kit.
        cavities: the cavities of the tools, in the tools' order.
        taken: the recesses cut so far; a wall is left between them and the notches.

    Returns:
        The notches, and a sentence for each tool beside which no notch fits.
    """
    parameters = kit.parameters
    wall = min(_WALL, max(parameters.minimum_wall, parameters.nested_wall))
    room = CrossSection.square((parameters.length - 2 * wall, parameters.width - 2 * wall), True)
    notches: list[Recess] = []
    notes = []
    for index, (tool, cavity) in enumerate(zip(kit.tools, cavities, strict=True)):
        barred = CrossSection()
        for other in (*cavities[:index], *cavities[index + 1 :]):
            barred += _grown(other.rim, wall)
        for recess in (*notches, *(r for r in taken if r.kind != "cavity")):
            barred += _grown(recess.outline, wall)
        outlines = _best_pair(kit, index, cavity, room - barred, wall)
        floor = max(cavity.floor, parameters.height - DEEPEST)
        notches += [Recess("notch", tool.name, outline, floor) for outline in outlines]
        if not outlines:
            notes.append(
                f"there is no room for a finger notch beside '{tool.name}': use a larger "
                "--wall_mm or a larger block"
            )
    return notches, notes


def _best_pair(
    kit: Kit, index: int, cavity: Cavity, free: CrossSection, wall: float
) -> list[CrossSection]:
    """Returns the outlines of a tool's notches, or an empty list if none fits.

    Two notches are preferred to one. After that, larger notches are preferred, and then those
    nearer to the grasp.
    """
    single: list[CrossSection] = []
    # The search is in the order of preference, so the first pair that fits is the best.
    for radius, slide in itertools.product(RADII, _SLIDES):
        outlines = []
        for centre, outward in _beside(kit, index, cavity, slide):
            disc = _half_disc(centre, outward, radius)
            if ((disc - cavity.outline) - free).area() < 1e-9:
                outline = _notch(cavity, disc, radius, wall)
                if outline is not None:
                    outlines.append(outline)
        if len(outlines) == 2 and _is_wall_between(outlines[0], outlines[1], cavity, wall):
            return outlines
        single = single or outlines[:1]
    return single


def _is_wall_between(one: CrossSection, other: CrossSection, cavity: Cavity, wall: float) -> bool:
    """Whether the wall between two notches of a cavity is at least `wall` metres thick."""
    return ((_grown(one, wall) ^ other) - cavity.outline).area() < 1e-9


def _beside(
    kit: Kit, index: int, cavity: Cavity, slide: float
) -> Iterator[tuple[NDArray[np.float64], NDArray[np.float64]]]:
    """Yields the points on the cavity's walls on both sides of the grasp.

    Args:
        kit: the kit.
        index: the index of the tool.
        cavity: the tool's cavity.
        slide: the distance from the grasp along the tool, in metres.

    Yields:
        A point (2) on the wall and the outward direction (2) there, in the kit frame.
    """
    grasp, pose = kit.tools[index].grasp, kit.layout.poses[index]
    c, s = math.cos(pose.yaw), math.sin(pose.yaw)
    along_angle = pose.yaw + grasp.theta
    along = np.array([math.cos(along_angle), math.sin(along_angle)])
    across = np.array([-along[1], along[0]])
    held = np.array([pose.x + c * grasp.x - s * grasp.y, pose.y + s * grasp.x + c * grasp.y])
    start = held + slide * along
    crossings = _crossings(cavity.outline, start, across)
    # Skip a line that misses or only touches the cavity: it does not meet a wall on both sides.
    if len(crossings) and crossings.min() < 0 < crossings.max():
        yield start + crossings.max() * across, across
        yield start + crossings.min() * across, -across


def _crossings(
    outline: CrossSection, start: NDArray[np.float64], direction: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Returns the signed distances (n) from `start` at which a line crosses an outline, in m."""
    normal = np.array([-direction[1], direction[0]])
    found = [np.empty(0)]
    for loop in outline.to_polygons():
        a, b = np.asarray(loop) - start, np.roll(loop, -1, axis=0) - start
        height_a, height_b = a @ normal, b @ normal
        crosses = (height_a < 0) != (height_b < 0)
        share = height_a[crosses] / (height_a[crosses] - height_b[crosses])
        found.append((a[crosses] + share[:, None] * (b[crosses] - a[crosses])) @ direction)
    return np.concatenate(found)


def _half_disc(
    centre: NDArray[np.float64], outward: NDArray[np.float64], radius: float
) -> CrossSection:
    """Returns a disc around a point on the wall, without the part deep inside the cavity.

    The part that is cut off is more than half a radius from the wall.
    """
    disc = CrossSection.circle(radius, ARC_SEGMENTS)
    kept = CrossSection.square((1.5 * radius, 2 * radius)).translate((-0.5 * radius, -radius))
    angle = math.degrees(math.atan2(outward[1], outward[0]))
    return (disc ^ kept).rotate(angle).translate((float(centre[0]), float(centre[1])))


def _notch(cavity: Cavity, disc: CrossSection, radius: float, wall: float) -> CrossSection | None:
    """Returns the outline of a notch, or None if it is not half round or leaves a thin fin."""
    beside = disc - cavity.outline
    share = beside.area() / (math.pi * radius**2 / 2)
    if len(beside.decompose()) != 1 or not _SHARES[0] <= share <= _SHARES[1]:
        return None
    # Look for thin fins of the block between the notch and the cavity: a morphological closing of
    # the notch and cavity fills them. It also fills a little of the two corners where the notch
    # meets the cavity. So compare the filled area with that at two right-angled corners.
    x_min, y_min, x_max, y_max = disc.bounds()
    near = CrossSection.square((x_max - x_min + 4 * wall, y_max - y_min + 4 * wall)).translate(
        (x_min - 2 * wall, y_min - 2 * wall)
    )
    united = (cavity.outline ^ near) + disc
    filled = (_grown(_grown(united, wall / 2), -wall / 2) - united) ^ _grown(disc, wall)
    if filled.area() > _FINS * (2 - math.pi / 2) * (wall / 2) ** 2:
        return None
    return disc - _grown(cavity.outline, -_OVERLAP)


def _grown(outline: CrossSection, distance: float) -> CrossSection:
    return outline.offset(distance, JoinType.Round, circular_segments=ARC_SEGMENTS)
