import math
from pathlib import Path

import pytest

from kitting_drake.common.errors import UserError
from kitting_drake.real_camera import load_trajectory, read_robot
from systems.arm_kinematics import ArmBase

WHOLE = """
model: panda
base: [0.1, -0.2, 0.05]
yaw_deg: 90
home: [0.4, 0.1, 0.4, 0.2]
joints: [0, -0.2, 0, -2, 0, 1.9, 0.8]
rate: 500
"""


def test_reads_every_field(tmp_path: Path):
    path = tmp_path / "robot.yaml"
    path.write_text(WHOLE)
    robot = read_robot(path)
    assert robot.base == ArmBase(0.1, -0.2, 0.05, math.pi / 2)
    assert robot.home == (0.4, 0.1, 0.4, 0.2)
    assert robot.joints == (0, -0.2, 0, -2, 0, 1.9, 0.8)
    assert (robot.model, robot.rate) == ("panda", 500)
    assert robot.joint_names[0] == "panda_joint1"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("model: ur5", "model must be fr3 or panda, not 'ur5'"),
        ("modle: fr3", "unknown field 'modle': did you mean 'model'"),
        ("base: [100, 0, 0]", r"base is \(100, 0, 0\), but no coordinate"),
        ("base: [0, 0]", "base must hold 3 numbers"),
        ("joints: [0, 0, 0, 0, 0, 0, 0]", r"joints\[3\] is 0, outside of -3.0421 to -0.1518 rad"),
        ("rate: 30", "rate must be a whole number from 200 to 1000 Hz, not 30"),
    ],
)
def test_invalid_fields_are_named(text: str, message: str, tmp_path: Path):
    path = tmp_path / "robot.yaml"
    path.write_text(text)
    with pytest.raises(UserError, match=message):
        read_robot(path)


def test_another_json_is_no_trajectory(tmp_path: Path):
    path = tmp_path / "action.json"
    path.write_text('{"joint_trajectory": {"points": []}}')
    with pytest.raises(UserError, match="is not a trajectory"):
        load_trajectory(path)
