import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph
from pydrake.systems.framework import DiagramBuilder

from kitting_drake.common.errors import UserError
from kitting_drake.common.paths import MODELS, SCENARIOS
from kitting_drake.common.rendering import can_render
from kitting_drake.common.sdformat import model_text
from kitting_drake.scenario.appearance import Appearance
from kitting_drake.scenario.loader import load_scenario
from kitting_drake.station.paint import lights_of
from systems.signals import Observation
from tests.kitting_drake.rig import build_rig

needs_renderer = pytest.mark.skipif(not can_render(), reason="images cannot be rendered here")


def rig_of(text: str, seed: int = 2):
    scenario = load_scenario(SCENARIOS / "kitting_oracle.yaml", None, text)
    return build_rig(scenario, seed=seed, base=SCENARIOS)


def observed(text: str) -> Observation:
    return rig_of(text).port("observation")


@pytest.fixture(scope="module")
def plain() -> Observation:
    """An observation of a scene without paint."""
    return observed("{}")


@needs_renderer
def test_paint_changes_colours_but_not_heights(plain: Observation):
    red = observed('{appearance: {paints: {"*": !Fixed {rgb: [1.0, 0.0, 0.0]}}}}').image
    np.testing.assert_array_equal(red[3], plain.height)
    assert red[1:3].max() == 0
    assert red[0].max() > 0.5


@pytest.mark.slow
@needs_renderer
def test_drawn_colours_depend_on_the_seed(plain: Observation):
    text = '{appearance: {paints: {"table/*": !Drawn {}, "fixtures/*": !Drawn {shared: true}}}}'
    one = observed(text).image
    np.testing.assert_array_equal(one, observed(text).image)
    changed = (one[:3] != plain.rgb).any(axis=0)
    # Most pixels change, but not the tools'.
    assert 0.8 < changed.mean() < 1.0
    np.testing.assert_array_equal(one[3], plain.height)


def test_a_pattern_without_a_match_raises():
    with pytest.raises(UserError, match=r"appearance\.paints: .*tabel/\*"):
        rig_of('{appearance: {paints: {"tabel/*": !Drawn {}}}}')
    with pytest.raises(UserError, match=r"appearance\.sheen\.\*"):
        rig_of('{appearance: {sheen: {"*": 2.0}}}')


@needs_renderer
def test_sheen_makes_holes_on_its_surfaces_only(plain: Observation):
    holed = observed('{appearance: {sheen: {"objects/*": 0.9}}}')
    lost = plain.valid & ~holed.valid
    tools = (plain.height > 0.004) & (plain.height < 0.04)
    assert lost[tools].mean() > 5 * lost[plain.height < 0.001].mean()


def test_drawn_lights_depend_on_the_seed_and_point_down():
    appearance = Appearance(drawn_lights=0.6)
    drawn = [lights_of(appearance, seed) for seed in range(20)]
    assert {len(lights) for lights in drawn} == {1, 2, 3}
    assert all(light.direction[2] < 0 for lights in drawn for light in lights)
    again = lights_of(appearance, 3)
    assert [light.intensity for light in again] == [light.intensity for light in drawn[3]]
    assert lights_of(Appearance(), 0) == []


def test_mass_varies_with_the_seed_within_its_range():
    def masses(text: str, seed: int) -> np.ndarray:
        rig = rig_of(text, seed)
        return (
            np.array([rig.plant.get_body(item.body).default_mass() for item in rig.objects]) / 1.0
        )

    varied = masses("{variation: {mass: 0.3}}", 1)
    factors = varied / masses("{}", 1)
    assert ((factors > 0.7) & (factors < 1.3) & (factors != 1)).all()
    assert len(set(factors.round(9))) == len(factors)
    np.testing.assert_array_equal(masses("{variation: {mass: 0.3}}", 1), varied)


def test_a_models_friction_is_scaled_and_its_meshes_are_found(tmp_path: Path):
    text = model_text(MODELS / "table" / "table.sdf", friction=1.5, mass=1.0)
    assert "mu_dynamic>0.75<" in text
    tool = model_text(MODELS / "tools" / "claw_hammer" / "claw_hammer.sdf", friction=0.5, mass=2.0)
    assert "<mass>0.1805997838</mass>" in tool
    assert "mu_static>0.25<" in tool
    assert f"file://{MODELS / 'tools' / 'claw_hammer' / 'steel.obj'}" in tool
    # Special characters in a folder's name stay as they are, because Drake does not decode URIs.
    folder = tmp_path / "ä b#c%20d"
    shutil.copytree(MODELS / "tools" / "claw_hammer", folder)
    plant, _ = AddMultibodyPlantSceneGraph(DiagramBuilder(), time_step=0.01)
    moved = model_text(folder / "claw_hammer.sdf", friction=0.5, mass=2.0)
    assert Parser(plant).AddModelsFromString(moved, "sdf")
    broken = tmp_path / "broken.sdf"
    broken.write_text("<sdf")
    with pytest.raises(UserError, match=r"broken\.sdf"):
        model_text(broken, friction=0.5)


def test_the_text_of_an_unvaried_model_is_that_of_its_file(tmp_path: Path):
    hammer = MODELS / "tools" / "claw_hammer" / "claw_hammer.sdf"
    numbers = re.findall(r"<(mass|ixx|pose|size)>([^<]*)<", hammer.read_text())
    text = model_text(hammer)
    assert text is not None
    assert re.findall(r"<(mass|ixx|pose|size)>([^<]*)<", text) == numbers
    # For a damaged SDFormat file, one that includes another, and a URDF, no text is returned. Drake
    # then reads the file itself.
    other = tmp_path / "other.sdf"
    for content in ("<sdf", "<sdf><include><uri>hammer.sdf</uri></include></sdf>"):
        other.write_text(content)
        assert model_text(other) is None
    assert model_text(tmp_path / "other.urdf") is None
