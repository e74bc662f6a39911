"""Made-up episodes and policies, for tests of what is made of them."""

import os
import random
import signal
import subprocess
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from kitting_drake.hkd.tools.tool import CATEGORIES


@pytest.fixture(scope="session")
def made_up_episode() -> Callable[..., dict[str, Any]]:
    """Makes a line of `episodes.jsonl` out of an error for each category in turn."""

    def make(seed: int, errors_mm: list[float], failure: str | None = None) -> dict[str, Any]:
        errors = dict(zip(CATEGORIES, errors_mm, strict=False))
        objects = [
            {
                "name": f"my_{category}",
                "category": category,
                "success": error < 3.5,
                "strict_success": error < 3.5,
                "add_s_mm": error,
                "position_error_mm": error,
                "angle_error_deg": -error,
                "height_error_mm": 0.0,
                "cause": None if error < 3.5 else "insertion blocked",
            }
            for category, error in errors.items()
        ]
        actions = [
            {
                "object": f"my_{category}",
                "category": category,
                "outcome": "placed",
                "pick_position_error_mm": 1.0,
                "pick_angle_error_deg": 2.0,
                "place_position_error_mm": 2 * error,
                "place_angle_error_deg": 3 * error,
            }
            for category, error in errors.items()
        ]
        succeeded = sum(error < 3.5 for error in errors_mm)
        return {
            "seed": seed,
            "objects": objects,
            "actions_taken": actions,
            "success_rate": 0.0 if failure else succeeded / len(errors_mm),
            "strict_success_rate": 0.0 if failure else succeeded / len(errors_mm),
            "actions": len(errors_mm),
            "missed_grasps": 0,
            "dropped_objects": 0,
            "sim_seconds": 30.0,
            "wall_seconds": 10.0,
            "point_contact_pairs": 0,
            "moving_at_end": [],
            "failure": failure,
            "timed_out": False,
            "interrupted": False,
        }

    return make


@pytest.fixture(scope="session")
def kill_at_random() -> Callable[..., None]:
    """Kills a process at a random moment: after a file of its own has changed so many times."""

    def kill(process: subprocess.Popen, file: Path, rng: random.Random, *, changes: int) -> None:
        def size() -> int:
            return file.stat().st_size if file.exists() else 0

        for _ in range(changes):
            before = size()
            while size() == before:
                assert process.poll() is None, "it was to be killed before its end"
                time.sleep(0.01)
        time.sleep(rng.uniform(0, 0.5))
        assert process.poll() is None, "it was to be killed before its end"
        os.kill(process.pid, signal.SIGKILL)
        process.wait()

    return kill


@pytest.fixture(scope="session")
def weights_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A policy that has learned nothing: the smallest networks, as they are before training."""
    # Who tests no network does not wait for torch.
    import torch

    from kitting_drake.policies.config import NetworkConfig
    from kitting_drake.policies.methods import make_networks
    from kitting_drake.policies.weights import save_weights

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
