"""Draws cameras at random poses, such as people would choose."""

import math

import numpy as np

from kitting_drake.scenario.cameras import Camera, LookAt

_COUNTS = (0.5, 0.25, 0.25)
"""The shares of scenes with one, two and three cameras."""
_STEEPEST = 60.0
"""The largest angle between a viewing direction and straight down, in degrees."""
_DISTANCE = (0.65, 1.1)
"""The range of the distance from a camera to the point that it looks at, in metres."""
_MIDDLE = (0.5, 0.0)
"""The middle (x, y) of the workspace, in metres."""
_ASIDE = (0.08, 0.15)
"""The largest distances, along x and y in metres, from the workspace's middle to the point that a
camera looks at."""
_FOCAL = (430.0, 620.0)
"""The range of the focal lengths, in pixels, for images of 640 x 480 pixels."""


def draw_views(rng: np.random.Generator) -> dict[str, Camera]:
    """Draws one to three cameras of 640 x 480 pixels that look at the workspace.

    Args:
        rng: the generator of all random draws.
    """
    count = 1 + int(rng.choice(len(_COUNTS), p=_COUNTS))
    return {f"camera_{number}": _draw_view(rng) for number in range(count)}


def _draw_view(rng: np.random.Generator) -> Camera:
    # Draw the direction uniformly on the sphere, but never exactly straight down, where the
    # camera's upright direction is undefined.
    steepest = math.cos(math.radians(_STEEPEST))
    slant = math.acos(rng.uniform(steepest, math.cos(math.radians(2.0))))
    azimuth, distance = rng.uniform(0, math.tau), rng.uniform(*_DISTANCE)
    target = np.array([*_MIDDLE, 0.0])
    target[:2] += rng.uniform(-1, 1, 2) * _ASIDE
    away = np.array(
        [
            math.sin(slant) * math.cos(azimuth),
            math.sin(slant) * math.sin(azimuth),
            math.cos(slant),
        ]
    )
    return LookAt(
        position=(target + distance * away).tolist(),
        target=target.tolist(),
        focal_length=float(rng.uniform(*_FOCAL)),
    )
