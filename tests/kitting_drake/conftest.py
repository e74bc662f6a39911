"""Fixtures: killing processes, and untrained weights."""

import os
import random
import signal
import subprocess
import time
from collections.abc import Callable
from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def kill_at_random() -> Callable[..., None]:
    """Kills a process at a random moment after `changes` changes of a file."""

    def kill(process: subprocess.Popen, file: Path, rng: random.Random, *, changes: int) -> None:
        def size() -> int:
            return file.stat().st_size if file.exists() else 0

        for _ in range(changes):
            before = size()
            while size() == before:
                assert process.poll() is None, "it ended before the kill"
                time.sleep(0.01)
        time.sleep(rng.uniform(0, 0.5))
        assert process.poll() is None, "it ended before the kill"
        os.kill(process.pid, signal.SIGKILL)
        process.wait()

    return kill


@pytest.fixture(scope="session")
def weights_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Weights of the smallest networks before training."""
    # Import torch lazily.
    import torch

    from kitting_drake.policies.networks.architecture import NetworkConfig
    from kitting_drake.policies.networks.methods import make_networks
    from kitting_drake.policies.networks.weights import save_weights

    torch.set_num_threads(1)
    torch.manual_seed(0)
    path = tmp_path_factory.mktemp("weights") / "policy.safetensors"
    card = {
        "scenario": "mine",
        "demonstrations": 3,
        "demonstration_seeds": [10_000, 10_001],
        "validation_seeds": [10_002],
        "steps": 0,
        "resolution": 0.003125,
    }
    save_weights(path, make_networks(NetworkConfig(preset="tiny", orientations=72)), card)
    return path
