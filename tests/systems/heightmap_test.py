"""o_t from depth images: pixels that are seen, pixels within the view, and levelling."""

import math

import numpy as np
import pytest

from systems.heightmap import DepthRays, View, project
from systems.signals import Observation, PixelGrid, PlanarPose, fill_unseen
from systems.surface_heights import read_surface_heights
from systems.table_plane import find_table

GRID = PixelGrid()
DOWN = np.array([[0.0, -1, 0, 0.5], [-1, 0, 0, 0], [0, 0, -1, 0.9], [0, 0, 0, 1]])


def flat(
    X_WD: np.ndarray = DOWN, *, lowered: float = 0.0, focal: float = 450.0, noise: float = 0.0
) -> View:
    """A camera's view of a level table, `lowered` below z = 0, with a box, 30 mm high, on it."""
    rays = DepthRays.from_pinhole(
        size=(640, 480), focal=(focal, focal), centre=(320, 240), depth_range=(0.01, 10)
    )
    u, v = np.broadcast_arrays(rays.u, rays.v)
    along = np.stack([u, v, np.ones_like(u)], -1) @ X_WD[:3, :3].T
    table = (-lowered - X_WD[2, 3]) / along[..., 2]
    top = (0.03 - lowered - X_WD[2, 3]) / along[..., 2]
    xy = X_WD[:2, 3] + top[..., None] * along[..., :2]
    on_box = (np.abs(xy - (0.45, 0.1)) < 0.05).all(axis=-1)
    depth = np.where(on_box, top, table)
    depth = depth + noise * np.random.default_rng(0).standard_normal(depth.shape)
    return View(None, depth.astype(np.float32), X_WD, rays)


def aslant(
    middle: tuple[float, float],
    kind: str = "box",
    degrees: float = 45,
    height: float = 0.03,
    length: float = 0.08,
) -> View:
    """The view of a camera that looks along +x and down, at an angle to the vertical, from 0.8 m
    away. It sees a box on the table, 60 mm wide, or a pocket of this size in a block."""
    s, c = math.sin(math.radians(degrees)), math.cos(math.radians(degrees))
    X_WD = np.array([[0, -c, s, 0.45 - 0.8 * s], [-1, 0, 0, 0], [0, -s, -c, 0.8 * c], [0, 0, 0, 1]])
    rays = DepthRays.from_pinhole(
        size=(640, 480), focal=(520, 520), centre=(320, 240), depth_range=(0.01, 10)
    )
    u, v = np.broadcast_arrays(rays.u, rays.v)
    along = np.stack([u, v, np.ones_like(u)], -1) @ X_WD[:3, :3].T
    low, high = np.array([*middle, height / 2]) + np.outer((-1, 1), (length / 2, 0.03, height / 2))
    with np.errstate(divide="ignore"):
        ends = np.stack([(end - X_WD[:3, 3]) / along for end in (low, high)])
    enter, leave = ends.min(axis=0).max(axis=-1), ends.max(axis=0).min(axis=-1)
    table, top = ((z - X_WD[2, 3]) / along[..., 2] for z in (0, height))
    if kind == "box":
        depth = np.where(enter < leave, enter, table)
    else:
        # A ray that enters the pocket through its open top leaves it at a wall or at the floor.
        depth = np.where((enter < leave) & (np.abs(enter - top) < 1e-9), leave, top)
    return View(None, depth.astype(np.float32), X_WD, rays)


@pytest.mark.parametrize("kind", ["box", "pocket"])
@pytest.mark.parametrize(("degrees", "height"), [(30, 0.015), (45, 0.01), (60, 0.02)])
def test_an_oblique_camera_sees_outlines_where_they_are(kind: str, degrees: float, height: float):
    away = []
    for middle in np.random.default_rng(0).uniform((0.42, -0.05), (0.48, 0.05), (16, 2)):
        seen = project([aslant((middle[0], middle[1]), kind, degrees, height)], GRID)
        pixels = np.argwhere((seen.outline_height > height / 2) == (kind == "box"))
        offsets = GRID.to_world(pixels) - middle
        away.append(offsets[np.abs(offsets).max(axis=1) < 0.06].mean(axis=0))
    np.testing.assert_allclose(np.mean(away, axis=0), 0, atol=0.0004)


def test_without_edges_an_oblique_camera_shifts_what_it_sees():
    """This is why there are edges."""
    views = [aslant((x, 0.0)) for x in np.linspace(0.42, 0.48, 16)]
    found = [project([view], GRID).filled_height > 0.015 for view in views]
    middles = [GRID.to_world(np.argwhere(mask).mean(axis=0))[0] for mask in found]
    assert np.mean(middles) < 0.45 - 0.0002


def test_a_thin_rod_across_the_view_is_seen():
    for x in np.linspace(0.45, 0.453, 8):
        seen = project([aslant((x, 0.0), height=0.01, length=0.003)], GRID)
        rod = seen.outline_height > 0.003
        assert rod.sum() > 15
        assert seen.outline_valid[rod].mean() > 0.5


def test_a_noisy_table_has_hardly_any_edges():
    view = aslant((0.45, 0.0), height=1e-9)
    noise = 0.001 * np.random.default_rng(0).standard_normal(view.depth.shape)
    seen = project([view._replace(depth=(view.depth + noise).astype(np.float32))], GRID)
    assert (seen.edge_height > 0).mean() < 0.001


def test_edges_follow_the_level_of_the_table_and_the_region_of_interest():
    view = aslant((0.45, 0.0))
    lifted = view.X_WD + np.array([[0.0], [0], [0.006], [0]]) * [0, 0, 0, 1]
    true, seen = (project([view._replace(X_WD=X)], GRID) for X in (view.X_WD, lifted))
    assert seen.table[2] == pytest.approx(0.006, abs=5e-4)
    edges = true.edge_height > 0
    np.testing.assert_allclose(seen.edge_height[edges], true.edge_height[edges], atol=5e-4)
    region = np.ones(GRID.shape, bool)
    region[np.nonzero(edges.any(axis=1))[0][0] :] = False
    assert not project([view], GRID, region).edge_height.any()


def test_outlines_without_known_edges_are_those_of_the_heights():
    seen = project([aslant((0.45, 0.0))], GRID)
    stored = Observation(seen.image, GRID, seen.valid, seen.in_view)
    np.testing.assert_array_equal(stored.outline_height, seen.filled_height)
    np.testing.assert_array_equal(stored.outline_valid, seen.valid)


def test_pixels_outside_all_images_are_out_of_view():
    seen = project([flat(focal=900.0)], GRID)
    assert 0.1 < seen.in_view.mean() < 0.7
    assert seen.valid[seen.in_view].mean() > 0.99
    # A pixel is in view if a camera would see the bare table there. Outside the view, the top of a
    # high box may be visible.
    assert seen.valid[~seen.in_view].mean() < 0.03
    middle = tuple(np.rint(GRID.to_pixel((0.5, 0.0))).astype(int))
    assert seen.in_view[middle]


def test_a_region_of_interest_hides_the_rest():
    region = np.zeros(GRID.shape, bool)
    region[:, :170] = True
    seen = project([flat()], GRID, region)
    assert not seen.valid[:, 170:].any() and not seen.in_view[:, 170:].any()
    assert not seen.image[:, :, 170:].any()


@pytest.mark.parametrize("lowered", [-0.006, 0.005])
def test_a_table_that_is_off_is_levelled(lowered: float):
    true = project([flat()], GRID)
    seen = project([flat(lowered=lowered, noise=0.0005)], GRID)
    assert true.table == (0.0, 0.0, 0.0)
    assert seen.table[2] == pytest.approx(-lowered, abs=5e-4)
    assert np.median(seen.height[seen.height > 0.02]) == pytest.approx(0.03, abs=5e-4)
    # A table that looks lower may really be lower, so the heights for motions are lowered. One that
    # looks higher counts as a calibration error.
    pick = PlanarPose(0.45, 0.1)
    found = read_surface_heights(seen, pick, pick)
    assert found.pick_top == pytest.approx(0.03 - max(lowered, 0.0), abs=2e-3)


def test_a_tilted_camera_is_levelled():
    tilt = np.radians(0.5)
    turn = np.eye(4)
    turn[:3, :3] = [[np.cos(tilt), 0, np.sin(tilt)], [0, 1, 0], [-np.sin(tilt), 0, np.cos(tilt)]]
    view = flat()
    seen = project([view._replace(X_WD=view.X_WD @ turn)], GRID)
    assert np.hypot(*seen.table[:2]) == pytest.approx(tilt * GRID.resolution, rel=0.1)
    assert np.percentile(seen.height[seen.valid], 80) < 0.0005


def test_a_table_far_off_is_not_levelled():
    assert project([flat(lowered=0.015)], GRID).table == (0.0, 0.0, 0.0)
    rough = np.random.default_rng(0).uniform(0, 0.2, GRID.shape).astype(np.float32)
    assert find_table(rough, np.ones(GRID.shape, bool), GRID.resolution) == (0.0, 0.0, 0.0)


def test_what_no_camera_sees_is_not_filled_from_its_border():
    height = np.zeros((40, 60), np.float32)
    height[10:20, 25:30] = 0.05  # An object that ends at the border of the view.
    valid = np.zeros(height.shape, bool)
    valid[:, :30] = True
    height[5:7, 5:7] = np.nan
    valid[5:7, 5:7] = False
    filled = fill_unseen(height, valid, in_view=np.arange(60) < np.full((40, 1), 30))
    assert not filled[:, 30:].any()
    assert not filled[5:7, 5:7].any() and filled[15, 27] == np.float32(0.05)
    # A large hole within the view is filled near its border only.
    assert not fill_unseen(height, valid)[:, 56:].any()


def test_the_shadow_of_an_object_is_table():
    height = np.zeros((30, 40), np.float32)
    height[10:20, 10:20] = 0.02
    valid = np.ones(height.shape, bool)
    valid[10:20, 20:26] = False  # The object's shadow is six pixels wide.
    valid[14:16, 13:15] = False  # Depths are missing on top of the object.
    filled = fill_unseen(np.where(valid, height, 0), valid)
    assert not filled[10:20, 20:26].any()
    np.testing.assert_array_equal(filled[14:16, 13:15], np.float32(0.02))


def test_a_long_shadow_is_table_to_its_end():
    """The shadow is 40 pixels wide, and ends at the border of the image."""
    height = np.zeros((30, 100), np.float32)
    height[5:25, 10:30] = 0.05
    valid = np.ones(height.shape, bool)
    valid[:25, 30:70] = False
    assert not fill_unseen(np.where(valid, height, 0), valid)[:, 30:].any()


def test_the_default_is_that_everything_is_in_view():
    seen = Observation(np.zeros((4, 8, 9), np.float32), PixelGrid(rows=8, cols=9))
    assert seen.in_view.all() and not seen.valid.any()
