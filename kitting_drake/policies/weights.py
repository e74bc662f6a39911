"""Trained networks as files: safetensors, loaded as plain convolutions without any group library.

A file holds what was trained, in its own small coordinates, and the few kernel bases that turn them
into plain convolutions: a tenth of what the plain kernels would take (4 of 37 MB, preset small).
"""

from __future__ import annotations

import dataclasses
import json
import textwrap
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from kitting_drake.common.errors import UserError
from kitting_drake.common.files import write_whole
from kitting_drake.policies.config import NetworkConfig
from kitting_drake.policies.methods import make_networks
from kitting_drake.policies.networks import Networks
from kitting_drake.policies.steerable import PlainConv2d, SteerableConv2d, expand_kernel

FORMAT = "kitting_drake policy"
FORMAT_VERSION = 1


@dataclass(frozen=True)
class WeightsFile:
    """What a file says beside the weights."""

    config: NetworkConfig
    card: dict[str, Any]
    """Where the weights come from: data, seeds, steps, validation."""


def save_weights(path: Path, networks: Networks, card: dict[str, Any]) -> None:
    """Writes networks, as they are trained, to a file.

    Args:
        path: where; there whole or not at all.
        networks: made with steerable convolutions.
        card: for people, and for results; anything that JSON takes.
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
    write_whole(path, save(plain, metadata))


def _plain_size(layer: SteerableConv2d) -> int:
    """How many numbers its plain kernel has."""
    pairs = layer.weights.shape[0] * layer.weights.shape[1]
    return pairs * layer.basis[0].numel()


def read_weights_file(path: Path) -> WeightsFile:
    """Reads what a file says beside the weights, which is quick.

    Raises:
        UserError: the file cannot be used.
    """
    metadata, _ = _read(path, tensors=False)
    return WeightsFile(_config(path, metadata), _json(path, metadata, "card"))


def load_networks(path: Path, compute_type: torch.dtype = torch.float32) -> Networks:
    """Networks of plain convolutions, for inference.

    Args:
        path: a file that `save_weights` wrote.
        compute_type: of the convolutions.

    Raises:
        UserError: the file cannot be read, is not such a file, or its weights are not those of the
            networks that its config names.
    """
    metadata, tensors = _read(path, tensors=True)
    config = _config(path, metadata)
    bases = _json(path, metadata, "bases")
    state = {}
    for name, tensor in tensors.items():
        layer, _, kind = name.rpartition(".")
        if layer == "basis":
            continue
        basis = tensors.get(str(bases.get(layer)))
        if kind == "weights" and basis is not None:
            square = basis.dim() == 5 and basis.shape[3] == basis.shape[4]
            if tensor.dim() != 3 or not square or tensor.shape[2] != len(basis):
                raise UserError(f"{path}: the weights of {layer} do not fit their kernel basis")
            state[f"{layer}.weight"] = expand_kernel(tensor, basis)
        else:
            state[name] = tensor
    try:
        networks = make_networks(config, PlainConv2d)
    except (TypeError, ValueError) as error:
        raise UserError(f"{path}: its config cannot be used: {error}") from error
    try:
        networks.load_state_dict(state)
    except RuntimeError as error:
        # Torch tells of every tensor.
        first = textwrap.shorten(str(error).splitlines()[1], 150, placeholder=" ...")
        raise UserError(
            f"{path}: the weights are not those of a {config.preset} {config.method} network: "
            f"{first}"
        ) from error
    if not all(bool(value.isfinite().all()) for value in state.values()):
        raise UserError(f"{path}: the weights are not all finite numbers")
    networks.compute_type = compute_type
    networks.eval().requires_grad_(False)
    return networks


def preferred_device() -> torch.device:
    """The accelerator where there is one, else the CPU: where networks are trained and asked."""
    return torch.device("cuda" if torch.cuda.is_available() else "cpu")


def preferred_type() -> torch.dtype:
    """bfloat16 where the preferred device computes in it, else float32."""
    if preferred_device().type == "cuda":
        return torch.bfloat16 if torch.cuda.is_bf16_supported() else torch.float32
    fast = torch.backends.cpu.get_cpu_capability() in ("AVX512", "AMX") and (
        torch.cpu._is_avx512_bf16_supported() or torch.cpu._is_amx_tile_supported()
    )
    return torch.bfloat16 if fast else torch.float32


def _read(path: Path, *, tensors: bool) -> tuple[dict[str, str], dict[str, Tensor]]:
    try:
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
            names = file.keys() if tensors else []
            content = {name: file.get_tensor(name) for name in names}
    except (OSError, SafetensorError) as error:
        reason = getattr(error, "strerror", None) or "it is not a whole safetensors file"
        if isinstance(error, FileNotFoundError):
            reason = "there is no such file"
        raise UserError(f"cannot read the weights {path}: {reason}") from error
    if metadata.get("format") != FORMAT:
        raise UserError(f"{path} is a safetensors file, but no policy of this program")
    if metadata.get("format_version") != str(FORMAT_VERSION):
        raise UserError(
            f"{path} has format version {metadata.get('format_version')}, and this program reads "
            f"{FORMAT_VERSION}"
        )
    return metadata, content


def _json(path: Path, metadata: dict[str, str], key: str) -> dict[str, Any]:
    try:
        value = json.loads(metadata[key])
    except (KeyError, ValueError) as error:
        raise UserError(f"{path}: its {key} cannot be read") from error
    if not isinstance(value, dict):
        raise UserError(f"{path}: its {key} cannot be read")
    return value


def _config(path: Path, metadata: dict[str, str]) -> NetworkConfig:
    values = _json(path, metadata, "config")
    known = {item.name for item in dataclasses.fields(NetworkConfig)}
    if set(values) != known:
        raise UserError(f"{path}: its config must have the fields {', '.join(sorted(known))}")
    try:
        values["angle_frequencies"] = tuple(values["angle_frequencies"])
        return NetworkConfig(**values)
    except (TypeError, ValueError) as error:
        raise UserError(f"{path}: its config cannot be used: {error}") from error
