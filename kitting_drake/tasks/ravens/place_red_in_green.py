"""place-red-in-green: put red cubes into green bowls, among objects of other colours."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from pydrake.math import RigidTransform

from kitting_drake.policies.data.learning import Learning
from kitting_drake.tasks.boxes import (
    COLOURS,
    CUBE_FOOTPRINT,
    CUBE_GRASP_OFFSET,
    CUBE_SIDE,
    coloured,
    cube_object,
    random_grasp,
)
from kitting_drake.tasks.footprints import Footprint, disc, draw_poses
from kitting_drake.tasks.ravens.ravens_task import RavensTask, grasp_rng
from kitting_drake.tasks.task import Fixture, Scene, SceneObject
from systems.bounds import bounded
from systems.placement import Goal
from systems.signals import PixelGrid
from systems.success import PoseWithin

_BOWL = Footprint((disc(0.06),))
_DISTRACTOR_CUBE = Footprint(CUBE_FOOTPRINT.body)
_BOWL_FLOOR = 0.004
"""Height of a bowl's floor above the table, in metres."""


@dataclass
class PlaceRedInGreen(RavensTask):
    """Red cubes are put into green bowls.

    The demonstrator grasps a cube on one of its centre lines. It rotates the cube to the heading of
    the bowl, although this heading is not visible.
    """

    # The colours define the goals, and the task has its own distractors.
    not_perturbed = ("colour", "distractors")

    # Largest number of green bowls. There are at most as many red cubes as green bowls.
    bowls: int = bounded(3, 1, 6)

    # Number of cubes and bowls of other colours.
    distractors: int = bounded(10, 0, 12)

    # A cube is in a bowl if its horizontal distance from the bowl's middle is at most this, in m.
    position_threshold: float = bounded(0.05, 0.001, 0.06)

    @property
    def learning(self) -> Learning:
        return Learning(later_picks_possible=True, many_answers=True)

    def make_scene(self, *, grid: PixelGrid, seed: int, base: Path) -> Scene:
        rng = np.random.default_rng([seed, 1])
        bowl_count = int(rng.integers(1, self.bowls + 1))
        cube_count = int(rng.integers(1, bowl_count + 1))
        # Cubes and bowls are equally likely, and each kind cycles through its colours.
        are_cubes = rng.random(self.distractors) < 0.5
        bowl_colours = ["green"] * bowl_count + _others("green", int((~are_cubes).sum()), rng)
        cube_colours = ["red"] * cube_count + _others("red", int(are_cubes.sum()), rng)

        footprints = [_BOWL] * len(bowl_colours) + [CUBE_FOOTPRINT] * cube_count
        footprints += [_DISTRACTOR_CUBE] * (len(cube_colours) - cube_count)
        poses = draw_poses(footprints, grid=grid, rng=np.random.default_rng(seed))
        X_WBowls, X_WCubes = poses[: len(bowl_colours)], poses[len(bowl_colours) :]

        in_bowls = tuple(
            X_WBowl @ RigidTransform([0, 0, _BOWL_FLOOR]) for X_WBowl in X_WBowls[:bowl_count]
        )
        return Scene(
            objects=_cubes(cube_colours, X_WCubes, grasp_rng(seed)),
            fixtures=tuple(
                Fixture(f"bowl_{number}_{name}", coloured("bowl.sdf", COLOURS[name]), X_WBowl)
                for number, (name, X_WBowl) in enumerate(
                    zip(bowl_colours, X_WBowls, strict=True), start=1
                )
            ),
            goals=tuple(
                Goal(
                    name=f"red cube {number} in a green bowl",
                    objects=tuple(range(cube_count)),
                    poses=in_bowls,
                    reward=1 / cube_count,
                    any_heading=True,
                )
                for number in range(1, cube_count + 1)
            ),
            success=PoseWithin(self.position_threshold),
            max_actions=10,
        )


def _cubes(
    colours: list[str], X_WCubes: list[RigidTransform], rng: np.random.Generator
) -> tuple[SceneObject, ...]:
    return tuple(
        cube_object(
            f"cube_{number}_{name}",
            COLOURS[name],
            X_WCube,
            (random_grasp((CUBE_SIDE,) * 3, CUBE_GRASP_OFFSET, rng),),
        )
        for number, (name, X_WCube) in enumerate(zip(colours, X_WCubes, strict=True), start=1)
    )


def _others(excluded: str, count: int, rng: np.random.Generator) -> list[str]:
    """Names of colours except `excluded`, in random order. They repeat once all have been used."""
    names = [name for name in COLOURS if name != excluded]
    rng.shuffle(names)
    return [names[index % len(names)] for index in range(count)]
