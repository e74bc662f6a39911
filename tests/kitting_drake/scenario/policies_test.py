import dataclasses
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import save_file

from kitting_drake.common.errors import UserError
from kitting_drake.policies.learned_policy import Decision, LearnedPolicy
from kitting_drake.policies.weights import load_networks, preferred_type
from kitting_drake.scenario.policies import describe_learned, make_function, seeds_learned_from
from kitting_drake.scenario.schema import Learned, PythonPolicy
from systems.signals import Observation, PickPlaceAction, PixelGrid

ROOT = Path(__file__).resolve().parents[3]
GRID = PixelGrid(rows=33, cols=49)


def observation() -> Observation:
    return Observation(np.random.default_rng(0).random((4, *GRID.shape), np.float32), GRID)


@pytest.mark.parametrize("continuous", [True, False])
@pytest.mark.parametrize("orientations", [36, 180])
def test_a_learned_policy_as_the_scenario_says(
    weights_file: Path, orientations: int, continuous: bool
):
    told: list[Decision] = []
    config = Learned(weights_file.name, orientations=orientations, continuous=continuous)
    function = make_function(
        config,
        base=weights_file.parent,
        grid=GRID,
        watch=lambda _, decision: told.append(decision),
    )
    networks = load_networks(weights_file, preferred_type())
    policy = LearnedPolicy(networks, orientations=orientations, continuous=continuous)
    action = function(observation())
    assert action == policy(observation())
    assert [decision.action for decision in told] == [action]


def test_what_cannot_be_had_is_named(weights_file: Path, tmp_path: Path):
    def refusal(grid: PixelGrid = GRID, **fields: object) -> str:
        with pytest.raises(UserError) as caught:
            config = Learned(**fields)  # type: ignore[arg-type]
            make_function(config, base=tmp_path, grid=grid, watch=None)
        assert "\n" not in str(caught.value)
        return str(caught.value)

    gone = f"cannot read the weights {tmp_path}/gone.safetensors: there is no such file"
    assert refusal(weights="gone.safetensors") == gone
    save_file({"weight": torch.zeros(3)}, tmp_path / "other.safetensors")
    assert "other.safetensors is a safetensors file, but no policy" in refusal(
        weights="other.safetensors"
    )
    assert refusal(weights=str(weights_file), orientations=24).startswith(
        "policy.orientations: 24 orientations alias"
    )
    assert "37 orientations are not a multiple of 2" in refusal(
        weights=str(weights_file), orientations=37
    )
    coarse = dataclasses.replace(GRID, resolution=0.00625)
    assert "heightmap.resolution is 0.00625 m, and the policy of" in refusal(
        coarse, weights=str(weights_file)
    )


def test_results_say_what_a_policy_is(weights_file: Path):
    config = Learned(weights_file.name, orientations=36, continuous=False)
    assert describe_learned(config, base=weights_file.parent) == {
        "method": "so2",
        "preset": "tiny",
        "orientations": 36,
        "continuous": False,
        "trained_orientations": 72,
        "compute_type": str(preferred_type()).removeprefix("torch."),
        "scenario": "mine",
        "demonstrations": 3,
        "steps": 0,
    }
    assert seeds_learned_from(config, base=weights_file.parent) == {10_000, 10_001, 10_002}


def test_a_function_of_ones_own_needs_no_networks():
    config = PythonPolicy("systems.signals:PickPlaceAction")
    assert make_function(config, base=ROOT, grid=GRID, watch=None) is PickPlaceAction


def test_who_uses_no_network_does_not_wait_for_torch():
    program = "import sys, kitting_drake.run; print('torch' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True)
    assert done.stdout == "False\n", done.stderr
