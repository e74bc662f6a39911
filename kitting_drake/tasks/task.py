"""The contract of a task: the Scene that it makes from a seed, and what it says about itself.

A task is a config dataclass, a variant of the scenario's `task:` union. Nothing outside
`kitting_drake/tasks/` knows more of it than what is here.
"""

from __future__ import annotations

from collections.abc import Sequence
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

TABLE = ((0.0, -0.75), (1.0, 0.75))
"""Lower and upper (x, y) corner of the table in the world, in metres; its top is z = 0."""


@dataclass(frozen=True)
class SceneObject:
    """Something that can be picked."""

    name: str
    """Unique in the scene."""
    category: str
    """By which results are grouped."""
    model: Path
    """SDFormat of one free link; its frame is the object's frame B."""
    X_WB: RigidTransform
    """Its initial pose."""
    p_BPoints: NDArray[np.float64] = field(repr=False)
    """(m, 3) points of its surface, sampled by area, in B, in metres."""
    grasps: tuple[Grasp, ...] = ()
    """In B, best first; none is needed for what no goal takes."""
    symmetry: int = 1
    """Rotations about B's z by 2 pi / symmetry that a person could not tell; 1: there are none."""


@dataclass(frozen=True)
class Fixture:
    """Something that stands on the table and never moves."""

    name: str
    model: Path
    """SDFormat of one link."""
    X_WF: RigidTransform
    """Pose of its link's frame."""


@dataclass(frozen=True)
class Arrivals:
    """Objects that appear one at a time during an episode; until then they are out of the cell.

    The next one appears while the hand retreats or observes, as soon as no object's origin lies
    over `area`.
    """

    objects: tuple[int, ...]
    """Indices into the scene's objects, in the order in which they appear."""
    poses: tuple[RigidTransform, ...]
    """X_WB of each as it appears, at rest in the air."""
    area: tuple[tuple[float, float], tuple[float, float]]
    """Lower and upper (x, y) corner in the world, in metres."""

    def __post_init__(self) -> None:
        assert len(self.objects) == len(self.poses)


def waiting_pose(index: int) -> RigidTransform:
    """X_WB of an object that has yet to appear: out of the cell, and of the cameras' sight."""
    return RigidTransform([-20.0 - index, 0.0, -20.0])


@dataclass(frozen=True)
class Scene:
    """The beginning of one episode, and what is to be brought about."""

    objects: tuple[SceneObject, ...]
    fixtures: tuple[Fixture, ...]
    goals: tuple[Goal, ...]
    """In the order in which an expert fills them; their rewards add up to 1."""
    success: SuccessPredicate
    max_actions: int
    """After so many actions the episode is over."""
    arrivals: Arrivals | None = None
    """Objects that are not there at the beginning; None: all are."""

    def __post_init__(self) -> None:
        names = [item.name for item in self.objects] + [item.name for item in self.fixtures]
        assert len(set(names)) == len(names), f"names must be unique: {names}"
        assert abs(sum(goal.reward for goal in self.goals) - 1) < 1e-9

    @property
    def goal_objects(self) -> tuple[int, ...]:
        """The indices of the objects that some goal takes: those that results speak of."""
        return tuple(sorted({index for goal in self.goals for index in goal.objects}))


@dataclass
class ActionRecord:
    """One pick and place, against what the expert would have done. Keys of `results.json`."""

    object: str
    """The object that was lifted; if none was, the one nearest to the pick."""
    category: str
    """The category of the object."""
    outcome: str
    """`placed`, `missed` (nothing was grasped), `dropped` (on the way), `pressed` (down, where it
    is), or `unfinished`."""
    pick: PlanarPose
    place: PlanarPose
    pick_position_error_mm: float | None
    """From the nearest of the object's annotated grasps; None if it has none."""
    pick_angle_error_deg: float | None
    """From that grasp, half rotations being the same: 0 to 90."""
    place_position_error_mm: float | None
    """How far from its goal the action would bring the middle of the object as it lay before the
    pick; None if no goal takes it."""
    place_angle_error_deg: float | None
    """By how much its heading would be off, modulo its symmetry: 0 to 180."""


class TaskConfig:
    """The interface of a task; each variant of the scenario's `task:` derives from it.

    A variant is a dataclass of YAML fields with defaults (see `systems.bounds.bounded`).
    """

    causes: tuple[str, ...] = (MISSED_GRASP, SLIPPED, MISPLACED, NEVER_PICKED)
    """The answers of `find_cause`, in the order of tables."""
    not_perturbed: tuple[str, ...] = ()
    """Names of `--perturb` that would change what the task asks for, and do not apply to it."""
    objects_are_independent: bool = False
    """Whether no object of a scene stands on another, or in its way, once it is placed: intervals
    of rates are then over objects, else over episodes."""

    def make_scene(self, *, grid: PixelGrid, seed: int, base: Path) -> Scene:
        """The scene of a seed; the same seed gives the same scene.

        Args:
            grid: the workspace. What is drawn lies within it, and on the table.
            seed: of all draws.
            base: where relative paths start.

        Raises:
            UserError: the scene cannot be made.
        """
        raise NotImplementedError

    @property
    def title(self) -> str:
        """The task's name for results: that of the literature only where nothing was changed."""
        raise NotImplementedError

    @property
    def learning(self) -> Learning:
        """The assumptions that a learner of the task may make."""
        return Learning()

    def input_files(self, base: Path) -> list[Path]:
        """The files, beside those of the project, that the scenes depend on.

        Raises:
            UserError: they cannot be found.
        """
        return []

    def modules(self) -> list[str]:
        """Modules of a person's own that it is made of."""
        return []

    def validate(self) -> None:
        """Checks what neither types nor ranges say.

        Raises:
            ValueError: one sentence that begins with the path of a field, `task.x`.
        """

    def find_cause(
        self,
        scene: Scene,
        index: int,
        X_WB: Sequence[RigidTransform],
        placement: Placement,
        records: Sequence[ActionRecord],
    ) -> str:
        """Why an object that did not end in success did not: one of `causes`.

        Args:
            scene: the episode's.
            index: of the object.
            X_WB: where all objects ended.
            placement: of the object.
            records: the episode's actions.
        """
        last = last_action_on(scene.objects[index].name, records)
        if isinstance(last, str):
            return last
        return SLIPPED if last.outcome == "dropped" else MISPLACED


def last_action_on(name: str, records: Sequence[ActionRecord]) -> ActionRecord | str:
    """The last action that held an object, or the cause why no action did."""
    grasped = [item for item in records if item.outcome not in ("unfinished", "pressed")]
    own = [item for item in grasped if item.object == name]
    held = [item for item in own if item.outcome != "missed"]
    if held:
        return held[-1]
    return MISSED_GRASP if own else NEVER_PICKED
