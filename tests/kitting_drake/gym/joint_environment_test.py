"""The environment that takes joint targets, and the frames that `collect` records for it."""

import types
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import kitting_drake.gym
from kitting_drake.common.errors import UserError
from kitting_drake.episode.chosen import build_chosen, run_chosen
from kitting_drake.episode.frame_recorder import FrameRecorder
from kitting_drake.episode.joint_view import JointView
from kitting_drake.policies.data.frames import EpisodeFrames, FrameSettings
from kitting_drake.scenario.choosing import find_scenario

pytestmark = pytest.mark.usefixtures("rendering")

SCENARIOS = """
Hand: &hand
  task: !ArrangedKitting
    kit_pose: {x: 0.5, y: -0.1}
    tools: {combination_wrench: {x: 0.42, y: 0.14}}
Arm:
  <<: *hand
  robot: !FrankaArm {}
"""
IMAGE = "observation.images.front"


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("joints") / "small.yaml"
    path.write_text(SCENARIOS)
    return path


def make(path: Path, name: str = "Hand", **arguments: Any) -> Any:
    made = gymnasium.make(
        f"kitting_drake/{kitting_drake.gym.JOINTS}-v0",
        scenario=path,
        scenario_name=name,
        **arguments,
    )
    return made.unwrapped


def recorded(path: Path, name: str, settings: FrameSettings) -> EpisodeFrames:
    chosen = find_scenario(path, name)
    diagram, station = build_chosen(chosen, seed=3)
    recorder = FrameRecorder(station, settings)
    result = run_chosen(chosen, diagram, station, sampler=recorder)
    assert result.strict_success_rate == 1.0
    return recorder.frames()


def test_targets_are_reached_and_limited(path: Path):
    environment = make(path, fps=16, image_width=64, cameras=["front"])
    assert environment.names == ("x", "y", "z", "yaw", "gripper")
    observation, info = environment.reset(seed=3)
    assert observation in environment.observation_space
    assert observation[IMAGE].shape == (48, 64, 3)
    assert info["seed"] == 3 and info["success_rate"] == 0.0
    start = observation["observation.state"]
    target = start + np.array([0.02, -0.02, 0.01, 0.05, -0.02], np.float32)
    for _ in range(8):
        observation, reward, terminated, truncated, info = environment.step(target)
        assert (reward, terminated, truncated) == (0.0, False, False)
    assert info["seconds"] == 0.5
    np.testing.assert_allclose(observation["observation.state"], target, atol=2e-3)
    # The target is out of reach within a step: x may move at 1.7 m/s.
    far = target + np.array([0.5, 0, 0, 0, 0], np.float32)
    before = observation["observation.state"][0]
    observation, *_ = environment.step(far)
    assert 0.0 < observation["observation.state"][0] - before < 1.7 / 16 + 1e-3
    for bad in (np.zeros(4), np.full(5, np.nan)):
        with pytest.raises(ValueError, match="5 finite numbers"):
            environment.step(bad)
    environment.close()
    with pytest.raises(gymnasium.error.ResetNeeded):
        environment.step(target)


def test_time_is_limited(path: Path):
    environment = make(path, scenario_text="{time_limit: 0.2}", image_width=16, cameras=["front"])
    observation, _ = environment.reset(seed=3)
    ends = [environment.step(observation["observation.state"])[2:4] for _ in range(4)]
    assert ends == [(False, False)] * 3 + [(False, True)]


def test_bad_arguments(path: Path):
    for arguments, message in (
        ({"cameras": ["rear"]}, "no camera 'rear': the scenario has front, left, right"),
        ({"fps": 50}, "fps is 50"),
    ):
        with pytest.raises(UserError, match=message):
            make(path, **arguments)


def test_frames_are_taken_at_equal_times(monkeypatch: pytest.MonkeyPatch):
    times: list[float] = []
    now = types.SimpleNamespace(time=0.0)
    context: Any = types.SimpleNamespace(get_time=lambda: now.time)
    plant = types.SimpleNamespace(time_step=lambda: 1 / 128)
    station: Any = types.SimpleNamespace(plant=plant, seed=1, reward=lambda _: now.time > 0.5)

    class View:
        names, cameras = ("x", "gripper"), ("front",)

        def __init__(self, *_: object) -> None:
            pass

        def state(self, _: object) -> Any:
            times.append(now.time)
            return np.zeros(2, np.float32)

        def command(self, _: object) -> Any:
            return np.full(2, now.time, np.float32)

        def images(self, _: object) -> Any:
            return {"observation.images.front": np.zeros((2, 2, 3), np.uint8)}

    monkeypatch.setattr("kitting_drake.episode.frame_recorder.JointView", View)
    recorder = FrameRecorder(station, FrameSettings(fps=15))
    for step in range(129):
        now.time = step / 128
        recorder.sample(context)
    assert len(times) == 16
    np.testing.assert_allclose(times, np.arange(16) / 15, atol=0.5 / 128 + 1e-9)
    frames = recorder.frames()
    # The action of a frame is the command at the next frame.
    np.testing.assert_array_equal(frames.action[:-1, 0], np.float32(times[1:]))
    assert frames.reward.sum() == 1.0 and frames.reward[7] == 1.0
    assert frames.success.tolist() == [False] * 7 + [True] * 9


def test_a_closing_force_is_a_smaller_opening(path: Path):
    # A force of 30 N at 800 N/m moves each finger by 37.5 mm, so the opening shrinks by 75 mm.
    view = object.__new__(JointView)
    values = {
        "commanded": np.array([0.1, 0.2, 0.3, 0.4, *np.zeros(8)]),
        "commanded_opening": np.array([0.02, 0.0]),
        "commanded_closing_force": np.array([30.0]),
    }
    view._joints, view._stiffness = 4, 800.0
    view._port = lambda _, name: values[name]  # type: ignore[method-assign]
    command = view.command(None)  # type: ignore[arg-type]
    np.testing.assert_allclose(command, [0.1, 0.2, 0.3, 0.4, 0.02 - 0.075], rtol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "fps"), [("Hand", 16), ("Arm", 15)])
def test_recorded_actions_kit_the_tool_again(path: Path, name: str, fps: int):
    frames = recorded(path, name, FrameSettings(fps=fps, width=64, cameras=("front",)))
    assert len(frames) > 30 and len(frames.images["front"]) == len(frames)
    assert frames.success[-1] and frames.reward.sum() == 1.0
    environment = make(path, name, fps=fps, image_width=64, cameras=["front"])
    observation, info = environment.reset(seed=3)
    np.testing.assert_array_equal(observation["observation.state"], frames.state[0])
    assert environment.names == frames.names
    total, ends = 0.0, False
    for action in frames.action:
        assert action in environment.action_space
        observation, reward, ends, truncated, info = environment.step(action)
        total += reward
        if ends:
            break
    assert ends and not truncated and total == 1.0
    assert info["is_success"] and info["strict_success_rate"] == 1.0


@pytest.mark.slow
def test_gymnasiums_own_checks_of_the_joint_environment_pass(path: Path):
    check_env(make(path, image_width=64), skip_render_check=True)
