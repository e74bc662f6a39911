import math

import numpy as np
import pytest

from systems.jaw_room import object_width
from systems.signals import PixelGrid, PlanarPose

GRID = PixelGrid()
PICK = PlanarPose(0.5, 0.1, 0.0)


def width(*bars: tuple[float, float, float], pick: PlanarPose = PICK, top: float = 0.02) -> float:
    """`object_width` at the pick. Each bar, along x, is (y of its middle, width, height)."""
    y = GRID.to_world(np.stack(np.indices(GRID.shape), -1))[..., 1]
    height = np.zeros(GRID.shape, np.float32)
    for middle, across, tall in bars:
        height[np.abs(y - middle) < across / 2] = tall
    return object_width(height, GRID, pick, 0.0, top)


def test_the_width_is_that_of_the_object_and_at_most_two_pixels_more():
    found = width((0.1, 0.025, 0.02))
    assert 0.025 <= found <= 0.025 + 2.1 * GRID.resolution
    # If the pick is off the middle, the width is twice the distance to the farther side.
    aside = width((0.105, 0.025, 0.02))
    assert 0.035 <= aside <= 0.035 + 2.1 * GRID.resolution
    # At this yaw the jaws close along the bar, whose ends are outside the image.
    assert width((0.1, 0.025, 0.02), pick=PlanarPose(0.5, 0.1, math.pi / 2)) == math.inf


@pytest.mark.parametrize(
    "bars",
    [
        (),
        ((0.1, 0.09, 0.02),),
        # A second bar is where a finger would go down if the jaws were half open.
        ((0.1, 0.025, 0.02), (0.13, 0.01, 0.02)),
    ],
)
def test_otherwise_it_is_unknown(bars: tuple):
    assert width(*bars) == math.inf


def test_what_is_lower_than_the_fingers_does_not_matter():
    assert math.isfinite(width((0.1, 0.025, 0.02), (0.13, 0.01, 0.005)))
