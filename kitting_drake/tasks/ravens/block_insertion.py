"""block-insertion: put an L-shaped block into a fixture with walls around it."""

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from kitting_drake.common.paths import MODELS
from kitting_drake.tasks.boxes import box_points
from kitting_drake.tasks.footprints import Footprint, draw_poses, rectangle
from kitting_drake.tasks.ravens.ravens_task import PoseTask, grasp_rng
from kitting_drake.tasks.task import Fixture, Scene, SceneObject
from systems.grasp import Grasp
from systems.placement import Goal
from systems.signals import PixelGrid

_ARMS = (((0.08, 0.03, 0.04), (0.025, 0.0)), ((0.03, 0.05, 0.04), (0.0, 0.04)))
"""Size and middle of the block's two boxes, in metres, as in `models/ravens/l_block.sdf`."""
_HEIGHT = 0.04
_WALL_HEIGHT = 0.02
_ALONG_ARM = (0.035, 0.055)
"""Range of the distance from the block's corner to the demonstrator's grasp, in metres."""


def _grasp(along_x: bool, distance: float) -> Grasp:
    if along_x:
        return Grasp(x=distance, y=0.0, theta=0.0, width=0.03, surface_height=_HEIGHT)
    return Grasp(x=0.0, y=distance, theta=math.pi / 2, width=0.03, surface_height=_HEIGHT)


_GRASPS = tuple(_grasp(along_x, distance) for along_x in (True, False) for distance in _ALONG_ARM)

_BLOCK = Footprint(tuple(rectangle(*size[:2], x=x, y=y) for size, (x, y) in _ARMS), _GRASPS)
_FIXTURE = Footprint(
    (rectangle(0.102, 0.052, x=0.025), rectangle(0.052, 0.052, y=0.05)),
    _GRASPS,
)


@dataclass
class BlockInsertion(PoseTask):
    """An L-shaped block is put into a fixture. The demonstrator grips either of its arms."""

    def make_scene(self, *, grid: PixelGrid, seed: int, base: Path) -> Scene:
        X_WFixture, X_WBlock = draw_poses(
            [_FIXTURE, _BLOCK], grid=grid, rng=np.random.default_rng(seed)
        )
        rng = grasp_rng(seed)
        grasp = _grasp(rng.random() < 0.5, float(rng.uniform(*_ALONG_ARM)))
        block = SceneObject(
            name="block",
            category="block",
            model=MODELS / "ravens" / "l_block.sdf",
            X_WB=X_WBlock,
            p_BPoints=_surface_points(),
            grasps=(grasp,),
        )
        goal = Goal(
            name="block in fixture",
            objects=(0,),
            poses=(X_WFixture,),
            reward=1.0,
            rim_height=_WALL_HEIGHT,
        )
        return Scene(
            objects=(block,),
            fixtures=(Fixture("fixture", MODELS / "ravens" / "l_fixture.sdf", X_WFixture),),
            goals=(goal,),
            success=self.success,
            max_actions=3,
        )


def _surface_points() -> np.ndarray:
    """(m, 3) points of the block's surface, in its frame, in metres."""
    (long_size, long_middle), (short_size, short_middle) = _ARMS
    long_points = box_points(long_size) + (*long_middle, 0.0)
    short_points = box_points(short_size) + (*short_middle, 0.0)
    # Leave out the points at which the two boxes meet, because they are inside the block.
    seam = long_size[1] / 2
    on_seam = np.isclose(long_points[:, 1], seam) & (np.abs(long_points[:, 0]) < short_size[0] / 2)
    return np.concatenate(
        [long_points[~on_seam], short_points[~np.isclose(short_points[:, 1], seam)]]
    )
