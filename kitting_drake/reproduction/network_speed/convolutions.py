"""Times only the convolutions of a function, which gives a lower bound of the function's time."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from kitting_drake.reproduction.network_speed.timing import Timing

_GROUPS = {"aten::conv2d": 6, "aten::convolution": 8, "aten::convolution_backward": 9}
"""torch's convolutions, each with the index of its argument `groups`."""


class _Outline(NamedTuple):
    """The shape, type and memory format of a tensor, without its values."""

    shape: tuple[int, ...]
    type: torch.dtype
    channels_last: bool

    @classmethod
    def of(cls, tensor: Tensor) -> _Outline:
        channels_last = tensor.dim() == 4 and tensor.is_contiguous(
            memory_format=torch.channels_last
        )
        return cls(tuple(tensor.shape), tensor.dtype, channels_last)

    def filled(self, device: torch.device) -> Tensor:
        """Returns a tensor of random numbers with this shape, type and memory format."""
        tensor = torch.randn(self.shape, device=device).to(self.type)
        return (
            tensor.contiguous(memory_format=torch.channels_last) if self.channels_last else tensor
        )


@dataclass(frozen=True)
class Convolutions:
    """The convolutions that a function computes, including those of its backward passes.

    Depthwise convolutions are left out: they only blur features for pooling.
    """

    calls: Counter[tuple[Any, tuple[Any, ...]]]
    """The number of calls, by torch's function and its arguments. An `_Outline` stands for each
    tensor."""

    @classmethod
    def of(cls, function: Callable[[], object]) -> Convolutions:
        """Runs a function once and records its convolutions."""
        with _Recorder() as recorder:
            function()
        return cls(recorder.calls)

    def alone(self, device: torch.device) -> dict[Any, Callable[[], object]]:
        """Returns, for each key of `calls`, a function that computes the call once on random
        numbers."""
        return {call: _replay(*call, device) for call in self.calls}

    def seconds(self, timings: dict[Any, Timing]) -> float:
        """Returns the total time of all calls, in seconds.

        Args:
            timings: the timing of each function that `alone` returns, by the same keys.
        """
        return sum(count * timings[call].seconds for call, count in self.calls.items())


def _replay(function: Any, outlined: tuple[Any, ...], device: torch.device) -> Callable[[], object]:
    arguments = [item.filled(device) if isinstance(item, _Outline) else item for item in outlined]
    return lambda: function(*arguments)


class _Recorder(TorchDispatchMode):
    """Records convolutions when they are called."""

    def __init__(self) -> None:
        super().__init__()
        self.calls: Counter[tuple[Any, tuple[Any, ...]]] = Counter()

    def __torch_dispatch__(
        self, function: Any, types: Any, args: Any = (), kwargs: Any = None
    ) -> Any:
        place = _GROUPS.get(function.name())
        # torch omits trailing arguments that have default values; the default is one group.
        if place is not None and args[place : place + 1] in ((), (1,)):
            outlined = (
                _Outline.of(item)
                if isinstance(item, Tensor)
                else tuple(item)
                if isinstance(item, list)
                else item
                for item in args
            )
            self.calls[function, tuple(outlined)] += 1
        return function(*args, **(kwargs or {}))
