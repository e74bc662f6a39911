"""The Gymnasium environments satisfy Gymnasium's contract and agree with `evaluate`."""

import dataclasses
import subprocess
import sys
import time
import types
import weakref
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import kitting_drake.gym
from kitting_drake.common.errors import UserError
from kitting_drake.episode.chosen import build_chosen, run_chosen
from kitting_drake.gym.spaces import as_action, as_observation, as_values
from kitting_drake.policies.matching.shape_matching import ShapeMatchingPolicy
from kitting_drake.scenario.choosing import find_scenario
from kitting_drake.scenario.policies import PythonPolicy
from systems.heightmap_projector import HeightmapProjector
from systems.pick_place_parameters import PickPlaceParameters
from systems.signals import Observation, PickPlaceAction, PixelGrid, PlanarPose

pytestmark = pytest.mark.usefixtures("rendering")

SMALL = """
OneTool:
  task: !ArrangedKitting
    kit_pose: {x: 0.5, y: -0.1}
    tools: {combination_wrench: {x: 0.42, y: 0.14}}
    tries: 2
  cameras:
    overhead: !Pinhole {position: [0.5, 0, 0.75], rpy_deg: [180, 0, -90], width: 320, height: 240,
      focal_length: 200}
"""
ROOT = Path(__file__).resolve().parents[3]
NOWHERE = np.array([0.3, 0.45, 0.0, 0.3, 0.4, 0.0, 0.0])
STOP = np.array([0.3, 0.45, 0.0, 0.3, 0.4, 0.0, 1.0])


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("gym") / "small.yaml"
    path.write_text(SMALL)
    return path


def make(path: Path, **arguments: Any) -> gymnasium.Env:
    return gymnasium.make("kitting_drake/Scenario-v0", scenario=path, **arguments)


def test_all_are_registered():
    names = {"KittingSeen", "KittingUnseen", "BlockInsertion", "AlignBoxCorner", "PlaceRedInGreen"}
    names |= {"StackBlockPyramid", "PalletizingBoxes", "Scenario"}
    registered = {spec.name for spec in gymnasium.registry.values() if spec.namespace}
    assert names <= registered
    # Checks that each environment's scenario exists; none is built.
    for name in kitting_drake.gym.SCENARIOS:
        gymnasium.make(f"kitting_drake/{name}-v0").close()


def test_a_file_in_the_working_directory_replaces_no_environment(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    (tmp_path / "kitting_unseen.yaml").write_text("Mine: {}")
    monkeypatch.chdir(tmp_path)
    gymnasium.make("kitting_drake/KittingUnseen-v0").close()


@pytest.mark.slow
def test_gymnasiums_own_checks_pass(small: Path):
    # Gymnasium's check of rendering makes many pictures; the next test checks one.
    check_env(make(small, cameras=True).unwrapped, skip_render_check=True)


@pytest.mark.slow
def test_a_picture_shows_the_cell(small: Path):
    environment = make(small, render_mode="rgb_array")
    environment.reset(seed=1)
    picture = environment.render()
    assert picture.shape == (800, 1280, 3)
    assert picture.std() > 10


class Recorder:
    """Shape matching as a custom policy that records its actions."""

    def __init__(self) -> None:
        self.actions: list[PickPlaceAction] = []
        self._policy = ShapeMatchingPolicy(PickPlaceParameters())

    def __call__(self, observation: Observation) -> PickPlaceAction:
        self.actions.append(self._policy(observation))
        return self.actions[-1]


def evaluated(
    path: Path, policy: Callable, seed: int, monkeypatch: pytest.MonkeyPatch, name: str | None
) -> dict[str, Any]:
    """The result of an episode run as by `evaluate`."""
    monkeypatch.setitem(sys.modules, "own", types.SimpleNamespace(policy=policy))
    chosen = find_scenario(path, name)
    own = PythonPolicy(function="own:policy")
    chosen = dataclasses.replace(chosen, scenario=dataclasses.replace(chosen.scenario, policy=own))
    return run_chosen(chosen, *build_chosen(chosen, seed=seed)).as_dict()


def played(environment: gymnasium.Env, policy: Callable, seed: int) -> tuple[float, dict[str, Any]]:
    """The return of an episode and its last `info`."""
    grid = environment.unwrapped.grid
    arrays, info = environment.reset(seed=seed)
    total, is_over = 0.0, False
    while not is_over:
        action = as_values(policy(as_observation(arrays, grid)))
        arrays, reward, terminated, truncated, info = environment.step(action)
        total, is_over = total + reward, terminated or truncated
    return total, info


def test_an_episode_equals_that_of_evaluate(small: Path, monkeypatch: pytest.MonkeyPatch):
    """With a policy that misses once: results are bit-identical, and the return is the reward."""

    class MissesFirst(Recorder):
        def __call__(self, observation: Observation) -> PickPlaceAction:
            action = super().__call__(observation)
            return as_action(NOWHERE, observation.grid) if len(self.actions) == 1 else action

    expected = evaluated(small, MissesFirst(), 3, monkeypatch, None)
    total, info = played(make(small), MissesFirst(), 3)
    assert expected["objects"][0]["success"]
    assert expected["missed_grasps"] == 1
    assert total == expected["success_rate"] == 1.0
    assert len(info["failed_picks"]) == 1
    assert [attempt["outcome"] for attempt in info["history"]] == ["missed", "placed"]
    # Every goal is filled, so both episodes end without a stop, with equal results.
    assert {key for key in expected if info.get(key) != expected[key]} == {"policy", "wall_seconds"}


def test_each_step_renders_one_observation(small: Path, monkeypatch: pytest.MonkeyPatch):
    """Otherwise a step would be costlier than an action in `evaluate`."""
    count = []
    render = HeightmapProjector._CalcObservation

    def counted(*arguments: Any) -> None:
        count.append(1)
        render(*arguments)

    monkeypatch.setattr(HeightmapProjector, "_CalcObservation", counted)
    environment = make(small, cameras=True)
    environment.reset(seed=0)
    environment.step(NOWHERE)
    environment.step(STOP)
    assert len(count) == 3


@pytest.mark.slow
@pytest.mark.usefixtures("freed_diagrams")
def test_earlier_scenes_are_garbage_collected(small: Path):
    environment = make(small, render_mode="rgb_array")
    environment.reset(seed=0)
    environment.step(NOWHERE)
    environment.render()
    first = weakref.ref(environment.unwrapped._station)
    environment.reset(seed=1)
    assert first() is None
    second = weakref.ref(environment.unwrapped._station)
    environment.close()
    assert second() is None


def test_termination_and_truncation(small: Path):
    environment = make(small)
    with pytest.warns(UserWarning, match="ignores its options tools"):
        environment.reset(seed=0, options={"tools": 3})
    *_, terminated, truncated, info = environment.step(STOP)
    assert (terminated, truncated, info["actions"]) == (True, False, 0)
    with pytest.raises(gymnasium.error.ResetNeeded):
        environment.step(NOWHERE)
    environment.reset(seed=0)
    ends = [environment.step(NOWHERE)[2:4] for _ in range(2)]
    assert ends == [(False, False), (False, True)]
    short = make(small, scenario_text="{time_limit: 1.0}")
    short.reset(seed=0)
    _, reward, terminated, truncated, info = short.step(NOWHERE)
    assert (reward, terminated, truncated, info["timed_out"]) == (0.0, False, True, True)


def test_invalid_input_raises(small: Path, tmp_path: Path):
    blind = tmp_path / "blind.yaml"
    blind.write_text("Blind: {cameras: {}}\n")
    environment = make(small)
    with pytest.raises(gymnasium.error.ResetNeeded):
        environment.step(NOWHERE)
    environment.reset(seed=0)
    with pytest.raises(ValueError, match=r"place_x .*nan"):
        environment.step(np.where(np.arange(7) == 3, np.nan, NOWHERE))
    with pytest.raises(ValueError, match=r"\(4,\)"):
        environment.unwrapped.step(np.zeros(4))
    # The episode continues; positions off the table are clipped.
    far = np.array([9.0, -9.0, 100.0, -3.0, 5.0, -77.0, 0.0])
    assert environment.unwrapped.step(far)[4]["failure"] is None
    with pytest.raises(ValueError, match="seed"):
        environment.unwrapped.reset(seed=-1)
    short = make(small, scenario_text="{time_limit: 0.1}")
    with pytest.raises(UserError, match=r"seed 3 .*time_limit is 0\.1 s"):
        short.reset(seed=3)
    with pytest.raises(UserError, match="scenario"):
        make(tmp_path / "nowhere.yaml")
    with pytest.raises(UserError, match="cameras"):
        make(blind)


def test_as_values_inverts_as_action():
    action = PickPlaceAction(PlanarPose(0.4, 0.1, 3.0), PlanarPose(0.5, -0.2, 5.0))
    assert as_action(as_values(action), PixelGrid()) == action
    with pytest.raises(ValueError, match="press"):
        as_values(dataclasses.replace(action, press=True))


@pytest.mark.slow
def test_reset_without_a_seed_draws_one(small: Path):
    environment = make(small)
    _, first = environment.reset(seed=5)
    drawn = environment.reset()[1]["seed"]
    environment.reset(seed=5)
    assert first["seed"] == 5
    assert environment.reset()[1]["seed"] == drawn != 5


@pytest.mark.slow
def test_vector_environments(small: Path):
    make(small).reset(seed=0)
    environments = gymnasium.make_vec(
        "kitting_drake/Scenario-v0",
        num_envs=2,
        vectorization_mode="async",
        # This process has rendered, so a fork would deadlock.
        vector_kwargs={"context": "spawn"},
        scenario=small,
    )
    try:
        arrays, info = environments.reset(seed=[1, 2])
        assert arrays["height"].shape == (2, 160, 320)
        assert info["seed"].tolist() == [1, 2]
        _, rewards, terminated, *_ = environments.step(np.stack([NOWHERE, STOP]))
        assert rewards.tolist() == [0.0, 0.0]
        assert terminated.tolist() == [False, True]
    finally:
        environments.close()


@pytest.mark.slow
def test_gymnasium_imports_the_module_from_the_environments_name():
    program = (
        "import gymnasium, sys\n"
        "name = 'kitting_drake.gym:kitting_drake/BlockInsertion-v0'\n"
        "print(gymnasium.make(name).spec.id, 'torch' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, cwd=ROOT)
    assert done.stdout.split() == ["kitting_drake/BlockInsertion-v0", "False"], done.stderr


@pytest.mark.slow
def test_a_step_costs_what_an_action_costs_in_evaluate(monkeypatch: pytest.MonkeyPatch):
    """Compares the CPU time of the same actions in the environment and in `evaluate`."""
    path = Path("kitting_unseen.yaml")
    environment = gymnasium.make("kitting_drake/KittingUnseen-v0")
    evaluated(path, Recorder(), 1, monkeypatch, "KittingUnseenToolsets")
    played(environment, Recorder(), 1)
    here = there = 0.0
    for seed in range(2, 10):
        start = time.process_time()
        if seed % 2:
            # Alternate the order, because the first run warms the caches for the second.
            total, info = played(environment, Recorder(), seed)
            middle = time.process_time()
            result = evaluated(path, Recorder(), seed, monkeypatch, "KittingUnseenToolsets")
            here, there = here + middle - start, there + time.process_time() - middle
        else:
            result = evaluated(path, Recorder(), seed, monkeypatch, "KittingUnseenToolsets")
            middle = time.process_time()
            total, info = played(environment, Recorder(), seed)
            here, there = here + time.process_time() - middle, there + middle - start
        assert total == result["success_rate"]
        for own, other in zip(info["objects"], result["objects"], strict=True):
            # The environment's o_t is one time step older than that of `evaluate`.
            assert own["add_s_mm"] == pytest.approx(other["add_s_mm"], abs=0.01)
    print(f"a step costs {here / there:.3f} of an action in evaluate")
    assert here / there < 1.1


@pytest.mark.slow
def test_a_random_agent_runs_a_hundred_steps():
    environment = gymnasium.make("kitting_drake/KittingSeen-v0")
    environment.action_space.seed(0)
    environment.reset(seed=0)
    for _ in range(100):
        _, _, terminated, truncated, info = environment.step(environment.action_space.sample())
        assert info["failure"] is None
        if terminated or truncated:
            environment.reset()
