"""An object whose two ends look alike in the recess's outline is placed the right way round."""

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from kitting_drake.policies.matching.inventory import Inventory
from systems.signals import Observation, PixelGrid

GRID = PixelGrid()


def driver(row: int, col: int, *, blade_first: bool) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """The masks of a screwdriver's handle (30 by 5 pixels) and of its blade (12 by 1 pixels)."""
    handle, blade = np.zeros(GRID.shape, bool), np.zeros(GRID.shape, bool)
    handle[row - 2 : row + 3, col : col + 30] = True
    first = col - 12 if blade_first else col + 30
    blade[row, first : first + 12] = True
    return handle, blade


@pytest.mark.parametrize("seed", range(3))
def test_a_slot_too_shallow_for_the_recess_s_outline_tells_which_way_round(seed: int):
    height = np.zeros(GRID.shape, np.float32)
    height[20:110, 20:110] = 0.05
    handle, blade = driver(65, 45, blade_first=False)
    height[handle], height[blade] = 0.035, 0.048
    handle, blade = driver(70, 200, blade_first=True)
    height[handle | blade] = 0.012
    noise = np.random.default_rng(seed).normal(0.0, 0.0007, GRID.shape)
    image = np.full((4, *GRID.shape), 0.5, np.float32)
    image[3] = height + noise
    (pair,) = Inventory.of(Observation(image, GRID)).pairs
    assert abs(math.remainder(pair.fit.rotation - math.pi, math.tau)) < math.radians(3)
