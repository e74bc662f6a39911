"""Objects and recesses in noisy heights."""

import numpy as np
import pytest
from scipy import ndimage

from kitting_drake.policies.matching.regions.segmentation import segment
from systems.signals import Observation, PixelGrid

GRID = PixelGrid()
FLAT = (slice(40, 44), slice(30, 80))
"""The pixels of a flat object on the table."""
CAVITY = (slice(70, 74), slice(210, 260))
"""The pixels of the object's cavity."""


@pytest.mark.parametrize("noise", [0.0, pytest.param(0.001, marks=pytest.mark.slow), 0.002])
@pytest.mark.parametrize("height", [0.008, 0.02])
def test_flat_objects_and_cavities_are_whole_in_noise(noise: float, height: float):
    """Noise must not cut off a region's ends, which show which way round an object lies."""
    true = np.zeros(GRID.shape)
    true[50:130, 190:280] = 0.05
    true[FLAT], true[CAVITY] = height, 0.05 - height
    for seed in range(5):
        field = ndimage.gaussian_filter(np.random.default_rng(seed).normal(size=GRID.shape), 0.7)
        image = np.full((4, *GRID.shape), 0.5, np.float32)
        image[3] = np.maximum(true + noise * field / field.std(), 0)
        found = segment(Observation(image, GRID))
        for regions, region in ((found.objects, FLAT), (found.recesses, CAVITY)):
            whole = np.zeros(GRID.shape, bool)
            whole[region] = True
            assert len(regions) == 1
            share = (regions[0].mask & whole).sum() / (regions[0].mask | whole).sum()
            assert share > (0.8 if noise else 0.99)
        assert not found.protruding


def test_parts_of_one_square_centimetre_are_seen_and_noise_is_not():
    for resolution, noise, expected in ((0.0015, 0.0, 1), (0.0015, 0.001, 1), (0.003125, 0.0, 1)):
        grid = PixelGrid(resolution=resolution)
        side = round(0.0105 / resolution)
        true = np.zeros(grid.shape)
        true[50:130, 190:280] = 0.05
        true[30 : 30 + side, 60 : 60 + side] = 0.01
        for seed in range(3):
            field = np.random.default_rng(seed).normal(size=grid.shape)
            field = ndimage.gaussian_filter(field, 0.7)
            image = np.full((4, *grid.shape), 0.5, np.float32)
            image[3] = np.maximum(true + noise * field / field.std(), 0)
            assert len(segment(Observation(image, grid)).objects) == expected


def test_a_shallow_recess_does_not_tilt_the_top_of_its_fixture():
    """A recess 3.5 mm deep on one side of the block lies within the band in which the top is
    fitted."""
    height = np.zeros(GRID.shape, np.float32)
    height[40:100, 40:120] = 0.05
    height[52:88, 45:70] = 0.0465
    height[60:80, 90:110] = 0.03
    image = np.full((4, *GRID.shape), 0.5, np.float32)
    image[3] = height
    found = segment(Observation(image, GRID))
    depths = sorted(item.height for item in found.free_recesses)
    assert depths == pytest.approx([0.0035, 0.02], abs=2e-4)
    assert np.abs(found.depth[52:88, 45:70] - 0.0035).max() < 3e-4


def test_a_strip_of_a_block_at_the_border_is_no_object():
    """The corner of a block that leaves the image is not within the convex hull of its plateau."""
    rows, cols = np.indices(GRID.shape)
    height = np.where((rows > 100) & (cols > 60) & (cols < 150), 0.05, 0.0).astype(np.float32)
    height[110:140, 80:100] = 0.03
    # Near the border the measured height falls.
    height[-3:, 60:100] = np.where(height[-3:, 60:100] > 0, 0.0462, 0.0)
    height[-3:, 100:150] = 0.0
    height[20:40, 200:240] = 0.02
    image = np.full((4, *GRID.shape), 0.5, np.float32)
    image[3] = height
    assert [round(item.height, 3) for item in segment(Observation(image, GRID)).objects] == [0.02]
