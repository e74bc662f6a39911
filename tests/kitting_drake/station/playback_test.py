"""The plant's arm follows a trajectory that is loaded from a file."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from kitting_drake.common.errors import UserError
from kitting_drake.real_camera import load_trajectory, save_trajectory
from kitting_drake.scenario import Scenario
from kitting_drake.scenario.robots import FrankaArm
from kitting_drake.station.playback import play_trajectory
from kitting_drake.station.robot import make_motion
from kitting_drake.tasks import Kitting
from systems.arm_limits import ARM_LIMITS
from systems.arm_trajectory import ArmTrajectory, plan_action
from tests.kitting_drake.rig import build_rig

BASE = Path(__file__).parent
SCENARIO = Scenario(robot=FrankaArm(), task=Kitting(tools=["claw_hammer"]), cameras={})
TRACKED = 0.002
"""The largest deviation of the joints from their commands that the tests allow, in rad."""


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The trajectory file of the oracle's first action in the scene of seed 0."""
    rig = build_rig(SCENARIO, base=BASE)
    action, goal = rig.port("action"), rig.scene.goals[0]
    floor = float(goal.poses[0].translation()[2])
    surfaces = dataclasses.replace(action.heights, place_floor=floor)
    trajectory = plan_action(make_motion(SCENARIO), SCENARIO.planner, action, surfaces)
    assert isinstance(trajectory, ArmTrajectory)
    folder = tmp_path_factory.mktemp("trajectory")
    save_trajectory(folder, trajectory, [f"fr3_joint{i}" for i in range(1, 8)], {})
    loaded = load_trajectory(folder / "trajectory.json")
    np.testing.assert_allclose(loaded.positions, trajectory.positions, atol=1e-9)
    assert (loaded.segments, loaded.jaws) == (trajectory.segments, trajectory.jaws)
    return folder / "trajectory.json"


def start_of(trajectory: ArmTrajectory, mode: str) -> float:
    return next(it.first for it in trajectory.segments if it.mode == mode) / trajectory.rate


def test_the_plant_follows_the_file_and_a_replay_is_equal(file: Path):
    trajectory = load_trajectory(file)
    end = start_of(trajectory, "CLOSE")
    played = play_trajectory(SCENARIO, trajectory, base=BASE, seconds=end)
    # The commanded positions interpolate the planned points.
    for joint in range(7):
        planned = np.interp(played.time, trajectory.times, trajectory.positions[:, joint])
        np.testing.assert_allclose(played.commanded[:, joint], planned, atol=3e-6)
    assert np.ptp(played.position, axis=0).max() > 0.3
    assert np.abs(played.position - played.commanded[:, :7]).max() < TRACKED
    again = play_trajectory(SCENARIO, load_trajectory(file), base=BASE, seconds=end / 4)
    several = len(again.time)
    np.testing.assert_array_equal(again.position, played.position[:several])
    np.testing.assert_array_equal(again.torque, played.torque[:several])


def test_a_floating_hand_cannot_play_it(file: Path):
    with pytest.raises(UserError, match="needs !FrankaArm"):
        play_trajectory(Scenario(task=SCENARIO.task), load_trajectory(file), base=BASE)


@pytest.mark.slow
def test_the_whole_file_kits_the_tool(file: Path):
    trajectory, goal = load_trajectory(file), build_rig(SCENARIO, base=BASE).scene.goals[0]
    played = play_trajectory(SCENARIO, trajectory, base=BASE)
    again = play_trajectory(SCENARIO, trajectory, base=BASE)
    np.testing.assert_array_equal(again.position, played.position)
    np.testing.assert_array_equal(again.torque, played.torque)
    assert (np.abs(played.torque) <= ARM_LIMITS["fr3"].torque).all()
    carried = played.time <= start_of(trajectory, "LOWER")
    assert np.abs(played.position - played.commanded[:, :7])[carried].max() < TRACKED
    placed = played.object_poses[0].translation() - goal.poses[0].translation()
    assert np.abs(placed).max() < 0.003
