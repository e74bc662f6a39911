import numpy as np

from kitting_drake.policies.matching.regions.lone_pixels import without_lone_pixels


def test_a_flying_pixel_beside_a_block_disappears():
    block = np.zeros((20, 20), np.float32)
    block[6:14, 6:14] = 0.02
    seen = block.copy()
    seen[5, 9], seen[8, 14], seen[13, 13] = 0.011, 0.006, 0.013
    cleaned = without_lone_pixels(seen)
    # At a corner, most neighbours are the table.
    block[13, 13] = 0
    np.testing.assert_array_equal(cleaned, block)
    assert seen[5, 9] == np.float32(0.011)


def test_a_slender_tool_on_a_rough_table_stays():
    rough = np.random.default_rng(0).normal(0, 0.0005, (20, 30)).astype(np.float32)
    rough[10, 3:27] += 0.01
    np.testing.assert_array_equal(without_lone_pixels(rough)[10, 4:26], rough[10, 4:26])


def test_an_incline_stays():
    incline = np.arange(30, dtype=np.float32)[:, None] * 0.006 + np.zeros((30, 20), np.float32)
    np.testing.assert_array_equal(without_lone_pixels(incline), incline)
