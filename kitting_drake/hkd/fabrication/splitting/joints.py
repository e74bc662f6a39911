"""Dovetails that join the pieces of a block.

A dovetail is a prism that stands on the printer's bed, so it prints without support. A piece slides
onto its neighbours from above. Where a cavity is in the way, the dovetail ends below the cavity's
floor.
"""

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from manifold3d import CrossSection, JoinType
from numpy.typing import NDArray

from kitting_drake.hkd.fabrication.splitting.cut_lines import TAB_REACH, Line
from kitting_drake.hkd.fabrication.splitting.opening import (
    LEAST_WALL,
    Opening,
    corner_area,
    thin_parts,
)

SIZES = ((10.0, 15.0, TAB_REACH), (6.0, 9.0, 5.0))
"""The dovetails to try: width at the root, width at the tip, and length, in mm."""
APART = 60.0
"""The approximate distance between dovetails of the same two pieces, in mm."""

_ROOF = 2.0
"""The least material between a dovetail and the floor of a recess above it, in mm."""
_LOWEST = 5.0
"""The least height of a dovetail, in mm."""
_MARGIN = LEAST_WALL + 0.6
"""The least material around a dovetail, in mm."""
_STEP = 1.5
"""Along a cut, a dovetail is tried at positions that are this far apart, in mm."""
_ROOT = 1.0
"""The length by which a dovetail overlaps its own piece, in mm."""


@dataclass(frozen=True)
class Joint:
    """A dovetail of the piece with the index `owner`, in a socket of the piece `other`."""

    owner: int
    other: int
    outline: CrossSection
    """The outline of the dovetail, in mm. It overlaps the piece `owner` at the root."""
    height: float
    """The height of the dovetail's top above the block's bottom, in mm."""


_Box = tuple[float, float, float, float]
"""The bounds x_min, y_min, x_max, y_max of an outline, in mm."""
_Boxed = tuple[Opening, _Box]
"""An opening, and the bounds of its outline, which are slow to compute."""


@dataclass(frozen=True)
class _Place:
    """A place that has room for a dovetail."""

    joint: Joint
    middle: NDArray[np.float64]
    """The middle (2) of the dovetail's root, in mm."""

    @property
    def value(self) -> float:
        """The quality of the joint, which grows with the dovetail's height and area."""
        return self.joint.height * float(np.sqrt(self.joint.outline.area()))


def choose_joints(
    lines: Sequence[Line],
    regions: Sequence[CrossSection],
    openings: Sequence[Opening],
    height: float,
    feet: Sequence[CrossSection] = (),
) -> list[Joint]:
    """Places dovetails along cuts.

    Args:
        lines: the cuts.
        regions: the outlines of the pieces from above.
        openings: the block's recesses.
        height: the block's height, in mm.
        feet: sections of the feet below the block.

    Returns:
        The joints. Each dovetail belongs to the piece with the lower index, so that the pieces can
        be put together in their order.
    """
    found: dict[tuple[int, int], list[_Place]] = {}
    boxed = [(opening, opening.outline.bounds()) for opening in openings]
    for line in lines:
        for place in _places(line, regions, boxed, height):
            pair = (place.joint.owner, place.joint.other)
            found.setdefault(pair, []).append(place)
    joints: list[Joint] = []
    for places in found.values():
        joints += _spread(places, joints, regions, feet)
    return joints


def _spread(
    places: list[_Place],
    taken: Sequence[Joint],
    regions: Sequence[CrossSection],
    feet: Sequence[CrossSection],
) -> list[Joint]:
    """Returns the best joints between two pieces, spread along the seam.

    Args:
        places: the places along the seam that have room for a dovetail.
        taken: the joints that are already placed between other pieces.
        regions: see `choose_joints`.
        feet: see `choose_joints`.
    """
    middles = np.array([place.middle for place in places])
    along = np.linalg.norm(middles - middles[0], axis=1)
    count = max(2, round((along.max() + 2 * APART / 3) / APART))
    edges = np.linspace(0.0, along.max() + 1e-6, count + 1)
    chosen: list[Joint] = []
    barred = CrossSection()
    for joint in taken:
        barred += joint.outline
    for low, high in itertools.pairwise(edges):
        here = [
            (place, at) for place, at in zip(places, along, strict=True) if low <= at < high + 1e-9
        ]
        # Among equally good places, prefer the one in the middle.
        here.sort(key=lambda item: (-round(item[0].value, 1), abs(item[1] - (low + high) / 2)))
        for place, _ in here:
            outline = place.joint.outline
            apart = (outline.offset(3 * _MARGIN, JoinType.Round) ^ barred).is_empty()
            if apart and _keeps_walls(place.joint, regions, feet):
                chosen.append(place.joint)
                barred += outline
                break
    return chosen


def _keeps_walls(
    joint: Joint, regions: Sequence[CrossSection], feet: Sequence[CrossSection]
) -> bool:
    """Whether all walls beside a joint, in its two pieces and their feet, are thick enough."""
    near = joint.outline.offset(4 * _MARGIN, JoinType.Miter)
    owner, other = (regions[i] ^ near for i in (joint.owner, joint.other))
    inner = joint.outline.offset(2 * _MARGIN, JoinType.Miter)
    return all(
        part.area() <= corner_area(LEAST_WALL)
        for shape in (owner + joint.outline, other - joint.outline)
        for level in (shape, *(shape ^ section for section in feet))
        for part in (thin_parts(level, LEAST_WALL) ^ inner).decompose()
    )


def _places(
    line: Line, regions: Sequence[CrossSection], openings: Sequence[_Boxed], height: float
) -> Iterator[_Place]:
    for start, end in itertools.pairwise(line):
        length = float(np.linalg.norm(end - start))
        along = (end - start) / max(length, 1e-9)
        for size, sign in itertools.product(SIZES, (1, -1)):
            inset = size[0] / 2 + 0.5
            outward = sign * np.array([along[1], -along[0]])
            for at in np.arange(inset, length - inset + 1e-6, _STEP):
                middle = start + at * along
                owner = _region_at(middle - 2 * outward, regions)
                other = _region_at(middle + size[2] * outward, regions)
                if owner is None or other is None or owner >= other:
                    continue
                outline = _dovetail(middle, along, outward, size)
                joint = _fitted(outline, (owner, other), regions, openings, height)
                if joint is not None:
                    yield _Place(joint, middle)


def _region_at(point: NDArray[np.float64], regions: Sequence[CrossSection]) -> int | None:
    dot = CrossSection.square((0.02, 0.02), True).translate((float(point[0]), float(point[1])))
    return next((i for i, region in enumerate(regions) if not (region ^ dot).is_empty()), None)


def _overlap(one: _Box, other: _Box) -> bool:
    return one[0] < other[2] and other[0] < one[2] and one[1] < other[3] and other[1] < one[3]


def _dovetail(
    middle: NDArray[np.float64],
    along: NDArray[np.float64],
    outward: NDArray[np.float64],
    size: tuple[float, float, float],
) -> CrossSection:
    root, tip, reach = size
    corners = [
        middle + side * along - depth * outward
        for side, depth in (
            (-root / 2, _ROOT),
            (root / 2, _ROOT),
            (root / 2, 0.0),
            (tip / 2, -reach),
            (-tip / 2, -reach),
            (-root / 2, 0.0),
        )
    ]
    outline = CrossSection([np.array(corners)])
    return outline if outline.area() > 0 else CrossSection([np.array(corners[::-1])])


def _fitted(
    outline: CrossSection,
    pair: tuple[int, int],
    regions: Sequence[CrossSection],
    openings: Sequence[_Boxed],
    height: float,
) -> Joint | None:
    """Returns the joint with a given outline, or None if it finds no room.

    Args:
        outline: the outline of the dovetail.
        pair: the indices of the dovetail's piece and of the socket's piece.
        regions: the outlines of the pieces from above.
        openings: the block's recesses, with their bounds.
        height: the block's height, in mm.
    """
    owner, other = pair
    around = outline.offset(_MARGIN, JoinType.Round)
    if (around - regions[owner] - regions[other]).area() > 1e-6:
        return None
    # The dovetail may overlap its own piece only at the root.
    inside = outline.offset(-_ROOT - 0.2, JoinType.Round) ^ regions[owner]
    if inside.area() > 1e-6:
        return None
    floors = [
        opening.floor
        for opening, box in openings
        if _overlap(box, around.bounds()) and not (around ^ opening.outline).is_empty()
    ]
    top = min(floors) - _ROOF if floors else height
    if top < _LOWEST:
        return None
    return Joint(owner, other, outline, top)
