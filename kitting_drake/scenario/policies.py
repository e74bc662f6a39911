"""The policies that see nothing but the observation, as functions from it to an action."""

from __future__ import annotations

import importlib
import importlib.util
import math
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from kitting_drake.common.errors import UserError
from kitting_drake.scenario.schema import Learned, PythonPolicy
from systems.signals import Observation, PickPlaceAction, PixelGrid

if TYPE_CHECKING:
    from kitting_drake.policies.learned_policy import Decision

Watch = Callable[[Observation, "Decision"], None]
"""Told of every decision of a learned policy."""


def make_function(
    config: Learned | PythonPolicy, *, base: Path, grid: PixelGrid, watch: Watch | None
) -> Callable[[Observation], PickPlaceAction]:
    """The function that a scenario names.

    Args:
        config: the scenario's policy.
        base: where relative paths start.
        grid: of the observations that it will be given.
        watch: told of a learned policy's decisions.

    Raises:
        UserError: it cannot be had.
    """
    if isinstance(config, PythonPolicy):
        return _import_function(config)
    # Only who uses a network waits for torch.
    from kitting_drake.policies.learned_policy import LearnedPolicy
    from kitting_drake.policies.weights import (
        load_networks,
        preferred_device,
        preferred_type,
        read_weights_file,
    )

    networks = load_networks(base / config.weights, preferred_type()).to(preferred_device())
    learned_at = read_weights_file(base / config.weights).card.get("resolution")
    if learned_at is not None and not math.isclose(learned_at, grid.resolution, rel_tol=1e-6):
        raise UserError(
            f"heightmap.resolution is {grid.resolution:g} m, and the policy of {config.weights} "
            f"learned from pixels of {learned_at:g} m"
        )
    try:
        return LearnedPolicy(
            networks,
            orientations=config.orientations,
            continuous=config.continuous,
            watch=watch,
        )
    except ValueError as error:
        raise UserError(f"policy.orientations: {error}") from error


def describe_learned(config: Learned, *, base: Path) -> dict[str, Any]:
    """What results say of a learned policy: its method, its size, what it learned from, and in
    which numbers this machine computes it.

    Raises:
        UserError: the weights cannot be read.
    """
    from kitting_drake.policies.weights import preferred_type, read_weights_file

    file = read_weights_file(base / config.weights)
    return {
        "method": file.config.method,
        "preset": file.config.preset,
        "orientations": config.orientations,
        "continuous": config.continuous,
        "trained_orientations": file.config.orientations,
        "compute_type": str(preferred_type()).removeprefix("torch."),
        **{key: file.card.get(key) for key in ("scenario", "demonstrations", "steps")},
    }


def seeds_learned_from(config: Learned, *, base: Path) -> set[int]:
    """The seeds of the demonstrations that a policy was trained, or chosen, with.

    Raises:
        UserError: the weights cannot be read.
    """
    from kitting_drake.policies.weights import read_weights_file

    card = read_weights_file(base / config.weights).card
    return {*card.get("demonstration_seeds", ()), *card.get("validation_seeds", ())}


def source_of(config: PythonPolicy) -> Path:
    """The file of the module that a function is in.

    Raises:
        UserError: it cannot be found.
    """
    module = config.function.partition(":")[0]
    try:
        spec = importlib.util.find_spec(module)
    except (ImportError, ValueError) as error:
        raise UserError(f"policy.function: cannot import {config.function}: {error}") from error
    if spec is None or spec.origin is None:
        raise UserError(f"policy.function: there is no file of the module {module}")
    return Path(spec.origin)


def _import_function(config: PythonPolicy) -> Callable[[Observation], PickPlaceAction]:
    module, _, name = config.function.partition(":")
    try:
        function = getattr(importlib.import_module(module), name)
    except (Exception, SystemExit) as error:
        # A person's own module may raise anything.
        reason = f"{type(error).__name__}: {error}"
        raise UserError(f"policy.function: cannot import {config.function}: {reason}") from error
    if not callable(function):
        raise UserError(f"policy.function: {config.function} is not a function")
    return function
