"""Reads and writes trained networks as safetensors files. Loaded networks have plain convolutions
and need no group library.

A file holds a few bases of kernels, and the trained weights, which are coefficients in these bases.
The plain kernels are computed from them when the file is loaded. The kernels themselves would take
ten times the space (37 MB instead of 4 MB for the preset "small").
"""

from __future__ import annotations

import dataclasses
import json
import math
import textwrap
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from kitting_drake.common.errors import UserError
from kitting_drake.common.files import write_atomically
from kitting_drake.policies.data.static_scenes import STATIC
from kitting_drake.policies.networks.architecture import NetworkConfig
from kitting_drake.policies.networks.factored import Networks
from kitting_drake.policies.networks.layers.steerable import (
    ExpandedConv2d,
    PlainConv2d,
    SteerableConv2d,
    expand_kernel,
)
from kitting_drake.policies.networks.methods import make_networks

FORMAT = "kitting_drake policy"
FORMAT_VERSION = 1

_RENAMED = {"colour_deviation": "colour_std", "height_deviation": "height_std"}
"""Config fields that have other names in older files, with their present names."""
_ADDED = ("colour", "stop")
"""Config fields that older files lack; they take their defaults."""


@dataclass(frozen=True)
class WeightsFile:
    """The metadata of a weights file."""

    config: NetworkConfig
    card: dict[str, Any]
    """The origin of the weights: data, seeds, steps, validation. An optional `stop_threshold` sets
    `Networks.stop_threshold`."""


def card_seeds(card: Mapping[str, Any]) -> set[int]:
    """Returns the seeds of all demonstrations for training and validation. If training started from
    other weights, the seeds of those weights are included."""
    seeds = set(card.get("start_seeds", ()))
    # Seeds of static scenes are not seeds of episodes.
    if card.get("scenario") != STATIC:
        seeds |= {*card.get("demonstration_seeds", ()), *card.get("validation_seeds", ())}
    return seeds


def learned_seeds(card: Mapping[str, Any]) -> dict[str, list[int]]:
    """Returns, for each scenario, the seeds of the training demonstrations. If training started
    from other weights, the seeds of those weights are included."""
    learned = {scenario: set(seeds) for scenario, seeds in card.get("start_learned", {}).items()}
    own = set(card.get("demonstration_seeds", ()))
    scenario = str(card.get("scenario"))
    learned[scenario] = learned.get(scenario, set()) | own
    return {scenario: sorted(seeds) for scenario, seeds in learned.items()}


def save_weights(path: Path, networks: Networks, card: dict[str, Any]) -> None:
    """Writes trained networks to a file.

    Args:
        path: the file; it is written atomically.
        networks: networks with steerable convolutions.
        card: the origin of the weights, see `WeightsFile`; it must be serializable as JSON.
    """
    tensors: dict[str, Tensor] = {}
    bases: dict[str, str] = {}
    names: dict[Any, str] = {}
    covered: set[str] = set()
    for name, module in networks.named_modules():
        if isinstance(module, SteerableConv2d) and module.basis.numel() < _plain_size(module):
            size = module.basis.shape[-1]
            basis = names.setdefault(
                (module.in_fibre, module.out_fibre, size), f"basis.{len(names)}"
            )
            tensors[basis] = module.basis
            tensors[f"{name}.weights"] = module.weights
            bases[name] = basis
        elif hasattr(module, "kernel") and hasattr(module, "channel_bias"):
            tensors[f"{name}.weight"] = module.kernel()
        else:
            continue
        covered.update(f"{name}.{key}" for key, _ in module.named_parameters())
        bias = module.channel_bias()
        if bias is not None:
            tensors[f"{name}.bias"] = bias
    for name, parameter in networks.named_parameters():
        if name not in covered:
            tensors[name] = parameter
    metadata = {
        "format": FORMAT,
        "format_version": str(FORMAT_VERSION),
        "config": json.dumps(networks.config.as_dict()),
        "bases": json.dumps(bases),
        "card": json.dumps(card),
    }
    plain = {key: value.detach().cpu().float().contiguous() for key, value in tensors.items()}
    write_atomically(path, save(plain, metadata))


def _plain_size(layer: SteerableConv2d) -> int:
    """Returns the number of entries of a layer's plain kernel."""
    pairs = layer.weights.shape[0] * layer.weights.shape[1]
    return pairs * layer.basis[0].numel()


def read_weights_file(path: Path) -> WeightsFile:
    """Reads the metadata of a weights file without its weights.

    Raises:
        UserError: the file is unusable.
    """
    metadata, _ = _read(path, tensors=False)
    return WeightsFile(_config(path, metadata), _json(path, metadata, "card"))


def load_networks(path: Path, compute_type: torch.dtype = torch.float32) -> Networks:
    """Loads networks for inference, with plain convolutions.

    Args:
        path: a file that `save_weights` wrote.
        compute_type: the type of the convolutions; the weights are cast to it once.

    Raises:
        UserError: the file is unreadable or not a weights file, or its weights do not fit its
            config.
    """
    metadata, tensors = _read(path, tensors=True)
    config = _config(path, metadata)
    threshold = _stop_threshold(path, metadata)
    state = _plain_state(path, tensors, _json(path, metadata, "bases"))
    try:
        networks = make_networks(config, PlainConv2d)
    except (TypeError, ValueError) as error:
        raise _unusable(path, error) from error
    try:
        networks.load_state_dict(state)
    except RuntimeError as error:
        # Torch lists every mismatched tensor. Report only the first.
        first = textwrap.shorten(str(error).splitlines()[1], 150, placeholder=" ...")
        raise UserError(
            f"{path}: the weights do not fit a {config.preset} {config.method} network: {first}"
        ) from error
    if not all(bool(value.isfinite().all()) for value in state.values()):
        raise UserError(f"{path}: some weights are not finite numbers: train again")
    networks.stop_threshold = threshold
    networks.freeze(compute_type)
    return networks


def load_trainable(
    path: Path, fresh_angle_at: int | None = None, preset: str | None = None
) -> Networks:
    """Loads trainable networks with a file's weights.

    The file does not hold the optimisers' state.

    Args:
        path: a file that `save_weights` wrote.
        fresh_angle_at: the number of orientations N of the result. The pick-angle network then gets
            untrained weights, because its architecture may depend on N. None keeps the file's N and
            all its weights.
        preset: the preset of the result, used only with `fresh_angle_at`. Its U-nets must have the
            same sizes as the file's (`NetworkConfig.has_unets_of`). None keeps the file's preset.

    Raises:
        UserError: the file is unusable, see `load_networks`.
        ValueError: the networks do not support N orientations.
    """
    plain = load_networks(path)
    config = plain.config
    if fresh_angle_at is not None:
        config = dataclasses.replace(
            config, orientations=fresh_angle_at, preset=preset or config.preset
        )
    networks = make_networks(config)
    networks.check_orientations(config.orientations)
    stored = dict(plain.named_modules())

    def is_fresh(name: str) -> bool:
        return fresh_angle_at is not None and name.split(".")[0] == "beta"

    with torch.no_grad():
        for name, module in networks.named_modules():
            if isinstance(module, ExpandedConv2d) and not is_fresh(name):
                layer = stored[name]
                module.fit(layer.weight)
                if module.bias is not None:
                    module.bias.copy_(layer.bias[:: module.out_fibre.channels])
        rest = dict(plain.named_parameters())
        expanded = {n for n, m in networks.named_modules() if isinstance(m, ExpandedConv2d)}
        for name, parameter in networks.named_parameters():
            if name.rpartition(".")[0] not in expanded and not is_fresh(name):
                parameter.copy_(rest[name])
    return networks


def _plain_state(
    path: Path, tensors: dict[str, Tensor], bases: dict[str, Any]
) -> dict[str, Tensor]:
    """Returns the state dict of networks with plain convolutions, whose kernels are expanded from
    their bases."""
    state = {}
    for name, tensor in tensors.items():
        layer, _, kind = name.rpartition(".")
        if layer == "basis":
            continue
        basis = tensors.get(str(bases.get(layer)))
        if kind == "weights" and basis is not None:
            square = basis.dim() == 5 and basis.shape[3] == basis.shape[4]
            if tensor.dim() != 3 or not square or tensor.shape[2] != len(basis):
                raise UserError(
                    f"{path}: the weights of {layer} do not fit their kernel basis: give a file "
                    "that `train` wrote"
                )
            state[f"{layer}.weight"] = expand_kernel(tensor, basis)
        else:
            state[name] = tensor
    return state


def _read(path: Path, *, tensors: bool) -> tuple[dict[str, str], dict[str, Tensor]]:
    try:
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
            names = file.keys() if tensors else []
            content = {name: file.get_tensor(name) for name in names}
    except (OSError, SafetensorError) as error:
        reason = getattr(error, "strerror", None) or "it is not a complete safetensors file"
        if isinstance(error, FileNotFoundError):
            reason = "there is no such file"
        raise UserError(f"cannot read the weights {path}: {reason}") from error
    if metadata.get("format") != FORMAT:
        raise UserError(f"{path} is not a policy of this program: give a file that `train` wrote")
    if metadata.get("format_version") != str(FORMAT_VERSION):
        raise UserError(
            f"{path} has format version {metadata.get('format_version')}, but this version of "
            f"kitting_drake reads version {FORMAT_VERSION}: use the version that wrote it"
        )
    return metadata, content


def _json(path: Path, metadata: dict[str, str], key: str) -> dict[str, Any]:
    try:
        value = json.loads(metadata[key])
    except (KeyError, ValueError) as error:
        raise UserError(
            f"{path}: its {key} is missing or not valid JSON: give a file that `train` wrote"
        ) from error
    if not isinstance(value, dict):
        raise UserError(f"{path}: its {key} must be a JSON object: give a file that `train` wrote")
    return value


def _config(path: Path, metadata: dict[str, str]) -> NetworkConfig:
    values = {
        _RENAMED.get(name, name): value for name, value in _json(path, metadata, "config").items()
    }
    known = {item.name for item in dataclasses.fields(NetworkConfig)}
    if not known.difference(_ADDED) <= set(values) <= known:
        raise UserError(f"{path}: its config must have the fields {', '.join(sorted(known))}")
    try:
        values["angle_frequencies"] = tuple(values["angle_frequencies"])
        return NetworkConfig(**values)
    except (TypeError, ValueError) as error:
        raise _unusable(path, error) from error


def _unusable(path: Path, error: Exception) -> UserError:
    reason = error if isinstance(error, ValueError) else "one of its fields has the wrong type"
    return UserError(f"{path}: its config cannot be used: {reason}")


def _stop_threshold(path: Path, metadata: dict[str, str]) -> float | None:
    value = _json(path, metadata, "card").get("stop_threshold")
    if value is None:
        return None
    if not isinstance(value, int | float) or not math.isfinite(value):
        raise UserError(f"{path}: the stop_threshold of its card must be a number, not {value!r}")
    return float(value)
