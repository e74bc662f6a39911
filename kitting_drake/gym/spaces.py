"""Gymnasium spaces of observations and actions, and their conversion to the systems' signals."""

import math
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import ArrayLike, NDArray

from kitting_drake.scenario.schema import Scenario
from systems.signals import Observation, PickPlaceAction, PixelGrid, PlanarPose

ACTION = ("pick_x", "pick_y", "pick_theta", "place_x", "place_y", "place_theta", "stop")
"""The entries of an action: the gripper's poses in the world, in metres and radians, and `stop`
from 0 to 1. If `stop` is above `STOP`, the episode ends."""
STOP = 0.95
"""An action stops the episode if its `stop` is above this. The value is close to 1, so that a
random agent seldom stops."""
_ANGLES = [2, 5]


def action_space(grid: PixelGrid) -> spaces.Box:
    """Returns the space of actions: (7,) float64 with the entries `ACTION`, whose positions lie in
    the workspace and whose angles lie in [-pi, pi]."""
    low, high = (grid.x_min, grid.y_min, -math.pi), (grid.x_max, grid.y_max, math.pi)
    return spaces.Box(np.array([*low, *low, 0.0]), np.array([*high, *high, 1.0]), dtype=np.float64)


def observation_space(scenario: Scenario, *, cameras: bool) -> spaces.Dict:
    """Returns the space of observations, which are dicts with these keys, as in `Observation`:

    - `colour` (rows, cols, 3);
    - `height` (rows, cols), in metres above `heightmap.z_min`, by default the table;
    - `valid` and `in_view` (rows, cols);
    - `edge_height` (rows, cols), in metres like `height`;
    - `cameras`, if requested: for each camera `colour` (height, width, 3), and `depth` (height,
      width) in metres. Depth is 0 for points that are too near, and infinite for points too far.
    """
    grid = scenario.heightmap.grid()
    depth_range = grid.z_max - grid.z_min
    parts: dict[str, spaces.Space[Any]] = {
        "colour": spaces.Box(0, 255, (*grid.shape, 3), np.uint8),
        "height": spaces.Box(0.0, float(np.float32(depth_range)), grid.shape, np.float32),
        "valid": spaces.MultiBinary(grid.shape),
        "in_view": spaces.MultiBinary(grid.shape),
        "edge_height": spaces.Box(0.0, float(np.float32(depth_range)), grid.shape, np.float32),
    }
    if cameras:
        images: dict[str, spaces.Space[Any]] = {
            name: spaces.Dict(
                {
                    "colour": spaces.Box(0, 255, (item.height, item.width, 3), np.uint8),
                    "depth": spaces.Box(0.0, math.inf, (item.height, item.width), np.float32),
                }
            )
            for name, item in scenario.cameras.items()
        }
        parts["cameras"] = spaces.Dict(images)
    return spaces.Dict(parts)


def as_arrays(observation: Observation) -> dict[str, NDArray[Any]]:
    """Converts the observation o_t to arrays, with colours rounded to 8 bits."""
    colour = np.rint(255 * np.moveaxis(observation.rgb, 0, -1)).astype(np.uint8)
    return {
        "colour": colour,
        "height": observation.height.copy(),
        "valid": observation.valid.astype(np.int8),
        "in_view": observation.in_view.astype(np.int8),
        "edge_height": observation.edge_height.copy(),
    }


def as_observation(arrays: dict[str, Any], grid: PixelGrid) -> Observation:
    """Converts arrays back to an observation, for policies; the inverse of `as_arrays`.

    Args:
        arrays: an environment's observation.
        grid: the pixel grid of the scenario, `environment.unwrapped.grid`.
    """
    rgb = np.moveaxis(np.asarray(arrays["colour"], np.float32) / np.float32(255), -1, 0)
    image = np.concatenate([rgb, np.asarray(arrays["height"], np.float32)[None]])
    valid, in_view = (np.asarray(arrays[name], bool) for name in ("valid", "in_view"))
    edge_height = np.asarray(arrays["edge_height"], np.float32)
    return Observation(image, grid, valid, in_view, edge_height)


def as_action(values: ArrayLike, grid: PixelGrid) -> PickPlaceAction:
    """Converts seven numbers to an action. Positions are clipped to the workspace.

    Raises:
        ValueError: the shape is not (7,), or a number is not finite.
    """
    array = np.asarray(values, dtype=np.float64)
    if array.shape != (len(ACTION),):
        raise ValueError(f"an action must have the shape ({len(ACTION)},), not {array.shape}")
    for name, value in zip(ACTION, array, strict=True):
        if not math.isfinite(value):
            raise ValueError(f"{name} of an action must be a finite number, not {value}")
    space = action_space(grid)
    held = np.clip(array, space.low, space.high)
    # Angles are equivalent modulo 2 pi, so do not clip them.
    held[_ANGLES] = array[_ANGLES]
    pick, place = PlanarPose(*held[:3].tolist()), PlanarPose(*held[3:6].tolist())
    return PickPlaceAction(pick, place, stop=bool(array[6] > STOP))


def as_values(action: PickPlaceAction) -> NDArray[np.float64]:
    """Converts a policy's action to the numbers (7,) of an environment's action; the inverse of
    `as_action`.

    Raises:
        ValueError: the action presses, which environments do not support.
    """
    if action.press:
        raise ValueError("environments do not support actions that press: use another policy")
    return np.array([*action.pick.as_array(), *action.place.as_array(), float(action.stop)])
