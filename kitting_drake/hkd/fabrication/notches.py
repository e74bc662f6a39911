"""Finger notches: half-round recesses beside a tool, where a hand takes it out of its cavity."""

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
"""The radii that are tried, in metres: for a wide finger first, for a narrow one last."""
DEEPEST = 0.020
"""A notch is as deep as its cavity, but no deeper than a finger reaches, in metres."""

_WALL = 0.003
"""The least wall between a notch and all else, in metres; less where the kit's walls are less."""
_SLIDES = tuple(sign * step for step in np.arange(0.0, 0.041, 0.004) for sign in (1, -1))
"""How far along the tool from its grasp a notch may be, in metres."""
_SHARES = (0.85, 1.15)
"""The area of a notch beside its cavity, as a share of half a disc's."""
_FINS = 1.6
"""How much more than right corners may be thin between a notch and its cavity, as a share."""
_OVERLAP = 0.001
"""How far a notch reaches into its cavity, in metres, so that no skin is left between them."""


def cut_notches(
    kit: Kit, cavities: Sequence[Cavity], taken: Sequence[Recess]
) -> tuple[list[Recess], list[str]]:
    """Notches for all tools of a kit, on both sides of the tool where there is room.

    Args:
        kit: whose tools are to be taken out.
        cavities: of the tools, in their order.
        taken: other recesses beside the cavities; notches keep their distance from them.

    Returns:
        The notches, and a sentence for each tool beside which there is room for none.
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
                f"there is no room for a finger notch beside '{tool.name}': a thicker --wall_mm or "
                "a larger block gives some"
            )
    return notches, notes


def _best_pair(
    kit: Kit, index: int, cavity: Cavity, free: CrossSection, wall: float
) -> list[CrossSection]:
    """The outlines of a tool's notches: two rather than one, wide rather than near the grasp."""
    single: list[CrossSection] = []
    # The first pair is the best there is: wide notches are tried first, and of them near ones.
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
    """Whether what stands between two notches of a cavity is no thinner than a wall."""
    return ((_grown(one, wall) ^ other) - cavity.outline).area() < 1e-9


def _beside(
    kit: Kit, index: int, cavity: Cavity, slide: float
) -> Iterator[tuple[NDArray[np.float64], NDArray[np.float64]]]:
    """Points (2) of a cavity's wall on both sides of a grasp, and directions (2) out of it."""
    grasp, pose = kit.tools[index].grasp, kit.layout.poses[index]
    c, s = math.cos(pose.yaw), math.sin(pose.yaw)
    along_angle = pose.yaw + grasp.theta
    along = np.array([math.cos(along_angle), math.sin(along_angle)])
    across = np.array([-along[1], along[0]])
    held = np.array([pose.x + c * grasp.x - s * grasp.y, pose.y + s * grasp.x + c * grasp.y])
    start = held + slide * along
    crossings = _crossings(cavity.outline, start, across)
    # A line that misses the tool, or runs beside it, has no wall on one of its sides.
    if len(crossings) and crossings.min() < 0 < crossings.max():
        yield start + crossings.max() * across, across
        yield start + crossings.min() * across, -across


def _crossings(
    outline: CrossSection, start: NDArray[np.float64], direction: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Where a line crosses an outline: distances (n) from `start`, in metres."""
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
    """A disc about a point of the wall without what might reach through to the other wall."""
    disc = CrossSection.circle(radius, ARC_SEGMENTS)
    kept = CrossSection.square((1.5 * radius, 2 * radius)).translate((-0.5 * radius, -radius))
    angle = math.degrees(math.atan2(outward[1], outward[0]))
    return (disc ^ kept).rotate(angle).translate((float(centre[0]), float(centre[1])))


def _notch(cavity: Cavity, disc: CrossSection, radius: float, wall: float) -> CrossSection | None:
    """The outline of a notch; None where it is not half round or leaves a thin fin."""
    beside = disc - cavity.outline
    share = beside.area() / (math.pi * radius**2 / 2)
    if len(beside.decompose()) != 1 or not _SHARES[0] <= share <= _SHARES[1]:
        return None
    # A closing fills what is thin: a little of two right corners with the wall, more of fins.
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
