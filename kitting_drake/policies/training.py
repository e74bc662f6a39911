"""One training step, for every method (section V-C.1 of the paper)."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch

from kitting_drake.policies.images import LabelledImage, augment
from kitting_drake.policies.networks import Networks

BETAS = (0.9, 0.999)


class Trainer:
    """Networks and their optimisers, an Adam for each loss.

    What a step draws at random depends on the seed and the step's number alone: a run that is taken
    up again goes on as if it had not stopped.
    """

    def __init__(
        self,
        networks: Networks,
        *,
        seed: int,
        steps: int = 10_000,
        learning_rate: float = 1e-4,
        decay: bool = False,
        rigid: bool = False,
    ) -> None:
        """
        Args:
            networks: what to train.
            seed: of all draws.
            steps: how many there will be.
            learning_rate: Adam's.
            decay: let the learning rate fall to zero over the steps (half a cosine, after a rise
                over the first hundred) instead of keeping it.
            rigid: see `augment`.
        """
        self.networks = networks
        self.seed = seed
        self.steps = steps
        self.learning_rate = learning_rate
        self.decay = decay
        self.rigid = rigid
        self.step_count = 0
        self.optimisers = {
            name: torch.optim.Adam(
                [weight for module in modules for weight in module.parameters()],
                lr=learning_rate,
                betas=BETAS,
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

    def step(self, samples: list[LabelledImage]) -> dict[str, float]:
        """One step on one of the samples, drawn at random and augmented.

        Returns:
            Each loss, in nats.
        """
        random = np.random.default_rng([self.seed, self.step_count])
        sample = augment(samples[random.integers(len(samples))], random, rigid=self.rigid)
        self.networks.train()
        values = {}
        for name, loss_of in self.networks.losses(sample, random):
            optimiser = self.optimisers[name]
            for group in optimiser.param_groups:
                group["lr"] = self.rate(self.step_count)
            optimiser.zero_grad(set_to_none=True)
            loss = loss_of()
            loss.backward()
            optimiser.step()
            values[name] = float(loss.detach())
        self.step_count += 1
        return values

    def state_dict(self) -> dict[str, Any]:
        """All that `load_state_dict` needs to go on bit by bit."""
        return {
            "step_count": self.step_count,
            "networks": self.networks.state_dict(),
            "optimisers": {name: item.state_dict() for name, item in self.optimisers.items()},
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Takes up a run of the same networks and seed."""
        self.networks.load_state_dict(state["networks"])
        for name, optimiser in self.optimisers.items():
            optimiser.load_state_dict(state["optimisers"][name])
        self.step_count = state["step_count"]
