import dataclasses
import hashlib
import sys
import types
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from pydrake.common.value import Value
from safetensors.torch import save_file

from kitting_drake.common.errors import UserError
from kitting_drake.policies.draft import Stage
from kitting_drake.policies.learned_policy import Decision, LearnedPolicy
from kitting_drake.policies.matching.shape_matching import Matched, ShapeMatchingPolicy
from kitting_drake.policies.networks.device import preferred_type
from kitting_drake.policies.networks.weights import load_networks
from kitting_drake.policies.stages import StopRule, make_stages
from kitting_drake.scenario.policies import (
    Learned,
    Oracle,
    PolicyConfig,
    PolicySite,
    PythonPolicy,
    QuantizedOracle,
    ShapeMatching,
)
from kitting_drake.tasks import ArrangedKitting
from systems.pick_place_parameters import PickPlaceParameters
from systems.signals import Observation, PickPlaceAction, PixelGrid, PlanarPose
from tests.kitting_drake.policies.scenes import stored_observation

GRID = PixelGrid(rows=33, cols=49)


@pytest.fixture(scope="module")
def site() -> PolicySite:
    """A site whose list of placed objects is empty, because there is no plant to place them in."""
    scene = ArrangedKitting().make_scene(grid=PixelGrid(), seed=0, base=Path())
    return PolicySite(scene=scene, objects=(), grid=GRID, base=Path())


def observation() -> Observation:
    return Observation(np.random.default_rng(0).random((4, *GRID.shape), np.float32), GRID)


def action(config: PolicyConfig, site: PolicySite, seen: Observation) -> PickPlaceAction:
    """The action that a policy's system outputs for an observation."""
    system = config.make_system(site)
    context = system.CreateDefaultContext()
    # A policy that uses no colours has the port `observation_heights` instead of `observation`.
    heights = system.HasInputPort("observation_heights")
    name = "observation_heights" if heights else "observation"
    system.GetInputPort(name).FixValue(context, Value(seen))
    return system.GetOutputPort("action").Eval(context)


@pytest.mark.parametrize(("orientations", "continuous"), [(36, True), (180, False)])
def test_learned_makes_the_configured_policy(
    site: PolicySite, weights_file: Path, orientations: int, continuous: bool
):
    told: list[Decision] = []
    site = dataclasses.replace(
        site, base=weights_file.parent, observer=lambda _, decision: told.append(decision)
    )
    config = Learned(weights_file.name, orientations=orientations, continuous=continuous)
    found = action(config, site, observation())
    networks = load_networks(weights_file, preferred_type())
    # Without `continuous`, no stage refines an action, but the policy may still stop.
    stages = make_stages(site.planner, insertion=True) if continuous else [StopRule()]
    policy = LearnedPolicy(networks, orientations=orientations, stages=stages)
    assert found == policy(observation())
    [decision] = told
    assert found.stop == decision.stop
    assert found.stop or found == decision.action


def test_invalid_weights_and_fields_are_refused(
    site: PolicySite, weights_file: Path, tmp_path: Path
):
    site = dataclasses.replace(site, base=tmp_path)

    def refusal(grid: PixelGrid = GRID, **fields: object) -> str:
        with pytest.raises(UserError) as caught:
            config = Learned(**fields)  # type: ignore[arg-type]
            config.make_system(dataclasses.replace(site, grid=grid))
        assert "\n" not in str(caught.value)
        return str(caught.value)

    gone = f"cannot read the weights {tmp_path}/gone.safetensors: there is no such file"
    assert refusal(weights="gone.safetensors") == gone
    save_file({"weight": torch.zeros(3)}, tmp_path / "other.safetensors")
    assert "other.safetensors is not a policy" in refusal(weights="other.safetensors")
    assert refusal(weights=str(weights_file), orientations=24).startswith(
        "policy.orientations: 24 orientations alias"
    )
    assert "37 orientations are not a multiple of 2" in refusal(
        weights=str(weights_file), orientations=37
    )
    coarse = dataclasses.replace(GRID, resolution=0.00625)
    assert "heightmap.resolution is 0.00625 m" in refusal(coarse, weights=str(weights_file))


def test_details_and_digests_for_results(weights_file: Path):
    config = Learned(weights_file.name, orientations=36, continuous=False)
    base = weights_file.parent
    assert config.name == "learned"
    assert config.details(base) == {
        "method": "so2",
        "preset": "tiny",
        "orientations": 36,
        "continuous": False,
        "fit_outlines": False,
        "recover": False,
        "avoid_failed_picks": True,
        "least_confidence": 0.0,
        "trained_orientations": 72,
        "compute_type": str(preferred_type()).removeprefix("torch."),
        "scenario": "mine",
        "demonstrations": 3,
        "steps": 0,
        "learning_rate": None,
        "decay": None,
        "taken_only": None,
        "rigid": None,
        "rotations": None,
        "training_seed": None,
        "angle_only": False,
        "checkpoint_step": None,
    }
    assert Learned(weights="").details(base)["checkpoint_step"] == 4800
    assert config.training_seeds(base) == {10_000, 10_001, 10_002}
    # The generalist learned from static scenes, whose seeds are not seeds of episodes.
    assert Learned(weights="").training_seeds(base) == set()
    assert config.digest(base) == f"sha256 {hashlib.sha256(weights_file.read_bytes()).hexdigest()}"
    with pytest.raises(UserError, match=r"gone\.safetensors"):
        Learned("gone.safetensors").digest(base)
    assert Oracle().details(base) == {"method": "oracle"}
    rounded = QuantizedOracle(orientations=72)
    assert rounded.name == "quantized_oracle"
    assert rounded.details(base) == {"method": "quantized_oracle", "orientations": 72}
    assert (rounded.digest(base), rounded.training_seeds(base)) == (None, set())


STOP = """
from systems.signals import PickPlaceAction

def act(observation):
    return PickPlaceAction(stop=True)
"""


def test_a_users_function_and_its_digest(
    site: PolicySite, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    path = tmp_path / "a_policy_of_mine.py"
    path.write_text(STOP)
    monkeypatch.syspath_prepend(tmp_path)
    config = PythonPolicy("a_policy_of_mine:act")
    assert action(config, site, observation()) == PickPlaceAction(stop=True)
    # The digest changes with the module's source.
    first = config.digest(tmp_path)
    path.write_text(STOP + "\n# better\n")
    assert config.digest(tmp_path) != first
    path.write_text(STOP)
    assert config.digest(tmp_path) == first
    with pytest.raises(UserError, match="there is no file of the module time"):
        PythonPolicy("time:sleep").digest(tmp_path)
    # If the module belongs to a package, the digest covers the whole package.
    package = tmp_path / "a_package_of_mine"
    package.mkdir()
    (package / "__init__.py").touch()
    (package / "stop.py").write_text(STOP)
    (package / "helper.py").write_text("WIDTH = 1\n")
    config = PythonPolicy("a_package_of_mine.stop:act")
    first = config.digest(tmp_path)
    (package / "helper.py").write_text("WIDTH = 2\n")
    assert config.digest(tmp_path) != first


FAILED = """
import the_helper_beside
from systems.signals import PickPlaceAction

def act(observation, failed_picks):
    return PickPlaceAction(place=failed_picks[-1])
"""


def test_a_module_beside_the_scenario_is_found(site: PolicySite, tmp_path: Path):
    path = tmp_path / "the_policy_beside.py"
    path.write_text(FAILED)
    (tmp_path / "the_helper_beside.py").touch()
    config = PythonPolicy("the_policy_beside:act", takes_failed_picks=True)
    before = list(sys.path)
    first = config.digest(tmp_path)
    path.write_text(FAILED + "# better\n")
    assert config.digest(tmp_path) != first
    # The module is an input file, so that `--ray` ships it.
    assert config.input_files(tmp_path) == [path]
    assert config.modules() == ["the_policy_beside"]
    system = config.make_system(dataclasses.replace(site, base=tmp_path))
    assert sys.path == before
    context = system.CreateDefaultContext()
    system.GetInputPort("observation").FixValue(context, Value(observation()))
    failed = (PlanarPose(0.1, 0.2, 0.3), PlanarPose(0.4, 0.5, 0.6))
    system.GetInputPort("failed_picks").FixValue(context, Value(failed))
    assert system.GetOutputPort("action").Eval(context).place == failed[1]
    with pytest.raises(UserError, match="cannot import the_policy_elsewhere:act"):
        PythonPolicy("the_policy_elsewhere:act").make_system(site)


def test_the_policy_uses_the_scenarios_planner(
    site: PolicySite, weights_file: Path, monkeypatch: pytest.MonkeyPatch
):
    seen = stored_observation("kitting_unseen")
    deep = PickPlaceParameters(grasp_depth=0.030, max_grasp_depth=0.030)
    site = dataclasses.replace(site, grid=seen.grid)
    picks = [
        action(ShapeMatching(), dataclasses.replace(site, planner=planner), seen).pick
        for planner in (PickPlaceParameters(), deep)
    ]
    assert picks[0] != picks[1]
    given: list[PickPlaceParameters] = []

    def noted(planner: PickPlaceParameters, **arguments: Any) -> tuple[Stage, ...]:
        given.append(planner)
        return make_stages(planner, **arguments)

    monkeypatch.setattr("kitting_drake.policies.stages.make_stages", noted)
    Learned(str(weights_file)).make_system(dataclasses.replace(site, planner=deep))
    assert given == [deep]


def test_acts_on_the_surest_object_or_stops(site: PolicySite, monkeypatch: pytest.MonkeyPatch):
    seen = stored_observation("kitting_unseen")
    site = dataclasses.replace(site, grid=seen.grid)
    proposed = list(ShapeMatchingPolicy(site.planner).proposals(seen))
    assert len(proposed) == 4
    poor = {"fit": 2.0, "cost": 5.0, "reverse": 5.0}
    for k, item in enumerate(proposed[:2]):
        proposed[k] = Matched(item.action, (item.geometry or {}) | poor)
    monkeypatch.setattr(ShapeMatchingPolicy, "proposals", lambda *arguments: iter(proposed))
    assert action(ShapeMatching(), site, seen) == proposed[2].action
    assert action(ShapeMatching(least_confidence=0.9), site, seen) == proposed[2].action
    refusal = PickPlaceAction(stop=True, reason="not sure")
    assert action(ShapeMatching(least_confidence=1.0), site, seen) == refusal
    with pytest.raises(ValueError, match=r"policy\.least_confidence needs"):
        Learned(fit_outlines=False, least_confidence=0.9).validate()


@pytest.mark.parametrize("avoids", [True, False])
def test_avoid_failed_picks(site: PolicySite, weights_file: Path, avoids: bool):
    seen = stored_observation("kitting_unseen")
    site = dataclasses.replace(site, grid=seen.grid)
    config = Learned(str(weights_file), continuous=False, avoid_failed_picks=avoids)
    system = config.make_system(site)
    context = system.CreateDefaultContext()
    port = "observation" if system.HasInputPort("observation") else "observation_heights"
    system.GetInputPort(port).FixValue(context, Value(seen))
    first = system.GetOutputPort("action").Eval(context).pick
    system.GetInputPort("failed_picks").FixValue(context, Value((first,)))
    second = system.GetOutputPort("action").Eval(context).pick
    assert (second != first) == avoids
    with pytest.raises(ValueError, match=r"policy\.recover"):
        Learned(recover=True, avoid_failed_picks=False).validate()


@pytest.mark.parametrize("insertion", [True, False])
def test_every_stage_with_a_planner_uses_the_given_one(insertion: bool):
    planner = PickPlaceParameters(grasp_depth=0.030)
    stages = make_stages(planner, insertion=insertion, recover=True)
    given = [stage.planner for stage in stages if hasattr(stage, "planner")]
    assert len(given) == (4 if insertion else 3)
    assert all(item is planner for item in given)


@pytest.mark.parametrize(
    ("function", "message"),
    [
        ("no_such_module:policy", "policy.function: cannot import no_such_module:policy"),
        ("stub_policy:missing", "policy.function: cannot import stub_policy:missing"),
        ("stub_policy:number", "policy.function: stub_policy:number is not a function"),
    ],
)
def test_invalid_functions_are_refused(
    site: PolicySite, function: str, message: str, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setitem(sys.modules, "stub_policy", types.SimpleNamespace(number=3))
    with pytest.raises(UserError, match=message):
        PythonPolicy(function).make_system(site)
