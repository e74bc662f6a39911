"""Checks whether the waiting hand hides part of the table from a camera."""

import itertools

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform, RollPitchYaw

from kitting_drake.scenario.cameras import Camera, camera_pose, depth_camera
from kitting_drake.scenario.schema import Scenario
from systems.hand_geometry import FINGERTIP_DISTANCE, PALM_SIZE
from systems.signals import PixelGrid

_YAWS = np.deg2rad([0.0, 45.0, 90.0, 135.0])
_PLACES = 9
"""Number of waiting positions to check along the workspace's y axis, because the hand may wait at
any y."""


def hidden_table_note(scenario: Scenario) -> str | None:
    """A warning if the waiting hand hides part of the workspace from a camera; else None.

    Unless another camera sees the hidden part, it is a hole in o_t.
    """
    grid = scenario.heightmap.grid()
    p_WPoints = _waiting_hand(scenario.planner.home, grid)
    names = [name for name, config in scenario.cameras.items() if _hides(p_WPoints, config, grid)]
    if not names:
        return None
    which = f"camera {names[0]}" if len(names) == 1 else f"cameras {', '.join(names)}"
    return (
        f"where the hand waits (planner.home) it hides part of the table from {which}: choose "
        "another home, such as [-0.4, 0, 0.4, 0]"
    )


def _waiting_hand(home: list[float], grid: PixelGrid) -> NDArray[np.float64]:
    """(n, 3) points of boxes around the hand, at all waiting positions, in the world, in metres."""
    half_x, half_y = PALM_SIZE[0] / 2, PALM_SIZE[1] / 2
    p_GPoints = np.stack(
        np.meshgrid(
            np.linspace(-half_x, half_x, 3),
            np.linspace(-half_y, half_y, 5),
            np.linspace(0.0, FINGERTIP_DISTANCE, 4),
        ),
        axis=-1,
    ).reshape(-1, 3)
    x, y, z, yaw = home
    found = []
    for at_y, turn in itertools.product([y, *np.linspace(grid.y_min, grid.y_max, _PLACES)], _YAWS):
        X_WG = RigidTransform(RollPitchYaw(0, 0, yaw + turn), [x, at_y, z])
        found.append(X_WG.multiply(p_GPoints.T).T)
    return np.concatenate(found)


def _hides(p_WPoints: NDArray[np.float64], camera: Camera, grid: PixelGrid) -> bool:
    """Whether any of the points hides a part of the workspace from a camera."""
    X_WC = camera_pose(camera)
    lens = depth_camera(camera, "").core().intrinsics()
    x, y, z = X_WC.inverse().multiply(p_WPoints.T)
    ahead = z > 0.01
    depth = np.where(ahead, z, 1.0)
    u = lens.focal_x() * x / depth + lens.center_x()
    v = lens.focal_y() * y / depth + lens.center_y()
    in_image = ahead & (u > 0) & (u < lens.width()) & (v > 0) & (v < lens.height())
    p_WC = X_WC.translation()
    rays = p_WPoints - p_WC
    # Intersect each downward ray with the table.
    down = in_image & (rays[:, 2] < -1e-6)
    along = (grid.z_min - p_WC[2]) / np.where(down, rays[:, 2], -1.0)
    p_WTable = p_WC + along[:, np.newaxis] * rays
    return bool(grid.contains(p_WTable[down & (along > 1), :2]).any())
