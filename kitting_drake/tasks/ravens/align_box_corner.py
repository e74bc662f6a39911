"""align-box-corner: put a corner of a box of random size into an L-shaped marker on the table."""

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from pydrake.math import RigidTransform, RollPitchYaw

from kitting_drake.common.paths import MODELS
from kitting_drake.tasks.boxes import (
    box_footprint,
    box_object,
    outermost_grasps,
    random_brown,
    random_grasp,
)
from kitting_drake.tasks.footprints import Footprint, draw_poses, rectangle
from kitting_drake.tasks.ravens.ravens_task import PoseTask, grasp_rng
from kitting_drake.tasks.task import Fixture, Scene
from systems.bounds import bounded
from systems.grasp import Grasp
from systems.placement import Goal
from systems.signals import PixelGrid

_ARM_LENGTH, _ARM_WIDTH = 0.055, 0.005
"""Length and width of each arm of the marker, in metres."""
_GRASP_OFFSET = 0.01
"""The demonstrator grasps the box at most this far from its middle, in metres."""


@dataclass
class AlignBoxCorner(PoseTask):
    """A box is moved so that one of its four corners fits the corner of a marker."""

    # Range of the lengths of the box's horizontal edges, in m.
    box_sides: list[float] = bounded([0.03, 0.07], 0.01, 0.07)

    # Range of the box's height, in m.
    box_height: list[float] = bounded([0.03, 0.06], 0.015, 0.1)

    def make_scene(self, *, grid: PixelGrid, seed: int, base: Path) -> Scene:
        shape_rng = np.random.default_rng([seed, 1])
        least, greatest = np.transpose([self.box_sides, self.box_sides, self.box_height])
        length, width, height = (float(side) for side in shape_rng.uniform(least, greatest))
        size = (round(length, 4), round(width, 4), round(height, 4))
        colour = random_brown(shape_rng)
        X_WMarker, X_WBox = draw_poses(
            [_marker_footprint(size), box_footprint(size, _GRASP_OFFSET)],
            grid=grid,
            rng=np.random.default_rng(seed),
        )
        poses = tuple(X_WMarker @ X_MarkerBox for X_MarkerBox in corner_poses(size))
        grasps = (random_grasp(size, _GRASP_OFFSET, grasp_rng(seed)),)
        return Scene(
            objects=(box_object("box", "box", size, colour, X_WBox, grasps=grasps),),
            fixtures=(Fixture("marker", MODELS / "ravens" / "corner_marker.sdf", X_WMarker),),
            goals=(Goal(name="corner in marker", objects=(0,), poses=poses, reward=1.0),),
            success=self.success,
            max_actions=3,
        )

    def validate(self) -> None:
        for name in ("box_sides", "box_height"):
            least, greatest = getattr(self, name)
            if least > greatest:
                raise ValueError(
                    f"task.{name} must be [least, greatest], not [{least:g}, {greatest:g}]"
                )


def corner_poses(size: tuple[float, float, float]) -> list[RigidTransform]:
    """The four poses of a box, in the marker's frame, with a corner in the marker."""
    poses = []
    for turns in range(4):
        x, y = (size[0], size[1]) if turns % 2 == 0 else (size[1], size[0])
        poses.append(RigidTransform(RollPitchYaw(0, 0, turns * math.pi / 2), [x / 2, y / 2, 0]))
    return poses


def _marker_footprint(size: tuple[float, float, float]) -> Footprint:
    """A footprint that covers the marker, the box in all its poses at the marker, and the hand that
    places the box."""
    longest = max(size[:2])
    side = max(_ARM_LENGTH - _ARM_WIDTH, longest)
    middle = (side - _ARM_WIDTH) / 2
    grasps = []
    for X_MarkerBox in corner_poses(size):
        x, y, _ = X_MarkerBox.translation()
        yaw = RollPitchYaw(X_MarkerBox.rotation()).yaw_angle()
        grasps += [
            Grasp(
                x + math.cos(yaw) * grasp.x - math.sin(yaw) * grasp.y,
                y + math.sin(yaw) * grasp.x + math.cos(yaw) * grasp.y,
                yaw + grasp.theta,
                grasp.width,
                grasp.surface_height,
            )
            for grasp in outermost_grasps(size, _GRASP_OFFSET)
        ]
    square = rectangle(side + _ARM_WIDTH, side + _ARM_WIDTH, x=middle, y=middle)
    return Footprint((square,), tuple(grasps))
