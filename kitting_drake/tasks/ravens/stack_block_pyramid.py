"""stack-block-pyramid: stack six cubes of six colours on a base, row by row."""

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from pydrake.math import RigidTransform

from kitting_drake.common.paths import MODELS
from kitting_drake.tasks.boxes import (
    COLOURS,
    CUBE_FOOTPRINT,
    CUBE_GRASP_OFFSET,
    CUBE_SIDE,
    cube_object,
    grasp_along,
)
from kitting_drake.tasks.footprints import Footprint, draw_poses, rectangle
from kitting_drake.tasks.ravens.ravens_task import PoseTask, grasp_rng
from kitting_drake.tasks.task import Fixture, Scene
from systems.grasp import Grasp
from systems.placement import Goal
from systems.signals import PixelGrid

_ROWS = (("purple", "blue", "green"), ("yellow", "orange"), ("red",))
"""The colours of the rows, from the bottom up."""
_PITCH = 0.05
"""Distance between the middles of neighbouring cubes in a row, along y of the base, in metres."""
_BASE_SIZE = (0.05, 0.15, 0.005)

_BASE = Footprint(
    (rectangle(*_BASE_SIZE[:2]),),
    tuple(
        Grasp(0.0, y + offset, math.pi / 2, CUBE_SIDE, CUBE_SIDE)
        for y in (-_PITCH, 0.0, _PITCH)
        for offset in (-CUBE_GRASP_OFFSET, CUBE_GRASP_OFFSET)
    ),
    tall=True,
)


@dataclass
class StackBlockPyramid(PoseTask):
    """Six cubes are stacked into a pyramid.

    The demonstrator grasps a cube on its centre line along y and gives it the heading of the base.
    The jaws then open across the row.
    """

    # The colour of a cube determines its place.
    not_perturbed = ("colour",)

    def make_scene(self, *, grid: PixelGrid, seed: int, base: Path) -> Scene:
        names = [name for row in _ROWS for name in row]
        X_WBase, *X_WCubes = draw_poses(
            [_BASE] + [CUBE_FOOTPRINT] * len(names), grid=grid, rng=np.random.default_rng(seed)
        )
        offsets = grasp_rng(seed).uniform(-CUBE_GRASP_OFFSET, CUBE_GRASP_OFFSET, len(names))
        return Scene(
            objects=tuple(
                cube_object(
                    f"{name}_cube",
                    COLOURS[name],
                    X_WCube,
                    (grasp_along((CUBE_SIDE,) * 3, "y", float(offset)),),
                )
                for name, X_WCube, offset in zip(names, X_WCubes, offsets, strict=True)
            ),
            fixtures=(Fixture("base", MODELS / "ravens" / "pyramid_base.sdf", X_WBase),),
            goals=_goals(X_WBase),
            success=self.success,
            max_actions=12,
        )


def _goals(X_WBase: RigidTransform) -> tuple[Goal, ...]:
    """A goal for each place of the pyramid, row by row.

    Any cube of a row may fill any place of this row. A row counts once the row below is complete.
    """
    goals: list[Goal] = []
    below: tuple[int, ...] = ()
    first = 0
    for level, row in enumerate(_ROWS):
        cubes = tuple(range(first, first + len(row)))
        for place in range(len(row)):
            y = (place - (len(row) - 1) / 2) * _PITCH
            z = _BASE_SIZE[2] + level * CUBE_SIDE
            goals.append(
                Goal(
                    name=f"row {level + 1}, place {place + 1}",
                    objects=cubes,
                    poses=(X_WBase @ RigidTransform([0, y, z]),),
                    reward=1 / 6,
                    after=below,
                )
            )
        below, first = cubes, first + len(row)
    return tuple(goals)
