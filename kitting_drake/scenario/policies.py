"""The types of policies in a scenario. Each one makes its LeafSystem.

Drake's YAML loader needs evaluated annotations, hence no `from __future__ import annotations`.
"""

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from pydrake.systems.framework import LeafSystem

from kitting_drake.common.errors import UserError
from kitting_drake.common.own_modules import files_beside, import_own, own_digest
from kitting_drake.common.paths import GENERALIST
from kitting_drake.policies.choices import Choose, choose_by_networks, choose_by_shape
from kitting_drake.policies.factory import load_learned_policy, make_shape_matching
from kitting_drake.tasks.task import Scene
from systems.action_quantizer import ActionQuantizer
from systems.bounds import bounded
from systems.cluttered_table import ClutteredTable
from systems.ledge import Ledge
from systems.oracle_policy import OraclePolicy
from systems.pick_place_parameters import PickPlaceParameters
from systems.pick_place_policy import PickPlacePolicy
from systems.placement import PlacedObject, heading
from systems.signals import Observation, PickPlaceAction, PixelGrid, PlanarPose

if TYPE_CHECKING:
    from kitting_drake.policies.learned_policy import Decision

DecisionObserver = Callable[[Observation, "Decision"], None]
"""A function that is called with every decision of a learned policy and its observation."""

_TOLD = (
    "scenario",
    "demonstrations",
    "steps",
    "learning_rate",
    "decay",
    "taken_only",
    "rigid",
    "rotations",
)
"""Fields of the card (the metadata) of a weights file that are reported with the results."""


@dataclass(frozen=True)
class PolicySite:
    """The properties of the station that a policy needs to make its system."""

    scene: Scene
    objects: tuple[PlacedObject, ...]
    """The scene's objects, with their bodies."""
    grid: PixelGrid
    """The pixel grid of the observations."""
    base: Path
    """The base folder of relative paths in the scenario."""
    observer: DecisionObserver | None = None
    may_stop: bool = True
    """Whether the policy may decide to stop. False if the episode ends as soon as every goal is met
    (`end_at_success`)."""
    planner: PickPlaceParameters = field(default_factory=PickPlaceParameters)
    """The parameters of the hand's motion."""
    has_cameras: bool = True
    """Whether the station provides the observation o_t. If not, the oracle's actions carry the
    heights that the planner needs."""


class PolicyConfig:
    """Base class of the types of policies in a scenario."""

    needs_observation: bool = True
    """Whether the policy needs cameras."""

    @property
    def name(self) -> str:
        """The policy's name in results."""
        return "".join(f"_{c.lower()}" if c.isupper() else c for c in type(self).__name__)[1:]

    def make_system(self, site: PolicySite) -> LeafSystem:
        """Makes the policy's system, with the output port `action`. Each of its input ports has the
        name of the station's output port to which it is connected (see `station.KittingStation`).

        Raises:
            UserError: a field or a file is invalid for this station.
        """
        raise NotImplementedError

    def details(self, base: Path) -> dict[str, Any]:
        """Details of the policy that are reported with results, as JSON values.

        Raises:
            UserError: a file cannot be read.
        """
        return {}

    def digest(self, base: Path) -> str | None:
        """A digest of the contents of the policy's files; None if there are no files.

        Raises:
            UserError: a file cannot be read.
        """
        return None

    def input_files(self, base: Path) -> list[Path]:
        """The user's files that the policy reads, except for its Python modules."""
        return []

    def modules(self) -> list[str]:
        """The user's modules that the policy imports."""
        return []

    def training_seeds(self, base: Path) -> set[int]:
        """The seeds of the demonstrations that were used to train or validate the policy.

        Raises:
            UserError: a file cannot be read.
        """
        return set()

    def validate(self) -> None:
        """Checks the constraints that types and ranges cannot express.

        Raises:
            ValueError: a field violates a constraint. The message begins with the field's path,
                such as `policy.weights`.
        """


@dataclass
class Oracle(PolicyConfig):
    """An expert that knows all poses and uses annotated grasps (section IV-B.4 of the paper)."""

    needs_observation = False

    def make_system(self, site: PolicySite) -> LeafSystem:
        return _make_oracle(site, None)

    def details(self, base: Path) -> dict[str, Any]:
        return {"method": "oracle"}


@dataclass
class QuantizedOracle(PolicyConfig):
    """The oracle with its actions rounded to those that a network of the paper can choose.

    Its success rate is an upper bound for the paper's policy.
    """

    needs_observation = False

    # Number of orientations N. Angles are rounded to multiples of 2 pi / N, and positions to pixel
    # centres of the heightmap.
    orientations: int = bounded(180, 2, 3600)

    def make_system(self, site: PolicySite) -> LeafSystem:
        return _make_oracle(site, ActionQuantizer(site.grid, self.orientations))

    def details(self, base: Path) -> dict[str, Any]:
        return {"method": "quantized_oracle", "orientations": self.orientations}


@dataclass
class Learned(PolicyConfig):
    """A policy with networks that the command `train` trained."""

    # The weights file that `train` wrote, relative to the scenario's folder. If empty, the policy
    # for arbitrary tools in models/policies/ is used.
    weights: str = ""

    # Number of orientations N. The networks predict picks and rotations at multiples of 2 pi / N.
    # The SO(2) method takes any even N.
    orientations: int = bounded(180, 2, 3600)

    # Whether to refine actions between pixel centres and between the N orientations. If false,
    # actions are pixel centres and one of the N orientations, as in the paper.
    continuous: bool = True

    # Whether to refine actions by the geometry of the observation o_t. Needs `continuous`. The
    # paper's policy has none of these refinements:
    #
    # - The place: fit the object's outline to that of the recess, if the two agree.
    # - The pick: move the grasp to where the jaws have clearance.
    # - Touching objects: separate them by the outlines of the empty recesses.
    # - Stopping: continue while an object fits into a recess, or an untried object may fit.
    # - In tasks without insertion: among rotations that score equally well, choose one with
    #   clearance for the opening fingers.
    fit_outlines: bool = True

    # Whether to avoid picks within 10 mm of a failed grasp. The paper's policy has no such memory.
    avoid_failed_picks: bool = True

    # Whether to correct failed insertions, take heaps apart and turn objects over. The policy first
    # presses down protruding objects. Then it picks objects that fit into a recess. When none is
    # left, it takes objects off other objects, then moves misplaced objects to their place, takes
    # out objects that could not be pressed down, and turns over objects that lie upside down. No
    # object is taken out twice. Recovery needs extra actions: see the task's `tries`.
    recover: bool = False

    # The least probability of success with which the policy acts. Below it, the policy stops with
    # the reason `not sure`, as `decide` does below 0.9. At 0 it always acts. Only decisions that
    # use outlines have such a probability (see `fit_outlines`).
    least_confidence: float = bounded(0.0, 0.0, 1.0)

    def make_system(self, site: PolicySite) -> LeafSystem:
        # Outlines and recesses matter only if objects are inserted into cavities.
        insertion = any(goal.rim_height is not None for goal in site.scene.goals)
        if self.recover and not insertion:
            raise UserError("policy.recover must be false: this task has no cavities to fill")
        loaded = load_learned_policy(
            self._path(site.base),
            site.planner,
            insertion=insertion,
            orientations=self.orientations,
            orientations_field="policy.orientations",
            continuous=self.continuous,
            fit_outlines=self.fit_outlines,
            recover=self.recover,
            may_stop=site.may_stop,
        )
        loaded.check_grid(site.grid, "heightmap.resolution")
        if site.grid.z_min != 0:
            raise UserError(
                f"heightmap.z_min is {site.grid.z_min:g}, but the policy {loaded.path.name} needs "
                "0, as in its training"
            )
        # An observer gets colours even if the networks use only heights.
        heights_only = not loaded.colour and site.observer is None
        function = _FirstChoice(choose_by_networks(loaded, self.least_confidence), site.observer)
        return PickPlacePolicy(
            policy=function
            if self.avoid_failed_picks
            else _OfObservationAlone(function, forgets=True),
            heights_only=heights_only,
        )

    def details(self, base: Path) -> dict[str, Any]:
        from kitting_drake.policies.networks.device import preferred_type
        from kitting_drake.policies.networks.weights import read_weights_file

        file = read_weights_file(self._path(base))
        return {
            "method": file.config.method,
            "preset": file.config.preset,
            "orientations": self.orientations,
            "continuous": self.continuous,
            "fit_outlines": self.continuous and self.fit_outlines,
            "recover": self.recover,
            "avoid_failed_picks": self.avoid_failed_picks,
            "least_confidence": self.least_confidence,
            "trained_orientations": file.config.orientations,
            "compute_type": str(preferred_type()).removeprefix("torch."),
            **{key: file.card.get(key) for key in _TOLD},
            "training_seed": file.card.get("seed"),
            "angle_only": file.card.get("angle_only", False),
            # The training step of the checkpoint that was best in validation.
            "checkpoint_step": (file.card.get("validation") or {}).get("step"),
        }

    def digest(self, base: Path) -> str | None:
        return _digest(self._path(base))

    def input_files(self, base: Path) -> list[Path]:
        return [self._path(base)] if self.weights else []

    def training_seeds(self, base: Path) -> set[int]:
        from kitting_drake.policies.networks.weights import card_seeds, read_weights_file

        return card_seeds(read_weights_file(self._path(base)).card)

    def validate(self) -> None:
        if self.recover and not self.avoid_failed_picks:
            raise ValueError("policy.recover needs policy.avoid_failed_picks: true")
        if self.least_confidence and not (self.continuous and self.fit_outlines):
            raise ValueError(
                "policy.least_confidence needs policy.continuous and policy.fit_outlines: true"
            )

    def _path(self, base: Path) -> Path:
        return base / self.weights if self.weights else GENERALIST


@dataclass
class ShapeMatching(PolicyConfig):
    """A policy without training that fits the outlines of loose objects to those of recesses.

    It uses only heights, not colours.
    """

    # Whether to recover from failed insertions, as for !Learned.
    recover: bool = False

    # The least probability of success with which the policy acts, as for !Learned.
    least_confidence: float = bounded(0.0, 0.0, 1.0)

    def make_system(self, site: PolicySite) -> LeafSystem:
        policy = make_shape_matching(site.planner, recover=self.recover)
        function = _FirstChoice(choose_by_shape(policy, self.least_confidence))
        return PickPlacePolicy(policy=function, heights_only=True)

    def details(self, base: Path) -> dict[str, Any]:
        return {
            "method": "shape_matching",
            "recover": self.recover,
            "least_confidence": self.least_confidence,
        }


@dataclass
class PythonPolicy(PolicyConfig):
    """Your own function from `Observation` to `PickPlaceAction` (see systems/signals.py).

    `evaluate` compares the sources of the function's package, or of its module, with those of
    earlier episodes, so that a run is not resumed with changed code. It does not check other files
    that the function reads, such as weights. Use another --output after you change them.
    """

    # `module:function`, called with an Observation. The module must be importable, or lie beside
    # the scenario's file.
    function: str = ""

    # Whether the function takes a second argument, the poses (`PlanarPose`) of failed grasps,
    # oldest first.
    takes_failed_picks: bool = False

    def make_system(self, site: PolicySite) -> LeafSystem:
        try:
            function = import_own(self.function, site.base)
        except (Exception, SystemExit) as error:
            # A user's module may raise any exception.
            reason = f"{type(error).__name__}: {error}"
            raise UserError(f"policy.function: cannot import {self.function}: {reason}") from error
        if not callable(function):
            raise UserError(f"policy.function: {self.function} is not a function")
        return PickPlacePolicy(
            policy=function if self.takes_failed_picks else _OfObservationAlone(function)
        )

    def digest(self, base: Path) -> str | None:
        try:
            return f"sha256 {own_digest(self.function.partition(':')[0], base)}"
        except (ImportError, ValueError) as error:
            raise UserError(f"policy.function: cannot import {self.function}: {error}") from error
        except LookupError as error:
            raise UserError(f"policy.function: {error}") from error
        except OSError as error:
            reason = f"{error.filename}: {error.strerror}"
            raise UserError(f"policy.function: cannot read {reason}") from error

    def input_files(self, base: Path) -> list[Path]:
        return files_beside(self.function.partition(":")[0], base)

    def modules(self) -> list[str]:
        return [self.function.partition(":")[0]]

    def validate(self) -> None:
        module, _, function = self.function.partition(":")
        if not module or not function:
            raise ValueError(f"policy.function must be module:function, not '{self.function}'")


@dataclass(frozen=True)
class _OfObservationAlone:
    """Calls a function that takes only an observation. The failed picks are ignored."""

    function: Callable[[Observation], PickPlaceAction]
    forgets: bool = False
    """Whether the function gets the observation without its `history`."""

    def __call__(
        self, observation: Observation, failed_picks: Sequence[PlanarPose] = ()
    ) -> PickPlaceAction:
        return self.function(replace(observation, history=()) if self.forgets else observation)

    def __repr__(self) -> str:
        return repr(self.function)


@dataclass(frozen=True)
class _FirstChoice:
    """Acts by the first choice, and reports the networks' decision that led to it."""

    choose: Choose
    observer: DecisionObserver | None = None

    def __call__(
        self, observation: Observation, failed_picks: Sequence[PlanarPose] = ()
    ) -> PickPlaceAction:
        choice = next(self.choose(observation, failed_picks))
        if self.observer is not None and choice.decision is not None:
            self.observer(observation, choice.decision)
        return choice.action


Policy = Oracle | QuantizedOracle | Learned | ShapeMatching | PythonPolicy
"""The types of policies in a scenario; the first is the default."""


def _make_oracle(site: PolicySite, quantizer: ActionQuantizer | None) -> OraclePolicy:
    return OraclePolicy(
        objects=site.objects,
        grasps=[item.grasps for item in site.scene.objects],
        goals=site.scene.goals,
        success=site.scene.success,
        quantizer=quantizer,
        tip_depth=site.planner.grasp_depth,
        release_clearance=site.planner.release_clearance,
        open_width=site.planner.open_width,
        brings_heights=not site.has_cameras,
        table=_cluttered_table(site),
    )


def _cluttered_table(site: PolicySite) -> ClutteredTable | None:
    scene = site.scene
    if scene.laying_area is None:
        return None
    return ClutteredTable(
        objects=site.objects,
        grasps=[item.grasps for item in scene.objects],
        area=scene.laying_area,
        fixtures=[
            item.X_WF.multiply(item.p_FPoints.T).T
            for item in scene.fixtures
            if item.p_FPoints is not None
        ],
        planner=site.planner,
        ledge=_ledge(scene),
    )


def _ledge(scene: Scene) -> Ledge | None:
    """The kit's block, over whose edges objects can be turned; None if the scene has no kit."""
    for item in scene.fixtures:
        if item.p_FPoints is not None:
            length, width, _ = np.ptp(item.p_FPoints, axis=0).tolist()
            x, y = item.X_WF.translation()[:2].tolist()
            return Ledge(PlanarPose(x, y, heading(item.X_WF)), (length, width))
    return None


def _digest(path: Path) -> str:
    try:
        return f"sha256 {hashlib.sha256(path.read_bytes()).hexdigest()}"
    except OSError as error:
        raise UserError(f"cannot read {path}: {error.strerror}") from error
