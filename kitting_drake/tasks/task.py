"""The interface of a task: a dataclass of parameters that makes a Scene from a seed.

A task is a variant of the scenario's `task:` union. Code outside `kitting_drake/tasks/` depends
only on this interface.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform

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

TABLE = ((0.0, -0.75), (1.0, 0.75))
"""Lower and upper (x, y) corner of the table in the world, in metres; its top is at z = 0."""


@dataclass(frozen=True)
class SceneObject:
    """An object that can be picked."""

    name: str
    """Unique in the scene."""
    category: str
    """Results are grouped by it."""
    model: Path
    """SDFormat file of one free link; its frame is the object's frame B."""
    X_WB: RigidTransform
    """Initial pose."""
    p_BPoints: NDArray[np.float64] = field(repr=False)
    """(m, 3) surface points, sampled by area, in B, in metres."""
    grasps: tuple[Grasp, ...] = ()
    """In B, best first; may be empty if the object can fill no goal."""
    symmetry: int = 1
    """Order of the rotational symmetry about B's z; 1 for none."""
    axis: tuple[float, float] | None = None
    """(x, y) of the axis of symmetry in B, in metres; None: the middle of the bounding box."""


@dataclass(frozen=True)
class Fixture:
    """A body on the table that never moves."""

    name: str
    model: Path
    """SDFormat file of one link."""
    X_WF: RigidTransform
    """Pose of the link's frame."""
    p_FPoints: NDArray[np.float64] | None = field(default=None, repr=False)
    """(m, 3) points of its surface in its frame, in metres, that the expert's hand keeps clear of;
    None: it is never in the way."""


@dataclass(frozen=True)
class Arrivals:
    """Objects that appear one at a time during an episode. Until then they are outside the cell.

    The next one appears while the hand retreats or observes and no object's origin is over `area`.
    """

    objects: tuple[int, ...]
    """Indices of the scene's objects, in the order of appearance."""
    poses: tuple[RigidTransform, ...]
    """X_WB at which each object appears, at rest in the air."""
    area: tuple[tuple[float, float], tuple[float, float]]
    """Lower and upper (x, y) corner in the world, in metres."""

    def __post_init__(self) -> None:
        assert len(self.objects) == len(self.poses)


def waiting_pose(index: int) -> RigidTransform:
    """X_WB of an object that has not appeared: outside the cell, and out of the cameras' sight."""
    return RigidTransform([-20.0 - index, 0.0, -20.0])


@dataclass(frozen=True)
class Scene:
    """The initial state of an episode, and its goals."""

    objects: tuple[SceneObject, ...]
    fixtures: tuple[Fixture, ...]
    goals: tuple[Goal, ...]
    """In the expert's order; the rewards add up to 1."""
    success: SuccessPredicate
    max_actions: int
    """The episode ends after this many actions."""
    arrivals: Arrivals | None = None
    """Objects that appear later; None: all are present initially."""
    measures: Mapping[str, SuccessPredicate] = field(default_factory=dict)
    """Other measures of success by name. Results report them beside `success`, and `strict`; they
    change neither the reward nor the expert."""
    laying_area: tuple[tuple[float, float], tuple[float, float]] | None = None
    """Lower and upper (x, y) corner of the part of the table on which the expert may lay objects
    that are in the way, in metres; None: objects lie apart, and it never does."""

    def __post_init__(self) -> None:
        names = [item.name for item in self.objects] + [item.name for item in self.fixtures]
        assert len(set(names)) == len(names), f"names must be unique: {names}"
        assert abs(sum(goal.reward for goal in self.goals) - 1) < 1e-9

    @property
    def goal_objects(self) -> tuple[int, ...]:
        """Indices of the objects that can fill a goal. Results list these objects."""
        return tuple(sorted({index for goal in self.goals for index in goal.objects}))


@dataclass(frozen=True)
class PeakForce:
    """The largest contact force on the hand during an action, without the weight of the held
    object, as means over 1/64 s. See `systems.contact_guard.ContactGuard`."""

    vertical: float
    """In N."""
    lateral: float
    """In N."""
    mode: str
    """The mode of the planner in which the larger of the two rose."""


@dataclass
class ActionRecord:
    """A pick and place and its errors with respect to the expert's. Keys of `results.json`."""

    object: str
    """The lifted object; if none was lifted, the one nearest to the pick."""
    category: str
    """The object's category."""
    outcome: str
    """`placed`, `missed` (nothing grasped), `dropped` (lost on the way), `pressed` (pushed down),
    `stopped` (by a contact force beyond `planner.force_limit`), `set down` (where it was picked,
    because it would have turned between the pads), `unreachable` (the robot did not move) or
    `unfinished`."""
    pick: PlanarPose
    place: PlanarPose
    pick_position_error_mm: float | None
    """Distance from the nearest of the object's annotated grasps; None if it has none."""
    pick_angle_error_deg: float | None
    """Angle from that grasp, modulo half rotations: 0 to 90."""
    place_position_error_mm: float | None
    """Distance of the object's middle from its goal after a rigid motion by the action; None if the
    object can fill no goal."""
    place_angle_error_deg: float | None
    """Heading error after that motion, modulo the object's symmetry: 0 to 180."""
    peak_force_n: PeakForce | None = None
    """None before the first contact force is known."""


class TaskConfig:
    """The interface of a task. Each variant of the scenario's `task:` derives from it.

    A variant is a dataclass of YAML fields with defaults (see `systems.bounds.bounded`).
    """

    causes: tuple[str, ...] = (MISSED_GRASP, SLIPPED, MISPLACED, NEVER_PICKED)
    """The possible results of `find_cause`, in the order of tables."""
    not_perturbed: tuple[str, ...] = ()
    """Names of `--perturb` that do not apply, because they would change the task."""
    objects_are_independent: bool = False
    """Whether placed objects neither support nor obstruct each other. Intervals of rates are then
    over objects, else over episodes."""

    def make_scene(self, *, grid: PixelGrid, seed: int, base: Path) -> Scene:
        """Makes the scene of a seed, deterministically.

        Args:
            grid: the workspace. Drawn poses are in it, and on the table.
            seed: the seed of all draws.
            base: base folder of relative paths.

        Raises:
            UserError: the scene cannot be made.
        """
        raise NotImplementedError

    @property
    def title(self) -> str:
        """The task's name in results. With default parameters it is the name in the literature."""
        raise NotImplementedError

    @property
    def learning(self) -> Learning:
        """Properties of the task that learning may assume."""
        return Learning()

    def input_files(self, base: Path) -> list[Path]:
        """The files on which the scenes depend, except for the project's own.

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
            ValueError: a field violates one. The message begins with its path, `task.x`.
        """

    def find_cause(
        self,
        scene: Scene,
        index: int,
        X_WB: Sequence[RigidTransform],
        placement: Placement,
        records: Sequence[ActionRecord],
    ) -> str:
        """Why an object is not a success: one of `causes`.

        Args:
            scene: the scene of the episode.
            index: the index of the object.
            X_WB: final poses of all objects.
            placement: the placement of the object.
            records: the episode's actions.
        """
        last = last_action_on(scene.objects[index].name, records)
        if isinstance(last, str):
            return last
        return SLIPPED if last.outcome == "dropped" else MISPLACED


def last_action_on(name: str, records: Sequence[ActionRecord]) -> ActionRecord | str:
    """The last action that held an object; if there is none, the cause."""
    grasped = [item for item in records if item.outcome not in ("unfinished", "pressed")]
    own = [item for item in grasped if item.object == name]
    held = [item for item in own if item.outcome != "missed" and not _stopped_empty(item)]
    if held:
        return held[-1]
    return MISSED_GRASP if own else NEVER_PICKED


def _stopped_empty(record: ActionRecord) -> bool:
    """Whether the force guard stopped the hand before it grasped."""
    peak = record.peak_force_n
    return record.outcome == "stopped" and peak is not None and peak.mode in _EMPTY_MODES
