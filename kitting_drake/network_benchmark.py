"""What the networks cost here and now: figure 6(c) of the paper, and what lies beside it.

All figures come from one run on one machine, and what is compared takes turns. Needs no Drake.
"""

from __future__ import annotations

import copy
import dataclasses
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
from torch import Tensor, nn

from kitting_drake.errors import UserError
from kitting_drake.policies import config as sizes
from kitting_drake.policies.config import METHODS, PRESETS, NetworkConfig
from kitting_drake.policies.demonstrations import read_demonstrations
from kitting_drake.policies.escnn_reference import as_escnn
from kitting_drake.policies.images import Image, LabelledImage, crop, rotation
from kitting_drake.policies.learned_policy import LearnedPolicy
from kitting_drake.policies.methods import make_networks
from kitting_drake.policies.networks import FactoredNetworks, Networks, SO2Networks
from kitting_drake.policies.samples import Scene, labelled_images, scenes
from kitting_drake.policies.steerable import PlainConv2d
from kitting_drake.policies.training import Trainer
from kitting_drake.policies.unet import UNet
from kitting_drake.policies.weights import load_networks, preferred_type, save_weights
from kitting_drake.timing import (
    Timing,
    count_operations,
    describe_machine,
    measure_peak,
    memory_bytes,
    read_clock,
    time_each,
)
from systems.signals import Observation, PixelGrid

PARTS = {
    "pick_position": ("position_logits",),
    "pick_angle": ("angle_logits", "angle_maximum"),
    "phi": ("encode_scene",),
    "psi": ("encode_crop",),
}
"""Of a decision, by the methods of `Networks` that compute them; the rest of it is `search`."""
MEASURES = ("training_step", "alpha_training_step", "decision", "alpha_inference")
"""What is timed of each way to run the same networks."""

_MADE_FOR_N = ("equivariant_transporter",)
"""Methods whose networks depend on N; the others' are asked at any N."""
_EXPECTED_SHARE = 0.3
"""Of the machine's peak: what a network is expected to reach when its time is predicted."""


@dataclass(frozen=True)
class Plan:
    """What to measure, and how carefully."""

    preset: str = "small"
    compared_preset: str | None = "paper"
    """One more, of which only the models that answer the pick angle are measured."""
    orientations: tuple[int, ...] = (36, 72, 120, 180)
    """N of section V-B.1 of the paper."""
    finer: int = 720
    """N at which the paper's own method alone is asked."""
    repeats: int = 9
    """Of which the median is taken."""
    peak_side: int = 2048
    """Of the matrices whose product shows the machine's peak; fourfold on an accelerator."""
    budget: float = 60.0
    """Seconds that a figure may take; what is predicted to take longer is left out."""
    demonstrations: Path | None = None
    """Where the observation comes from; None: it is drawn."""

    def __post_init__(self) -> None:
        if self.preset not in PRESETS:
            raise UserError(f"--preset must be one of {', '.join(PRESETS)}, not '{self.preset}'")


@dataclass
class _Bench:
    """What all measurements share."""

    plan: Plan
    device: torch.device
    folder: Path
    """For the weights of exported networks."""
    scene: Scene
    grid: PixelGrid
    peak: dict[torch.dtype, dict[str, float]] = field(default_factory=dict)
    """By type: what `measure_peak` gives."""

    @property
    def image(self) -> Image:
        return self.scene.image

    @property
    def pixel(self) -> tuple[int, int]:
        """(row, col) of the pick."""
        row, col = np.rint(self.scene.targets[0].pick).astype(int)
        return int(row), int(col)

    def observe(self) -> Observation:
        """The scene as if seen anew: networks may remember what they saw."""
        return Observation(self.image.copy(), self.grid)

    def time_each(
        self, functions: dict[Any, Callable[[], object]], *, training: bool = False
    ) -> dict[Any, Timing]:
        """`timing.time_each`, as carefully as planned."""
        plan = self.plan
        with torch.inference_mode(not training):
            return time_each(functions, self.device, repeats=plan.repeats, budget=plan.budget)

    def inputs(self, networks: Networks) -> dict[str, Tensor]:
        """Each network's."""
        scene = networks.prepare(self.image)
        return {
            "alpha": scene,
            "phi": scene,
            "psi": networks.prepare(crop(self.image, self.pixel, sizes.PLACE_CROP)),
            "beta": networks.prepare(crop(self.image, self.pixel, sizes.PICK_CROP)),
        }

    def export(self, networks: Networks, type_: torch.dtype) -> Networks:
        """What evaluation runs: saved, and loaded as plain convolutions."""
        path = self.folder / "networks.safetensors"
        save_weights(path, networks, {})
        return load_networks(path, type_).to(self.device)

    def why_not(self, outlined: Networks, operations: int) -> str | None:
        """Why something is not timed, if it is not.

        Args:
            outlined: its networks, without values.
            operations: of one run.
        """
        seconds = operations / (_EXPECTED_SHARE * self.peak[preferred_type()]["best"])
        if seconds > self.plan.budget:
            return f"would take about {seconds:.0f} s"
        size = 4 * sum(weight.numel() for weight in outlined.parameters())
        if size > memory_bytes(self.device) / 2:
            return f"needs {size / 2**30:.0f} GiB of kernels"
        return None


def benchmark_networks(plan: Plan, console: Console) -> dict[str, Any]:
    """Measures everything that `benchmark networks` shows.

    Times are in seconds of wall time, rates in operations a second; a multiply-accumulate is two
    operations.

    Args:
        plan: what to measure.
        console: for progress.

    Raises:
        UserError: the demonstrations cannot be used.
    """
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    machine = describe_machine(device)
    scene, grid = _observed(plan.demonstrations)
    types = sorted({preferred_type(), torch.float32}, key=str)
    presets = [plan.preset]
    if plan.compared_preset not in (None, plan.preset):
        presets.append(str(plan.compared_preset))
    torch.manual_seed(0)
    measured: dict[str, Any] = {
        "machine": machine,
        "inference_type": _type_name(preferred_type()),
        "preset": plan.preset,
        "repeats": plan.repeats,
        "budget_s": plan.budget,
        "observation": str(plan.demonstrations or "drawn"),
    }
    columns = (TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn())
    with (
        tempfile.TemporaryDirectory() as folder,
        Progress(*columns, console=console, transient=True, disable=console.quiet) as progress,
    ):
        bench = _Bench(plan, device, Path(folder), scene, grid)

        def peak() -> dict[str, dict[str, float]]:
            side = plan.peak_side * (4 if device.type == "cuda" else 1)
            bench.peak = {
                type_: measure_peak(type_, device, side=side, repeats=plan.repeats)
                for type_ in types
            }
            return {_type_name(type_): rates for type_, rates in bench.peak.items()}

        stages: dict[str, Callable[[], Any]] = {
            "peak": peak,
            "folding": lambda: measure_folding(bench),
            "share_of_peak": lambda: measure_shares(bench),
            "alpha_levels": lambda: measure_levels(bench),
            "decision": lambda: measure_decisions(bench),
            "pick_angle": lambda: [
                row for preset in presets for row in measure_pick_angles(bench, preset)
            ],
        }
        task = progress.add_task("", total=len(stages))
        for name, stage in stages.items():
            progress.update(task, description=name.replace("_", " "))
            measured[name] = stage()
            progress.advance(task)
    for name in ("decision", "pick_angle"):
        measured[f"{name}_growth"] = _growth(measured[name], plan.orientations)
    return measured


def _type_name(type_: torch.dtype) -> str:
    return str(type_).removeprefix("torch.")


def _observed(path: Path | None) -> tuple[Scene, PixelGrid]:
    """What is decided upon: the first observation of a demonstration, or one that is drawn."""
    if path is None:
        grid = PixelGrid()
        return drawn_scene(grid), grid
    demonstrations = read_demonstrations(path, 1)
    grid = demonstrations.origin.grid
    observed = scenes(demonstrations.demonstrations, grid)
    if not observed:
        raise UserError(f"{path} holds no demonstration")
    return observed[0], grid


def drawn_scene(grid: PixelGrid) -> Scene:
    """Four bars of a tool's size, and a block with cavities for them, on a table."""
    random = np.random.default_rng(0)
    pixel = np.stack(np.meshgrid(np.arange(grid.rows), np.arange(grid.cols), indexing="ij"), -1)
    image = np.full((4, *grid.shape), 0.4, np.float32)
    image[3] = 0.0

    def bar(middle: NDArray[np.float64], angle: float, length: float, width: float) -> Any:
        """Which pixels (rows, cols) are in it; lengths in metres, along the rows at angle 0."""
        along, across = np.moveaxis(np.abs((pixel - middle) @ rotation(angle)), -1, 0)
        half = 0.5 * np.array([length, width]) / grid.resolution
        return (along <= half[0]) & (across <= half[1])

    rows, cols = grid.shape
    kit = np.array([0.5 * rows, 0.25 * cols])
    block = bar(kit, 0.0, 0.26, 0.28)
    image[:3, block], image[3, block] = 0.6, 0.05
    targets = []
    for index in range(4):
        pick = np.array([(0.2 + 0.2 * index) * rows, 0.75 * cols])
        place = kit + (0.0, (index - 1.5) * 0.06 / grid.resolution)
        theta = float(random.uniform(0.3, 1.2))
        cavity, tool = bar(place, 0.0, 0.17, 0.03), bar(pick, theta, 0.17, 0.025)
        image[3, cavity] = 0.03
        image[:3, tool] = random.uniform(0.1, 0.9, (3, 1))
        image[3, tool] = 0.02
        targets.append(LabelledImage(image, pick=pick, pick_theta=theta, place=place, turn=-theta))
    return Scene(image, tuple(targets))


# Figure 6(c): the models that answer the pick angle.


def measure_pick_angles(bench: _Bench, preset: str) -> list[dict[str, Any]]:
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
                **_times(timings.get(n)),
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


def _ask_angle(networks: Networks, bench: _Bench, orientations: int) -> Callable[[], object]:
    """The angle at a known pixel, of an image that was not seen before."""

    return lambda: networks.angle_logits(bench.image.copy(), bench.pixel, orientations)


def _times(timing: Timing | None) -> dict[str, Any]:
    return dataclasses.asdict(timing) if timing else {"seconds": None}


def _growth(rows: list[dict[str, Any]], orientations: tuple[int, ...]) -> list[dict[str, Any]]:
    """For each preset and method, how much more the largest of the N costs than the smallest."""
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


# The whole decision.


def measure_decisions(bench: _Bench) -> list[dict[str, Any]]:
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
                    **_times(timing),
                    "parts": typical[len(typical) // 2] if typical else None,
                }
            )
    return rows


def _ask_everything(networks: Networks, bench: _Bench, orientations: int) -> Callable[[], object]:
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

    def __init__(self, bench: _Bench, networks: Networks) -> None:
        self._bench, self._device = bench, bench.device
        self._networks = networks
        self._parts: dict[str, float] = {}
        for part, methods in PARTS.items():
            for method in methods:
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


# The same networks, in plain escnn and folded.


def measure_folding(bench: _Bench) -> dict[str, Any]:
    """The paper's networks as escnn's modules run them, and as this package does.

    The weights are the same, and so is what is computed, up to rounding.

    Returns:
        `rungs`, by name: the time of each of `MEASURES`; `speed_up`, likewise: how many times
        faster than plain escnn in float32; `alpha_difference`: by how much alpha's answer differs
        from that one's, of its standard deviation; `alpha_operations`, of one inference.
    """
    config = NetworkConfig("so2", bench.plan.preset)
    ours = make_networks(config)
    assert isinstance(ours, SO2Networks)
    # Trained, and for inference. escnn in eval mode keeps the kernels that it has expanded.
    ways: dict[str, tuple[Networks, Networks]] = {}
    for type_ in (torch.float32, torch.bfloat16):
        if type_ not in bench.peak:
            continue
        autocast = None if type_ == torch.float32 else type_
        plain = as_escnn(ours, autocast).eval().requires_grad_(False)
        ways[f"escnn_{_type_name(type_)}"] = (as_escnn(ours, autocast), plain)
    for type_ in (torch.float32, torch.bfloat16):
        if type_ not in bench.peak:
            continue
        trained = copy.deepcopy(ours)
        trained.compute_type = type_
        ways[f"ours_{_type_name(type_)}"] = (trained, bench.export(ours, type_))
    for pair in ways.values():
        for networks in pair:
            networks.to(bench.device)

    baseline = next(iter(ways))
    with torch.inference_mode():
        answers = {
            name: plain.position_logits(bench.image, config.orientations)
            for name, (_, plain) in ways.items()
        }
    exact = answers[baseline]
    timings = {
        "training_step": bench.time_each(
            {name: _training(trained, bench.scene) for name, (trained, _) in ways.items()},
            training=True,
        ),
        "alpha_training_step": bench.time_each(
            {
                name: _stepping(trained.get_submodule("alpha"), bench.inputs(trained)["alpha"])
                for name, (trained, _) in ways.items()
            },
            training=True,
        ),
        "decision": bench.time_each(
            {name: _deciding(plain, bench) for name, (_, plain) in ways.items()}
        ),
        "alpha_inference": bench.time_each(
            {
                name: _inferring(plain.get_submodule("alpha"), bench.inputs(plain)["alpha"])
                for name, (_, plain) in ways.items()
            }
        ),
    }
    return {
        "rungs": {
            name: {measure: _times(timings[measure][name]) for measure in MEASURES} for name in ways
        },
        "speed_up": {
            name: {
                measure: timings[measure][baseline].seconds / timings[measure][name].seconds
                for measure in MEASURES
            }
            for name in ways
        },
        "alpha_difference": {
            name: float((answer - exact).std() / exact.std()) for name, answer in answers.items()
        },
        "alpha_operations": {
            # Types do not change them, and autocast cannot be counted.
            name: count_operations(
                _inferring(
                    ways[f"{name}_float32"][1].get_submodule("alpha"), bench.inputs(ours)["alpha"]
                )
            )
            for name in ("escnn", "ours")
        },
    }


def _training(networks: Networks, scene: Scene) -> Callable[[], object]:
    """A training step of all four networks, augmentation and losses included: always the same."""
    trainer = Trainer(networks, seed=0)
    samples = labelled_images([scene], taken_only=False)

    def step() -> None:
        trainer.step_count = 0
        trainer.step(samples)

    return step


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


def _deciding(networks: Networks, bench: _Bench) -> Callable[[], object]:
    policy = LearnedPolicy(networks, orientations=networks.config.orientations)
    return lambda: policy.decide(bench.observe())


# Shares of the machine's peak.


def measure_shares(bench: _Bench) -> list[dict[str, Any]]:
    """What share of the machine's peak the paper's networks reach.

    Returns:
        A row for each network, type and mode (`inference`, `training`).
    """
    ours = make_networks(NetworkConfig("so2", bench.plan.preset))
    inferring: dict[Any, Callable[[], object]] = {}
    stepping: dict[Any, Callable[[], object]] = {}
    for type_ in bench.peak:
        exported = bench.export(ours, type_)
        trained = copy.deepcopy(ours).to(bench.device)
        trained.compute_type = type_
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
                "type": _type_name(type_),
                "mode": mode,
                "operations": operations,
                **_times(timing),
                "rate": rate,
                "share": rate / bench.peak[type_]["best"],
            }
        )
    return rows


def measure_levels(bench: _Bench) -> dict[str, Any]:
    """Alpha's inference, level by level of the U-net and layer by layer.

    Returns:
        `levels` and `layers`; of a level, `convolution_s` is in its convolutions and `rest_s` in
        all else (ELU, sums, resampling, concatenation). The times are medians.
    """
    type_ = preferred_type()
    networks = bench.export(make_networks(NetworkConfig("so2", bench.plan.preset)), type_)
    alpha = networks.get_submodule("alpha")
    assert isinstance(alpha, UNet)
    watch = _UNetWatch(alpha, bench.device)
    features = bench.inputs(networks)["alpha"]
    runs = []
    with torch.inference_mode():
        for turn in range(bench.plan.repeats + 2):
            seconds = watch.run(features)
            # Two to warm up.
            if turn >= 2:
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
                    "type": _type_name(layer_type),
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
    """Hooks that note when each level and each convolution of a U-net begins and ends."""

    def __init__(self, network: UNet, device: torch.device) -> None:
        self._network, self._device = network, device
        self._starts: dict[str, float] = {}
        self._ends: dict[str, float] = {}
        self.operations: dict[str, int] = {}
        """Of each convolution."""
        self.types: dict[str, torch.dtype] = {}
        """That each computes in."""
        self._blocks = {
            f"{way}.{i}": f"{way} {i + 1}" for way, n in (("down", 5), ("up", 4)) for i in range(n)
        }
        self.layers: dict[str, list[str]] = {
            level: [] for level in ("lift", *self._blocks.values(), "head")
        }
        """The convolutions of each level."""
        for name, module in network.named_modules():
            if isinstance(module, PlainConv2d):
                block = ".".join(name.split(".")[:2])
                level = self._blocks.get(block, "lift" if name == "lift" else "head")
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
        # What lies before a block (resampling, concatenation) belongs to it.
        seconds["lift"] = self._starts["down.0"] - start
        before = self._starts["down.0"]
        for block, level in self._blocks.items():
            seconds[level] = self._ends[block] - before
            before = self._ends[block]
        return seconds | {"head": end - before}
