"""Grasps of shapes that have no two faces for the jaws."""

import math

import numpy as np
import pytest
from manifold3d import CrossSection, Manifold
from numpy.typing import NDArray

from kitting_drake.hkd.grasps.corners import corner_cost
from kitting_drake.hkd.grasps.proposals import propose_grasps
from kitting_drake.hkd.tools.meshes import vertices_and_faces


def triangles(solid: Manifold) -> NDArray[np.float64]:
    vertices, faces = vertices_and_faces(solid)
    return 1e-3 * vertices[faces]


def star(points: int, outer: float, inner: float) -> Manifold:
    """A prism, 20 mm high, whose base is a star with corners at two radii, in mm."""
    angles = np.arange(2 * points) * math.pi / points
    radii = np.where(np.arange(2 * points) % 2, inner, outer)
    corners = np.column_stack([radii * np.cos(angles), radii * np.sin(angles)])
    return CrossSection([corners]).extrude(20.0)


def polygon(sides: int, radius: float) -> Manifold:
    return star(sides, radius, radius * math.cos(math.pi / sides))


@pytest.mark.parametrize(
    ("solid", "sides", "width"),
    [
        # The jaws hold a corner and the opposite side.
        (polygon(3, 34.0), 3, 0.051),
        pytest.param(
            *(polygon(5, 31.0), 5, 0.031 * (1 + math.cos(math.pi / 5))), marks=pytest.mark.slow
        ),
        # The jaws hold a star by two of its arms, or by a point and the opposite notch.
        (star(5, 30.0, 14.0), 10, None),
    ],
)
def test_a_corner_is_held_against_what_is_opposite(
    solid: Manifold, sides: int, width: float | None
):
    best = propose_grasps(triangles(solid), np.zeros(3))[0]
    assert best.penalties["corner"] > 0
    # The x axis is an axis of symmetry. The jaws close along or across an axis of symmetry.
    line = math.degrees(best.theta) + 90
    assert math.remainder(line, 180 / sides) == pytest.approx(0.0, abs=0.6)
    if width is not None:
        assert best.width == pytest.approx(width, abs=3e-4)


def test_faces_are_preferred_to_corners():
    bar = triangles(Manifold.cube((60, 25, 20), True).translate((0, 0, 10)))
    best = propose_grasps(bar, np.zeros(3), corners=True)[0]
    assert "corner" not in best.penalties
    assert best == propose_grasps(bar, np.zeros(3))[0]


def test_a_corner_beside_the_opposite_face_would_turn():
    columns = 35
    face = np.full((columns, 4), -np.inf)
    corner = np.zeros((columns, 4))
    corner += np.abs(np.arange(columns) - 17)[:, None] * 0.001 + 0.05
    face[:] = 0.0
    assert corner_cost(face, corner, 0.0005, 0.0003) == pytest.approx(0.5)
    # The face touches its pad only beside the corner; opposite the corner, it recedes.
    face[16:] = -0.005
    assert corner_cost(face, corner, 0.0005, 0.0003) is None
    # A tool that tapers toward one end of the pads, and one that tapers too much.
    for slope, cost in ((0.3, 1.1), (0.6, None)):
        taper = np.full((columns, 4), slope * 0.0005) * np.arange(columns)[:, None]
        found = corner_cost(-taper, taper, 0.0005, 0.0003)
        assert found == (cost if cost is None else pytest.approx(cost, abs=0.05))
    # Two corners can be held if they are opposite each other, but not if they are offset.
    assert corner_cost(-corner, corner, 0.0005, 0.0003) == pytest.approx(2.5)
    assert corner_cost(-np.roll(corner, 5, axis=0), corner, 0.0005, 0.0003) is None
