"""The policies for real cameras. Each yields actions with a confidence."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

from kitting_drake.policies.choices import Choice, choose_by_networks, choose_by_shape
from kitting_drake.policies.confidence import read_reliability
from kitting_drake.policies.factory import (
    LoadedPolicy,
    load_learned_policy,
    make_shape_matching,
)
from systems.pick_place_parameters import PickPlaceParameters
from systems.signals import Observation, PixelGrid, PlanarPose


class BenchPolicy(Protocol):
    """A policy for real cameras."""

    @property
    def name(self) -> str:
        """The policy's name in records."""
        ...

    def check_grid(self, grid: PixelGrid) -> None:
        """Checks that the policy supports observations of this grid.

        Raises:
            UserError: the policy does not support them.
        """
        ...

    def choices(
        self, observation: Observation, failed_picks: Sequence[PlanarPose] = ()
    ) -> Iterator[Choice]:
        """Yields the choice for an observation. If it is an action, the choices for other objects
        may follow, for a robot that cannot reach the first.

        Args:
            observation: the heightmap o_t.
            failed_picks: gripper poses at which a grasp failed before; they are avoided.
        """
        ...


@dataclass(frozen=True)
class ShapeMatchingDecider:
    """The training-free policy, which matches outlines (see `ShapeMatchingPolicy`)."""

    recover: bool = False
    """Whether to correct failed insertions; see `Recovery`."""
    parameters: PickPlaceParameters = field(default_factory=PickPlaceParameters)
    """The parameters of the robot's motion; give `decide` the same."""
    least_confidence: float | None = None
    """The least confidence, from 0 to 1, with which the policy acts; None for the fitted
    threshold."""

    @property
    def name(self) -> str:
        return "shape_matching"

    def check_grid(self, grid: PixelGrid) -> None:
        """Does nothing: shape matching supports every grid."""

    def choices(
        self, observation: Observation, failed_picks: Sequence[PlanarPose] = ()
    ) -> Iterator[Choice]:
        policy = make_shape_matching(self.parameters, recover=self.recover)
        return choose_by_shape(policy, self.least_confidence)(observation, failed_picks)


@dataclass(frozen=True)
class _Networks:
    """A learned policy; see `load_policy`."""

    loaded: LoadedPolicy
    least: float
    """The least confidence, from 0 to 1, with which the policy acts."""

    @property
    def name(self) -> str:
        return self.loaded.path.stem

    def check_grid(self, grid: PixelGrid) -> None:
        self.loaded.check_grid(grid, "workspace.resolution")

    def choices(
        self, observation: Observation, failed_picks: Sequence[PlanarPose] = ()
    ) -> Iterator[Choice]:
        return choose_by_networks(self.loaded, self.least)(observation, failed_picks)


def load_policy(
    weights: Path | None = None,
    *,
    orientations: int = 180,
    fit_outlines: bool = True,
    recover: bool = False,
    parameters: PickPlaceParameters | None = None,
    least_confidence: float | None = None,
) -> BenchPolicy:
    """Loads a learned policy, as `policy: !Learned` does in a scenario.

    Args:
        weights: a file that `train` wrote; None for the generalist.
        orientations: the number N of orientations.
        fit_outlines: whether the task is to insert objects. If so, places are refined by outlines,
            and grasps by the clearance of the jaws. If not, the rotation of a place is chosen among
            equivalent ones so that the fingers have room to open.
        recover: whether to correct failed insertions; see `Recovery`.
        parameters: the parameters of the robot's motion; None for the simulated cell's defaults.
            Give `decide` the same.
        least_confidence: the least confidence, from 0 to 1, with which the policy acts; None for
            the threshold of `confidence.json`, 0.9, or for 0 without outlines.

    Raises:
        UserError: the file is unusable, or the networks do not support N orientations.
    """
    loaded = load_learned_policy(
        weights,
        PickPlaceParameters() if parameters is None else parameters,
        insertion=fit_outlines,
        orientations=orientations,
        orientations_field="--orientations",
        recover=recover,
    )
    least = 0.0
    if least_confidence is not None:
        least = least_confidence
    elif fit_outlines:
        least = read_reliability("networks", loaded.path).threshold
    return _Networks(loaded, least)
