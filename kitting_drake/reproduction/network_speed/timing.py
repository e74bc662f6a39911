"""Measures times, operation counts and the machine's peak rate, for benchmarks of networks."""

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
"""The largest number of runs before the timing starts. In these runs kernels are chosen and memory
is allocated."""
_PEAK_RUNS = 15
"""The number of runs that measure the peak rate. The fastest one counts."""


@dataclass(frozen=True)
class Timing:
    """The wall time of an operation, in seconds."""

    seconds: float
    """The median time."""
    fastest: float
    slowest: float
    runs: int

    @classmethod
    def of(cls, times: list[float]) -> Timing:
        """Makes the timing of some runs from their times in seconds."""
        return cls(float(np.median(times)), min(times), max(times), len(times))


def read_clock(device: torch.device) -> float:
    """Waits until the device has finished all its work, then reads the clock, in seconds."""
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
    """Times functions in alternation, so that other load on the machine slows all of them alike.

    Args:
        functions: the functions by name.
        device: the device on which they compute.
        repeats: the number of timings of each function, after warming up.
        budget: the time in seconds after which a function is not run again.
    """
    spent = dict.fromkeys(functions, 0.0)
    times: dict[Name, list[float]] = {name: [] for name in functions}
    warm_ups = min(_WARM_UPS, repeats)
    for repeat in range(warm_ups + repeats):
        for name, function in functions.items():
            if repeat and spent[name] > budget:
                continue
            start = read_clock(device)
            function()
            elapsed = read_clock(device) - start
            spent[name] += elapsed
            times[name].append(elapsed)
    # If there was only time for warm-up runs, use the last of them.
    return {name: Timing.of(runs[warm_ups:] or runs[-1:]) for name, runs in times.items()}


def count_operations(function: Callable[[], object]) -> int:
    """Counts the floating-point operations of a function's convolutions and matrix products.

    A multiply-accumulate counts as two operations. Backward passes are included. Functions in
    `torch.inference_mode` cannot be counted.
    """
    with _OperationCounter() as counter:
        function()
    return counter.total


class _OperationCounter(TorchDispatchMode):
    """A counter with torch's formulas; torch's own FlopCounterMode takes ten times as long."""

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
    """Measures the machine's peak rate, in operations per second.

    Args:
        type_: the type in which to compute.
        device: the device on which to compute.
        side: the side of the matrices. The convolution has `side / 8` channels.

    Returns:
        `matmul`, the rate of a product of large square matrices; `convolution`, the rate of a wide
        3x3 convolution in channels_last; and `best`, the larger of the two.
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
    """Returns a description of the machine on which the measurements run."""
    return {
        "cpu": _cpu_name(),
        "cores": len(os.sched_getaffinity(0)),
        "threads": torch.get_num_threads(),
        "device": torch.cuda.get_device_name(device) if device.type == "cuda" else "cpu",
        "torch": torch.__version__,
        "python": platform.python_version(),
        # The load by other programs before the measurements; it is 0 on an idle machine.
        "load_before": os.getloadavg()[0],
    }


def memory_bytes(device: torch.device) -> int:
    """Returns the memory of the machine or the accelerator, whichever is smaller, in bytes."""
    size = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    if device.type == "cuda":
        size = min(size, torch.cuda.get_device_properties(device).total_memory)
    return size


def _cpu_name() -> str:
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.is_file() else []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()
