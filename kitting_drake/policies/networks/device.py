"""Chooses the device and the floating-point type of the networks."""

from __future__ import annotations

import functools
import time

import torch
import torch.nn.functional as F

_CLEARLY = 0.8
"""bfloat16 is chosen if it takes less than this share of float32's time. The margin makes the
choice reproducible."""
_ROUNDS = 5
_SHAPES = ((1, 32, 81, 161), (32, 32, 3, 3))
"""The input and the kernel of a typical U-net convolution, which takes a few milliseconds."""


def preferred_device() -> torch.device:
    """Returns the device for training and inference: a GPU if there is one, otherwise the CPU."""
    return torch.device("cuda" if torch.cuda.is_available() else "cpu")


@functools.cache
def preferred_type() -> torch.dtype:
    """Returns the type to compute in: bfloat16 if the preferred device is faster in it, otherwise
    float32.

    With AMX, convolutions in bfloat16 take a fifth of the time of float32. With AVX-512 alone they
    take 0.5 to 1.5 times as long as in float32, depending on the CPU. So each process times one
    convolution in both types.
    """
    if preferred_device().type == "cuda":
        # Below compute capability 8, bfloat16 is emulated and slower.
        native = torch.cuda.is_bf16_supported(including_emulation=False)
        return torch.bfloat16 if native else torch.float32
    if torch.backends.cpu.get_cpu_capability() not in ("AVX512", "AMX"):
        return torch.float32
    if torch.cpu._is_amx_tile_supported():
        return torch.bfloat16
    faster = torch.cpu._is_avx512_bf16_supported() and _is_faster_in_bfloat16()
    return torch.bfloat16 if faster else torch.float32


def _is_faster_in_bfloat16() -> bool:
    """Whether a convolution is clearly faster in bfloat16 than in float32.

    Compares the fastest of several runs in each type.
    """
    fastest = dict.fromkeys((torch.float32, torch.bfloat16), float("inf"))
    threads = torch.get_num_threads()
    # Use one thread: on shared cores, threads that wait for each other would add processor time.
    torch.set_num_threads(1)
    try:
        for _ in range(1 + _ROUNDS):  # The first round is a warm-up.
            for dtype in fastest:
                fastest[dtype] = min(fastest[dtype], _seconds(dtype))
    finally:
        torch.set_num_threads(threads)
    return fastest[torch.bfloat16] < _CLEARLY * fastest[torch.float32]


@torch.inference_mode()
def _seconds(dtype: torch.dtype) -> float:
    """Returns the processor time of one convolution, in seconds. Other processes barely affect
    it."""
    features, kernel = (
        torch.ones(shape, dtype=dtype).to(memory_format=torch.channels_last) for shape in _SHAPES
    )
    begin = time.process_time()
    F.conv2d(features, kernel, padding=1)
    return time.process_time() - begin
