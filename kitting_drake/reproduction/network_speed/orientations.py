"""Measures the cost of predictions at N orientations: figure 6(c) of the paper, and whole
decisions."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import torch
from torch import nn

from kitting_drake.policies.data.images import crop
from kitting_drake.policies.learned_policy import LearnedPolicy
from kitting_drake.policies.networks.architecture import METHODS, PICK_CROP, NetworkConfig
from kitting_drake.policies.networks.device import preferred_type
from kitting_drake.policies.networks.factored import FactoredNetworks, Networks
from kitting_drake.policies.networks.layers.steerable import PlainConv2d
from kitting_drake.policies.networks.methods import make_networks
from kitting_drake.policies.networks.transporter import TransporterNetworks, encodings_per_decision
from kitting_drake.reproduction.network_speed.plan import Plan, SpeedSetup, times_of
from kitting_drake.reproduction.network_speed.timing import Timing, count_operations, read_clock

PARTS = {
    "pick_position": ("alpha", "f_pick"),
    "pick_angle": ("beta",),
    "phi": ("phi",),
    "psi": ("psi",),
}
"""The networks of each part of a decision. One more part, `search`, is the correlation and the
processing of inputs and outputs."""

_MADE_FOR_N = ("equivariant_transporter",)
"""The methods whose architecture depends on N. The networks of the other methods predict at any
N."""


def measure_pick_angles(setup: SpeedSetup, preset: str) -> list[dict[str, Any]]:
    """Measures the parameters and the inference time of the models that predict the pick angle.

    For the Transporter, this is its whole picking module, which sees the scene at every angle.

    Returns:
        A row for each method and N.
    """
    rows = []
    for method, orientations in _cells(setup.plan):
        config = NetworkConfig(method, preset, max(orientations))
        trained = make_networks(config)
        losses = trained.modules_by_loss()
        models = losses.get("pick_angle", next(iter(losses.values())))
        parameters = sum(weight.numel() for model in models for weight in model.parameters())
        names = {name for name, child in trained.named_children() if child in models}
        del trained, losses, models

        outlined = _without_others(_outlined(config), names)
        operations = {
            n: setup.count((config, n), _compute_angles(outlined, setup, n)) for n in orientations
        }
        skipped = {n: setup.why_not(outlined, count) for n, count in operations.items()}
        timings: dict[int, Timing] = {}
        if not all(skipped.values()):
            # Use untrained networks, which are as fast as trained ones. Loading networks from a
            # file, as an evaluation does, could take gigabytes.
            networks = _without_others(make_networks(config, PlainConv2d), names).to(setup.device)
            networks.freeze(preferred_type())
            timings = setup.time_each(
                {n: _predict_angle(networks, setup, n) for n in orientations if not skipped[n]}
            )
        rows += [
            {
                "preset": preset,
                "method": method,
                "orientations": n,
                "parameters": parameters,
                "operations": operations[n],
                "skipped": skipped[n],
                **times_of(timings.get(n)),
            }
            for n in orientations
        ]
    return rows


def _cells(plan: Plan) -> Iterator[tuple[str, tuple[int, ...]]]:
    """Yields each method with the values of N for which one set of networks is enough.

    A method whose architecture depends on N is yielded once for each N.
    """
    for method in METHODS:
        if method in _MADE_FOR_N:
            yield from ((method, (n,)) for n in plan.orientations)
        elif method == "so2":
            yield method, (*plan.orientations, plan.finer)
        else:
            yield method, plan.orientations


def _outlined(config: NetworkConfig) -> Networks:
    """Returns plain networks on the meta device, to count operations without computing."""
    with torch.device("meta"):
        return make_networks(config, PlainConv2d).to("meta").requires_grad_(False)


def _without_others(networks: Networks, names: set[str]) -> Networks:
    """Deletes all children of networks except those in `names`, to free their memory."""
    for name in [name for name, _ in networks.named_children() if name not in names]:
        delattr(networks, name)
    return networks


def _compute_angles(networks: Networks, setup: SpeedSetup, n: int) -> Callable[[], object]:
    """Returns a function that computes all angles at a known pixel.

    The function does not read the values of its result, because the meta device computes none.
    """
    if isinstance(networks, FactoredNetworks):
        crops = networks.prepare(crop(setup.image, setup.pixel, PICK_CROP))
        return lambda: networks.crop_angle_logits(crops, n)
    return _predict_angle(networks, setup, n)


def _predict_angle(networks: Networks, setup: SpeedSetup, n: int) -> Callable[[], object]:
    """Returns a function that predicts the angle at a known pixel."""
    if isinstance(networks, FactoredNetworks):
        return lambda: networks.predict_angle(setup.image, setup.pixel, n)
    return lambda: networks.predict_pick(setup.image, n).angle(setup.pixel)


def measure_decisions(setup: SpeedSetup) -> list[dict[str, Any]]:
    """Times whole decisions of exported networks, and the parts of each decision.

    Returns:
        A row for each method and N. The times of the parts are from the run whose total time is the
        median.
    """
    rows = []
    for method, orientations in _cells(setup.plan):
        config = NetworkConfig(method, setup.plan.preset, max(orientations))
        outlined = _outlined(config)
        operations = {
            n: setup.count((config, n), _compute_angles(outlined, setup, n))
            + count_operations(_compute_others(outlined, setup, n))
            for n in orientations
        }
        skipped = {n: setup.why_not(outlined, count) for n, count in operations.items()}
        timings: dict[int, Timing] = {}
        runs: dict[int, list[dict[str, float]]] = {n: [] for n in orientations}
        trained = make_networks(config)
        parameters = sum(weight.numel() for weight in trained.parameters())
        if not all(skipped.values()):
            watched = _WatchedPolicy(setup, setup.export(trained, preferred_type()))
            timings = setup.time_each(
                {n: watched.deciding(n, runs[n]) for n in orientations if not skipped[n]}
            )
        for n in orientations:
            timing = timings.get(n)
            counted = runs[n][-timing.runs :] if timing else []
            typical = sorted(counted, key=lambda run: sum(run.values()))
            rows.append(
                {
                    "preset": setup.plan.preset,
                    "method": method,
                    "orientations": n,
                    "parameters": parameters,
                    "operations": operations[n],
                    "skipped": skipped[n],
                    **times_of(timing),
                    "parts": typical[len(typical) // 2] if typical else None,
                }
            )
    return rows


def _compute_others(networks: Networks, setup: SpeedSetup, n: int) -> Callable[[], object]:
    """Returns a function with all computations of the networks for a decision, except angles and
    search."""

    def compute() -> None:
        # Skip the Transporter, which computes positions together with angles.
        if isinstance(networks, FactoredNetworks):
            networks.position_logits(setup.image)
        networks.encode_scene(setup.image)
        if isinstance(networks, TransporterNetworks):
            rotations = [0.0] * encodings_per_decision(n)
            networks.encode_crops(setup.image, setup.pixel, rotations)
        else:
            networks.encode_crop(setup.image, setup.pixel)

    return compute


class _WatchedPolicy:
    """A policy that times each part of its decisions."""

    def __init__(self, setup: SpeedSetup, networks: Networks) -> None:
        self._setup, self._device = setup, setup.device
        self._networks = networks
        self._parts: dict[str, float] = {}
        self._start = 0.0
        for part, names in PARTS.items():
            for name, network in networks.named_children():
                if name in names:
                    network.register_forward_pre_hook(self._before)
                    network.register_forward_hook(self._after(part))

    def _before(self, module: nn.Module, inputs: Any) -> None:
        self._start = read_clock(self._device)

    def _after(self, part: str) -> Callable[..., None]:
        def hook(module: nn.Module, inputs: Any, output: Any) -> None:
            self._parts[part] += read_clock(self._device) - self._start

        return hook

    def deciding(self, orientations: int, runs: list[dict[str, float]]) -> Callable[[], object]:
        """Returns a function that decides at N and appends the times of its parts, in seconds, to
        `runs`."""
        policy = LearnedPolicy(self._networks, orientations=orientations)

        def decide() -> None:
            self._parts = dict.fromkeys(PARTS, 0.0)
            observation = self._setup.observe()
            start = read_clock(self._device)
            policy.decide(observation)
            total = read_clock(self._device) - start
            runs.append(self._parts | {"search": total - sum(self._parts.values())})

        return decide


def growth(rows: list[dict[str, Any]], orientations: tuple[int, ...]) -> list[dict[str, Any]]:
    """Returns the ratios of the costs at the largest N to those at the smallest N.

    Args:
        rows: the rows of `measure_pick_angles` or `measure_decisions`.
        orientations: the values of N.

    Returns:
        A row of ratios for each preset and method; None for values that were not measured.
    """
    ends = (min(orientations), max(orientations))
    cells = {(row["preset"], row["method"], row["orientations"]): row for row in rows}
    result = []
    for preset, method in dict.fromkeys((row["preset"], row["method"]) for row in rows):
        few, many = (cells[preset, method, n] for n in ends)
        ratios = {
            key: many[key] / few[key] if many[key] and few[key] else None
            for key in ("parameters", "operations", "seconds")
        }
        result.append({"preset": preset, "method": method, "from": ends[0], "to": ends[1]} | ratios)
    return result
