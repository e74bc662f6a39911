import numpy as np
import pytest

from systems.signals import Observation, PixelGrid, PlanarPose
from systems.surface_heights import read_surface_heights

GRID = PixelGrid(z_min=-0.1)
PICK, PLACE = PlanarPose(0.40, 0.20), PlanarPose(0.60, -0.20)


def observation(*boxes: tuple[PlanarPose, float, float]) -> Observation:
    """Boxes by their middle, half their side and their height above the world's origin."""
    image = np.zeros((4, *GRID.shape), np.float32)
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
    assert found.highest == pytest.approx(0.03, abs=1e-6)
