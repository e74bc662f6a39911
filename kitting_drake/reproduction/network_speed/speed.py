"""The speed of the paper's networks, relative to plain escnn and to the machine's peak."""

from __future__ import annotations

import copy
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from kitting_drake.policies.data.samples import ObservedScene, labelled_images
from kitting_drake.policies.learned_policy import LearnedPolicy
from kitting_drake.policies.networks.architecture import NetworkConfig
from kitting_drake.policies.networks.device import preferred_type
from kitting_drake.policies.networks.escnn_reference import as_escnn
from kitting_drake.policies.networks.factored import Networks, SO2Networks
from kitting_drake.policies.networks.layers.steerable import PlainConv2d
from kitting_drake.policies.networks.methods import make_networks
from kitting_drake.policies.networks.unet import UNet
from kitting_drake.policies.training.training_step import Trainer
from kitting_drake.reproduction.network_speed.convolutions import Convolutions
from kitting_drake.reproduction.network_speed.plan import Bench, times_of, type_name
from kitting_drake.reproduction.network_speed.timing import Timing, count_operations, read_clock

MEASURES = ("training_step", "alpha_training_step", "decision", "alpha_inference")
"""The operations that are timed for each way to run the same networks."""


def measure_folding(bench: Bench) -> dict[str, Any]:
    """Times the paper's networks built of escnn's modules, and as this package runs them.

    Their weights are the same, and so is what they compute, up to rounding.

    Returns:
        By way of running them, `rungs`: the time of each of `MEASURES`; `speed_up`: how many times
        faster than plain escnn in float32 each of them is; `convolution_share`: for ours, the share
        of the time of a training step and of a decision that its convolutions alone take, by plain
        torch on tensors of the same shapes and type; `alpha_difference`: the difference of alpha's
        output from plain escnn's, relative to its standard deviation; and `alpha_operations` of one
        inference.
    """
    ways = _ways(bench)
    exported = {name: pair[1] for name, pair in ways.items()}
    timings = _time_ways(bench, ways)
    baseline = next(iter(ways))
    with torch.inference_mode():
        outputs = {
            name: networks.predict_pick(bench.image, networks.config.orientations).position
            for name, networks in exported.items()
        }
    exact = outputs[baseline]
    return {
        "rungs": {
            name: {measure: times_of(timings[measure][name]) for measure in MEASURES}
            for name in ways
        },
        "speed_up": {
            name: {
                measure: timings[measure][baseline].seconds / timings[measure][name].seconds
                for measure in MEASURES
            }
            for name in ways
        },
        "convolution_share": {
            name: {
                "training_step": _convolution_share(_training(pair[0], bench.scene), bench, True),
                "decision": _convolution_share(_deciding(pair[1], bench), bench, False),
            }
            for name, pair in ways.items()
            if name.startswith("ours")
        },
        "alpha_difference": {
            name: float((output - exact).std() / exact.std()) for name, output in outputs.items()
        },
        "alpha_operations": {
            # Those of autocast cannot be counted, but they are the same.
            name: count_operations(_inferring(*_alpha(exported[f"{name}_float32"], bench)))
            for name in ("escnn", "ours")
        },
    }


def _ways(bench: Bench) -> dict[str, tuple[Networks, Networks]]:
    """The same networks in each way to run them: one for training, and one for inference."""
    ours = make_networks(NetworkConfig("so2", bench.plan.preset))
    assert isinstance(ours, SO2Networks)
    types = [type_ for type_ in (torch.float32, torch.bfloat16) if type_ in bench.peak]
    ways: dict[str, tuple[Networks, Networks]] = {}
    for type_ in types:
        autocast = None if type_ == torch.float32 else type_
        # In evaluation mode escnn keeps the kernels that it has expanded.
        plain = as_escnn(ours, autocast).eval().requires_grad_(False)
        ways[f"escnn_{type_name(type_)}"] = (as_escnn(ours, autocast), plain)
    for type_ in types:
        ways[f"ours_{type_name(type_)}"] = (_computing_in(ours, type_), bench.export(ours, type_))
    for pair in ways.values():
        for networks in pair:
            networks.to(bench.device)
    return ways


def _time_ways(
    bench: Bench, ways: dict[str, tuple[Networks, Networks]]
) -> dict[str, dict[str, Timing]]:
    """Each of `MEASURES` for each way to run the networks."""
    trained = {name: pair[0] for name, pair in ways.items()}
    exported = {name: pair[1] for name, pair in ways.items()}
    return {
        "training_step": bench.time_each(
            {name: _training(networks, bench.scene) for name, networks in trained.items()},
            training=True,
        ),
        "alpha_training_step": bench.time_each(
            {name: _stepping(*_alpha(networks, bench)) for name, networks in trained.items()},
            training=True,
        ),
        "decision": bench.time_each(
            {name: _deciding(networks, bench) for name, networks in exported.items()}
        ),
        "alpha_inference": bench.time_each(
            {name: _inferring(*_alpha(networks, bench)) for name, networks in exported.items()}
        ),
    }


def _convolution_share(function: Callable[[], object], bench: Bench, training: bool) -> float:
    """The share of a function's time that its convolutions take when they are computed alone."""
    convolutions = Convolutions.of(function)
    # In alternation with the function, so that other load on the machine affects both alike.
    functions: dict[Any, Callable[[], object]] = {"all": function}
    functions |= convolutions.alone(bench.device)
    timings = bench.time_each(functions, training=training)
    return convolutions.seconds(timings) / timings["all"].seconds


def _alpha(networks: Networks, bench: Bench) -> tuple[nn.Module, Tensor]:
    """The network alpha, and its input."""
    return networks.get_submodule("alpha"), bench.inputs(networks)["alpha"]


def _computing_in(networks: Networks, type_: torch.dtype) -> Networks:
    """A copy that computes in another type, to be trained."""
    networks = copy.deepcopy(networks)
    networks.compute_type = type_
    return networks


def _training(networks: Networks, scene: ObservedScene) -> Callable[[], object]:
    """Training steps of all four networks, augmentation and losses included: the same ones,
    whatever the networks."""
    trainer = Trainer(networks, seed=0, curvature=True)
    samples = labelled_images([scene], taken_only=False)
    return lambda: trainer.step(samples)


def _stepping(network: nn.Module, features: Tensor) -> Callable[[], object]:
    """A training step of one network: forwards, backwards, Adam."""
    optimiser = torch.optim.Adam(network.parameters(), lr=1e-6)

    def step() -> None:
        optimiser.zero_grad(set_to_none=True)
        network(features).square().mean().backward()
        optimiser.step()

    return step


def _inferring(network: nn.Module, features: Tensor) -> Callable[[], object]:
    return lambda: network(features)


def _deciding(networks: Networks, bench: Bench) -> Callable[[], object]:
    policy = LearnedPolicy(networks, orientations=networks.config.orientations)
    return lambda: policy.decide(bench.observe())


def measure_shares(bench: Bench) -> list[dict[str, Any]]:
    """The share of the machine's peak that the paper's networks reach.

    Returns:
        A row for each network, type and mode (`inference`, `training`).
    """
    ours = make_networks(NetworkConfig("so2", bench.plan.preset))
    inferring: dict[Any, Callable[[], object]] = {}
    stepping: dict[Any, Callable[[], object]] = {}
    for type_ in bench.peak:
        exported = bench.export(ours, type_)
        trained = _computing_in(ours, type_).to(bench.device)
        for name, features in bench.inputs(exported).items():
            inferring[name, type_, "inference"] = _inferring(exported.get_submodule(name), features)
            stepping[name, type_, "training"] = _stepping(trained.get_submodule(name), features)
    timings = bench.time_each(inferring) | bench.time_each(stepping, training=True)
    functions = inferring | stepping
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
                "share": rate / bench.peak[type_]["best"],
            }
        )
    return rows


def measure_levels(bench: Bench) -> dict[str, Any]:
    """Times alpha's inference, level by level of the U-net and layer by layer.

    Returns:
        `levels` and `layers`. A level's `convolution_s` is the time in its convolutions, `rest_s`
        that in all else (ELU, sums, resampling, concatenation). The times are medians.
    """
    type_ = preferred_type()
    networks = bench.export(make_networks(NetworkConfig("so2", bench.plan.preset)), type_)
    alpha = networks.get_submodule("alpha")
    assert isinstance(alpha, UNet)
    watch = _UNetWatch(alpha, bench.device)
    features = bench.inputs(networks)["alpha"]
    runs = []
    with torch.inference_mode():
        for repeat in range(bench.plan.repeats + 2):
            seconds = watch.run(features)
            # The first two runs warm up.
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
                    "share": operations / median[name] / bench.peak[layer_type]["best"],
                }
            )
        convolution = sum(median[name] for name in names)
        needed = sum(
            watch.operations[name] / bench.peak[watch.types[name]]["best"] for name in names
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
    """Hooks that record when each level and each convolution of a U-net begins and ends."""

    def __init__(self, network: UNet, device: torch.device) -> None:
        self._network, self._device = network, device
        self._starts: dict[str, float] = {}
        self._ends: dict[str, float] = {}
        self.operations: dict[str, int] = {}
        """The number of operations of each convolution."""
        self.types: dict[str, torch.dtype] = {}
        """The type that each convolution computes in."""
        self._blocks = {
            f"{way}.{i}": f"{way} {i + 1}" for way, n in (("down", 5), ("up", 4)) for i in range(n)
        }
        self.layers: dict[str, list[str]] = {
            level: [] for level in ("input", *self._blocks.values(), "head")
        }
        """The convolutions of each level."""
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
        """Seconds of each level and of each convolution of one inference."""
        start = read_clock(self._device)
        self._network(features)
        end = read_clock(self._device)
        seconds = {
            name: self._ends[name] - self._starts[name]
            for names in self.layers.values()
            for name in names
        }
        # The resampling and concatenation before a block belong to it.
        seconds["input"] = self._starts["down.0"] - start
        before = self._starts["down.0"]
        for block, level in self._blocks.items():
            seconds[level] = self._ends[block] - before
            before = self._ends[block]
        return seconds | {"head": end - before}
