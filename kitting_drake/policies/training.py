"""One training step, for every method (section V-C.1)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch

from kitting_drake.policies.demonstrations import FinalObservation
from kitting_drake.policies.images import Image, LabelledImage, Motion, augment
from kitting_drake.policies.networks import Networks

BETAS = (0.9, 0.999)

_STOP_PROBABILITY = 1 / 8
"""The probability that a training step also learns from a final observation."""


class Trainer:
    """Networks and their optimisers, an Adam for each loss.

    All random draws of a step depend on the seed and the step's number alone, so that a run which
    is resumed continues as if it had not been interrupted.
    """

    def __init__(
        self,
        networks: Networks,
        *,
        seed: int,
        steps: int = 10_000,
        learning_rate: float = 1e-4,
        decay: bool = False,
        curvature: bool = False,
    ) -> None:
        """
        Args:
            networks: what to train.
            seed: of all draws.
            steps: how many there will be.
            learning_rate: Adam's.
            decay: let the learning rate fall to zero over the steps (half a cosine, after a rise
                over the first hundred) instead of keeping it constant.
            curvature: see `augment`.
        """
        self.networks = networks
        self.seed = seed
        self.steps = steps
        self.learning_rate = learning_rate
        self.decay = decay
        self.curvature = curvature
        self.step_count = 0
        self.optimisers = {
            name: torch.optim.Adam(
                [weight for module in modules for weight in module.parameters()],
                lr=learning_rate,
                betas=BETAS,
                fused=True,
            )
            for name, modules in networks.modules_by_loss().items()
        }

    def rate(self, step: int) -> float:
        """Adam's learning rate at a step."""
        if not self.decay:
            return self.learning_rate
        rise = min(1.0, (step + 1) / 100)
        share = min(1.0, step / self.steps)
        return self.learning_rate * rise * 0.5 * (1 + math.cos(math.pi * share))

    def step(
        self, samples: Sequence[LabelledImage], finals: Sequence[FinalObservation] = ()
    ) -> dict[str, float]:
        """One step on a sample that is drawn at random and augmented.

        Networks that can stop also learn, in one step of eight, from one of the final observations.
        Its loss is added to that of the picking module; all else sees as many samples as ever.

        Args:
            samples: observations with something to pick.
            finals: observations in which nothing is left to pick.

        Returns:
            Each loss, in nats; `stop`, that of a final observation, only where there was one.
        """
        random = np.random.default_rng([self.seed, self.step_count])
        sample = augment(samples[random.integers(len(samples))], random, curvature=self.curvature)
        # Has draws of its own, so that the sample is the same with and without final observations.
        stop_random = np.random.default_rng([self.seed, self.step_count, 1])
        final = self._draw_final(finals, stop_random)
        self.networks.train()
        values = {}
        for name, loss_of in self.networks.losses(sample, random):
            optimiser = self.optimisers[name]
            for group in optimiser.param_groups:
                group["lr"] = self.rate(self.step_count)
            optimiser.zero_grad(set_to_none=True)
            loss = loss_of()
            loss.backward()
            values[name] = float(loss.detach())
            if name == self.networks.picking and final is not None:
                stop_loss = self.networks.stop_loss(final, stop_random)
                stop_loss.backward()
                values["stop"] = float(stop_loss.detach())
            optimiser.step()
        self.step_count += 1
        return values

    def _draw_final(
        self, finals: Sequence[FinalObservation], random: np.random.Generator
    ) -> Image | None:
        """A final observation after a random motion, if this step has one."""
        if not (self.networks.config.stop and finals) or random.random() >= _STOP_PROBABILITY:
            return None
        return Motion.draw(finals[random.integers(len(finals))].image, random).moved_image()

    def state_dict(self) -> dict[str, Any]:
        """All that `load_state_dict` needs to continue bit by bit."""
        return {
            "step_count": self.step_count,
            "networks": self.networks.state_dict(),
            "optimisers": {name: item.state_dict() for name, item in self.optimisers.items()},
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Resumes a run of the same networks and seed."""
        self.networks.load_state_dict(state["networks"])
        for name, optimiser in self.optimisers.items():
            optimiser.load_state_dict(state["optimisers"][name])
        self.step_count = state["step_count"]
