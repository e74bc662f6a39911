"""Clocks, counters and the machine's own limits, for benchmarks of networks; needs no Drake."""

from __future__ import annotations

import os
import platform
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
import torch.nn.functional as F
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils.flop_counter import flop_registry

Name = TypeVar("Name")

_WARM_UPS = 2
"""Runs before the first that counts, at most: kernels are chosen, weights laid out."""
_PEAK_RUNS = 15
"""Of which the fastest shows the peak."""


@dataclass(frozen=True)
class Timing:
    """How long something took, in seconds of wall time."""

    seconds: float
    """The median."""
    fastest: float
    slowest: float
    runs: int

    @classmethod
    def of(cls, times: list[float]) -> Timing:
        """Of single runs."""
        return cls(float(np.median(times)), min(times), max(times), len(times))


def read_clock(device: torch.device) -> float:
    """Seconds, when all that was asked of the device is done."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return time.perf_counter()


def time_each(
    functions: Mapping[Name, Callable[[], object]],
    device: torch.device,
    *,
    repeats: int,
    budget: float,
) -> dict[Name, Timing]:
    """Times functions in turns, so that whatever else the machine does falls on all of them.

    Args:
        functions: what to run.
        device: where they compute.
        repeats: how often each is timed, after warming up.
        budget: seconds after which a function is not run once more.
    """
    spent = dict.fromkeys(functions, 0.0)
    times: dict[Name, list[float]] = {name: [] for name in functions}
    warm_ups = min(_WARM_UPS, repeats)
    for turn in range(warm_ups + repeats):
        for name, function in functions.items():
            if turn and spent[name] > budget:
                continue
            start = read_clock(device)
            function()
            elapsed = read_clock(device) - start
            spent[name] += elapsed
            if turn == 0 or turn >= warm_ups:
                times[name].append(elapsed)
    # The first counts only where there was no time for another.
    return {name: Timing.of(runs[1:] or runs) for name, runs in times.items()}


def count_operations(function: Callable[[], object]) -> int:
    """Floating-point operations of a function's convolutions and products of matrices.

    A multiply-accumulate is two. Backward passes within the function are counted. Does not see what
    runs in `torch.inference_mode`.
    """
    with _OperationCounter() as counter:
        function()
    return counter.total


class _OperationCounter(TorchDispatchMode):
    """Torch's own FlopCounterMode knows the formulas too, but takes ten times as long."""

    def __init__(self) -> None:
        super().__init__()
        self.total = 0

    def __torch_dispatch__(
        self, function: Any, types: Any, args: Any = (), kwargs: Any = None
    ) -> Any:
        kwargs = kwargs or {}
        result = function(*args, **kwargs)
        formula = flop_registry.get(function.overloadpacket)
        if formula is not None:
            self.total += int(formula(*args, **kwargs, out_val=result))
        return result


def measure_peak(type_: torch.dtype, device: torch.device, *, side: int) -> dict[str, float]:
    """What the machine reaches at best, in operations a second.

    Args:
        type_: to compute in.
        device: where.
        side: of the matrices; the convolution is of an eighth as many channels.

    Returns:
        Of a product of large square matrices as `matmul`, of a wide 3x3 convolution in
        channels_last as `convolution`, and of the better as `best`.
    """
    channels = side // 8
    matrix = torch.randn(side, side, device=device, dtype=type_)
    image = torch.randn(side // 128, channels, 32, 32, device=device, dtype=type_)
    kernel = torch.randn(channels, channels, 3, 3, device=device, dtype=type_)
    image, kernel = (item.contiguous(memory_format=torch.channels_last) for item in (image, kernel))
    functions: dict[str, Callable[[], object]] = {
        "matmul": lambda: matrix @ matrix,
        "convolution": lambda: F.conv2d(image, kernel, padding=1),
    }
    with torch.inference_mode():
        timings = time_each(functions, device, repeats=_PEAK_RUNS, budget=10.0)
    with torch.no_grad():
        rates = {
            name: count_operations(function) / timings[name].fastest
            for name, function in functions.items()
        }
    return rates | {"best": max(rates.values())}


def describe_machine(device: torch.device) -> dict[str, Any]:
    """What the figures were measured on."""
    return {
        "cpu": _cpu_name(),
        "cores": len(os.sched_getaffinity(0)),
        "threads": torch.get_num_threads(),
        "device": torch.cuda.get_device_name(device) if device.type == "cuda" else "cpu",
        "torch": torch.__version__,
        "python": platform.python_version(),
        # What others did: 0 on a machine of one's own, before anything was measured.
        "load_before": os.getloadavg()[0],
    }


def memory_bytes(device: torch.device) -> int:
    """Of the whole machine, or of the accelerator if it has less."""
    size = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    if device.type == "cuda":
        size = min(size, torch.cuda.get_device_properties(device).total_memory)
    return size


def _cpu_name() -> str:
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.is_file() else []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()
