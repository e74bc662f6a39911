import math

import numpy as np
import pytest

from kitting_drake.policies.demonstrations import Demonstration, DemonstrationStep
from kitting_drake.policies.samples import Scene, labelled_images, normalisation, scenes
from systems.signals import Observation, PickPlaceAction, PixelGrid, PlanarPose

GRID = PixelGrid(x_min=0.3, y_min=-0.2, resolution=0.01, rows=20, cols=30)
THETAS = (0.5, -2.0, 3.0)
TURN = 1.25


def demonstration(seed: int, steps: int) -> Demonstration:
    """Of step i the object lies at pixel (i, 2 i) and belongs at (10 + i, 3)."""
    taken = []
    for i in range(steps):
        pick, place = GRID.to_world((i, 2 * i)), GRID.to_world((10 + i, 3))
        image = np.full((4, *GRID.shape), (seed + i) / 100, np.float32)
        action = PickPlaceAction(PlanarPose(*pick, THETAS[i]), PlanarPose(*place, THETAS[i] + TURN))
        taken.append(DemonstrationStep.of(Observation(image, GRID), action, name="a", category="b"))
    return Demonstration(seed, 1.0, tuple(taken))


@pytest.fixture
def observed() -> list[Scene]:
    return scenes([demonstration(10, 3), demonstration(20, 1)], GRID)


def test_what_was_picked_later_might_have_been_picked_at_once(observed: list[Scene]):
    assert [len(scene.targets) for scene in observed] == [3, 2, 1, 1]
    for index, scene in enumerate(observed[:3]):
        for i, target in enumerate(scene.targets, start=index):
            assert target.image is scene.image
            np.testing.assert_allclose(target.pick, (i, 2 * i), atol=1e-9)
            np.testing.assert_allclose(target.place, (10 + i, 3), atol=1e-9)
            assert target.pick_theta == THETAS[i]
            assert target.turn == pytest.approx(TURN)
    # Each with what was seen then: nothing that had gone is picked.
    assert [scene.image[3, 0, 0] for scene in observed] == pytest.approx([0.10, 0.11, 0.12, 0.20])


def test_as_the_paper_one_sample_for_each_observation(observed: list[Scene]):
    samples = labelled_images(observed, taken_only=True)
    assert [tuple(np.rint(sample.pick)) for sample in samples] == [(0, 0), (1, 2), (2, 4), (0, 0)]
    assert all(sample.other_picks.shape == (0, 2) for sample in samples)


def test_a_sample_for_each_possible_action_knows_of_the_others(observed: list[Scene]):
    samples = labelled_images(observed, taken_only=False)
    assert len(samples) == 3 + 2 + 1 + 1
    second = samples[1]
    np.testing.assert_allclose(second.pick, (1, 2), atol=1e-9)
    np.testing.assert_allclose(second.other_picks, [(0, 0), (2, 4)], atol=1e-9)
    np.testing.assert_array_equal(second.other_thetas, [THETAS[0], THETAS[2]])
    assert samples[-1].other_picks.shape == (0, 2)
    assert samples[-1].other_thetas.shape == (0,)


def test_inputs_are_normalised_over_all_that_was_seen(observed: list[Scene]):
    found = normalisation(observed)
    levels = np.array([0.10, 0.11, 0.12, 0.20])
    assert found["height_mean"] == pytest.approx(levels.mean(), rel=1e-5)
    assert found["height_deviation"] == pytest.approx(levels.std(), rel=1e-5)
    # The file holds colours in 8 bits.
    levels = np.rint(255 * levels) / 255
    assert found["colour_mean"] == pytest.approx(levels.mean(), rel=1e-5)
    assert found["colour_deviation"] == pytest.approx(levels.std(), rel=1e-5)


def test_what_is_the_same_everywhere_is_not_divided_by_nothing():
    found = normalisation([Scene(np.zeros((4, 5, 5), np.float32), ())])
    assert (found["colour_mean"], found["height_mean"]) == (0, 0)
    assert math.isfinite(1 / found["colour_deviation"])
    assert math.isfinite(1 / found["height_deviation"])
