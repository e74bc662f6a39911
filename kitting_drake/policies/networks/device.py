"""Where networks compute, and in which type."""

from __future__ import annotations

import functools
import time

import torch
import torch.nn.functional as F

_CLEARLY = 0.8
"""bfloat16 is taken only if it takes less than this share of the time, so that the choice is the
same at every start."""
_ROUNDS = 5
_SHAPES = ((1, 32, 81, 161), (32, 32, 3, 3))
"""A convolution as the U-nets have it, of a few milliseconds: its input and its kernel."""


def preferred_device() -> torch.device:
    """The device to train and infer on: an accelerator where there is one, else the CPU."""
    return torch.device("cuda" if torch.cuda.is_available() else "cpu")


@functools.cache
def preferred_type() -> torch.dtype:
    """The type to compute in: bfloat16 where the preferred device is faster in it, else float32.

    That a CPU has instructions for bfloat16 does not tell. With AMX convolutions take a fifth of
    the time; with AVX-512 alone, half of it on some CPUs and half as much again on others, so that
    there one is timed, once a process.
    """
    if preferred_device().type == "cuda":
        # Before compute capability 8 it is emulated, and slower.
        native = torch.cuda.is_bf16_supported(including_emulation=False)
        return torch.bfloat16 if native else torch.float32
    if torch.backends.cpu.get_cpu_capability() not in ("AVX512", "AMX"):
        return torch.float32
    if torch.cpu._is_amx_tile_supported():
        return torch.bfloat16
    faster = torch.cpu._is_avx512_bf16_supported() and _is_faster_in_bfloat16()
    return torch.bfloat16 if faster else torch.float32


def _is_faster_in_bfloat16() -> bool:
    """Whether a convolution is; the two types take turns, and the fastest of each counts."""
    fastest = dict.fromkeys((torch.float32, torch.bfloat16), float("inf"))
    threads = torch.get_num_threads()
    # Threads that wait for one another would count as work where cores are shared.
    torch.set_num_threads(1)
    try:
        for _ in range(1 + _ROUNDS):  # In the first, kernels are chosen.
            for dtype in fastest:
                fastest[dtype] = min(fastest[dtype], _seconds(dtype))
    finally:
        torch.set_num_threads(threads)
    return fastest[torch.bfloat16] < _CLEARLY * fastest[torch.float32]


@torch.inference_mode()
def _seconds(dtype: torch.dtype) -> float:
    """The processor time of one convolution, which other processes hardly lengthen."""
    features, kernel = (
        torch.ones(shape, dtype=dtype).to(memory_format=torch.channels_last) for shape in _SHAPES
    )
    begin = time.process_time()
    F.conv2d(features, kernel, padding=1)
    return time.process_time() - begin
