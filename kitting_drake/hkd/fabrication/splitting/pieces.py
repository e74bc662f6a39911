"""Splits a block into pieces that fit a printer's bed."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from manifold3d import CrossSection, JoinType, Manifold
from numpy.typing import NDArray

from kitting_drake.common.errors import UserError
from kitting_drake.hkd.fabrication.splitting.cut_lines import TAB_REACH, choose_cuts
from kitting_drake.hkd.fabrication.splitting.joints import Joint, choose_joints
from kitting_drake.hkd.fabrication.splitting.opening import LEAST_WALL, Opening

_BEYOND = 1.0
"""The length by which the prisms that cut or join the pieces stick out of the block, in mm."""
_MOST_PIECES = 40
_UPRIGHT = 2
"""The number of `foot_sections` that lie below the upper slope of the feet."""


@dataclass(frozen=True)
class Piece:
    """A piece of a block, in the block's frame, in mm."""

    number: int
    """The number of the piece, counted from 1. Pieces are put together in this order."""
    body: Manifold
    """The piece with its dovetails and sockets."""
    region: CrossSection
    """The outline of the piece from above, without dovetails and sockets."""

    @property
    def corner(self) -> NDArray[np.float64]:
        """The lower corner (3) of the piece's bounding box, which is the origin of its files."""
        return np.array(self.body.bounding_box()[:3])

    @property
    def size(self) -> NDArray[np.float64]:
        """The extents (3) of the piece along x, y and z."""
        return np.array(self.body.bounding_box()[3:]) - self.corner


@dataclass(frozen=True)
class Split:
    """The pieces of a block, and the joints between them."""

    pieces: tuple[Piece, ...]
    joints: tuple[Joint, ...]
    play: float
    """The gap between a dovetail and its socket, on each side, in mm."""
    notes: tuple[str, ...]


def split_block(
    block: Manifold,
    openings: Sequence[Opening],
    bed: tuple[float, float],
    play: float,
    feet: Sequence[CrossSection] = (),
) -> Split | None:
    """Splits a block that is larger than a bed.

    Args:
        block: the block in mm, with its lower corner at the origin.
        openings: the block's recesses.
        bed: the sides of the bed, in mm; pieces may be turned by 90 degrees.
        play: see `Split.play`.
        feet: see `choose_cuts`.

    Returns:
        The pieces, or None if the block fits the bed.

    Raises:
        UserError: the bed is too small, or all cuts that were tried leave a thin wall.
    """
    length, width, height = block.bounding_box()[3:]
    if fits((length, width), bed):
        return None
    named = f"--bed {bed[0]:g} {bed[1]:g}"
    if min(bed) < 4 * TAB_REACH or length * width > _MOST_PIECES * bed[0] * bed[1]:
        raise UserError(
            f"{named} is too small for a block of {length:g} by {width:g} mm: make a smaller block"
        )
    notes = []
    cuts = choose_cuts((length, width), openings, bed, feet)
    if cuts is None and feet:
        # Try again, but allow thin walls on the upper slopes of the feet (not lower down).
        cuts = choose_cuts((length, width), openings, bed, feet[:_UPRIGHT])
        notes.append("cuts beside feet leave thin edges on the slopes of the feet: trim them")
    if cuts is None:
        raise UserError(
            f"{named}: each cut that was tried leaves a wall thinner than {LEAST_WALL:g} mm: use a "
            "larger --wall_mm or another bed"
        )
    joints = choose_joints(cuts.lines, cuts.regions, openings, height, feet)
    bodies = [block ^ _prism(region, 0.0, height) for region in cuts.regions]
    for joint in joints:
        whole = joint.height >= height
        dovetail = _prism(joint.outline, 0.0, joint.height + _BEYOND * whole)
        socket = _prism(
            joint.outline.offset(play, JoinType.Miter),
            0.0,
            joint.height + (_BEYOND if whole else play),
        )
        bodies[joint.owner] += block ^ dovetail
        bodies[joint.other] -= socket
    pieces = tuple(
        Piece(i + 1, body, region)
        for i, (body, region) in enumerate(zip(bodies, cuts.regions, strict=True))
    )
    too_large = [piece for piece in pieces if not fits(tuple(piece.size[:2]), bed)]
    assert not too_large, "the cuts' windows leave room for the dovetails"
    return Split(pieces, tuple(joints), play, (*notes, *_notes(pieces, joints)))


def fits(size: tuple[float, ...], bed: tuple[float, float]) -> bool:
    """Whether a rectangle fits a bed, as it is or turned by 90 degrees."""
    (a, b), (room_a, room_b) = size, bed
    tiny = 1e-6
    return (a <= room_a + tiny and b <= room_b + tiny) or (
        a <= room_b + tiny and b <= room_a + tiny
    )


def _prism(outline: CrossSection, low: float, high: float) -> Manifold:
    return Manifold.extrude(outline, high - low + _BEYOND).translate((0, 0, low - _BEYOND))


def _notes(pieces: Sequence[Piece], joints: Sequence[Joint]) -> list[str]:
    """Returns a sentence for each pair of neighbouring pieces without a dovetail."""
    joined = {(joint.owner, joint.other) for joint in joints}
    notes = []
    for i, one in enumerate(pieces):
        grown = one.region.offset(0.01, JoinType.Miter)
        for j in range(i + 1, len(pieces)):
            shared = (grown ^ pieces[j].region).area() / 0.01
            if shared > 25.0 and (i, j) not in joined:
                notes.append(
                    f"pieces {i + 1} and {j + 1} have no room for a dovetail: glue them, or use a "
                    "larger --wall_mm"
                )
    return notes
