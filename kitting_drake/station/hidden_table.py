"""Checks whether the cameras see the table, and whether the waiting robot hides part of it."""

import itertools

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform, RollPitchYaw

from kitting_drake.scenario.cameras import Camera, camera_pose, depth_camera
from kitting_drake.scenario.robots import FrankaArm
from kitting_drake.scenario.schema import Scenario
from systems.arm_collisions import link_points
from systems.arm_limits import ARM_LIMITS
from systems.arm_motion import ArmMotion
from systems.hand_geometry import (
    FINGER_DEPTH,
    FINGER_LENGTH,
    FINGERTIP_DISTANCE,
    MAX_OPENING,
    PALM_HEIGHT,
    PALM_SIZE,
)
from systems.signals import PixelGrid

_YAWS = np.deg2rad([0.0, 45.0, 90.0, 135.0])
"""Yaws at which the waiting hand is checked, relative to the yaw of the home pose, in rad."""
_PLACES = 9
"""The hand may wait at any y of the workspace. This many values of y are checked, besides that of
the home pose."""
_GRID = 100
"""Number of points to check along each side of the workspace."""
_BORDER = 0.015
"""The workspace's border, of this width in m, may be hidden: it is too narrow for an object."""


def hidden_table_note(scenario: Scenario) -> str | None:
    """Returns a warning if no camera looks at the workspace, or if the waiting robot hides part of
    it from a camera; else None.

    Unless another camera sees the hidden part, it is a hole in the observation o_t.

    Raises:
        ValueError: an arm cannot reach the home pose.
    """
    grid = scenario.heightmap.grid()
    cameras = scenario.cameras.values()
    if cameras and not any(_looks_at(grid, camera) for camera in cameras):
        return "the cameras see 0 % of the workspace: turn them towards the table"
    x, y, z, yaw = scenario.planner.home
    along_y = [y, *np.linspace(grid.y_min, grid.y_max, _PLACES).tolist()]
    robot, arm = scenario.robot, np.empty((0, 3))
    who, advice = "hand", "choose another home, such as [-0.4, 0, 0.4, 0]"
    if isinstance(robot, FrankaArm):
        who, advice = "arm", "choose another home, or place the camera elsewhere"
        z = min(z, robot.highest_wait)
        arm = _waiting_arm(scenario, robot, along_y)
    p_WPoints = np.concatenate([_waiting_hand((x, z, yaw), along_y), arm])
    names = [name for name, config in scenario.cameras.items() if _hides(p_WPoints, config, grid)]
    if not names:
        return None
    which = f"camera {names[0]}" if len(names) == 1 else f"cameras {', '.join(names)}"
    return f"where the {who} waits (planner.home) it hides part of the table from {which}: {advice}"


def _waiting_hand(home: tuple[float, float, float], along_y: list[float]) -> NDArray[np.float64]:
    """Returns points (n, 3) of boxes around the waiting hand, in the world, in metres.

    Args:
        home: x, z and yaw of the home pose, in m and rad.
        along_y: the values of y at which the hand may wait, in m.
    """
    palm = _box(PALM_SIZE, PALM_HEIGHT, FINGERTIP_DISTANCE)
    fingers = _box((FINGER_LENGTH, MAX_OPENING + 2 * FINGER_DEPTH), 0.0, PALM_HEIGHT)
    p_GPoints = np.concatenate([palm, fingers])
    x, z, yaw = home
    found = []
    for y, turn in itertools.product(along_y, _YAWS):
        X_WG = RigidTransform(RollPitchYaw(0, 0, yaw + turn), [x, y, z])
        found.append(X_WG.multiply(p_GPoints.T).T)
    return np.concatenate(found)


def _box(size: tuple[float, float], low: float, high: float) -> NDArray[np.float64]:
    """Returns points (n, 3) of a box between two heights, around the z axis, in m."""
    x, y = size
    axes = np.linspace(-x / 2, x / 2, 3), np.linspace(-y / 2, y / 2, 5), np.linspace(low, high, 3)
    return np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 3)


def _waiting_arm(scenario: Scenario, robot: FrankaArm, along_y: list[float]) -> NDArray[np.float64]:
    """Returns points (n, 3) of a waiting arm's links, in the world, in metres."""
    motion = ArmMotion(
        scenario.planner,
        ARM_LIMITS[robot.model],
        robot.arm_base(),
        highest_wait=robot.highest_wait,
    )
    postures = [motion.waiting_joints(y, motion.home_joints, surface=0.0) for y in along_y]
    return np.concatenate([link_points(q, robot.arm_base()) for q in postures])


def _looks_at(grid: PixelGrid, camera: Camera) -> bool:
    """Whether any part of the workspace is in a camera's image."""
    x, y = np.meshgrid(
        np.linspace(grid.x_min, grid.x_max, _GRID), np.linspace(grid.y_min, grid.y_max, _GRID)
    )
    p_WTable = np.stack([x.ravel(), y.ravel(), np.full(x.size, grid.z_min)], axis=1)
    return bool(_is_in_image(p_WTable, camera).any())


def _is_in_image(p_WPoints: NDArray[np.float64], camera: Camera) -> NDArray[np.bool_]:
    """Whether each of the points (n, 3) is in a camera's image."""
    X_WC = camera_pose(camera)
    lens = depth_camera(camera, "").core().intrinsics()
    x, y, z = X_WC.inverse().multiply(p_WPoints.T)
    ahead = z > 0.01
    depth = np.where(ahead, z, 1.0)
    u = lens.focal_x() * x / depth + lens.center_x()
    v = lens.focal_y() * y / depth + lens.center_y()
    return ahead & (u > 0) & (u < lens.width()) & (v > 0) & (v < lens.height())


def _hides(p_WPoints: NDArray[np.float64], camera: Camera, grid: PixelGrid) -> bool:
    """Whether any of the points hides a part of the workspace from a camera."""
    in_image = _is_in_image(p_WPoints, camera)
    p_WC = camera_pose(camera).translation()
    rays = p_WPoints - p_WC
    # Intersect each downward ray with the table.
    down = in_image & (rays[:, 2] < -1e-6)
    along = (grid.z_min - p_WC[2]) / np.where(down, rays[:, 2], -1.0)
    p_WTable = p_WC + along[:, np.newaxis] * rays
    x, y, _ = p_WTable[down & (along > 1)].T
    inside_x = (x > grid.x_min + _BORDER) & (x < grid.x_max - _BORDER)
    inside_y = (y > grid.y_min + _BORDER) & (y < grid.y_max - _BORDER)
    return bool((inside_x & inside_y).any())
