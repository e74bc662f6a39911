import math

import numpy as np
import pytest

from kitting_drake.policies.data import samples
from kitting_drake.policies.data.demonstrations import Demonstration
from kitting_drake.policies.data.recorded import DemonstrationStep, FinalObservation, record
from kitting_drake.policies.data.samples import (
    HeightsOnly,
    ObservedScene,
    final_observations,
    labelled_images,
    scenes,
)
from kitting_drake.policies.training.normalisation import normalisation
from systems.signals import Observation, PickPlaceAction, PixelGrid, PlanarPose

GRID = PixelGrid(x_min=0.3, y_min=-0.2, resolution=0.01, rows=20, cols=30)
THETAS = (0.5, -2.0, 3.0)
ROTATION = 1.25


def demonstration(seed: int, steps: int) -> Demonstration:
    """A demonstration whose step i moves the object at pixel (i, 2 i) to pixel (10 + i, 3)."""
    taken = []
    for i in range(steps):
        pick, place = GRID.to_world((i, 2 * i)), GRID.to_world((10 + i, 3))
        image = np.full((4, *GRID.shape), (seed + i) / 100, np.float32)
        action = PickPlaceAction(
            PlanarPose(*pick, THETAS[i]), PlanarPose(*place, THETAS[i] + ROTATION)
        )
        taken.append(DemonstrationStep.of(Observation(image, GRID), action, name="a", category="b"))
    final = FinalObservation.of(Observation(np.full((4, *GRID.shape), 0.5, np.float32), GRID))
    return Demonstration(seed, 1.0, tuple(taken), final if steps > 1 else None)


@pytest.fixture
def observed() -> list[ObservedScene]:
    items = [demonstration(10, 3), demonstration(20, 1)]
    return scenes(items, GRID, later_picks_possible=True)


def test_later_picks_are_labels_of_earlier_observations(observed: list[ObservedScene]):
    assert [len(scene.targets) for scene in observed] == [3, 2, 1, 1]
    for index, scene in enumerate(observed[:3]):
        for i, target in enumerate(scene.targets, start=index):
            np.testing.assert_array_equal(target.image, scene.observation.image)
            np.testing.assert_allclose(target.pick, (i, 2 * i), atol=1e-9)
            np.testing.assert_allclose(target.place, (10 + i, 3), atol=1e-9)
            assert target.pick_theta == THETAS[i]
            assert target.rotation == pytest.approx(ROTATION)
    # The images of the four scenes are those of four different observations.
    heights = [scene.recorded.height[0, 0] for scene in observed]
    assert heights == pytest.approx([0.10, 0.11, 0.12, 0.20])


def test_without_later_picks_only_the_taken_pick_is_a_label():
    items = [demonstration(10, 3), demonstration(20, 1)]
    observed = scenes(items, GRID, later_picks_possible=False)
    assert [len(scene.targets) for scene in observed] == [1, 1, 1, 1]
    np.testing.assert_allclose(observed[1].targets[0].pick, (1, 2), atol=1e-9)
    samples = labelled_images(observed, taken_only=False)
    assert [len(sample.other_picks) for sample in samples] == [0, 0, 0, 0]


def test_final_observations_come_from_episodes_that_the_expert_ended():
    (final,) = final_observations([demonstration(10, 3), demonstration(20, 1)])
    assert final.height[0, 0] == 0.5


def test_taken_only_gives_one_sample_per_observation(observed: list[ObservedScene]):
    samples = labelled_images(observed, taken_only=True)
    assert [tuple(np.rint(sample.pick)) for sample in samples] == [(0, 0), (1, 2), (2, 4), (0, 0)]
    assert all(sample.other_picks.shape == (0, 2) for sample in samples)


def test_a_sample_of_an_action_includes_the_other_picks(observed: list[ObservedScene]):
    samples = labelled_images(observed, taken_only=False)
    assert len(samples) == 3 + 2 + 1 + 1
    second = samples[1]
    np.testing.assert_allclose(second.pick, (1, 2), atol=1e-9)
    np.testing.assert_allclose(second.other_picks, [(0, 0), (2, 4)], atol=1e-9)
    np.testing.assert_array_equal(second.other_thetas, [THETAS[0], THETAS[2]])
    assert samples[-1].other_picks.shape == (0, 2)
    assert samples[-1].other_thetas.shape == (0,)


def test_inputs_are_normalised_over_all_observations(observed: list[ObservedScene]):
    found = normalisation(observed)
    levels = np.array([0.10, 0.11, 0.12, 0.20])
    assert found["height_mean"] == pytest.approx(levels.mean(), rel=1e-5)
    assert found["height_std"] == pytest.approx(levels.std(), rel=1e-5)
    # Demonstrations store 8-bit colours.
    levels = np.rint(255 * levels) / 255
    assert found["colour_mean"] == pytest.approx(levels.mean(), rel=1e-5)
    assert found["colour_std"] == pytest.approx(levels.std(), rel=1e-5)


def test_constant_inputs_do_not_divide_by_zero():
    grid = PixelGrid(rows=5, cols=5)
    blank = record(Observation(np.zeros((4, 5, 5), np.float32), grid))
    found = normalisation([ObservedScene(blank, (), grid)])
    assert (found["colour_mean"], found["height_mean"]) == (0, 0)
    assert math.isfinite(1 / found["colour_std"])
    assert math.isfinite(1 / found["height_std"])


def with_a_hole() -> np.ndarray:
    """An image of a 20 mm high plate on a table, all in grey; one pixel of the plate is unseen."""
    image = np.full((4, *GRID.shape), 0.5, np.float32)
    image[3] = 0.0
    image[3, 5:12, 5:12] = 0.02
    image[:, 8, 8] = 0.0
    return image


def test_networks_without_colours_learn_from_the_inputs_of_inference():
    whole = with_a_hole()
    recorded = FinalObservation.of(Observation(whole, GRID))
    shown = HeightsOnly(recorded).image
    expected = whole[3].copy()
    expected[8, 8] = 0.02
    np.testing.assert_array_equal(shown[3], expected)
    assert not shown[:3].any()
    action = PickPlaceAction(PlanarPose(*GRID.to_world((6, 6)), 0.0), PlanarPose())
    (sample,) = labelled_images(
        [ObservedScene(HeightsOnly(recorded), (action,), GRID)], taken_only=True
    )
    np.testing.assert_array_equal(sample.image, shown)


def test_a_black_image_has_no_unseen_pixels():
    """Black pixels at height zero are the table, which must not be filled in as if unseen."""
    assert not samples.observed(with_a_hole(), GRID).valid[8, 8]
    black = with_a_hole()
    black[:3] = 0.0
    assert samples.observed(black, GRID).valid.all()
    assert ObservedScene(
        HeightsOnly(FinalObservation.of(Observation(black, GRID))), (), GRID
    ).observation.valid.all()
