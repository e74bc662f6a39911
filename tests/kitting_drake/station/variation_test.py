import numpy as np
import pytest
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph
from pydrake.systems.framework import DiagramBuilder

from kitting_drake.common.paths import SCENARIOS
from kitting_drake.scenario.schema import Variation
from kitting_drake.station.plant import add_models
from kitting_drake.tasks import StackBlockPyramid
from kitting_drake.tasks.task import Scene
from systems.signals import PixelGrid

SPREAD = 0.3
OTHER_STREAMS = [stream for stream in range(20) if stream != 13]
"""Masses use the random stream [seed, 13]. These are the second numbers of the other streams.

Scenes use [seed] and [seed, 1] to [seed, 3]; colours, lights and cameras use others. NumPy pads
seeds with zeros, so [seed, 0] equals [seed]."""


@pytest.fixture(scope="module")
def scene() -> Scene:
    return StackBlockPyramid().make_scene(grid=PixelGrid(), seed=0, base=SCENARIOS)


def mass_factors(scene: Scene, seed: int, spread: float = SPREAD) -> np.ndarray:
    """The factors by which variation changes the objects' masses, which are 10 g without it."""
    plant, _ = AddMultibodyPlantSceneGraph(DiagramBuilder(), time_step=0.01)
    objects, _ = add_models(plant, scene, Variation(mass=spread), seed)
    masses = [plant.get_body(item.body).default_mass() for item in objects]
    return np.array(masses) / 0.01


def test_masses_vary_with_the_seed_only(scene: Scene):
    np.testing.assert_allclose(mass_factors(scene, 5, spread=0.0), 1.0, rtol=1e-12)
    first, other = mass_factors(scene, 5), mass_factors(scene, 6)
    np.testing.assert_array_equal(mass_factors(scene, 5), first)
    assert (np.abs(first - other) > 1e-6).all()
    assert (np.abs(first - 1) <= SPREAD).all()


def test_masses_have_their_own_random_stream(scene: Scene):
    seed = 5
    drawn = (mass_factors(scene, seed) - 1) / SPREAD
    for stream in OTHER_STREAMS:
        numbers = np.random.default_rng([seed, stream]).uniform(-1, 1, 100)
        nearest = np.abs(drawn[:, None] - numbers).min(axis=1)
        assert nearest.max() > 1e-4, f"masses are drawn from stream {stream}"
