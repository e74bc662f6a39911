"""palletizing-boxes: stack boxes that appear one at a time on a pallet."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform, RollPitchYaw

from kitting_drake.common.errors import UserError
from kitting_drake.common.paths import MODELS
from kitting_drake.tasks.boxes import box_object, grasp_along, random_brown
from kitting_drake.tasks.ravens.ravens_task import RavensTask, grasp_rng
from kitting_drake.tasks.task import (
    NEVER_APPEARED,
    ActionRecord,
    Arrivals,
    Fixture,
    Scene,
    waiting_pose,
)
from systems.bounds import bounded
from systems.placement import GONE, Goal, Placement
from systems.signals import PixelGrid
from systems.success import InZone

_BOX = (0.085, 0.04, 0.04)
_X_WPALLET = RigidTransform([0.5, 0.25, 0.0])
_PALLET_HEIGHT = 0.04
_P_WSOURCE = (0.5, -0.25)
"""(x, y) in the world at which the boxes appear, in metres."""
_DROP = 0.08
"""All boxes but the first appear in the air. This is the height of their bottom, in metres."""
_SOURCE_AREA = ((-5.0, -0.5), (5.0, 0.0))
"""The next box appears when no box is in this area, given by its lower and upper (x, y) corners, in
metres."""
_GRASP_OFFSET = 0.025
"""The demonstrator grasps a box at most this far from its middle along its longer side, in
metres."""
_ZONE = (0.30, 0.25, 0.30)
"""Size of the zone in which boxes count, in metres. It includes the pallet."""

_END_GAP = 0.01
"""Gap between the ends of two boxes in a line, in metres."""
_TARGET_PITCH = 0.076
"""Distance between the middles of the three lines of boxes on the pallet, in metres. It leaves room
for a finger of 26.3 mm between two lines."""

_POINT_SPACING = 0.02
"""Spacing of the points that are used to measure the share of a box inside the zone, in metres."""


@dataclass
class PalletizingBoxes(RavensTask):
    """Boxes that appear one at a time are stacked on a pallet.

    The demonstrator fills one layer after the other, and the places of a layer in random order.
    """

    causes = (NEVER_APPEARED, *RavensTask.causes)

    # Number of layers of six boxes.
    layers: int = bounded(3, 1, 4)

    def make_scene(self, *, grid: PixelGrid, seed: int, base: Path) -> Scene:
        rng, grasps = np.random.default_rng(seed), grasp_rng(seed)
        count = 6 * self.layers
        X_WArrivals = [
            RigidTransform(RollPitchYaw(0, 0, yaw), [*_P_WSOURCE, 0.0 if first else _DROP])
            for first, yaw in zip(
                [True] + [False] * (count - 1), rng.uniform(-math.pi, math.pi, count), strict=True
            )
        ]
        boxes = tuple(
            box_object(
                f"box_{number}",
                "box",
                _BOX,
                random_brown(rng),
                X_WArrival if number == 1 else waiting_pose(number),
                grasps=(grasp_along(_BOX, "x", float(offset)),),
            )
            for number, (X_WArrival, offset) in enumerate(
                zip(X_WArrivals, grasps.uniform(-_GRASP_OFFSET, _GRASP_OFFSET, count), strict=True),
                start=1,
            )
        )
        X_WDeck = _X_WPALLET @ RigidTransform([0, 0, _PALLET_HEIGHT])
        # Rotate each layer by 90 degrees relative to the one below, so that the columns hold
        # together.
        X_WGoals = [
            X_WDeck @ layer[place]
            for level in range(self.layers)
            for layer in [layer_poses(level, _TARGET_PITCH, across=level % 2 == 1)]
            for place in rng.permutation(len(layer))
        ]
        _check_workspace(grid, boxes[0].p_BPoints, X_WArrivals + X_WGoals)
        return Scene(
            objects=boxes,
            fixtures=(Fixture("pallet", MODELS / "ravens" / "pallet.sdf", _X_WPALLET),),
            # The boxes may be placed in any order, as in Ravens.
            goals=tuple(
                Goal(
                    name=f"place {number} on the pallet",
                    objects=tuple(range(count)),
                    poses=(X_WGoal,),
                    reward=1 / count,
                )
                for number, X_WGoal in enumerate(X_WGoals, start=1)
            ),
            success=InZone(_X_WPALLET, _ZONE, volume_points(_BOX)),
            max_actions=5 * count // 3,
            arrivals=Arrivals(tuple(range(1, count)), tuple(X_WArrivals[1:]), _SOURCE_AREA),
        )

    def find_cause(
        self,
        scene: Scene,
        index: int,
        X_WB: Sequence[RigidTransform],
        placement: Placement,
        records: Sequence[ActionRecord],
    ) -> str:
        # An object far from the cell may also have fallen off the table after it appeared. So check
        # that it is near its waiting pose.
        waits = X_WB[index].IsNearlyEqualTo(scene.objects[index].X_WB, 1.0)
        if waits and np.linalg.norm(X_WB[index].translation()) > GONE:
            return NEVER_APPEARED
        return super().find_cause(scene, index, X_WB, placement, records)


def layer_poses(level: int, pitch: float, *, across: bool = False) -> list[RigidTransform]:
    """The poses of six boxes in a layer, two per line, in the frame of the stack.

    Args:
        level: 0 for the lowest layer.
        pitch: the distance between lines, in metres.
        across: whether the lines are along y instead of x.
    """
    X_StackLayer = RigidTransform(
        RollPitchYaw(0, 0, math.pi / 2 if across else 0), [0, 0, level * _BOX[2]]
    )
    end = (_BOX[0] + _END_GAP) / 2
    return [
        X_StackLayer @ RigidTransform([x, y, 0]) for y in (-pitch, 0, pitch) for x in (-end, end)
    ]


def volume_points(size: tuple[float, float, float]) -> NDArray[np.float64]:
    """(m, 3) grid points that fill a box, in its frame, in metres."""

    def along(length: float) -> NDArray[np.float64]:
        count = math.ceil(length / _POINT_SPACING - 1e-9)
        return (np.arange(count, dtype=float) - (count - 1) / 2) * _POINT_SPACING

    x, y, z = np.meshgrid(*(along(length) for length in size), indexing="ij")
    return np.column_stack([x.ravel(), y.ravel(), z.ravel() + size[2] / 2])


def _check_workspace(
    grid: PixelGrid, p_BPoints: NDArray[np.float64], poses: list[RigidTransform]
) -> None:
    for X_WB in poses:
        if not grid.contains(X_WB.multiply(p_BPoints.T)[:2].T).all():
            raise UserError(
                "heightmap: the workspace must contain the boxes that appear around (0.5, -0.25) m "
                "and the pallet around (0.5, 0.25) m"
            )
