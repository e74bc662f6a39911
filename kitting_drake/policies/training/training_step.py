"""One training step, for every method (section V-C.1)."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.optim.lr_scheduler import LambdaLR

from kitting_drake.policies.data.images import Image, LabelledImage, Motion, Pictured, augment
from kitting_drake.policies.networks.factored import Networks

BETAS = (0.9, 0.999)

_STOP_PROBABILITY = 1 / 8
"""For networks with a stop class, the probability that a sample comes with a final observation, in
which nothing is left to pick."""


@dataclass(frozen=True)
class _Draw:
    """One random sample of a training step, sometimes with a final observation."""

    sample: LabelledImage
    random: np.random.Generator
    """The generator for the random draws of the losses."""
    final: Image | None
    """A final observation, from which the networks learn to stop; None for most samples."""
    stop_random: np.random.Generator
    """The generator for the random draws of the stop loss."""


@dataclass(frozen=True)
class _Prepared:
    """The samples of the next step, prepared in the background."""

    step: int
    samples: Sequence[LabelledImage]
    finals: Sequence[Pictured]
    draws: Future[list[_Draw]]

    def of(self, samples: Sequence[LabelledImage], finals: Sequence[Pictured]) -> bool:
        """Whether the samples were drawn from exactly these sequence objects."""
        return self.samples is samples and self.finals is finals


def decayed(step: int, steps: int) -> float:
    """Returns the factor of the learning rate at a step. It is a linear warm-up over a hundred
    steps, times a cosine decay to zero over all steps."""
    rise = min(1.0, (step + 1) / 100)
    return rise * 0.5 * (1 + math.cos(math.pi * min(1.0, step / steps)))


class Trainer:
    """Trains networks. Each loss has its own Adam optimiser.

    All random draws of a step depend only on the seed and the step's number, so a resumed run
    continues exactly. A thread prepares the samples of the next step. It is not a process of
    torch's DataLoader, because the samples refer to an open HDF5 file.
    """

    def __init__(
        self,
        networks: Networks,
        *,
        seed: int,
        steps: int = 10_000,
        learning_rate: float = 1e-4,
        decay: bool = False,
        batch: int = 1,
        curvature: bool = False,
        reflection: bool = False,
        only: str | None = None,
    ) -> None:
        """
        Args:
            networks: the networks to train.
            seed: the seed of all random draws.
            steps: the total number of steps.
            learning_rate: the learning rate of Adam.
            decay: whether the learning rate decays to zero (see `decayed`) instead of staying
                constant.
            batch: the number of samples in a step. Their losses are averaged.
            curvature: whether to augment by curvature, see `augment`.
            reflection: whether to augment by reflection, see `augment`.
            only: the name of the only loss to train; None trains all. The modules of other losses
                keep their weights. The random draws are the same as if all losses were trained.
        """
        self.networks = networks
        self.seed = seed
        self.steps = steps
        self.learning_rate = learning_rate
        self.decay = decay
        self.batch = batch
        self.curvature = curvature
        self.reflection = reflection
        self.step_count = 0
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="samples")
        self._prepared: _Prepared | None = None
        self.optimisers = {
            name: torch.optim.Adam(
                [weight for module in modules for weight in module.parameters()],
                lr=learning_rate,
                betas=BETAS,
                fused=True,
            )
            for name, modules in networks.modules_by_loss().items()
            if only in (None, name)
        }
        self._schedules = self._scheduled()

    def _scheduled(self) -> list[LambdaLR]:
        """Makes the optimisers' learning rate schedules, which start at the current step."""
        for optimiser in self.optimisers.values():
            for group in optimiser.param_groups:
                group["initial_lr"] = self.learning_rate
        return [
            LambdaLR(
                optimiser,
                lambda step: decayed(step, self.steps) if self.decay else 1.0,
                last_epoch=self.step_count - 1,
            )
            for optimiser in self.optimisers.values()
        ]

    def step(
        self, samples: Sequence[LabelledImage], finals: Sequence[Pictured] = ()
    ) -> dict[str, float]:
        """Executes one training step on random, augmented samples.

        With one of eight samples, on average, networks with a stop class also learn from a final
        observation. Its loss is added to the loss of the picking module.

        Args:
            samples: labelled observations in which something is left to pick.
            finals: observations in which nothing is left to pick.

        Returns:
            The mean of each loss in nats. `stop` is present only in steps with a final observation.
        """
        draws = self._take(samples, finals)
        self.networks.train()
        for optimiser in self.optimisers.values():
            optimiser.zero_grad(set_to_none=True)
        found: dict[str, list[float]] = {}
        for draw in draws:
            for name, value in self._learn(draw):
                found.setdefault(name, []).append(value)
        for optimiser in self.optimisers.values():
            optimiser.step()
        for schedule in self._schedules:
            schedule.step()
        self.step_count += 1
        return {name: sum(values) / len(values) for name, values in found.items()}

    def _learn(self, draw: _Draw) -> Iterator[tuple[str, float]]:
        """Computes the gradients of a sample's losses. Yields the name and value of each loss."""
        for name, loss_of in self.networks.losses(draw.sample, draw.random):
            if name not in self.optimisers:
                continue
            yield name, self._backward(loss_of())
            if name == self.networks.picking and draw.final is not None:
                yield "stop", self._backward(self.networks.stop_loss(draw.final, draw.stop_random))

    def _backward(self, loss: Tensor) -> float:
        (loss / self.batch).backward()
        return float(loss.detach())

    def _take(self, samples: Sequence[LabelledImage], finals: Sequence[Pictured]) -> list[_Draw]:
        """Returns the samples of this step, and starts to prepare those of the next step."""
        prepared = self._prepared
        if prepared and prepared.step == self.step_count and prepared.of(samples, finals):
            draws = prepared.draws.result()
        else:
            draws = self._draws(self.step_count, samples, finals)
        following = self.step_count + 1
        future = self._thread.submit(self._draws, following, samples, finals)
        self._prepared = _Prepared(following, samples, finals, future)
        return draws

    def _draws(
        self, step: int, samples: Sequence[LabelledImage], finals: Sequence[Pictured]
    ) -> list[_Draw]:
        return [self._draw(step * self.batch + i, samples, finals) for i in range(self.batch)]

    def _draw(
        self, number: int, samples: Sequence[LabelledImage], finals: Sequence[Pictured]
    ) -> _Draw:
        """Draws and augments a sample; for one sample in eight, also draws a final observation.

        Args:
            number: the number of the sample in the whole training.
            samples: see `step`.
            finals: see `step`.
        """
        random = np.random.default_rng([self.seed, number])
        sample = augment(
            samples[int(random.integers(len(samples)))],
            random,
            curvature=self.curvature,
            reflection=self.reflection,
        )
        # A separate generator keeps the samples independent of the final observations.
        stop_random = np.random.default_rng([self.seed, number, 1])
        return _Draw(sample, random, self._draw_final(finals, stop_random), stop_random)

    def _draw_final(self, finals: Sequence[Pictured], random: np.random.Generator) -> Image | None:
        """Returns a randomly moved final observation; None for most samples."""
        if not (self.networks.config.stop and finals) or random.random() >= _STOP_PROBABILITY:
            return None
        return Motion.draw(finals[int(random.integers(len(finals)))].image, random).moved_image()

    def state_dict(self) -> dict[str, Any]:
        """Returns everything that `load_state_dict` needs to continue exactly."""
        return {
            "step_count": self.step_count,
            "networks": self.networks.state_dict(),
            "optimisers": {name: item.state_dict() for name, item in self.optimisers.items()},
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restores the state of a run with the same networks and seed."""
        self.networks.load_state_dict(state["networks"])
        for name, optimiser in self.optimisers.items():
            optimiser.load_state_dict(state["optimisers"][name])
        self.step_count = state["step_count"]
        self._schedules = self._scheduled()
