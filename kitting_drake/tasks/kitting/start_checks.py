"""Checks whether tools that have settled are a valid start of an episode."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform

from kitting_drake.common.paths import MODELS
from kitting_drake.hkd.kits.kit import Kit
from kitting_drake.hkd.tools.tool import Tool
from kitting_drake.tasks.boxes import box_points
from kitting_drake.tasks.kitting.start_groups import projected
from kitting_drake.tasks.task import TABLE
from systems.cluttered_table import in_the_way, tilt
from systems.grasp import Grasp
from systems.hand_geometry import MAX_OPENING
from systems.oracle_policy import gripper_pose
from systems.signals import PixelGrid

FACES = ("as_drawn", "any")
"""The allowed values of a task's `faces`: the faces on which tools may lie."""
TRAY = MODELS / "tray" / "tray.sdf"
"""The SDFormat file of the tray."""
TRAY_SIZE = (0.380, 0.290, 0.020)
"""Outer extents of the tray along x, y and z of its frame, in metres. The origin of the frame is
the middle of the tray's bottom."""

_POINTS = 1500
"""Number of points of a tool's surface that are used to check whether it is in the way of the
hand."""
_UPRIGHT = math.cos(math.radians(60.0))
"""Cosine of the largest tilt at which a tool counts as lying on the same face as in its cavity."""
_ON_KIT = 0.002
"""A point at least this far inside the block's outline, in metres, counts as on the kit."""
_NEAR_GRASP = 0.035
"""Touching tools must be graspable one after another. Each needs an unobstructed grasp within this
distance, in m, of its annotated grasp."""
_LEANS = math.radians(5.0)
"""A tool tilted by more than this, in radians, counts as leaning."""


@dataclass(frozen=True)
class Start:
    """Poses of kit, tools and tray, before or after the tools come to rest."""

    X_WKit: RigidTransform
    X_WTools: tuple[RigidTransform, ...]
    X_WTray: RigidTransform | None
    """Pose of the tray; None if there is no tray."""


def surface_of_box(size: Sequence[float]) -> NDArray[np.float64]:
    """(m, 3) points of the surface of a box, in metres. The origin is the middle of its bottom."""
    length, width, height = size
    return box_points((length, width, height))


class StartCheck:
    """Checks the poses of tools before, during and after they settle.

    The arguments are those of `draw_start`; `drawn` has the poses from which the tools settle.
    """

    def __init__(
        self,
        kit: Kit,
        tools: Sequence[Tool],
        grasps: Sequence[Sequence[Grasp]],
        kind: str,
        faces: str,
        grid: PixelGrid,
        drawn: Start,
    ) -> None:
        self._kind, self._faces, self._drawn = kind, faces, drawn
        self._grasps, self._kit_size = grasps, kit.size
        self._spread = (
            [tool.surface_points(_POINTS) for tool in tools] if kind == "touching" else []
        )
        self._points = [np.unique(tool.triangles.reshape(-1, 3), axis=0) for tool in tools]
        self._kit_half = np.array(kit.size[:2]) / 2 - _ON_KIT
        self._grid = grid
        self._leaning = {
            index
            for index, X in enumerate(drawn.X_WTools)
            if kind == "leaning" and tilt(X) > _LEANS
        }

    def may_settle(self, X_WTools: Sequence[RigidTransform]) -> bool:
        """Whether it is worth simulating how tools settle from random poses. Touching tools hardly
        move, so they must already be graspable. Other kinds are always simulated."""
        return self._kind != "touching" or self._is_graspable(X_WTools)

    def may_go_on(self, X_WTools: Sequence[RigidTransform]) -> bool:
        """Whether all tools' origins are still in the workspace, off the kit and not below the
        table."""
        for X in X_WTools:
            p_W = X.translation()
            on_kit = np.abs((self._drawn.X_WKit.inverse() @ p_W)[:2]) < self._kit_half
            if not self._grid.contains(p_W[:2]) or on_kit.all() or p_W[2] < -0.02:
                return False
        return True

    def is_good(self, X_WTools: Sequence[RigidTransform]) -> bool:
        """Whether the tools at rest are a valid start of the requested kind."""
        (x_low, y_low), (x_high, y_high) = TABLE
        X_KW = self._drawn.X_WKit.inverse()
        for index, (points, X) in enumerate(zip(self._points, X_WTools, strict=True)):
            p_W = X.multiply(points.T)
            inside = self._grid.contains(p_W[:2].T).all()
            inside &= bool((p_W[0] > x_low).all() and (p_W[0] < x_high).all())
            inside &= bool((p_W[1] > y_low).all() and (p_W[1] < y_high).all())
            p_K = X_KW.multiply(p_W)[:2]
            on_kit = (np.abs(p_K) < self._kit_half[:, None]).all(axis=0).any()
            if not inside or (on_kit and index not in self._leaning):
                return False
            if self._faces == FACES[0] and X.rotation().matrix()[2, 2] < _UPRIGHT:
                return False
        return self._is_in_tray(X_WTools) and self._is_of_kind(X_WTools)

    def _is_in_tray(self, X_WTools: Sequence[RigidTransform]) -> bool:
        if self._drawn.X_WTray is None:
            return True
        half = np.array(TRAY_SIZE[:2]) / 2
        X_TW = self._drawn.X_WTray.inverse()
        return all(
            bool((np.abs((X_TW @ X).multiply(points.T)[:2]) < half[:, None]).all())
            for points, X in zip(self._points, X_WTools, strict=True)
        )

    def _is_of_kind(self, X_WTools: Sequence[RigidTransform]) -> bool:
        if self._kind == "leaning":
            return all(tilt(X_WTools[index]) > _LEANS for index in self._leaning)
        if self._kind in ("crossed", "heap"):
            outlines = [
                projected(points, X) for points, X in zip(self._points, X_WTools, strict=True)
            ]
            pairs = [
                (i, j)
                for j in range(len(outlines))
                for i in range(j)
                if (outlines[i] ^ outlines[j]).area() > 1e-5
            ]
            return len(pairs) >= (
                len(outlines) // 2 if self._kind == "crossed" else len(outlines) > 1
            )
        return self._kind != "touching" or self._is_graspable(X_WTools)

    def _is_graspable(self, X_WTools: Sequence[RigidTransform]) -> bool:
        """Whether the tools can be picked one after another, near their annotated grasps."""
        left = list(range(len(self._grasps)))
        p_WKit = self._drawn.X_WKit.multiply(surface_of_box(self._kit_size).T).T
        points = [X.multiply(p.T).T for p, X in zip(self._spread, X_WTools, strict=True)]
        while left:
            free = [
                index
                for index in left
                if self._is_free(
                    index, X_WTools[index], [points[i] for i in left if i != index], p_WKit
                )
            ]
            if not free:
                return False
            left.remove(free[0])
        return True

    def _is_free(
        self,
        index: int,
        X_WT: RigidTransform,
        others: Sequence[NDArray[np.float64]],
        p_WKit: NDArray[np.float64],
    ) -> bool:
        around = np.concatenate([p_WKit, *others])
        grasps = self._grasps[index]
        best = grasps[0]
        return any(
            not in_the_way(
                around,
                gripper_pose(X_WT, grasp),
                max(grasp.surface_height - 0.018, 0.0015),
                (grasp.width / 2, MAX_OPENING / 2),
            )
            for grasp in grasps
            if math.hypot(grasp.x - best.x, grasp.y - best.y) < _NEAR_GRASP
        )
