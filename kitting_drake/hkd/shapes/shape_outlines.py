"""The outlines of the project's twenty flat shapes, in mm.

All are 45 to 75 mm long along x and along y, like the shapes of Ravens' assembling-kits task. Their
features are wide enough to be seen in the observation o_t. Their notches are wide enough for the
cavities to follow them.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from manifold3d import CrossSection, JoinType

from kitting_drake.hkd.tools.symmetry import ORDERS

HEIGHT_MM = 20.0
"""The height of the shapes, in mm."""
ROUND = ORDERS[0]
"""The order of symmetry of a shape that looks the same at any heading."""

_ARC = 96
"""The number of edges of a full circle."""


@dataclass(frozen=True)
class OutlinedShape:
    """One of the project's flat shapes."""

    name: str
    split: str
    """The split: `train` or `test`."""
    draw: Callable[[], CrossSection]
    """A function that draws the outline, in mm."""
    symmetry: int = 1
    """The order of the rotational symmetry; `ROUND` for any rotation."""


def _disc(radius: float, x: float = 0.0, y: float = 0.0) -> CrossSection:
    return CrossSection.circle(radius, _ARC).translate((x, y))


def _bar(length: float, width: float, x: float = 0.0, y: float = 0.0) -> CrossSection:
    return CrossSection.square((length, width), True).translate((x, y))


def _polygon(*points: tuple[float, float]) -> CrossSection:
    return CrossSection([np.array(points)])


def _rounded(outline: CrossSection, radius: float) -> CrossSection:
    """Rounds the convex corners of an outline."""
    inner = outline.offset(-radius, JoinType.Miter, miter_limit=4.0)
    return inner.offset(radius, JoinType.Round, circular_segments=_ARC)


def _star(points: int, outer: float, inner: float) -> CrossSection:
    """Draws a star with a point toward +y.

    `outer` is the distance of the points from the centre, and `inner` that of the corners between
    them.
    """
    angles = math.pi / 2 + np.arange(2 * points) * math.pi / points
    radii = np.where(np.arange(2 * points) % 2, inner, outer)
    return CrossSection([np.column_stack([radii * np.cos(angles), radii * np.sin(angles)])])


def _regular(sides: int, radius: float) -> CrossSection:
    return _star(sides, radius, radius * math.cos(math.pi / sides))


def _turned(part: CrossSection, count: int) -> CrossSection:
    """Returns the union of a part and its `count` - 1 rotations about the origin."""
    result = CrossSection()
    for step in range(count):
        result += part.rotate(360.0 * step / count)
    return result


def _heart() -> CrossSection:
    lobes = _disc(15.5, -14.0, 10.0) + _disc(15.5, 14.0, 10.0)
    return lobes + _polygon((-25.8, 0.0), (0.0, -28.0), (25.8, 0.0), (0.0, 18.0))


def _crescent() -> CrossSection:
    return _rounded(_disc(30.0) - _disc(24.0, 18.0), 1.5)


def _drop() -> CrossSection:
    return CrossSection.batch_hull([_disc(23.0, -12.0), _disc(2.5, 34.0)])


def _arch() -> CrossSection:
    outer = _disc(30.0, 0.0, -6.0) ^ _bar(80.0, 60.0, 0.0, 24.0)
    return outer + _bar(20.0, 20.0, -20.0, -14.0) + _bar(20.0, 20.0, 20.0, -14.0)


SHAPES = (
    OutlinedShape("disc", "train", lambda: _disc(28.0), ROUND),
    OutlinedShape("ring", "train", lambda: _disc(30.0) - _disc(13.0), ROUND),
    OutlinedShape("triangle", "train", lambda: _regular(3, 34.0), 3),
    OutlinedShape("square", "train", lambda: _rounded(_bar(52.0, 52.0), 5.0), 4),
    OutlinedShape("plus", "train", lambda: _bar(60.0, 22.0) + _bar(22.0, 60.0), 4),
    OutlinedShape("star", "train", lambda: _rounded(_star(5, 33.0, 15.5), 1.0), 5),
    OutlinedShape("hexagon", "train", lambda: _regular(6, 30.0), 6),
    OutlinedShape("cog", "train", lambda: _disc(21.0) + _turned(_bar(15.0, 14.0, 22.5), 5), 5),
    OutlinedShape("stadium", "train", lambda: _rounded(_bar(75.0, 45.0), 22.4), 2),
    OutlinedShape("heart", "train", _heart),
    OutlinedShape(
        "arrow",
        "train",
        lambda: _polygon(
            (36.0, 0.0),
            (4.0, 29.0),
            (4.0, 11.0),
            (-36.0, 11.0),
            (-36.0, -11.0),
            (4.0, -11.0),
            (4.0, -29.0),
        ),
    ),
    OutlinedShape("crescent", "train", _crescent),
    OutlinedShape("letter_t", "train", lambda: _bar(60.0, 20.0, 0.0, 20.0) + _bar(22.0, 60.0)),
    OutlinedShape(
        "letter_l", "train", lambda: _bar(22.0, 60.0, -14.0) + _bar(50.0, 21.0, 0.0, -19.5)
    ),
    OutlinedShape("pentagon", "test", lambda: _regular(5, 31.0), 5),
    OutlinedShape("clover", "test", lambda: _disc(10.0) + _turned(_disc(15.0, 17.0), 3), 3),
    OutlinedShape(
        "letter_z",
        "test",
        lambda: _polygon(
            (-32.0, 9.0),
            (-14.0, 9.0),
            (-14.0, -28.0),
            (32.0, -28.0),
            (32.0, -9.0),
            (14.0, -9.0),
            (14.0, 28.0),
            (-32.0, 28.0),
        ),
        2,
    ),
    OutlinedShape(
        "letter_y",
        "test",
        lambda: (
            _bar(22.0, 30.0, 0.0, -15.0)
            + _bar(20.0, 36.0, 0.0, 16.0).rotate(50.0)
            + _bar(20.0, 36.0, 0.0, 16.0).rotate(-50.0)
        ),
    ),
    OutlinedShape("drop", "test", _drop),
    OutlinedShape("arch", "test", _arch),
)
"""Fourteen shapes for training and six for tests."""
