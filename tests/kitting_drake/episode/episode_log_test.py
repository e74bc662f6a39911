from pathlib import Path

import numpy as np
import pytest
from mcap_ros2.reader import read_ros2_messages

from kitting_drake.common.errors import UserError
from kitting_drake.episode.episode import run_episode
from kitting_drake.episode.episode_log import EpisodeLog, check_log, log_of_many, log_of_seed
from kitting_drake.scenario.schema import Scenario
from kitting_drake.tasks import Kitting
from systems.pick_place_parameters import Mode
from tests.kitting_drake.rig import build_rig

SECONDS = 4.0
SCENARIO = Scenario(task=Kitting(tools=["claw_hammer"]), time_limit=SECONDS)


@pytest.fixture(scope="module")
def log() -> EpisodeLog:
    rig = build_rig(SCENARIO)
    log = EpisodeLog(rig.station)
    run_episode(rig.diagram, rig.station, scenario="test", policy="oracle", log=log)
    return log


def test_the_log_has_every_step(log: EpisodeLog):
    arrays = log.arrays()
    n = len(arrays["time"])
    assert arrays["time"] == pytest.approx(np.arange(n) / 128)
    for key in ("position", "velocity", "torque"):
        assert arrays[f"joint_{key}"].shape == (n, 4)
    assert arrays["finger_position"].shape == (n, 2)
    assert arrays["wrist_force"].shape == (n, 6)
    assert arrays["object_poses"].shape == (n, 1, 3, 4)
    assert set(arrays["mode"].tolist()) >= {Mode.OBSERVE, Mode.APPROACH, Mode.DESCEND, Mode.LIFT}
    # The hand follows its commands and feels the lifted tool.
    error = np.abs(arrays["joint_position"] - arrays["commanded_position"])
    assert error[:, :3].max() < 0.01
    lifted = arrays["wrist_force"][arrays["mode"] == Mode.LIFT]
    assert lifted[:, 2].min() < -1.0
    assert np.diff(arrays["joint_position"], axis=0)[:, 2].min() < -1e-4


def test_each_logged_action_has_the_policys_observation(log: EpisodeLog):
    arrays = log.arrays()
    assert arrays["pick"].shape == arrays["place"].shape == (1, 3)
    assert arrays["observation_height"].shape == (1, 160, 320)
    begun = int(np.searchsorted(arrays["time"], arrays["action_time"][0]))
    assert arrays["mode"][begun] == Mode.APPROACH
    # The hand grips at the pick, where o_t shows a tool.
    grips = arrays["joint_position"][arrays["mode"] == Mode.CLOSE][-1]
    assert grips[:2] == pytest.approx(arrays["pick"][0, :2], abs=1e-3)
    row, col = ((arrays["pick"][0, :2] - (0.25, -0.5)) / 0.003125).astype(int)
    assert arrays["observation_height"][0, row, col] > 0.01


def test_npz_and_mcap_files_agree(log: EpisodeLog, tmp_path: Path):
    for ending in ("npz", "mcap"):
        log.save(tmp_path / f"log.{ending}")
    arrays = np.load(tmp_path / "log.npz")
    topics: dict[str, list] = {}
    for message in read_ros2_messages(tmp_path / "log.mcap"):
        topics.setdefault(message.channel.topic, []).append(message)
    positions = [item.ros_msg.position for item in topics["/joint_states"]]
    assert np.array_equal(positions, arrays["joint_position"])
    times = [item.log_time_ns / 1e9 for item in topics["/wrist_wrench"]]
    assert times == pytest.approx(arrays["time"])
    (seen,) = topics["/observation_height"]
    pixels = np.frombuffer(bytes(seen.ros_msg.data), "<f4").reshape(160, 320)
    assert np.array_equal(pixels, arrays["observation_height"][0])
    (pick,) = topics["/pick"]
    assert pick.ros_msg.pose.position.x == arrays["pick"][0, 0]
    assert {item.child_frame_id for item in topics["/tf"][0].ros_msg.transforms} >= {"hand"}


def test_logging_does_not_change_the_episode(log: EpisodeLog):
    rig = build_rig(SCENARIO)
    ends: list[np.ndarray] = []
    rig.run(
        lambda event: ends.append(rig.station.object_poses(event.root_context)[0].GetAsMatrix34())
    )
    assert np.array_equal(ends[-1], log.arrays()["object_poses"][-1, 0])


@pytest.mark.parametrize("name", ["log.csv", "log"])
def test_an_unsupported_log_file_raises_before_the_episode(name: str):
    with pytest.raises(UserError, match=r"--log"):
        check_log(Path(name))


def test_each_seed_has_its_own_log_file(tmp_path: Path):
    assert log_of_seed(Path("runs/log.npz"), 7) == Path("runs/log_00000007.npz")
    assert log_of_many(None, "auto") is None
    with pytest.raises(UserError, match=r"--ray"):
        log_of_many(tmp_path / "log.npz", "auto")
