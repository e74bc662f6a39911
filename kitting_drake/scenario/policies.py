"""The variants of a scenario's `policy:`; each knows how to make its LeafSystem.

Annotations are evaluated here: Drake's YAML loader reads the types of fields, not their texts.
"""

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pydrake.systems.framework import LeafSystem

from kitting_drake.common.errors import UserError
from kitting_drake.common.own_modules import files_beside, import_own, own_digest
from kitting_drake.common.paths import GENERALIST
from kitting_drake.policies.factory import load_learned_policy, make_shape_matching
from kitting_drake.tasks.task import Scene
from systems.action_quantizer import ActionQuantizer
from systems.bounds import bounded
from systems.oracle_policy import OraclePolicy
from systems.pick_place_parameters import PickPlaceParameters
from systems.pick_place_policy import PickPlacePolicy
from systems.placement import PlacedObject
from systems.signals import Observation, PickPlaceAction, PixelGrid, PlanarPose

if TYPE_CHECKING:
    from kitting_drake.policies.learned_policy import Decision

DecisionObserver = Callable[[Observation, "Decision"], None]
"""Told of every decision of a learned policy."""


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
"""The fields of a network's training that are reported with its results."""


@dataclass(frozen=True)
class PolicySite:
    """What a policy is told of the station that it plugs into."""

    scene: Scene
    objects: tuple[PlacedObject, ...]
    """The scene's objects, with their bodies."""
    grid: PixelGrid
    """The pixel grid of the observations."""
    base: Path
    """Where relative paths in the scenario start."""
    observer: DecisionObserver | None = None
    may_stop: bool = True
    """False where the episode ends by itself once all is done."""
    planner: PickPlaceParameters = field(default_factory=PickPlaceParameters)
    """How the hand will pick and place."""
    has_cameras: bool = True
    """Whether there is an o_t: else the oracle tells the planner how high things are."""


class PolicyConfig:
    """The interface of a policy; each variant of the scenario's `policy:` derives from it."""

    needs_observation: bool = True
    """Whether it sees by cameras, which are then needed."""

    @property
    def name(self) -> str:
        """The policy's name for results."""
        return "".join(f"_{c.lower()}" if c.isupper() else c for c in type(self).__name__)[1:]

    def make_system(self, site: PolicySite) -> LeafSystem:
        """The system. Its input ports are named after the station's output ports that they are
        connected to (see `station.KittingStation`); it has the output port `action`.

        Raises:
            UserError: it cannot be made.
        """
        raise NotImplementedError

    def details(self, base: Path) -> dict[str, Any]:
        """The details that distinguish policies of a kind, for results.

        Raises:
            UserError: its files cannot be read.
        """
        return {}

    def digest(self, base: Path) -> str | None:
        """A digest of the content of the policy's files; None if it has none.

        Raises:
            UserError: they cannot be read.
        """
        return None

    def input_files(self, base: Path) -> list[Path]:
        """The files that it reads, beside those of the project; not its modules."""
        return []

    def modules(self) -> list[str]:
        """The modules that it imports, beside those of the project and of what that requires."""
        return []

    def training_seeds(self, base: Path) -> set[int]:
        """The seeds of the demonstrations that it was trained, or chosen, with.

        Raises:
            UserError: its files cannot be read.
        """
        return set()

    def validate(self) -> None:
        """Checks what neither types nor ranges say.

        Raises:
            ValueError: one sentence that begins with the path of a field, `policy.x`.
        """


@dataclass
class Oracle(PolicyConfig):
    """Ground truth and annotated grasps (section IV-B.4 of the paper)."""

    needs_observation = False

    def make_system(self, site: PolicySite) -> LeafSystem:
        return _make_oracle(site, None)

    def details(self, base: Path) -> dict[str, Any]:
        return {"method": "oracle"}


@dataclass
class QuantizedOracle(PolicyConfig):
    """The oracle, rounded to the actions of a network: the ceiling of the paper's policy."""

    needs_observation = False

    # N: picks and rotations are among 2 pi i / N; positions are pixel centres of the heightmap.
    orientations: int = bounded(180, 2, 3600)

    def make_system(self, site: PolicySite) -> LeafSystem:
        return _make_oracle(site, ActionQuantizer(site.grid, self.orientations))

    def details(self, base: Path) -> dict[str, Any]:
        return {"method": "quantized_oracle", "orientations": self.orientations}


@dataclass
class Learned(PolicyConfig):
    """Networks trained by `train`."""

    # Their file, as `train` writes it; relative to the scenario's folder. Empty: the project's
    # own generalist.
    weights: str = ""

    # N: picks and rotations are among 2 pi i / N. The paper's own method takes any N.
    orientations: int = bounded(180, 2, 3600)

    # Refine actions to sub-pixel and sub-bin accuracy (the paper does not) instead of choosing
    # among pixel centres and the N orientations.
    continuous: bool = True

    # With `continuous`, by the geometry of o_t (the paper does none of these): refine the place by
    # fitting the outline of the object to that of the recess, where the two agree, and the grasp by
    # the room that there is for the jaws; and, unless `recover`, do not stop while an object
    # certainly fits into a recess. Where nothing is inserted: of rotations that the networks hold
    # for as good, take the one where the fingers have room when they let go.
    fit_outlines: bool = True

    # Do not pick again within 10 mm of where a grasp failed. The paper has no such memory.
    avoid_failed_picks: bool = True

    # Mend what an action left undone, as o_t shows it: press down what protrudes; pick what fits
    # into a recess before anything else; at last take out what could not be pressed down, and try
    # again. It takes actions: see the task's `tries`.
    recover: bool = False

    def make_system(self, site: PolicySite) -> LeafSystem:
        # Outlines and recesses mean something only where objects are inserted.
        insertion = any(goal.rim_height is not None for goal in site.scene.goals)
        if self.recover and not insertion:
            raise UserError("policy.recover mends insertions, and in this task nothing is inserted")
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
            watch=site.observer,
        )
        loaded.check_grid(site.grid, "heightmap.resolution")
        if site.grid.z_min != 0:
            raise UserError(
                f"heightmap.z_min is {site.grid.z_min:g}, and the policy of {loaded.path.name} "
                "learned from heights above the table: use 0"
            )
        # An observer is shown colours, whatever the networks see.
        heights_only = not loaded.colour and site.observer is None
        function = loaded.function
        return PickPlacePolicy(
            policy=function if self.avoid_failed_picks else _OfObservationAlone(function),
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
            "trained_orientations": file.config.orientations,
            "compute_type": str(preferred_type()).removeprefix("torch."),
            **{key: file.card.get(key) for key in _TOLD},
            "training_seed": file.card.get("seed"),
            "angle_only": file.card.get("angle_only", False),
            # The step of the checkpoint that was kept, of `steps`.
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

    def _path(self, base: Path) -> Path:
        return base / self.weights if self.weights else GENERALIST


@dataclass
class ShapeMatching(PolicyConfig):
    """Training-free: outlines of the loose objects, seen by height, fitted to those of recesses."""

    # Mend what an action left undone, as for !Learned.
    recover: bool = False

    def make_system(self, site: PolicySite) -> LeafSystem:
        function = make_shape_matching(site.planner, recover=self.recover)
        return PickPlacePolicy(policy=function, heights_only=True)

    def details(self, base: Path) -> dict[str, Any]:
        return {"method": "shape_matching", "recover": self.recover}


@dataclass
class PythonPolicy(PolicyConfig):
    """Your own function from `Observation` to `PickPlaceAction` (see systems/signals.py).

    Results tell policies apart by the sources of the function's package, or of its module if that
    is in none. What else it reads (weights, other modules) is not told: give another --output when
    that has changed.
    """

    # `module:function`, called with one Observation; the module is importable from where you run,
    # or lies beside the scenario's file.
    function: str = ""

    # Call it with a second argument: the poses (`PlanarPose`) at which grasps failed before, the
    # latest last.
    takes_failed_picks: bool = False

    def make_system(self, site: PolicySite) -> LeafSystem:
        try:
            function = import_own(self.function, site.base)
        except (Exception, SystemExit) as error:
            # A person's own module may raise anything.
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
    """A function of an observation alone, as a policy that may be given failed picks too."""

    function: Callable[[Observation], PickPlaceAction]

    def __call__(
        self, observation: Observation, failed_picks: Sequence[PlanarPose] = ()
    ) -> PickPlaceAction:
        return self.function(observation)

    def __repr__(self) -> str:
        return repr(self.function)


Policy = Oracle | QuantizedOracle | Learned | ShapeMatching | PythonPolicy
"""The variants of a scenario's `policy:`; the first is the default."""


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
    )


def _digest(path: Path) -> str:
    try:
        return f"sha256 {hashlib.sha256(path.read_bytes()).hexdigest()}"
    except OSError as error:
        raise UserError(f"cannot read {path}: {error.strerror}") from error
