"""palletizing-boxes: boxes are moved from one stack to another, on a pallet."""

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform, RollPitchYaw

from kitting_drake.common.errors import UserError
from kitting_drake.common.paths import MODELS
from kitting_drake.tasks.boxes import box_object, random_brown
from kitting_drake.tasks.ravens.ravens_task import RavensTask
from kitting_drake.tasks.task import Fixture, Scene
from systems.bounds import bounded
from systems.placement import Goal, InZone
from systems.signals import PixelGrid

_BOX = (0.085, 0.04, 0.04)
_X_WPALLET = RigidTransform([0.5, 0.25, 0.0])
_PALLET_HEIGHT = 0.04
_P_WSTACK = (0.5, -0.25)
"""Where the boxes are stacked to begin with."""
_ZONE = (0.30, 0.25, 0.30)
"""The room on the pallet, and the pallet's own, that counts."""

_END_GAP = 0.01
"""Between the ends of two boxes in a line."""
_TARGET_PITCH = 0.076
"""From box to box across the jaws, on the pallet: a box, 6 mm of release and a finger, 26.3 mm
deep, leave 3.7 mm to the next box."""
_SOURCE_PITCH = 0.096
"""The same where the boxes are taken from: half a box, half the open jaws and a finger leave
9.7 mm, of which disarray may take 7."""
_DISARRAY = 0.002
_DISARRAY_ANGLE = math.radians(2.0)
"""The boxes to be moved are off their places in the stack by at most so much."""

_POINT_SPACING = 0.02
"""The spacing of the points by which the reward measures the share of a box in the zone, in m."""


@dataclass
class PalletizingBoxes(RavensTask):
    """Boxes are moved from one stack to another, on a pallet."""

    # Layers of six boxes.
    layers: int = bounded(3, 1, 4)

    def make_scene(self, *, grid: PixelGrid, seed: int, base: Path) -> Scene:
        rng = np.random.default_rng(seed)
        count = 6 * self.layers
        yaw = float(rng.uniform(-math.pi, math.pi))
        X_WStack = RigidTransform(RollPitchYaw(0, 0, yaw), [*_P_WSTACK, 0])
        X_WBoxes = [
            X_WStack @ X_StackBox @ _disarray(rng)
            for level in range(self.layers)
            for X_StackBox in layer_poses(level, _SOURCE_PITCH)
        ]
        boxes = tuple(
            box_object(f"box_{number}", "box", _BOX, random_brown(rng), X_WBox)
            for number, X_WBox in enumerate(X_WBoxes, start=1)
        )
        X_WDeck = _X_WPALLET @ RigidTransform([0, 0, _PALLET_HEIGHT])
        # Every layer is across the one below, which ties the columns together.
        X_WGoals = [
            X_WDeck @ X_DeckBox
            for level in range(self.layers)
            for X_DeckBox in layer_poses(level, _TARGET_PITCH, across=level % 2 == 1)
        ]
        _check_workspace(grid, boxes[0].p_BPoints, X_WBoxes + X_WGoals)
        return Scene(
            objects=boxes,
            fixtures=(Fixture("pallet", MODELS / "ravens" / "pallet.sdf", _X_WPALLET),),
            # In this order the lower boxes come first; any order counts, as in Ravens.
            goals=tuple(
                Goal(
                    name=f"place {number} on the pallet",
                    objects=tuple(range(count)),
                    poses=(X_WGoal, X_WGoal @ _half_turn()),
                    reward=1 / count,
                )
                for number, X_WGoal in enumerate(X_WGoals, start=1)
            ),
            success=InZone(_X_WPALLET, _ZONE, volume_points(_BOX)),
            max_actions=5 * count // 3,
        )


def layer_poses(level: int, pitch: float, *, across: bool = False) -> list[RigidTransform]:
    """The poses of six boxes in a layer, two in a line, in the frame in which they are stacked.

    Args:
        level: 0 for the lowest layer.
        pitch: from one line to the next, in metres.
        across: whether the lines are along y, not along x.
    """
    X_StackLayer = RigidTransform(
        RollPitchYaw(0, 0, math.pi / 2 if across else 0), [0, 0, level * _BOX[2]]
    )
    end = (_BOX[0] + _END_GAP) / 2
    return [
        X_StackLayer @ RigidTransform([x, y, 0]) for y in (-pitch, 0, pitch) for x in (-end, end)
    ]


def volume_points(size: tuple[float, float, float]) -> NDArray[np.float64]:
    """(m, 3) points of a grid that fill a box, in its frame, in metres."""

    def along(length: float) -> NDArray[np.float64]:
        count = math.ceil(length / _POINT_SPACING - 1e-9)
        return (np.arange(count, dtype=float) - (count - 1) / 2) * _POINT_SPACING

    x, y, z = np.meshgrid(*(along(length) for length in size), indexing="ij")
    return np.column_stack([x.ravel(), y.ravel(), z.ravel() + size[2] / 2])


def _disarray(rng: np.random.Generator) -> RigidTransform:
    x, y = rng.uniform(-_DISARRAY, _DISARRAY, 2)
    yaw = rng.uniform(-_DISARRAY_ANGLE, _DISARRAY_ANGLE)
    return RigidTransform(RollPitchYaw(0, 0, yaw), [x, y, 0])


def _half_turn() -> RigidTransform:
    return RigidTransform(RollPitchYaw(0, 0, math.pi), [0, 0, 0])


def _check_workspace(
    grid: PixelGrid, p_BPoints: NDArray[np.float64], poses: list[RigidTransform]
) -> None:
    for X_WB in poses:
        if not grid.contains(X_WB.multiply(p_BPoints.T)[:2].T).all():
            raise UserError(
                "heightmap: the workspace does not hold the stack of boxes and the pallet, which "
                "are around (0.5, -0.25) and (0.5, 0.25) m"
            )
