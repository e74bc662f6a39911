"""The one place where policies are made, for the simulated cell and for real cameras; no Drake."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from kitting_drake.common.errors import UserError
from kitting_drake.common.paths import GENERALIST
from systems.pick_place_parameters import PickPlaceParameters
from systems.signals import Observation, PixelGrid

if TYPE_CHECKING:
    from kitting_drake.policies.learned_policy import Decision, LearnedPolicy
    from kitting_drake.policies.matching.shape_matching import ShapeMatchingPolicy


@dataclass(frozen=True)
class LoadedPolicy:
    """A learned policy, and what its weights file says of it."""

    function: LearnedPolicy
    path: Path
    """The weights file."""
    resolution: float | None
    """The side of the pixels that it learned from, in metres, if its file tells."""
    colour: bool
    """Whether it sees colours; else heights alone."""

    def check_grid(self, grid: PixelGrid, field: str) -> None:
        """Makes sure that the pixels are of the size that it learned from.

        Args:
            grid: of the observations.
            field: what the caller calls the grid's resolution.

        Raises:
            UserError: they are not.
        """
        learned, given = self.resolution, grid.resolution
        if learned is not None and not math.isclose(given, learned, rel_tol=1e-6):
            raise UserError(
                f"{field} is {given:g} m, and the policy of {self.path.name} learned from pixels "
                f"of {learned:g} m"
            )


def load_learned_policy(
    weights: Path | None,
    planner: PickPlaceParameters,
    *,
    insertion: bool,
    orientations: int = 180,
    orientations_field: str = "orientations",
    continuous: bool = True,
    fit_outlines: bool = True,
    recover: bool = False,
    may_stop: bool = True,
    watch: Callable[[Observation, Decision], None] | None = None,
) -> LoadedPolicy:
    """A policy of trained networks.

    Args:
        weights: a file that `train` wrote; None: the generalist's.
        planner: how the hand will pick and place.
        insertion: whether objects are put into recesses.
        orientations: N.
        orientations_field: what the caller calls them, for errors.
        continuous: see `make_stages`.
        fit_outlines: see `make_stages`.
        recover: see `make_stages`.
        may_stop: see `make_stages`.
        watch: called with each observation and decision.

    Raises:
        UserError: the file cannot be used, or not at so many orientations.
    """
    # Import torch only where networks are used.
    from kitting_drake.policies.learned_policy import LearnedPolicy
    from kitting_drake.policies.networks.device import preferred_device, preferred_type
    from kitting_drake.policies.networks.weights import load_networks, read_weights_file
    from kitting_drake.policies.stages import make_stages

    path = GENERALIST if weights is None else weights
    networks = load_networks(path, preferred_type()).to(preferred_device())
    stages = make_stages(
        planner,
        insertion=insertion,
        continuous=continuous,
        fit_outlines=fit_outlines,
        recover=recover,
        may_stop=may_stop,
    )
    try:
        function = LearnedPolicy(networks, orientations=orientations, stages=stages, watch=watch)
    except ValueError as error:
        raise UserError(f"{orientations_field}: {error}") from error
    resolution = read_weights_file(path).card.get("resolution")
    return LoadedPolicy(function, path, resolution, networks.config.colour)


def make_shape_matching(
    planner: PickPlaceParameters, *, recover: bool = False
) -> ShapeMatchingPolicy:
    """The training-free policy.

    Args:
        planner: how the hand will pick and place.
        recover: mend what earlier actions left undone.
    """
    # Import SciPy lazily.
    from kitting_drake.policies.matching.shape_matching import ShapeMatchingPolicy

    return ShapeMatchingPolicy(planner, recover=recover)
