"""Makes policies for the simulated cell and for real cameras. This module does not import Drake."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from kitting_drake.common.errors import UserError
from kitting_drake.common.paths import GENERALIST
from systems.pick_place_parameters import PickPlaceParameters
from systems.signals import PixelGrid

if TYPE_CHECKING:
    from kitting_drake.policies.learned_policy import LearnedPolicy
    from kitting_drake.policies.matching.shape_matching import ShapeMatchingPolicy


_LARGEST_RATIO = 3.0
"""The largest factor by which pixels may be larger or smaller than in training."""


@dataclass(frozen=True)
class LoadedPolicy:
    """A learned policy and the metadata of its weights file."""

    function: LearnedPolicy
    path: Path
    """The weights file."""
    resolution: float | None
    """The side of the pixels in training, in metres; None if the file does not give it."""
    colour: bool
    """Whether the policy sees colours; otherwise it sees only heights."""

    def check_grid(self, grid: PixelGrid, field: str) -> None:
        """Checks that the policy can use observations with a given pixel grid.

        Networks that see only heights can use pixels of another size than in training (see
        `network_input`). Networks that see colours cannot.

        Args:
            grid: the pixel grid of the observations.
            field: the caller's name for the grid's resolution, used in error messages.

        Raises:
            UserError: the policy cannot use this size of pixels.
        """
        learned, given = self.resolution, grid.resolution
        if learned is None or math.isclose(given, learned, rel_tol=1e-6):
            return
        advice = f"but the policy in {self.path.name} learned from pixels of {learned:g} m"
        if self.colour:
            raise UserError(
                f"{field} is {given:g} m, {advice}: use {learned:g} m, or train another policy"
            )
        if not 1 / _LARGEST_RATIO <= given / learned <= _LARGEST_RATIO:
            raise UserError(
                f"{field} is {given:g} m, {advice}: use a size from "
                f"{learned / _LARGEST_RATIO:.4g} to {learned * _LARGEST_RATIO:.4g} m"
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
) -> LoadedPolicy:
    """Loads a policy with trained networks.

    Args:
        weights: a file that `train` wrote; None for the weights that come with the package.
        planner: parameters of the motion with which the hand will pick and place.
        insertion: whether objects are inserted into recesses.
        orientations: N, the number of orientations in a full turn.
        orientations_field: the caller's name for `orientations`, used in error messages.
        continuous: whether to refine actions beyond the networks' pixels and bins.
        fit_outlines: whether to refine actions by the geometry of o_t as well.
        recover: whether to correct failed insertions, take heaps apart and turn objects over.
        may_stop: whether the policy may stop when there is nothing left to pick.

    Raises:
        UserError: the file is unusable, or the networks do not support N orientations.
    """
    # Import torch only where networks are used.
    from kitting_drake.policies.learned_policy import LearnedPolicy
    from kitting_drake.policies.networks.device import preferred_device, preferred_type
    from kitting_drake.policies.networks.weights import load_networks, read_weights_file
    from kitting_drake.policies.stages import make_stages

    path = GENERALIST if weights is None else weights
    resolution = read_weights_file(path).card.get("resolution")
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
        function = LearnedPolicy(
            networks,
            orientations=orientations,
            stages=stages,
            resolution=resolution,
        )
    except ValueError as error:
        raise UserError(f"{orientations_field}: {error}") from error
    return LoadedPolicy(function, path, resolution, networks.config.colour)


def make_shape_matching(
    planner: PickPlaceParameters, *, recover: bool = False
) -> ShapeMatchingPolicy:
    """Makes the policy that needs no training.

    Args:
        planner: parameters of the motion with which the hand will pick and place.
        recover: whether to correct failed insertions, take heaps apart and turn objects over.
    """
    # Import SciPy only where shapes are matched.
    from kitting_drake.policies.matching.shape_matching import ShapeMatchingPolicy

    return ShapeMatchingPolicy(planner, recover=recover)
