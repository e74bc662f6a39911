import dataclasses
import functools
import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from safetensors import safe_open
from safetensors.torch import save_file
from torch import Tensor

from kitting_drake.common.errors import UserError
from kitting_drake.policies.learned_policy import LearnedPolicy
from kitting_drake.policies.networks.architecture import METHODS, NetworkConfig
from kitting_drake.policies.networks.factored import Networks
from kitting_drake.policies.networks.methods import make_networks
from kitting_drake.policies.networks.weights import (
    learned_seeds,
    load_networks,
    load_trainable,
    read_weights_file,
    save_weights,
)
from systems.signals import Observation, PixelGrid

ROOT = Path(__file__).resolve().parents[4]
GRID = PixelGrid(rows=65, cols=81)
TINY = NetworkConfig(
    preset="tiny",
    orientations=72,
    colour_mean=0.4,
    colour_std=0.3,
    height_mean=0.01,
    height_std=0.02,
)
SMALL = dataclasses.replace(TINY, preset="small")
CARD = {"scenario": "mine", "demonstration_seeds": [10_000, 10_001], "steps": 7}


@functools.cache
def trained(config: NetworkConfig) -> Networks:
    """Networks whose weights and biases all differ from their initial values."""
    torch.manual_seed(0)
    networks = make_networks(config)
    with torch.no_grad():
        for weight in networks.parameters():
            weight += 0.1 * torch.randn_like(weight) * (weight.std() if len(weight) > 1 else 1)
    return networks.eval().requires_grad_(False)


def observation(seed: int) -> Observation:
    image = np.random.default_rng(seed).random((4, *GRID.shape), np.float32)
    image[3] *= 0.05
    return Observation(image, GRID)


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "policy.safetensors"
    save_weights(path, trained(TINY), CARD)
    return path


def maps(networks: Networks, image: NDArray[np.float32]) -> dict[str, Tensor]:
    """All predictions of the networks for an image, by name."""
    pixel = (20, 70)
    picking = networks.predict_pick(image, 36)
    angles = picking.angle(pixel)
    return {
        "position": picking.position,
        "angle": angles.logits,
        "refined angle": torch.tensor(angles.refined),
        "scene": networks.encode_scene(image),
        "crop": networks.encode_crop(image, pixel),
    }


def assert_close(found: dict[str, Tensor], expected: dict[str, Tensor], relative: float) -> None:
    for name, values in expected.items():
        assert values.dim() == 0 or values.std() > 0, f"{name} is constant"
        atol = relative * float(values.abs().max())
        torch.testing.assert_close(found[name], values, atol=atol, rtol=0, msg=lambda text: text)


@pytest.mark.parametrize(
    "config",
    [pytest.param(TINY, id="tiny"), pytest.param(SMALL, id="small", marks=pytest.mark.slow)],
)
def test_loaded_networks_predict_the_same_as_trained_ones(config: NetworkConfig, tmp_path: Path):
    path = tmp_path / "policy.safetensors"
    save_weights(path, trained(config), CARD)
    loaded = load_networks(path)
    assert loaded.config == config
    image = observation(0).image
    assert_close(maps(loaded, image), maps(trained(config), image), 1e-5)


# At N = 180, a least-squares fit to all elements of a kernel would need too much memory.
@pytest.mark.parametrize(
    ("method", "orientations"),
    [*((method, 72) for method in METHODS), ("equivariant_transporter", 180)],
)
def test_training_continues_from_a_file(method: str, orientations: int, tmp_path: Path):
    """The file holds expanded kernels, from which the weights are recovered."""
    networks = trained(dataclasses.replace(TINY, method=method, orientations=orientations))
    save_weights(tmp_path / "first.safetensors", networks, {})
    again = load_trainable(tmp_path / "first.safetensors")
    assert again.config == networks.config
    for name, parameter in networks.named_parameters():
        found = again.get_parameter(name)
        torch.testing.assert_close(found.detach(), parameter, atol=1e-5, rtol=1e-4, msg=name)
        assert found.requires_grad


def test_bfloat16_predicts_nearly_the_same_every_time(file: Path):
    loaded = load_networks(file, torch.bfloat16)
    types = {name: value.dtype for name, value in loaded.state_dict().items()}
    # Weights are cast once at loading; the last layers stay in float32.
    assert {types["alpha.lift.weight"], types["beta.stages.0.0.weight"]} == {torch.bfloat16}
    assert {types["alpha.out.weight"], types["beta.readout.weight"]} == {torch.float32}
    image = observation(0).image
    first = maps(loaded, image)
    assert_close(first, maps(trained(TINY), image), 0.05)
    maps(loaded, observation(1).image)
    assert_close(maps(loaded, image), first, 0.0)
    assert {name: value.dtype for name, value in loaded.state_dict().items()} == types


def test_loaded_networks_are_in_inference_mode(file: Path):
    loaded = load_networks(file)
    assert not loaded.training
    assert not any(weight.requires_grad for weight in loaded.parameters())


def test_a_file_holds_its_config_and_card(file: Path):
    found = read_weights_file(file)
    assert found.config == TINY
    assert found.card == CARD
    assert [path.name for path in file.parent.iterdir()] == [file.name]


def test_saving_is_reproducible(file: Path, tmp_path: Path):
    again = tmp_path / "again.safetensors"
    save_weights(again, trained(TINY), CARD)
    tensors, metadata = content(file)
    others, other_metadata = content(again)
    assert metadata == other_metadata
    assert tensors.keys() == others.keys()
    assert all(torch.equal(tensors[name], others[name]) for name in tensors)


def test_a_file_is_much_smaller_than_the_plain_kernels(tmp_path: Path):
    path = tmp_path / "policy.safetensors"
    save_weights(path, trained(SMALL), CARD)
    assert path.stat().st_size < 4 * 2**20
    plain = sum(weight.numel() * 4 for weight in load_networks(path).parameters())
    assert path.stat().st_size < plain / 8


def test_older_files_are_read(file: Path):
    """In an older file, the config has other names for some fields and lacks one."""
    tensors, metadata = content(file)
    config = json.loads(metadata["config"])
    for old, new in (("colour_deviation", "colour_std"), ("height_deviation", "height_std")):
        config[old] = config.pop(new)
    del config["stop"]
    metadata["config"] = json.dumps(config)
    save_file(tensors, file, metadata)
    found = load_networks(file)
    assert found.config == TINY
    assert not found.config.stop
    assert found.stop_threshold is None


def test_the_stop_threshold_is_stored_with_the_weights(tmp_path: Path):
    path = tmp_path / "policy.safetensors"
    networks = trained(dataclasses.replace(TINY, stop=True))
    save_weights(path, networks, CARD | {"stop_threshold": -1.5})
    loaded = load_networks(path)
    assert loaded.config.stop
    assert loaded.stop_threshold == -1.5
    image = observation(0).image
    expected = networks.predict_pick(image, 36).log_odds
    assert loaded.predict_pick(image, 36).log_odds == pytest.approx(expected, abs=1e-3)


NO_LIBRARIES = """
import sys
sys.modules["escnn"] = sys.modules["pydrake"] = None
from pathlib import Path
import numpy as np
from kitting_drake.policies.learned_policy import LearnedPolicy
from kitting_drake.policies.networks.weights import load_networks
from systems.signals import Observation, PixelGrid
image = np.load(sys.argv[2])
policy = LearnedPolicy(load_networks(Path(sys.argv[1])), orientations=72)
action = policy(Observation(image, PixelGrid(rows=65, cols=81)))
print(*action.pick.as_array(), *action.place.as_array())
"""


@pytest.mark.slow
def test_decides_without_escnn_or_drake(file: Path, tmp_path: Path):
    seen = observation(0)
    np.save(tmp_path / "image.npy", seen.image)
    command = [sys.executable, "-c", NO_LIBRARIES, str(file), str(tmp_path / "image.npy")]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    action = LearnedPolicy(load_networks(file), orientations=72)(seen)
    expected = [*action.pick.as_array(), *action.place.as_array()]
    assert [float(word) for word in done.stdout.split()] == pytest.approx(expected, abs=1e-5)


# Unusable files.

Metadata = dict[str, str]
Tensors = dict[str, Tensor]


def content(path: Path) -> tuple[Tensors, Metadata]:
    with safe_open(path, framework="pt") as file:
        return {name: file.get_tensor(name) for name in file.keys()}, file.metadata()  # noqa: SIM118 - it is no dict


def refusal(path: Path) -> str:
    """Loads an unusable file; returns the error's message, which is short and names the file."""
    with pytest.raises(UserError) as caught:
        load_networks(path)
    message = str(caught.value)
    assert str(path) in message
    assert "\n" not in message
    assert len(message) < 300 + len(str(path)), message
    return message


def test_a_missing_file_is_rejected(tmp_path: Path):
    assert "no such file" in refusal(tmp_path / "gone.safetensors")
    assert "cannot read the weights" in refusal(tmp_path)
    with pytest.raises(UserError, match=r"gone\.safetensors"):
        read_weights_file(tmp_path / "gone.safetensors")


@pytest.mark.parametrize("length", [0, 4, 8, 100, 5_000, 20_000, -1])
def test_a_truncated_file_is_rejected(file: Path, length: int):
    file.write_bytes(file.read_bytes()[:length])
    assert "safetensors file" in refusal(file)


@pytest.mark.parametrize("text", [b"not weights at all\n", b"\xff" * 99, b"PK\x03\x04" + bytes(99)])
def test_another_kind_of_file_is_rejected(file: Path, text: bytes):
    file.write_bytes(text)
    assert "safetensors file" in refusal(file)


def test_learned_seeds_include_those_of_starting_weights():
    mother = {"scenario": "a", "demonstration_seeds": [1, 2]}
    daughter = {
        "scenario": "b",
        "demonstration_seeds": [1, 7],
        "start_learned": learned_seeds(mother),
    }
    again = {"scenario": "a", "demonstration_seeds": [3], "start_learned": learned_seeds(daughter)}
    assert learned_seeds(again) == {"a": [1, 2, 3], "b": [1, 7]}


@pytest.mark.parametrize("metadata", [None, {"format": "pt"}])
def test_weights_of_another_program_are_rejected(file: Path, metadata: Metadata | None):
    save_file({"weight": torch.zeros(3)}, file, metadata)
    assert "policy" in refusal(file)


def reconfigured(**fields: Any) -> Callable[[Tensors, Metadata], None]:
    """Returns a function that changes fields of a file's config; None removes a field."""

    def spoil(_: Tensors, metadata: Metadata) -> None:
        config = json.loads(metadata["config"]) | fields
        kept = {name: value for name, value in config.items() if value is not None}
        metadata["config"] = json.dumps(kept)

    return spoil


def described(**entries: str) -> Callable[[Tensors, Metadata], None]:
    """Returns a function that changes entries of a file's metadata."""
    return lambda _, metadata: metadata.update(entries)


def a_tensor(tensors: Tensors, kind: str) -> str:
    return next(name for name in sorted(tensors) if kind in name)


def without(kind: str) -> Callable[[Tensors, Metadata], None]:
    def spoil(tensors: Tensors, _: Metadata) -> None:
        del tensors[a_tensor(tensors, kind)]

    return spoil


def changed(kind: str, change: Callable[[Tensor], Tensor]) -> Callable[[Tensors, Metadata], None]:
    def spoil(tensors: Tensors, _: Metadata) -> None:
        name = a_tensor(tensors, kind)
        tensors[name] = change(tensors[name]).contiguous()

    return spoil


def with_nan(tensor: Tensor) -> Tensor:
    spoilt = tensor.clone()
    spoilt.view(-1)[-1] = torch.nan
    return spoilt


MISMATCH = "the weights do not fit a tiny so2 network"
SPOILT = {
    "version": (described(format_version="2"), "format version 2"),
    "config not JSON": (described(config="{"), "its config"),
    "config not a mapping": (described(config="[1]"), "its config"),
    "bases not a mapping": (described(bases="null"), "its bases"),
    "bases without names": (described(bases='{"alpha.lift": [1]}'), MISMATCH),
    "threshold not a number": (
        described(card='{"stop_threshold": "low"}'),
        "stop_threshold",
    ),
    "unknown method": (reconfigured(method="magic"), "method must be one of so2, "),
    "unknown preset": (reconfigured(preset="vast"), "preset must be one of paper, small, "),
    "missing field": (
        reconfigured(colour_mean=None),
        "its config must have the fields angle_frequencies, ",
    ),
    "unknown field": (
        reconfigured(shade="red"),
        "its config must have the fields angle_frequencies, ",
    ),
    "text for a truth value": (reconfigured(colour="red"), "colour must be true or false"),
    "text for a number": (reconfigured(height_mean="high"), "its config"),
    "number for a list": (reconfigured(angle_frequencies=3), "its config"),
    "odd N": (reconfigured(orientations=37), "orientations must be an even number, not 37"),
    "fraction": (reconfigured(band=2.5), "its config"),
    "not a number": (reconfigured(colour_mean=float("nan")), "its config"),
    "frequencies": (reconfigured(angle_frequencies=[2, 0]), "ascending"),
    "too many frequencies": (reconfigured(band=9), "8 samples cannot hold frequency 9"),
    "another preset": (reconfigured(preset="small"), "do not fit a small so2 network"),
    "no weights": (lambda tensors, _: tensors.clear(), MISMATCH),
    "no basis": (without("basis."), MISMATCH),
    "no weight": (without("alpha.lift"), MISMATCH),
    "no bias": (without("out.bias"), MISMATCH),
    "one too many": (lambda tensors, _: tensors.update(gamma=torch.zeros(1)), MISMATCH),
    "weight transposed": (changed("out.weight", lambda old: old.transpose(0, 1)), MISMATCH),
    "weight for another basis": (changed("mix.weights", lambda old: old[..., 1:]), "do not fit"),
    "weight for more": (changed("mix.weights", lambda old: old.repeat(2, 1, 1)), MISMATCH),
    "oblong basis": (changed("basis.", lambda old: old[..., 1:]), "do not fit"),
    "flat basis": (changed("basis.", torch.Tensor.flatten), "do not fit"),
    "nan in a weight": (changed("lift", with_nan), "finite numbers"),
    "nan in a basis": (changed("basis.", with_nan), "finite numbers"),
    "nan in a bias": (changed("out.bias", with_nan), "finite numbers"),
    "infinity": (changed("lift", lambda old: old / 0), "finite numbers"),
}


@pytest.fixture(scope="module")
def both_kinds(tmp_path_factory: pytest.TempPathFactory) -> tuple[Tensors, Metadata]:
    """The tensors and metadata of a file with both plain and steerable layers."""
    path = tmp_path_factory.mktemp("weights") / "policy.safetensors"
    save_weights(path, trained(TINY), CARD)
    return content(path)


@pytest.mark.parametrize("case", SPOILT)
def test_a_corrupt_file_is_rejected(
    case: str, both_kinds: tuple[Tensors, Metadata], tmp_path: Path
):
    spoil, words = SPOILT[case]
    tensors, metadata = dict(both_kinds[0]), dict(both_kinds[1])
    spoil(tensors, metadata)
    path = tmp_path / "policy.safetensors"
    save_file(tensors, path, metadata)
    assert words in refusal(path)
