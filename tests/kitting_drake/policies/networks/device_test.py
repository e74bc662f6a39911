"""Tests of `kitting_drake.policies.networks.device`."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
import torch

from kitting_drake.policies.networks import device


@pytest.fixture(autouse=True)
def forgotten() -> Iterator[None]:
    """Clears the cache of `preferred_type` before and after each test."""
    device.preferred_type.cache_clear()
    yield
    device.preferred_type.cache_clear()


@pytest.mark.parametrize(
    ("share", "chosen"), [(0.5, torch.bfloat16), (0.95, torch.float32), (1.4, torch.float32)]
)
def test_with_avx512_alone_the_faster_type_is_chosen(
    monkeypatch: pytest.MonkeyPatch, share: float, chosen: torch.dtype
) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    monkeypatch.setattr(torch.backends.cpu, "get_cpu_capability", lambda: "AVX512")
    monkeypatch.setattr(torch.cpu, "_is_amx_tile_supported", lambda: False)
    monkeypatch.setattr(torch.cpu, "_is_avx512_bf16_supported", lambda: True)
    monkeypatch.setattr(device, "_seconds", {torch.float32: 1.0, torch.bfloat16: share}.__getitem__)
    threads = torch.get_num_threads()
    assert device.preferred_type() == chosen
    assert torch.get_num_threads() == threads


@pytest.mark.parametrize(("native", "chosen"), [(True, torch.bfloat16), (False, torch.float32)])
def test_an_accelerator_that_emulates_bfloat16_computes_in_float32(
    monkeypatch: pytest.MonkeyPatch, native: bool, chosen: torch.dtype
) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)

    def supported(including_emulation: bool = True) -> bool:
        return native or including_emulation

    monkeypatch.setattr(torch.cuda, "is_bf16_supported", supported)
    assert device.preferred_type() == chosen


def test_the_timing_is_plausible() -> None:
    times = [device._seconds(dtype) for dtype in (torch.float32, torch.bfloat16)]
    assert all(1e-5 < seconds < 10 for seconds in times)
