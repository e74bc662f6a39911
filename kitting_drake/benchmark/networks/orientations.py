"""What an answer costs at N orientations: figure 6(c) of the paper, and the whole decision."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import torch

from kitting_drake.benchmark.networks.bench import Bench, Plan, times_of
from kitting_drake.benchmark.networks.timing import Timing, count_operations, read_clock
from kitting_drake.policies.config import METHODS, NetworkConfig
from kitting_drake.policies.learned_policy import LearnedPolicy
from kitting_drake.policies.methods import make_networks
from kitting_drake.policies.networks import FactoredNetworks, Networks
from kitting_drake.policies.steerable import PlainConv2d
from kitting_drake.policies.weights import preferred_type

PARTS = {
    "pick_position": "position_logits",
    "pick_angle": "angle_answer",
    "phi": "encode_scene",
    "psi": "encode_crop",
}
"""Of a decision, by the method of `Networks` that computes it; the rest of it is `search`."""

_MADE_FOR_N = ("equivariant_transporter",)
"""Methods whose networks depend on N; the others' are asked at any N."""


def measure_pick_angles(bench: Bench, preset: str) -> list[dict[str, Any]]:
    """Parameters and inference time of what answers the pick angle.

    For the Transporter that is all of its picking: one network, given the scene at every angle.

    Returns:
        A row for each method and N.
    """
    rows = []
    for method, orientations in _cells(bench.plan):
        config = NetworkConfig(method, preset, max(orientations))
        trained = make_networks(config)
        losses = trained.modules_by_loss()
        models = losses.get("pick_angle", next(iter(losses.values())))
        parameters = sum(weight.numel() for model in models for weight in model.parameters())
        names = {name for name, child in trained.named_children() if child in models}
        del trained, losses, models

        outlined = _without_others(_outlined(config), names)
        operations = {n: count_operations(_ask_angle(outlined, bench, n)) for n in orientations}
        skipped = {n: bench.why_not(outlined, count) for n, count in operations.items()}
        timings: dict[int, Timing] = {}
        if not all(skipped.values()):
            # Fresh weights take as long as any, and writing some of these would take gigabytes.
            networks = _without_others(make_networks(config, PlainConv2d), names).to(bench.device)
            networks.compute_type = preferred_type()
            networks.eval().requires_grad_(False)
            asked = {n: _ask_angle(networks, bench, n) for n in orientations if not skipped[n]}
            timings = bench.time_each(asked)
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
    """Each method, with the N at which one set of its networks is asked."""
    for method in METHODS:
        if method in _MADE_FOR_N:
            yield from ((method, (n,)) for n in plan.orientations)
        elif method == "so2":
            yield method, (*plan.orientations, plan.finer)
        else:
            yield method, plan.orientations


def _outlined(config: NetworkConfig) -> Networks:
    """Plain networks without values: shapes pass through them at no cost."""
    with torch.device("meta"):
        return make_networks(config, PlainConv2d).to("meta").requires_grad_(False)


def _without_others(networks: Networks, names: set[str]) -> Networks:
    """The same, of its children only those named: the others' gigabytes are given back."""
    for name in [name for name, _ in networks.named_children() if name not in names]:
        delattr(networks, name)
    return networks


def _ask_angle(networks: Networks, bench: Bench, orientations: int) -> Callable[[], object]:
    """The angle at a known pixel, of an image that was not seen before."""
    return lambda: networks.angle_logits(bench.image.copy(), bench.pixel, orientations)


def measure_decisions(bench: Bench) -> list[dict[str, Any]]:
    """Time of a whole decision on exported networks, and of its parts.

    Returns:
        A row for each method and N; the parts are those of the run of median time.
    """
    rows = []
    for method, orientations in _cells(bench.plan):
        config = NetworkConfig(method, bench.plan.preset, max(orientations))
        outlined = _outlined(config)
        operations = {
            n: count_operations(_ask_everything(outlined, bench, n)) for n in orientations
        }
        skipped = {n: bench.why_not(outlined, count) for n, count in operations.items()}
        timings: dict[int, Timing] = {}
        runs: dict[int, list[dict[str, float]]] = {n: [] for n in orientations}
        trained = make_networks(config)
        parameters = sum(weight.numel() for weight in trained.parameters())
        if not all(skipped.values()):
            watched = _WatchedPolicy(bench, bench.export(trained, preferred_type()))
            asked = {n: watched.deciding(n, runs[n]) for n in orientations if not skipped[n]}
            timings = bench.time_each(asked)
        for n in orientations:
            timing = timings.get(n)
            counted = runs[n][-timing.runs :] if timing else []
            typical = sorted(counted, key=lambda run: sum(run.values()))
            rows.append(
                {
                    "preset": bench.plan.preset,
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


def _ask_everything(networks: Networks, bench: Bench, orientations: int) -> Callable[[], object]:
    """All that a decision asks of the networks, the search left out."""

    def ask() -> None:
        # The Transporter's networks answer both at once.
        if isinstance(networks, FactoredNetworks):
            networks.position_logits(bench.image, orientations)
        networks.angle_logits(bench.image, bench.pixel, orientations)
        networks.encode_scene(bench.image)
        networks.encode_crop(bench.image, bench.pixel)

    return ask


class _WatchedPolicy:
    """Decides, and notes the time of each part."""

    def __init__(self, bench: Bench, networks: Networks) -> None:
        self._bench, self._device = bench, bench.device
        self._networks = networks
        self._parts: dict[str, float] = {}
        for part, method in PARTS.items():
            setattr(networks, method, self._watched(part, getattr(networks, method)))

    def _watched(self, part: str, method: Callable[..., Any]) -> Callable[..., Any]:
        def call(*arguments: Any) -> Any:
            start = read_clock(self._device)
            answer = method(*arguments)
            self._parts[part] = self._parts.get(part, 0.0) + read_clock(self._device) - start
            return answer

        return call

    def deciding(self, orientations: int, runs: list[dict[str, float]]) -> Callable[[], object]:
        """A decision at N, that adds the seconds of its parts to `runs`."""
        policy = LearnedPolicy(self._networks, orientations=orientations)

        def decide() -> None:
            self._parts = dict.fromkeys(PARTS, 0.0)
            observation = self._bench.observe()
            start = read_clock(self._device)
            policy.decide(observation)
            total = read_clock(self._device) - start
            runs.append(self._parts | {"search": total - sum(self._parts.values())})

        return decide


def growth(rows: list[dict[str, Any]], orientations: tuple[int, ...]) -> list[dict[str, Any]]:
    """How much more the largest N costs than the smallest.

    Args:
        rows: of `measure_pick_angles` or `measure_decisions`.
        orientations: N.

    Returns:
        A row for each preset and method: ratios, or None where one of both was not measured.
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
