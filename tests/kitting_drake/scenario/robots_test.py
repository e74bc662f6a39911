from pathlib import Path

import pytest

from kitting_drake.common.errors import UserError
from kitting_drake.scenario import Scenario, load_scenario
from kitting_drake.scenario.robots import FloatingHand, FrankaArm

FILE = Path(__file__).parent / "test_scenarios.yaml"


def load(robot: str) -> Scenario:
    return load_scenario(FILE, "Defaults", text=f"robot: {robot}")


def test_the_default_is_the_floating_hand():
    assert load_scenario(FILE, "Defaults").robot == FloatingHand()


def test_untagged_fields_keep_the_robot():
    scenario = load_scenario(FILE, "OneOfEverything", text="robot: {yaw_deg: 9.0}")
    assert isinstance(scenario.robot, FrankaArm)
    assert (scenario.robot.model, scenario.robot.yaw_deg) == ("panda", 9.0)


@pytest.mark.parametrize(
    ("robot", "message"),
    [
        ("!FrankaArm {model: ur5}", "robot.model is 'ur5', an unknown arm: use fr3 or panda"),
        ("!FrankaArm {base: [0.5, 0.0, 0.0]}", "the arm's foot stands in the workspace"),
        ("!FrankaArm {base: [0.2, 0.0, 0.0]}", "the arm's foot stands in the workspace"),
        ("!FrankaArm {base: [0.1, 0.0, -0.05]}", "inside the table"),
        ("!FrankaArm {base: [0.1, 0.0]}", "robot.base must hold 3 numbers"),
        ("!FrankaArm {stiffness: [1, 2, 3, 4, 5, 6, -7]}", "robot.stiffness must be between"),
        ("!FrankaArm {gains: 3}", "robot.gains is an unknown field"),
        ("!Crane {}", "robot has the unknown tag !Crane"),
    ],
)
def test_invalid_robots(robot: str, message: str):
    with pytest.raises(UserError) as raised:
        load(robot)
    assert message in str(raised.value)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize(
    "base", ["[0.1, 0, 0]", "[0.16, 0, 0.1]", "[-0.3, 0, -0.3]", "[0.5, -0.6, 0]"]
)
def test_valid_bases(base: str):
    assert load(f"!FrankaArm {{base: {base}}}")
