"""Measures the cost of the networks on this machine: figure 6(c) of the paper, and related numbers.

All numbers come from one run on one machine. Alternatives that are compared are timed in
alternation. Drake is not needed.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from kitting_drake.policies.networks.device import preferred_device, preferred_type
from kitting_drake.reproduction.network_speed.folding import measure_folding
from kitting_drake.reproduction.network_speed.orientations import (
    growth,
    measure_decisions,
    measure_pick_angles,
)
from kitting_drake.reproduction.network_speed.peak_shares import measure_levels, measure_shares
from kitting_drake.reproduction.network_speed.plan import (
    Plan,
    SpeedSetup,
    observed_scene,
    type_name,
)
from kitting_drake.reproduction.network_speed.timing import describe_machine, measure_peak


def benchmark_networks(plan: Plan, console: Console) -> dict[str, Any]:
    """Runs all measurements of `benchmark networks`.

    Times are wall times in seconds, and rates are operations per second. A multiply-accumulate
    counts as two operations.

    Args:
        plan: the measurements to make.
        console: the console for the progress.

    Raises:
        UserError: the demonstrations are unusable.
    """
    device = preferred_device()
    machine = describe_machine(device)
    scene = observed_scene(plan.demonstrations)
    types = sorted({preferred_type(), torch.float32}, key=str)
    presets = [plan.preset]
    if plan.compared_preset not in (None, plan.preset):
        presets.append(str(plan.compared_preset))
    torch.manual_seed(0)
    measured: dict[str, Any] = {
        "machine": machine,
        "inference_type": type_name(preferred_type()),
        "preset": plan.preset,
        "repeats": plan.repeats,
        "budget_s": plan.budget,
        "observation": str(plan.demonstrations or "synthetic"),
    }
    columns = (TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn())
    with (
        tempfile.TemporaryDirectory() as folder,
        Progress(*columns, console=console, transient=True, disable=console.quiet) as progress,
    ):
        setup = SpeedSetup(plan, device, Path(folder), scene)

        def peak() -> dict[str, dict[str, float]]:
            side = plan.peak_side * (4 if device.type == "cuda" else 1)
            setup.peak = {type_: measure_peak(type_, device, side=side) for type_ in types}
            return {type_name(type_): rates for type_, rates in setup.peak.items()}

        stages: dict[str, Callable[[], Any]] = {
            "peak": peak,
            "folding": lambda: measure_folding(setup),
            "share_of_peak": lambda: measure_shares(setup),
            "alpha_levels": lambda: measure_levels(setup),
            "decision": lambda: measure_decisions(setup),
            "pick_angle": lambda: [
                row for preset in presets for row in measure_pick_angles(setup, preset)
            ],
        }
        task = progress.add_task("", total=len(stages))
        for name, stage in stages.items():
            progress.update(task, description=name.replace("_", " "))
            measured[name] = stage()
            progress.advance(task)
    for name in ("decision", "pick_angle"):
        measured[f"{name}_growth"] = growth(measured[name], plan.orientations)
    return measured
