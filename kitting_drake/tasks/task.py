"""The interface of a task: a dataclass of parameters that makes a Scene from a seed.

A scenario's field `task:` holds a task. Code outside `kitting_drake/tasks/` depends only on this
interface.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform

from kitting_drake.common.errors import UserError
from kitting_drake.policies.data.learning import Learning
from systems.grasp import Grasp
from systems.placement import Goal, Placement, SuccessPredicate
from systems.signals import PixelGrid, PlanarPose

NEVER_APPEARED = "never appeared"
NEVER_PICKED = "never picked"
MISSED_GRASP = "missed grasp"
SLIPPED = "slipped"
MISPLACED = "misplaced"

_EMPTY_MODES = ("APPROACH", "DESCEND", "CLOSE")
"""The planner's modes in which the hand has not grasped an object yet."""

TABLE = ((0.0, -0.75), (1.0, 0.75))
"""Lower and upper (x, y) corners of the table in the world, in metres. The table's top is at z =
0."""


@dataclass(frozen=True)
class SceneObject:
    """An object that can be picked."""

    name: str
    """Name of the object, which must be unique in the scene."""
    category: str
    """Category of the object. Results are grouped by category."""
    model: Path
    """SDFormat file of one free link; its frame is the object's frame B."""
    X_WB: RigidTransform
    """Initial pose of the object in the world."""
    p_BPoints: NDArray[np.float64] = field(repr=False)
    """(m, 3) points of the surface, sampled uniformly by area, in B, in metres."""
    grasps: tuple[Grasp, ...] = ()
    """The object's grasps in B, best first. They may be missing if the object can fill no goal."""
    symmetry: int = 1
    """Order of the object's rotational symmetry about B's z axis; 1 for none."""
    axis: tuple[float, float] | None = None
    """(x, y) of the axis of symmetry in B, in metres; None stands for the middle of the bounding
    box."""


@dataclass(frozen=True)
class Fixture:
    """A body on the table that never moves."""

    name: str
    model: Path
    """SDFormat file of one link."""
    X_WF: RigidTransform
    """Pose of the link's frame F in the world."""
    p_FPoints: NDArray[np.float64] | None = field(default=None, repr=False)
    """(m, 3) points of the fixture's surface in F, in metres, which the expert's hand avoids; None
    if the fixture is never in the way."""


@dataclass(frozen=True)
class Arrivals:
    """Objects that appear one at a time during an episode. Each is outside the cell until it
    appears.

    The next object appears while the hand retreats or observes, if no object's origin is over
    `area`.
    """

    objects: tuple[int, ...]
    """Indices of the scene's objects, in the order in which they appear."""
    poses: tuple[RigidTransform, ...]
    """X_WB at which each object appears, at rest in the air."""
    area: tuple[tuple[float, float], tuple[float, float]]
    """Lower and upper (x, y) corners of the area in the world, in metres."""

    def __post_init__(self) -> None:
        assert len(self.objects) == len(self.poses)


def waiting_pose(index: int) -> RigidTransform:
    """X_WB of an object that has not appeared yet. It is outside the cell and out of the cameras'
    sight."""
    return RigidTransform([-20.0 - index, 0.0, -20.0])


@dataclass(frozen=True)
class Scene:
    """The initial state of an episode, and its goals.

    Raises:
        UserError: a name is given twice, a goal's index is out of range, or the goals' rewards do
            not add up to 1.
    """

    objects: tuple[SceneObject, ...]
    fixtures: tuple[Fixture, ...]
    goals: tuple[Goal, ...]
    """The goals, in the order in which the expert fills them. Their rewards add up to 1."""
    success: SuccessPredicate
    max_actions: int
    """Number of actions after which the episode ends."""
    arrivals: Arrivals | None = None
    """Objects that appear later; None if all are present from the beginning."""
    measures: Mapping[str, SuccessPredicate] = field(default_factory=dict)
    """Other measures of success, by name. Results report them besides `success` and `strict`. They
    affect neither the reward nor the expert."""
    laying_area: tuple[tuple[float, float], tuple[float, float]] | None = None
    """Lower and upper (x, y) corners, in metres, of the part of the table on which the expert may
    lay objects that are in the way. None if the objects lie apart and are never in the way."""

    def __post_init__(self) -> None:
        names = [item.name for item in self.objects] + [item.name for item in self.fixtures]
        if twice := [name for name in names if names.count(name) > 1]:
            raise UserError(f"the name '{twice[0]}' is given to several objects or fixtures")
        for goal in self.goals:
            for what, indices, count in (
                ("object", goal.objects, len(self.objects)),
                ("goal", goal.after, len(self.goals)),
            ):
                if wrong := [index for index in indices if not 0 <= index < count]:
                    raise UserError(
                        f"the goal '{goal.name}' refers to {what} {wrong[0]}, but the indices of "
                        f"{what}s are 0 to {count - 1}"
                    )
        total = sum(goal.reward for goal in self.goals)
        if not abs(total - 1) < 1e-9:
            raise UserError(f"the goals' rewards must add up to 1, not {total:.10g}")

    @property
    def goal_objects(self) -> tuple[int, ...]:
        """Indices of the objects that can fill a goal. Results list these objects."""
        return tuple(sorted({index for goal in self.goals for index in goal.objects}))


@dataclass(frozen=True)
class PeakForce:
    """The largest contact force on the hand during an action, averaged over 1/64 s. It does not
    include the weight of the held object. See `systems.contact_guard.ContactGuard`."""

    vertical: float
    """The vertical force, in N."""
    lateral: float
    """The lateral force, in N."""
    mode: str
    """The planner's mode (`systems.pick_place_parameters.Mode`) in which the larger of the two
    forces occurred."""


@dataclass
class ActionRecord:
    """A pick and place, and how far it deviates from the expert's. The fields are keys of
    `results.json`."""

    object: str
    """Name of the lifted object. If none was lifted, it is the object nearest to the pick."""
    category: str
    """The object's category."""
    outcome: str
    """The outcome: `placed`, `missed` (nothing was grasped), `dropped` (the object was lost on the
    way), `pressed` (it was pushed down), `stopped` (a contact force exceeded
    `planner.force_limit`), `set down` (it was put back where it was picked, because it would have
    turned between the pads), `unreachable` (the robot did not move) or `unfinished`."""
    pick: PlanarPose
    place: PlanarPose
    pick_position_error_mm: float | None
    """Distance of the pick from the nearest of the object's annotated grasps, in mm; None if the
    object has no grasps or was pressed down."""
    pick_angle_error_deg: float | None
    """Angle between the pick and the nearest annotated grasp, modulo half rotations: 0 to 90
    degrees."""
    place_position_error_mm: float | None
    """Predicted distance of the object's middle from its goal after the action, in mm. It is
    assumed that the object moves rigidly with the hand. None if the object can fill no goal or was
    pressed down."""
    place_angle_error_deg: float | None
    """Predicted heading error, modulo the object's symmetry, if the object moves rigidly with the
    hand: 0 to 180 degrees."""
    peak_force_n: PeakForce | None = None
    """The largest contact force during the action; None until it is measured."""
    was_placed: bool = False
    """Whether the object was already a strict success when the action began."""


class TaskConfig:
    """The interface of a task, from which each type of task derives.

    A task is a dataclass of YAML fields with defaults (see `systems.bounds.bounded`).
    """

    causes: tuple[str, ...] = (MISSED_GRASP, SLIPPED, MISPLACED, NEVER_PICKED)
    """The possible results of `find_cause`, in the order in which tables list them."""
    not_perturbed: tuple[str, ...] = ()
    """Names of perturbations (see `--perturb`) that do not apply, because they would change the
    task."""
    objects_are_independent: bool = False
    """Whether placed objects neither support nor obstruct each other. If so, confidence intervals
    of rates are computed over objects, otherwise over episodes."""

    def make_scene(self, *, grid: PixelGrid, seed: int, base: Path) -> Scene:
        """Makes the scene of a seed. The same seed always gives the same scene.

        Args:
            grid: pixel grid of the workspace. Random poses lie inside it and on the table.
            seed: the seed of all draws.
            base: base folder of relative paths.

        Raises:
            UserError: the scene cannot be made.
        """
        raise NotImplementedError

    @property
    def title(self) -> str:
        """The task's name in results. With default parameters it is the task's name in the
        literature."""
        raise NotImplementedError

    @property
    def learning(self) -> Learning:
        """Assumptions about the task that training may make."""
        return Learning()

    def input_files(self, base: Path) -> list[Path]:
        """The files on which the scenes depend, except for files of the project.

        Raises:
            UserError: a file is missing.
        """
        return []

    def modules(self) -> list[str]:
        """The user's modules that define the task."""
        return []

    def validate(self) -> None:
        """Checks the constraints that types and ranges cannot express.

        Raises:
            ValueError: a field violates a constraint. The message begins with the field's path,
                such as `task.kit`.
        """

    def find_cause(
        self,
        scene: Scene,
        index: int,
        X_WB: Sequence[RigidTransform],
        placement: Placement,
        records: Sequence[ActionRecord],
    ) -> str:
        """The reason why an object does not fill its goal, one of `causes`.

        Args:
            scene: the scene of the episode.
            index: index of the object among the scene's objects.
            X_WB: final poses of all objects in the world.
            placement: the placement of the object.
            records: the episode's actions.
        """
        last = last_action_on(scene.objects[index].name, records)
        if isinstance(last, str):
            return last
        return SLIPPED if last.outcome == "dropped" else MISPLACED


def last_action_on(name: str, records: Sequence[ActionRecord]) -> ActionRecord | str:
    """Returns the last action in which the hand held the object `name`. If there is none, returns
    the cause of the failure."""
    attempted = [
        item for item in records if item.outcome not in ("unfinished", "pressed", "unreachable")
    ]
    own = [item for item in attempted if item.object == name]
    held = [item for item in own if item.outcome != "missed" and not _stopped_empty(item)]
    if held:
        return held[-1]
    return MISSED_GRASP if own else NEVER_PICKED


def _stopped_empty(record: ActionRecord) -> bool:
    """Whether the force guard stopped the hand before it grasped an object."""
    peak = record.peak_force_n
    return record.outcome == "stopped" and peak is not None and peak.mode in _EMPTY_MODES
