import math

import numpy as np
import pytest

from kitting_drake.common.errors import UserError
from kitting_drake.tasks.footprints import Footprint, disc, draw_poses, rectangle, separation
from systems.grasp import Grasp
from systems.signals import PixelGrid


def test_separation_is_the_gap_between_polygons():
    square = rectangle(0.02, 0.02)
    assert separation(square, rectangle(0.04, 0.02, x=0.05)) == pytest.approx(0.02)
    assert separation(square, rectangle(0.02, 0.02, x=0.015)) == pytest.approx(-0.005)
    # A corner of the diamond is opposite a side of the square.
    diamond = rectangle(0.02, 0.02, x=0.03, theta=math.pi / 4)
    assert separation(square, diamond) == pytest.approx(0.02 - 0.01 * math.sqrt(2))
    # Two corners that face each other are 14 mm apart, but their separation is only 10 mm.
    assert separation(square, rectangle(0.02, 0.02, x=0.03, y=0.03)) == pytest.approx(0.01)


def test_a_polygon_contains_its_disc():
    corners = disc(0.05)
    middles = (corners + np.roll(corners, 1, axis=0)) / 2
    np.testing.assert_allclose(np.linalg.norm(middles, axis=1), 0.05)


def test_the_hand_needs_free_space_at_a_grasp():
    """The open jaws are 133 mm wide and close along y."""
    grasped = Footprint(
        (rectangle(0.04, 0.04),), (Grasp(0.0, 0.0, 0.0, width=0.04, surface_height=0.04),)
    ).moved(0, 0, 0)
    along, across = (
        Footprint((rectangle(0.02, 0.02),)).moved(*at, 0) for at in ((0, 0.05), (0.05, 0))
    )
    assert not grasped.is_clear_of(along, 0.01)
    assert not along.is_clear_of(grasped, 0.01)
    assert grasped.is_clear_of(across, 0.01)
    assert not grasped.is_clear_of(across, 0.03)
    # The palm is 209 mm wide, so a tall object needs more distance.
    beside = ((rectangle(0.02, 0.02),), (), True)
    assert grasped.is_clear_of(Footprint(*beside[:2]).moved(0, 0.09, 0), 0.01)
    assert not grasped.is_clear_of(Footprint(*beside).moved(0, 0.09, 0), 0.01)


def test_a_workspace_without_free_space_raises():
    footprints = [Footprint((rectangle(0.1, 0.1),))] * 3
    with pytest.raises(UserError, match=r"no free space .* 3 objects"):
        draw_poses(footprints, grid=PixelGrid(rows=40, cols=80), rng=np.random.default_rng(0))
    # No part of this workspace is on the table.
    with pytest.raises(UserError, match="no free space"):
        draw_poses(footprints, grid=PixelGrid(x_min=2.0), rng=np.random.default_rng(0))
