"""Measures the share of the machine's peak rate that the SO(2) networks reach."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from kitting_drake.policies.networks.architecture import NetworkConfig
from kitting_drake.policies.networks.device import preferred_type
from kitting_drake.policies.networks.layers.steerable import PlainConv2d
from kitting_drake.policies.networks.methods import make_networks
from kitting_drake.policies.networks.unet import UNet
from kitting_drake.reproduction.network_speed.folding import computing_in, inferring, stepping
from kitting_drake.reproduction.network_speed.plan import SpeedSetup, times_of, type_name
from kitting_drake.reproduction.network_speed.timing import count_operations, read_clock


def measure_shares(setup: SpeedSetup) -> list[dict[str, Any]]:
    """Measures the share of the machine's peak rate that each of the SO(2) networks reaches.

    Returns:
        A row for each network, type and mode (`inference`, `training`).
    """
    ours = make_networks(NetworkConfig("so2", setup.plan.preset))
    inferences: dict[Any, Callable[[], object]] = {}
    steps: dict[Any, Callable[[], object]] = {}
    for type_ in setup.peak:
        exported = setup.export(ours, type_)
        trained = computing_in(ours, type_).to(setup.device)
        for name, features in setup.inputs(exported).items():
            inferences[name, type_, "inference"] = inferring(exported.get_submodule(name), features)
            steps[name, type_, "training"] = stepping(trained.get_submodule(name), features)
    timings = setup.time_each(inferences) | setup.time_each(steps, training=True)
    functions = inferences | steps
    rows = []
    for (name, type_, mode), timing in timings.items():
        operations = count_operations(functions[name, type_, mode])
        rate = operations / timing.seconds
        rows.append(
            {
                "network": name,
                "type": type_name(type_),
                "mode": mode,
                "operations": operations,
                **times_of(timing),
                "rate": rate,
                "share": rate / setup.peak[type_]["best"],
            }
        )
    return rows


def measure_levels(setup: SpeedSetup) -> dict[str, Any]:
    """Times alpha's inference by level of the U-net and by layer.

    Returns:
        `levels` and `layers`, with median times. A level's `convolution_s` is the time of its
        convolutions; its `rest_s` is the time of ELU, sums, resampling and concatenation.
    """
    type_ = preferred_type()
    networks = setup.export(make_networks(NetworkConfig("so2", setup.plan.preset)), type_)
    alpha = networks.get_submodule("alpha")
    assert isinstance(alpha, UNet)
    watch = _UNetWatch(alpha, setup.device)
    features = setup.inputs(networks)["alpha"]
    runs = []
    with torch.inference_mode():
        for repeat in range(setup.plan.repeats + 2):
            seconds = watch.run(features)
            # The first two runs are for warming up.
            if repeat >= 2:
                runs.append(seconds)
    median = {name: float(np.median([run[name] for run in runs])) for name in runs[0]}
    layers, levels = [], []
    for level, names in watch.layers.items():
        for name in names:
            layer_type = watch.types[name]
            operations = watch.operations[name]
            layers.append(
                {
                    "layer": name,
                    "level": level,
                    "type": type_name(layer_type),
                    "operations": operations,
                    "seconds": median[name],
                    "share": operations / median[name] / setup.peak[layer_type]["best"],
                }
            )
        convolution = sum(median[name] for name in names)
        needed = sum(
            watch.operations[name] / setup.peak[watch.types[name]]["best"] for name in names
        )
        levels.append(
            {
                "level": level,
                "operations": sum(watch.operations[name] for name in names),
                "seconds": median[level],
                "convolution_s": convolution,
                "rest_s": max(median[level] - convolution, 0.0),
                "convolution_share": needed / convolution,
                "share": needed / median[level],
            }
        )
    return {"levels": levels, "layers": layers}


class _UNetWatch:
    """Hooks that record the start and end of each level and each convolution of a U-net."""

    def __init__(self, network: UNet, device: torch.device) -> None:
        self._network, self._device = network, device
        self._starts: dict[str, float] = {}
        self._ends: dict[str, float] = {}
        self.operations: dict[str, int] = {}
        """The number of operations of each convolution."""
        self.types: dict[str, torch.dtype] = {}
        """The type in which each convolution computes."""
        self._blocks = {
            f"{way}.{i}": f"{way} {i + 1}" for way, n in (("down", 5), ("up", 4)) for i in range(n)
        }
        self.layers: dict[str, list[str]] = {
            level: [] for level in ("input", *self._blocks.values(), "head")
        }
        """The names of the convolutions of each level."""
        for name, module in network.named_modules():
            if isinstance(module, PlainConv2d):
                block = ".".join(name.split(".")[:2])
                level = self._blocks.get(block, "input" if name == "lift" else "head")
                self.layers[level].append(name)
            elif name not in self._blocks:
                continue
            module.register_forward_pre_hook(self._start(name))
            module.register_forward_hook(self._end(name))

    def _start(self, name: str) -> Callable[..., None]:
        def hook(module: nn.Module, inputs: Any) -> None:
            self._starts[name] = read_clock(self._device)

        return hook

    def _end(self, name: str) -> Callable[..., None]:
        def hook(module: nn.Module, inputs: Any, output: Tensor) -> None:
            self._ends[name] = read_clock(self._device)
            if isinstance(module, PlainConv2d):
                self.operations[name] = 2 * module.weight.numel() * output[:, 0].numel()
                self.types[name] = output.dtype

        return hook

    def run(self, features: Tensor) -> dict[str, float]:
        """Runs one inference; returns the time of each level and each convolution, in seconds."""
        start = read_clock(self._device)
        self._network(features)
        end = read_clock(self._device)
        seconds = {
            name: self._ends[name] - self._starts[name]
            for names in self.layers.values()
            for name in names
        }
        # Count the resampling and concatenation before a block as parts of the block.
        seconds["input"] = self._starts["down.0"] - start
        before = self._starts["down.0"]
        for block, level in self._blocks.items():
            seconds[level] = self._ends[block] - before
            before = self._ends[block]
        return seconds | {"head": end - before}
