import numpy as np
import pytest

from systems.hand_geometry import PALM_HEIGHT
from systems.motion_heights import motion_heights
from systems.pick_place_parameters import PickPlaceParameters
from systems.signals import Observation, PixelGrid, PlanarPose, SurfaceHeights
from systems.surface_heights import read_surface_heights
from systems.table_plane import level

GRID = PixelGrid(z_min=-0.1)
PICK, PLACE = PlanarPose(0.40, 0.20), PlanarPose(0.60, -0.20)


def observation(*boxes: tuple[PlanarPose, float, float]) -> Observation:
    """An observation of square boxes, given by (middle, half a side, world z of the top)."""
    image = np.full((4, *GRID.shape), 0.5, np.float32)
    image[3] = -GRID.z_min
    for middle, half, height in boxes:
        rows, cols = (
            slice(
                *np.rint(
                    GRID.to_pixel((middle.x, middle.y))[axis]
                    + np.array([-1, 1]) * half / GRID.resolution
                ).astype(int)
            )
            for axis in (0, 1)
        )
        image[3, rows, cols] = height - GRID.z_min
    return Observation(image, GRID)


def test_heights_are_in_the_world():
    box, block = (PICK, 0.01, 0.03), (PlanarPose(0.60, -0.215), 0.01, 0.05)
    found = read_surface_heights(observation(box, block), PICK, PLACE)
    assert found.pick_top == pytest.approx(0.03, abs=1e-6)
    assert found.support == pytest.approx(0.0, abs=1e-6)
    assert found.place_rim == pytest.approx(0.05, abs=1e-6)
    assert found.highest == pytest.approx(0.05, abs=1e-6)
    assert found.table == pytest.approx(0.0, abs=1e-6)


def test_an_object_on_a_tray_stands_on_the_tray():
    found = read_surface_heights(observation((PICK, 0.12, 0.02), (PICK, 0.02, 0.06)), PICK, PLACE)
    assert found.pick_top == pytest.approx(0.06, abs=1e-6)
    assert found.support == pytest.approx(0.02, abs=1e-6)


def test_poses_off_the_grid_have_the_lowest_heights():
    away = PlanarPose(3.0, 0.0)
    found = read_surface_heights(observation((PICK, 0.01, 0.03)), away, away)
    assert (found.pick_top, found.support, found.place_rim) == (GRID.z_min,) * 3
    assert found.place_floor == GRID.z_min
    assert found.highest == pytest.approx(0.03, abs=1e-6)


def on_a_kit(grid: PixelGrid) -> np.ndarray:
    """Heights (rows, cols) of a tool of 20 mm and a block of 50 mm with a cavity at the place."""
    rows, cols = np.indices(grid.shape)
    x, y = np.moveaxis(grid.to_world(np.stack([rows, cols], axis=-1)), -1, 0)
    height = np.zeros(grid.shape)
    height[(np.abs(x - PICK.x) < 0.06) & (np.abs(y - PICK.y) < 0.012)] = 0.02
    height[(np.abs(x - PLACE.x) < 0.1) & (np.abs(y - PLACE.y) < 0.1)] = 0.05
    height[(np.abs(x - PLACE.x) < 0.06) & (np.abs(y - PLACE.y) < 0.008)] = 0.02
    return height


@pytest.mark.parametrize("noise", [0.0, 0.0015])
@pytest.mark.parametrize("off", [0.0, 0.003])
def test_noise_and_calibration_errors_are_corrected(noise: float, off: float):
    """Noise, a tilt of 0.3 degrees and a height error hardly change the result."""
    grid = PixelGrid()
    true = on_a_kit(grid)
    rng = np.random.default_rng(0)
    errors = []
    for _ in range(5):
        tilt = np.tan(np.radians(0.3)) * np.arange(grid.cols) * grid.resolution
        seen = true + noise * rng.standard_normal(grid.shape) + off + (tilt if off else 0)
        image = np.full((4, *grid.shape), 0.5, np.float32)
        above, table = level(seen.astype(np.float32), image[3] > 0, grid.resolution)
        image[3] = np.maximum(above, 0)
        found = read_surface_heights(Observation(image, grid, table=table), PICK, PLACE)
        errors.append([found.pick_top - 0.02, found.place_rim - 0.05, found.place_floor - 0.02])
        # The planner uses this difference to decide whether a lowered object stands on the rim.
        errors[-1].append(found.support - (found.place_rim - 0.05))
        assert (found.doubt > 0) == bool(noise or off)
    assert np.abs(errors).max() < (0.002 if noise else 0.0005)


@pytest.mark.parametrize("noise", [0.0, 0.0015])
def test_unseen_pixels_do_not_count_as_the_table(noise: float):
    """A tool lies on a block. Its shadow, and most pixels where it is picked, are unseen."""
    grid = PixelGrid()
    row, col = np.rint(grid.to_pixel((PLACE.x, PLACE.y))).astype(int)
    height = noise * np.random.default_rng(0).standard_normal(grid.shape)
    height[row - 32 : row + 33, col - 32 : col + 33] += 0.05
    height[row - 10 : row + 11, col - 3 : col + 4] += 0.02
    valid = np.ones(grid.shape, bool)
    valid[row - 1 : row + 2, col - 1 : col + 1] = False
    valid[row - 12 : row + 13, col + 4 : col + 14] = False
    image = np.full((4, *grid.shape), 0.5, np.float32)
    image[3] = np.maximum(height, 0)
    image[:, ~valid] = 0.0
    found = read_surface_heights(Observation(image, grid, valid), PLACE, PICK)
    assert found.pick_top == pytest.approx(0.07, abs=1e-6 + noise)
    assert found.support == pytest.approx(0.05, abs=1e-6 + 2 * noise)


def test_edges_do_not_count_as_noise():
    """On a crowded table half of the pixels are near an edge, but all heights are exact."""
    image = np.full((4, *GRID.shape), 0.5, np.float32)
    image[3] = 0.0
    image[3, ::24] = image[3, 1::24] = 0.012
    image[3, :, ::24] = 0.012
    found = read_surface_heights(Observation(image, GRID), PICK, PLACE)
    assert found.doubt == 0
    assert found.highest == pytest.approx(GRID.z_min + 0.012, abs=1e-6)


def test_a_table_far_above_the_bottom_of_the_grid_is_not_corrected():
    image = np.full((4, *GRID.shape), 0.5, np.float32)
    image[3] = 0.02
    found = read_surface_heights(Observation(image, GRID), PICK, PLACE)
    assert found.table == pytest.approx(GRID.z_min + 0.02, abs=1e-6)
    assert found.doubt == 0


def test_a_lone_high_pixel_is_no_surface():
    seen = observation((PICK, 0.01, 0.03), (PlanarPose(0.60, -0.215), 0.01, 0.05))
    image = seen.image.copy()
    image[3, 70, 160] = 0.106 - GRID.z_min
    row, col = np.rint(GRID.to_pixel((0.60, -0.215))).astype(int)
    image[3, row, col] = 0.250 - GRID.z_min
    found = read_surface_heights(Observation(image, GRID), PICK, PLACE)
    assert found.highest == pytest.approx(0.05, abs=1e-6)
    # Six pixels are a surface.
    image[3, 70:72, 160:163] = 0.106 - GRID.z_min
    found = read_surface_heights(Observation(image, GRID), PICK, PLACE)
    assert found.highest == pytest.approx(0.106, abs=1e-6)


def test_what_is_far_from_the_wrist_is_not_around_it():
    seen = observation((PICK, 0.01, 0.03), (PlanarPose(0.60, -0.215), 0.01, 0.12))
    found = read_surface_heights(seen, PICK, PLACE)
    assert found.around_pick == pytest.approx(0.03, abs=1e-6)
    assert found.around_place == found.highest == pytest.approx(0.12, abs=1e-6)


@pytest.mark.parametrize(
    ("turn", "kit_height", "grips_higher"),
    [(0.0, 0.05, True), (np.pi / 2, 0.05, False), (0.0, 0.07, False)],
)
def test_a_flat_object_beside_a_kit_is_gripped_so_high_that_the_palm_clears_the_kit(
    turn: float, kit_height: float, grips_higher: bool
):
    """The palm reaches 0.1 m to the sides in the direction in which the jaws close. Beside a kit
    that is too high for the palm, a higher grip would be of no use."""
    kit = PlanarPose(PICK.x, PICK.y - 0.14)
    seen = observation((PICK, 0.01, 0.012), (kit, 0.05, kit_height))
    found = read_surface_heights(seen, PlanarPose(PICK.x, PICK.y, turn), PLACE)
    usual = motion_heights(SurfaceHeights(pick_top=0.012), PickPlaceParameters()).grasp
    grasp = motion_heights(found, PickPlaceParameters()).grasp
    assert found.below_palm == pytest.approx(0.012 if turn else kit_height, abs=1e-6)
    assert (grasp > usual + 1e-6) == grips_higher
    assert (grasp + PALM_HEIGHT > kit_height + 0.002) == grips_higher
