"""Measures the speed of the SO(2) networks in this package relative to plain escnn."""

from __future__ import annotations

import copy
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn

from kitting_drake.policies.data.samples import ObservedScene, labelled_images
from kitting_drake.policies.learned_policy import LearnedPolicy
from kitting_drake.policies.networks.architecture import NetworkConfig
from kitting_drake.policies.networks.escnn_reference import EscnnAngleNet, EscnnUNet, as_escnn
from kitting_drake.policies.networks.factored import Networks, SO2Networks
from kitting_drake.policies.networks.methods import make_networks
from kitting_drake.policies.training.training_step import Trainer
from kitting_drake.reproduction.network_speed.convolutions import Convolutions
from kitting_drake.reproduction.network_speed.plan import SpeedSetup, times_of, type_name
from kitting_drake.reproduction.network_speed.timing import Timing, count_operations

MEASURES = ("training_step", "alpha_training_step", "decision", "alpha_inference")
"""The names of the timed operations."""


def measure_folding(setup: SpeedSetup) -> dict[str, Any]:
    """Times the SO(2) networks, as built from escnn's modules and as this package runs them.

    All variants have the same weights and compute the same function, up to rounding.

    Returns:
        - `rungs`: the time of each of `MEASURES`, for each variant;
        - `speed_up`: the speed of each variant relative to plain escnn in float32;
        - `convolution_share`: for the variants of this package, the time that plain torch needs for
          convolutions of the same shapes and type, as a share of the time of a training step and of
          a decision;
        - `alpha_difference`: the standard deviation of alpha's output minus that of plain escnn,
          relative to the standard deviation of plain escnn's output;
        - `alpha_operations`: the number of operations of one inference of alpha.
    """
    ways = _ways(setup)
    exported = {name: pair[1] for name, pair in ways.items()}
    timings = _time_ways(setup, ways)
    baseline = next(iter(ways))
    with torch.inference_mode():
        outputs = {
            name: networks.predict_pick(setup.image, networks.config.orientations).position
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
                "training_step": _convolution_share(_training(pair[0], setup.scene), setup, True),
                "decision": _convolution_share(_deciding(pair[1], setup), setup, False),
            }
            for name, pair in ways.items()
            if name.startswith("ours")
        },
        "alpha_difference": {
            name: float((output - exact).std() / exact.std()) for name, output in outputs.items()
        },
        "alpha_operations": {
            # Count in float32: autocast has the same operations, but they cannot be counted.
            name: count_operations(inferring(*_alpha(exported[f"{name}_float32"], setup)))
            for name in ("escnn", "ours")
        },
    }


def _ways(setup: SpeedSetup) -> dict[str, tuple[Networks, Networks]]:
    """Returns the variants of the networks, each for training and for inference."""
    ours = make_networks(NetworkConfig("so2", setup.plan.preset))
    assert isinstance(ours, SO2Networks)
    types = [type_ for type_ in (torch.float32, torch.bfloat16) if type_ in setup.peak]
    ways: dict[str, tuple[Networks, Networks]] = {}
    escnn = as_escnn(ours)
    for type_ in types:
        trained = _with_autocast(escnn, type_)
        # In evaluation mode, escnn caches the expanded kernels.
        exported = copy.deepcopy(trained).eval().requires_grad_(False)
        ways[f"escnn_{type_name(type_)}"] = (trained, exported)
    for type_ in types:
        ways[f"ours_{type_name(type_)}"] = (computing_in(ours, type_), setup.export(ours, type_))
    for pair in ways.values():
        for networks in pair:
            networks.to(setup.device)
    return ways


def _with_autocast(escnn: Networks, type_: torch.dtype) -> Networks:
    """Returns a copy of networks that computes in a given type with torch's autocast."""
    escnn = copy.deepcopy(escnn)
    for network in escnn.children():
        if isinstance(network, EscnnUNet | EscnnAngleNet):
            network.autocast = None if type_ == torch.float32 else type_
    return escnn


def _time_ways(
    setup: SpeedSetup, ways: dict[str, tuple[Networks, Networks]]
) -> dict[str, dict[str, Timing]]:
    """Times each of `MEASURES` for each variant."""
    trained = {name: pair[0] for name, pair in ways.items()}
    exported = {name: pair[1] for name, pair in ways.items()}
    return {
        "training_step": setup.time_each(
            {name: _training(networks, setup.scene) for name, networks in trained.items()},
            training=True,
        ),
        "alpha_training_step": setup.time_each(
            {name: stepping(*_alpha(networks, setup)) for name, networks in trained.items()},
            training=True,
        ),
        "decision": setup.time_each(
            {name: _deciding(networks, setup) for name, networks in exported.items()}
        ),
        "alpha_inference": setup.time_each(
            {name: inferring(*_alpha(networks, setup)) for name, networks in exported.items()}
        ),
    }


def _convolution_share(function: Callable[[], object], setup: SpeedSetup, training: bool) -> float:
    """Returns the share of a function's time that its convolutions alone take."""
    convolutions = Convolutions.of(function)
    # Time the convolutions in alternation with the function, so that both share the effect of other
    # load.
    functions: dict[Any, Callable[[], object]] = {"all": function}
    functions |= convolutions.alone(setup.device)
    timings = setup.time_each(functions, training=training)
    return convolutions.seconds(timings) / timings["all"].seconds


def _alpha(networks: Networks, setup: SpeedSetup) -> tuple[nn.Module, Tensor]:
    """Returns the network alpha and its input."""
    return networks.get_submodule("alpha"), setup.inputs(networks)["alpha"]


def computing_in(networks: Networks, type_: torch.dtype) -> Networks:
    """Returns a copy of networks, for training, that computes in a given type."""
    networks = copy.deepcopy(networks)
    networks.compute_type = type_
    return networks


def _training(networks: Networks, scene: ObservedScene) -> Callable[[], object]:
    """Returns a function that makes training steps of all four networks, including augmentation.

    The steps are the same for all variants.
    """
    trainer = Trainer(networks, seed=0, curvature=True)
    samples = labelled_images([scene], taken_only=False)
    return lambda: trainer.step(samples)


def stepping(network: nn.Module, features: Tensor) -> Callable[[], object]:
    """Returns a function that makes a training step of one network: forward, backward, Adam."""
    optimiser = torch.optim.Adam(network.parameters(), lr=1e-6)

    def step() -> None:
        optimiser.zero_grad(set_to_none=True)
        network(features).square().mean().backward()
        optimiser.step()

    return step


def inferring(network: nn.Module, features: Tensor) -> Callable[[], object]:
    """Returns a function that makes one inference of a network."""
    return lambda: network(features)


def _deciding(networks: Networks, setup: SpeedSetup) -> Callable[[], object]:
    policy = LearnedPolicy(networks, orientations=networks.config.orientations)
    return lambda: policy.decide(setup.observe())
