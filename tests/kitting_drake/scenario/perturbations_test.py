from pathlib import Path

import pytest

from kitting_drake.common.errors import UserError
from kitting_drake.common.paths import SCENARIOS
from kitting_drake.scenario.appearance import Drawn, Fixed
from kitting_drake.scenario.description import describe
from kitting_drake.scenario.loader import load_scenario
from kitting_drake.scenario.perturbations import LEVELS, NAMES, perturbation
from kitting_drake.scenario.schema import Scenario
from kitting_drake.tasks import Kitting

KITTING = SCENARIOS / "paper/kitting_unseen.yaml"


@pytest.mark.parametrize("name", NAMES)
def test_every_level_gives_a_different_scenario(name: str):
    seen = [describe(load_scenario(KITTING, perturb=f"{name}:{level}")) for level in LEVELS]
    assert describe(load_scenario(KITTING)) not in seen
    assert all(one != other for i, one in enumerate(seen) for other in seen[:i])
    assert describe(load_scenario(KITTING, perturb=name)) == seen[1]


def test_values_of_the_moderate_level():
    scenario = load_scenario(KITTING, perturb="all")
    noise = scenario.sensor_noise
    assert (noise.depth_std, noise.hole_share) == (0.002, 0.03)
    assert (noise.rig_position_error, noise.rig_angle_error_deg) == pytest.approx((0.003, 0.3))
    assert (scenario.variation.friction, scenario.variation.mass) == (0.3, 0.3)
    assert scenario.task.distractors == 4
    assert scenario.appearance.paints == {"*": Drawn()}


def test_perturbations_combine_and_scenario_text_wins():
    text = "{sensor_noise: {hole_share: 0.2}}"
    noise = load_scenario(KITTING, None, text, "depth_noise:mild,depth_holes").sensor_noise
    assert (noise.depth_std, noise.steepest_deg, noise.hole_share) == (0.001, 80.0, 0.2)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("fog", "unknown name 'fog'"),
        ("mass:hard", "mass has no level 'hard'"),
        ("mass,mass:mild", "mass is given twice"),
        ("", "unknown name ''"),
    ],
)
def test_invalid_values_are_refused(text: str, message: str):
    with pytest.raises(UserError, match=message):
        load_scenario(KITTING, perturb=text)


def test_a_task_without_distractors(tmp_path: Path):
    ravens = SCENARIOS / "ravens.yaml"
    with pytest.raises(UserError, match="distractors does not apply to the task !BlockInsertion"):
        load_scenario(ravens, "BlockInsertion", perturb="distractors")
    # `all` omits perturbations that do not apply.
    assert load_scenario(ravens, "BlockInsertion", perturb="all").variation.mass == 0.3


def test_colours_that_define_a_task_are_not_perturbed():
    """In one task red cubes go into green bowls, in the other the colours tell the cubes apart."""
    ravens = SCENARIOS / "ravens.yaml"
    for name in ("PlaceRedInGreen", "StackBlockPyramid"):
        perturbed = load_scenario(ravens, name, perturb="all:severe")
        assert perturbed.appearance.paints == load_scenario(ravens, name).appearance.paints
        assert perturbed.variation.mass == 0.5
        with pytest.raises(UserError, match=f"colour does not apply to the task !{name}"):
            load_scenario(ravens, name, perturb="colour")
    assert load_scenario(ravens, "PlaceRedInGreen", perturb="all").task.distractors == 10


def test_worse_values_of_the_scenario_are_kept(tmp_path: Path):
    crowded = load_scenario(KITTING, None, None, "distractors:severe")
    assert perturbation("distractors:mild", crowded) == {"task": {"distractors": 8}}
    path = tmp_path / "measured.yaml"
    path.write_text(
        "Mine:\n"
        "  sensor_noise: {depth_std: 0.003, steepest_deg: 75.0}\n"
        "  variation: {mass: 0.2}\n"
        "  appearance: {drawn_lights: 0.5}\n"
    )
    for level, expected in (("mild", (0.003, 75, 0.2, 0.5)), ("severe", (0.004, 70, 0.5, 0.9))):
        scenario = load_scenario(path, None, None, f"all:{level}")
        noise, appearance = scenario.sensor_noise, scenario.appearance
        found = (noise.depth_std, noise.steepest_deg, scenario.variation.mass)
        assert (*found, appearance.drawn_lights) == expected


@pytest.mark.parametrize("level", LEVELS)
def test_colours_are_drawn_over_a_scenarios_own_paints(tmp_path: Path, level: str):
    path = tmp_path / "mine.yaml"
    path.write_text(
        "Mine: {appearance: {paints: {'*': !Fixed {rgb: [1, 0, 0]}, 'fixtures/*': !Fixed {}, "
        "'objects/*': !Fixed {rgb: [0, 1, 0]}}}}"
    )
    paints = load_scenario(path, None, None, f"colour:{level}").appearance.paints
    drawn = [name for name, paint in paints.items() if isinstance(paint, Drawn)]
    # The random paints come last, so that they win over those of the scenario.
    assert list(paints)[-len(drawn) :] == drawn
    assert drawn == (["*", "fixtures/*"] if level == "severe" else ["*"])
    assert paints["objects/*"] == Fixed(rgb=[0, 1, 0])


def test_by_default_nothing_is_perturbed():
    scenario = Scenario()
    assert scenario.sensor_noise.is_none
    assert not scenario.appearance.paints
    assert Kitting().distractors == 0
